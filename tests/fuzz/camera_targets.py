"""Readers of calibrated cameras and of what detectors say, and small sound files for them."""

import io
import json
import pickle
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
from target import Target


def camera_makers() -> tuple[Callable[[Path], list[Target]], ...]:
    """What makes the targets, each in a folder of its own."""
    return _calibrations, _detections, _stream, _known


def _read_calibration(path: Path) -> None:
    from habitus.io.cameras.read import read_calibration

    rig = read_calibration(path)
    assert 1 <= len(rig.cameras) <= 200 and len(set(rig.names)) == len(rig.names)
    assert all(text.isprintable() and len(text) < 500 for text in (*rig.names, *rig.notes))
    for camera in rig.cameras:
        numbers = [*camera.focal, *camera.centre, *camera.translation, *camera.distortion]
        assert np.isfinite(numbers).all() and np.abs(numbers).max() <= 2e6
        assert 0 < camera.width < 100_000 and 0 < camera.height < 100_000
        turn = camera.rotation
        assert np.abs(turn @ turn.T - np.eye(3)).max() < 1e-6 and np.linalg.det(turn) > 0.0


_TOML = """\
[cam_01]
name = "cam_01"
size = [ 640.0, 480.0]
matrix = [ [ 500.0, 0.0, 320.0], [ 0.0, 500.0, 240.0], [ 0.0, 0.0, 1.0]]
distortions = [ -0.05, 0.02, 0.001, 0.0]
rotation = [ 0.1, 1.2, -0.4]
translation = [ 0.3, 0.9, 2.8]
fisheye = false

[metadata]
error = 0.0
"""
_QUALISYS = """\
<?xml version='1.0'?>
<calibration><cameras><camera serial="1"><fov_video bottom="479" left="0" right="639" top="0"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1" x="100" y="200"
 z="300"/><intrinsic centerPointU="20480" centerPointV="15360" focalLengthU="32000"
 focalLengthV="32000" radialDistortion1="-.05" radialDistortion2=".1" radialDistortion3="0"
 tangentalDistortion1="0" tangentalDistortion2="0"/></camera></cameras></calibration>
"""
_VICON = """\
<Cameras><Camera USERID="1" SENSOR_SIZE="640 480" PIXEL_ASPECT_RATIO="1"><KeyFrames>
<KeyFrame FOCAL_LENGTH="500" ORIENTATION="0 0 0 1" POSITION="100 200 300" PRINCIPAL_POINT="320 240"
 VICON_RADIAL2="ViconRadial2 320 240 1e-8 1e-14 0"/></KeyFrames></Camera></Cameras>
"""
_MATRIX = "!!opencv-matrix {{rows: {0}, cols: {1}, dt: d, data: [ {2} ]}}"


def _yaml() -> tuple[str, str, str]:
    k = _MATRIX.format(3, 3, "500., 0., 320., 0., 500., 240., 0., 0., 1.")
    turn = _MATRIX.format(3, 3, "1., 0., 0., 0., 1., 0., 0., 0., 1.")
    place, lens = _MATRIX.format(3, 1, "0., 1., 3."), _MATRIX.format(1, 5, "0., 0., 0., 0., 0.")
    head = "%YAML:1.0\n---\n"
    names = 'names:\n  - "01"\n'
    inner = f"{head}{names}K_01: {k}\ndist_01: {lens}\nW_01: 640\nH_01: 480\n"
    outer = f"{head}{names}Rot_01: {turn}\nT_01: {place}\n"
    plain = (
        f"{head}image_width: 640\nimage_height: 480\ncamera_matrix: {k}\n"
        f"distortion_coefficients: {lens}\nR: {turn}\nT: {place}\n"
    )
    return inner, outer, plain


def _calibrations(folder: Path) -> list[Target]:
    inner, outer, plain = _yaml()
    opencap = {
        "intrinsicMat": np.diag([500.0, 500.0, 1.0]),
        "distortion": np.zeros((1, 5)),
        "rotation": np.eye(3),
        "translation": np.array([[0.0], [100.0], [3000.0]]),
        "imageSize": np.array([[480.0], [640.0]]),
    }
    files = {
        "calibration.toml": _TOML.encode(),
        "calibration.qca.txt": _QUALISYS.encode(),
        "calibration.xcp": _VICON.encode(),
        "calibration.yml": plain.encode(),
        "calibration.pickle": pickle.dumps(opencap, protocol=4),
    }
    single = [
        Target(name, ({name: content},), name, _read_calibration) for name, content in files.items()
    ]
    both = {"set/intri.yml": inner.encode(), "set/extri.yml": outer.encode()}
    return [*single, Target("easymocap folder", (both,), "set", _read_calibration)]


def _read_detections(path: Path) -> None:
    from habitus.io.keypoints.read import read_detections

    found = read_detections(path, 60.0)
    frames, cameras, people, points = found.confidence.shape
    assert min(frames, cameras, people, points) > 0 and found.pixels.shape == (
        *found.confidence.shape, 2,
    )  # fmt: skip
    assert len(found.names) == points and len(found.cameras) == cameras
    seen = found.confidence > 0.0
    assert np.isfinite(found.confidence).all() and found.confidence.max() <= 1.0
    assert np.isfinite(found.pixels[seen]).all() and np.abs(found.pixels[seen]).max() <= 2e6
    told = (found.name, *found.names, *found.cameras, *found.notes)
    assert all(text.isprintable() and len(text) < 500 for text in told)


