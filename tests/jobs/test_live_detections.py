"""Detections of several cameras, sent over a socket, become a person in motion; cameras that are
missing, late or see somebody else are survived and said.
"""

import json
import socket
import threading
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import habitus as hb
from habitus.body.keypoints import CONVENTIONS
from habitus.body.prior import prior_of
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.io.keypoints.fits import read_camera_fit
from habitus.io.streams.detections import DetectionStream
from habitus.jobs.cameras import CameraResult, fit_cameras
from habitus.jobs.live_cameras import known_subject
from habitus.observe.camera_rig import CameraRig
from habitus.rotations import matrix_from_rotvec
from habitus_lab.population.camera_scenes import CameraScene, camera_scene, detected

RATE = 60.0
FRAMES = 150
DOCS = Path(__file__).resolve().parents[2] / "docs" / "cameras.md"


@cache
def scene(seed: int = 3, shift: float = 0.0) -> CameraScene:
    """Somebody who walks on the spot, turns and swings the arms."""
    body = hb.load_body("female")
    names = body.joint_names
    rng = np.random.default_rng(seed)
    mean = prior_of(body).for_joints(names).mean.reshape(-1, 3)
    phase = np.linspace(0.0, 4.0 * np.pi, FRAMES) + seed
    pose = np.tile(np.concatenate([np.zeros((1, 3)), mean]), (FRAMES, 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * np.sin(phase)
        pose[:, names.index(f"{side}_hip"), 0] -= 0.5 * np.maximum(swing, -0.3)
        pose[:, names.index(f"{side}_knee"), 0] += 0.6 * np.maximum(swing, 0.0)
        pose[:, names.index(f"{side}_elbow"), 1] -= sign * 0.5
        pose[:, names.index(f"{side}_shoulder"), 1] += 0.4 * swing
    pose[:, 0, 1] = 0.4 * phase
    trans = np.zeros((FRAMES, 3))
    trans[:, 0] = shift + 0.3 * np.sin(phase / 3.0)
    return camera_scene(body, pose, trans, RATE, 4, rng)


@cache
def offline() -> CameraResult:
    (fit,) = fit_cameras(scene().detections, scene().rig)
    return fit


def errors(fit, made: CameraScene, first: int = 0) -> np.ndarray:
    """Distances (m) of joints but fingers, frame by frame."""
    rows = slice(first, first + len(fit.pose))
    truth = np.asarray(made.body(made.betas, made.pose[rows], made.trans[rows]).joints)
    return np.linalg.norm(fit.joints()[:, :22] - truth[:, :22], axis=-1)


def line(made: CameraScene, t: int, c: int, **other) -> dict:
    """What a detector sends of one camera and frame."""
    detections = made.detections
    at = np.nan_to_num(detections.pixels[t, c, 0] - 0.5)
    row = np.column_stack([at, detections.confidence[t, c, 0]]).round(3)
    return {
        "camera": detections.cameras[c],
        "frame": t,
        "convention": detections.convention,
        "keypoints": row.tolist(),
        **other,
    }


def every_line(made: CameraScene) -> list[list[dict]]:
    """Of each frame the lines of its cameras."""
    return [[line(made, t, c) for c in range(4)] for t in range(made.detections.num_frames)]


def free_port() -> int:
    """Of UDP on this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        return udp.getsockname()[1]


def follow(frames: list[list[dict | bytes]], rate: float = RATE, **options):
    """`habitus.live` on a socket to which the lines are sent; the fit and what was said."""
    stream = DetectionStream(scene().rig.names, f"127.0.0.1:{free_port()}", RATE)
    done = threading.Event()
    said: list[str] = []

    def send() -> None:
        began = time.perf_counter()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            for k, lines in enumerate(frames):
                time.sleep(max(0.0, began + k / rate - time.perf_counter()))
                for each in lines:
                    packet = each if isinstance(each, bytes) else json.dumps(each).encode()
                    udp.sendto(packet, ("127.0.0.1", stream.port))
        done.wait(0.3)
        stream.ended = True

    thread = threading.Thread(target=send)
    thread.start()
    try:
        fit = hb.live(
            stream,
            fps=RATE,
            say=lambda text, mark="": said.append(text),
            **{"cameras": scene().rig, **options},
        )
    finally:
        done.set()
        thread.join()
    return fit, " | ".join(said)


def test_detections_become_a_person_in_motion(tmp_path):
    fit, said = follow(every_line(scene()), known=offline(), out=tmp_path / "out")
    assert len(fit.pose) == FRAMES and fit.up_axis == "+y"
    found, wanted = errors(fit, scene()).mean(), errors(offline(), scene()).mean()
    assert found < 1.5 * wanted
    assert fit.verdict.level == "good" and "as saved" in said
    again = read_camera_fit(tmp_path / "out")
    np.testing.assert_allclose(again.pose, fit.pose, atol=1e-6)


def test_the_shape_is_found_in_the_first_second():
    fit, said = follow(every_line(scene()), seconds=1.0)
    assert "finding the shape" in said and "shape in" in said
    assert errors(fit, scene())[70:].mean() < 1.8 * errors(offline(), scene()).mean()
    assert np.ptp(fit.body.rest_vertices(fit.betas)[:, 1]) == pytest.approx(fit.height)


def test_another_person_beside_is_left_alone():
    made = scene()
    points = made.keypoints[::-1] + np.array([0.7, 0.0, 0.4])
    rng = np.random.default_rng(1)
    names, convention = made.detections.names, made.detections.convention
    other = detected(points, names, convention, made.rig, RATE, rng)
    frames = every_line(made)
    for t, lines in enumerate(frames):
        for c, each in enumerate(lines):
            at = np.nan_to_num(other.pixels[t, c, 0] - 0.5)
            row = np.column_stack([at, other.confidence[t, c, 0]]).tolist()
            if t < 30:
                continue
            own = each.pop("keypoints")
            each["people"] = [own, row] if (t + c) % 2 else [row, own]
    fit, _ = follow(frames, known=offline())
    assert errors(fit, made).mean() < 1.6 * errors(offline(), made).mean()


def test_a_camera_that_stops_is_said_and_the_others_go_on():
    frames = [
        lines if t < 50 else lines[:2] + lines[3:] for t, lines in enumerate(every_line(scene()))
    ]
    states: list[str] = []
    fit, _ = follow(frames, known=offline(), on_status=states.append)
    assert len(fit.pose) > 120 and "Nobody is detected by cam3" in states[-1]
    assert np.isfinite(fit.observed[100:, [0, 1, 3]]).any() and not (fit.confidence[60:, 2]).any()
    assert errors(fit, scene())[:120].mean() < 1.8 * errors(offline(), scene()).mean()


def test_who_leaves_and_returns_is_followed_again():
    frames = every_line(scene())
    for lines in frames[40:85]:
        for each in lines:
            each["keypoints"] = []
    fit, said = follow(frames, known=offline())
    assert "left at 1.2 s" in said and "seen again" in said
    assert not fit.confidence[42:85].any() and fit.confidence[90:].any()
    assert errors(fit, scene())[95:].mean() < 1.8 * errors(offline(), scene()).mean()


def test_nonsense_is_counted_and_changes_nothing():
    frames = every_line(scene())
    wild = [b"", b"{", b"[1]", b"\xff\xfe", b'{"camera": "cam1"}', b"[" * 60_000, b"9" * 60_000]
    wild += [json.dumps(line(scene(), 70, 0, **other)).encode() for other in (
        {"camera": "cam9"}, {"convention": "coco17"}, {"frame": 10**12}, {"frame": "70"},
        {"frame": float("nan")}, {"keypoints": [[1, 2, 3]] * 3}, {"keypoints": "none"},
        {"people": {}}, {"frame": 3},
    )]  # fmt: skip
    frames[75] = [*wild, *frames[75]]
    fit, said = follow(frames, known=offline())
    plain, _ = follow(every_line(scene()), known=offline())
    np.testing.assert_allclose(fit.pose[:100], plain.pose[:100], atol=1e-9)  # 25 frames after it
    assert "lines that are no JSON" in said and "lines of cameras without calibration" in said
    assert any("skipped" in warning for warning in fit.warnings)


def test_another_convention_than_the_known_one_is_said():
    frames = every_line(scene())
    keep = [scene().detections.names.index(name) for name in CONVENTIONS["coco17"]]
    for lines in frames:
        for each in lines:
            rows = np.array(each["keypoints"])[keep]
            each |= {"convention": "coco17", "keypoints": rows.tolist()}
    fit, said = follow(frames, known=offline())
    assert "keypoints are coco17" in said and fit.convention == "coco17"
    assert errors(fit, scene()).mean() < 0.04


def test_the_command_reads_files_and_the_documented_sender(tmp_path, capsys):
    offline().save(tmp_path / "known")
    rows = []
    for camera in scene().rig.cameras:
        matrix = np.diag([*camera.focal, 1.0])
        matrix[:2, 2] = camera.centre - 0.5
        rows += [
            f"[{camera.name}]", f"size = [{camera.width}, {camera.height}]",
            f"matrix = {matrix.tolist()}", "distortions = [0.0, 0.0, 0.0, 0.0]",
            f"rotation = {camera.rotation.tolist()}",
            f"translation = {camera.translation.tolist()}",
        ]  # fmt: skip
    (tmp_path / "Calib.toml").write_text("\n".join(rows))
    port = free_port()
    example = DOCS.read_text().split("    import json, socket\n")[1].split("\n\n")[0]
    code = "\n".join(each[4:] for each in ("    import json, socket\n" + example).splitlines())
    assert len(code.splitlines()) == 5
    code = code.replace("5005", str(port)).replace("halpe26", scene().detections.convention)

    def detect(camera):
        for t in range(FRAMES):
            time.sleep(1.0 / RATE)
            yield np.array(line(scene(), t, camera)["keypoints"])

    def send(camera):
        time.sleep(0.5)
        own = code.replace('"cam1"', f'"cam{camera + 1}"')
        exec(own, {"detect": detect, "video": camera})

    threads = [threading.Thread(target=send, args=(camera,)) for camera in range(4)]
    for thread in threads:
        thread.start()
    words = f"live --source detections 127.0.0.1:{port} --cameras {tmp_path / 'Calib.toml'} "
    words += f"--known {tmp_path / 'known'} --fps {RATE} --stop-after 3.2 --out {tmp_path / 'take'}"
    main(words.split())
    for thread in threads:
        thread.join()
    assert "as saved" in capsys.readouterr().out
    fit = read_camera_fit(tmp_path / "take")
    assert len(fit.pose) > 100 and fit.verdict.level != "failed"


def test_what_cannot_be_is_refused():
    rig = scene().rig
    with pytest.raises(HabitusError, match="1 camera; expected two"):
        hb.live("detections", cameras=CameraRig(rig.cameras[:1]))
    with pytest.raises(HabitusError, match="without cameras"):
        hb.live("detections")
    with pytest.raises(HabitusError, match="with no other"):
        hb.live("natnet", cameras=rig)
    with pytest.raises(HabitusError, match="no such file"):
        hb.live("detections", cameras=rig, known="nowhere.npz")


def test_distorted_cameras_and_a_calibration_that_was_corrected():
    made = scene()
    lens = np.array([-0.1, 0.02, 0.001, -0.0005, 0.0, 0.0, 0.0, 0.0])
    cameras = tuple(replace(camera, distortion=lens) for camera in made.rig.cameras)
    rig = replace(made.rig, cameras=cameras)
    frames = every_line(made)[:60]
    for lines in frames:
        for camera, each in zip(cameras, lines, strict=True):
            row = np.array(each["keypoints"])
            row[:, :2] = camera.distorted(row[:, :2] + 0.5) - 0.5
            each["keypoints"] = row.tolist()
    turn, shift = np.array([0.01, -0.02, 0.0]), np.array([0.02, 0.0, 0.01])
    off = replace(rig, cameras=(cameras[0].moved(matrix_from_rotvec(turn), shift), *cameras[1:]))
    back = np.zeros((4, 6))
    back[0, :3] = -turn
    back[0, 3:] = -matrix_from_rotvec(-turn) @ shift
    corrected = replace(offline(), corrections=back)  # of `off`, to the true cameras
    subject, warnings = known_subject(corrected, off, made.detections.convention)
    np.testing.assert_allclose(subject.cameras.rotation, rig.rotation, atol=1e-9)
    np.testing.assert_allclose(subject.cameras.translation, rig.translation, atol=1e-9)
    assert not warnings
    fit, _ = follow(frames, known=corrected, cameras=off)
    np.testing.assert_allclose(fit.corrections, back, atol=1e-9)
    assert errors(fit, made).mean() < 1.7 * errors(offline(), made)[:60].mean()