def _detections(folder: Path) -> list[Target]:
    from habitus.body.keypoints import CONVENTIONS

    rng = np.random.default_rng(0)
    names = CONVENTIONS["coco17"]
    heights = {"nose": 60, "eye": 55, "ear": 58, "shoulder": 100, "elbow": 150, "wrist": 195,
               "hip": 200, "knee": 290, "ankle": 370}  # fmt: skip
    across = {"nose": 0, "eye": 6, "ear": 12, "shoulder": 35, "elbow": 45, "wrist": 50, "hip": 20,
              "knee": 22, "ankle": 24}  # fmt: skip
    row = np.array(
        [
            [300 + across[name.rpartition("_")[2]] * (-1 if name.startswith("right") else 1),
             heights[name.rpartition("_")[2]], 0.8]
            for name in names
        ]
    )  # fmt: skip
    flat = row.ravel().round(2).tolist()
    frame = json.dumps({"people": [{"pose_keypoints_2d": flat}]}).encode()
    openpose = {f"set/cam{c}_json/f.{t}.json": frame for c in (1, 2) for t in range(2)}
    mmpose = {
        "meta_info": {"keypoint_id2name": {str(k): name for k, name in enumerate(names)}},
        "instance_info": [
            {"frame_id": 0, "instances": [
                {"keypoints": row[:, :2].tolist(), "keypoint_scores": row[:, 2].tolist()}]}
        ],
    }  # fmt: skip
    alphapose = [{"image_id": f"{t}.jpg", "keypoints": flat, "score": 2.0} for t in range(2)]
    heads = ["scorer", "bodyparts", "coords"]
    cells = [("net", name, axis) for name in names for axis in ("x", "y", "likelihood")]
    lines = [",".join([head, *[cell[k] for cell in cells]]) for k, head in enumerate(heads)]
    lines.append(",".join(["0", *map(str, flat)]))
    nodes = ["track", "frame_idx", "instance.score"]
    nodes += [f"{name}.{part}" for name in names for part in ("x", "y", "score")]
    seen = ",".join(map(str, flat))
    stream = io.BytesIO()
    np.save(stream, rng.uniform(0, 500, (2, 3, 33, 2)))
    packed = io.BytesIO()
    np.savez(packed, pred_keypoints_2d=rng.uniform(0, 500, (70, 2)).astype(np.float32))
    frames = {f"set/cam{c}/{t}.npz": packed.getvalue() for c in (1, 2) for t in range(2)}
    single = {
        "detections.json": json.dumps(mmpose).encode(),
        "list.json": json.dumps(alphapose).encode(),
        "detections.csv": "\n".join(lines).encode(),
        "sleap.csv": "\n".join([",".join(nodes), *(f"a,{t},.9,{seen}" for t in range(3))]).encode(),
        "detections.npy": stream.getvalue(),
    }
    return [
        Target("openpose folder", (openpose,), "set", _read_detections, 2),
        Target("sam3d keypoints folder", (frames,), "set", _read_detections, 2),
        *(Target(name, ({name: c},), name, _read_detections) for name, c in single.items()),
    ]


def _read_lines(path: Path) -> None:
    """Datagrams of detectors, as they come over the wire; what cannot be used is counted."""
    from habitus.io.streams.detections import MAX_PEOPLE, DetectionStream

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        port = udp.getsockname()[1]
    stream = DetectionStream(("cam1", "cam2"), f"127.0.0.1:{port}", 50.0)
    try:
        for packet in path.read_bytes().split(b"\0"):
            stream.take(packet, 0.0)
            for frame in stream.poll(0.0):
                assert frame.points.shape == (len(frame.heading.labels), 3)
                seen = np.isfinite(frame.points)
                assert (seen.all(1) | ~seen.any(1)).all() and len(seen) % MAX_PEOPLE == 0
                assert np.abs(frame.points[seen.all(1), :2]).max(initial=0.0) <= 2e6
        assert len(str(stream.skipped)) < 1000
    finally:
        stream.close()


def _stream(folder: Path) -> list[Target]:
    packets = [
        json.dumps(
            {"camera": camera, "frame": t, "convention": "coco17"}
            | ({"people": [[[3, 4.5, 0.9]] * 17] * 2} if t % 2 else {"keypoints": []})
        ).encode()
        for t in range(4)
        for camera in ("cam1", "cam2")
    ]
    return [Target("detection lines", ({"lines": b"\0".join(packets)},), "lines", _read_lines, 8)]


def _read_known(path: Path) -> None:
    from habitus.io.keypoints.fits import read_camera_fit

    fit = read_camera_fit(path)
    assert np.isfinite(fit.betas).all() and np.isfinite(fit.keypoint_places).all()
    assert fit.confidence.shape[1:] == (len(fit.cameras.names), len(fit.keypoint_names))
    assert all(text.isprintable() for text in (*fit.keypoint_names, *fit.cameras.names))


def _known(folder: Path) -> list[Target]:
    packed = io.BytesIO()
    np.savez(
        packed,
        poses=np.zeros((2, 72)), trans=np.zeros((2, 3)), betas=np.zeros(10), mocap_framerate=50.0,
        surface_model_type="default", up_axis="+y", convention="coco17",
        keypoint_names=np.array(["nose", "left_hip"]), camera_names=np.array(["a", "b"]),
        keypoints_observed=np.ones((2, 2, 2, 2)), keypoints_confidence=np.ones((2, 2, 2)),
        keypoint_places=np.zeros((2, 3)), camera_focal=np.ones((2, 2)),
        camera_centre=np.ones((2, 2)), camera_rotation=np.stack([np.eye(3)] * 2),
        camera_translation=np.ones((2, 3)), camera_corrections=np.zeros((2, 6)),
    )  # fmt: skip
    return [Target("camera fit.npz", ({"body.npz": packed.getvalue()},), "body.npz", _read_known)]
