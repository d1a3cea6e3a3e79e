"""Readers of what sensors saw: scans, folders of depth images, cameras, keypoints, streams; and the
layouts that are no TOML.
"""

import base64
import io
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from queue import SimpleQueue

import numpy as np
from target import Target, alone, tree_of


def sensor_makers() -> tuple[Callable[[Path], list[Target]], ...]:
    """What makes the targets, each in a folder of its own."""
    return _scans, _depth_folders, _descriptions, _streams, _lists


# -- scans -----------------------------------------------------------------------------------------


def _read_scan(path: Path) -> None:
    from habitus.io.scans import read_scan

    scan = read_scan(path)
    assert len(scan.points) and np.isfinite(scan.points).all()
    assert np.abs(scan.points).max() <= 1e9 and scan.name.isprintable()
    if scan.faces is not None:
        assert scan.faces.min() >= 0 and scan.faces.max() < len(scan.points)
    if scan.normals is not None:
        assert scan.normals.shape == scan.points.shape and np.isfinite(scan.normals).all()
    if scan.colours is not None:
        assert scan.colours.shape == scan.colour_places.shape
        assert np.isfinite(scan.colours).all() and np.isfinite(scan.colour_places).all()


def _picture(width: int = 8, height: int = 6, mode: str = "RGB", kind: str = "PNG") -> bytes:
    from PIL import Image

    shape = (height, width) if mode in ("L", "I;16", "F") else (height, width, len(mode))
    dtype = {"I;16": np.uint16, "F": np.float32}.get(mode, np.uint8)
    values = (
        1500 + np.arange(np.prod(shape)) % 700
        if mode in ("I;16", "F")
        else np.arange(np.prod(shape)) % 251
    )
    stream = io.BytesIO()
    Image.fromarray(values.reshape(shape).astype(dtype)).save(stream, kind)
    return stream.getvalue()


def _scans(folder: Path) -> list[Target]:
    import trimesh
    from PIL import Image

    from habitus.mesh.shapes import icosphere

    shape = icosphere(0)
    vertices, faces = shape.vertices.numpy(), shape.faces.numpy()
    colours = (np.arange(4 * len(vertices)).reshape(-1, 4) % 255).astype(np.uint8)
    plain = trimesh.Trimesh(vertices, faces, process=False)
    coloured = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    image = Image.open(io.BytesIO(_picture()))
    uv = np.linspace(0.0, 1.0, 2 * len(vertices)).reshape(-1, 2)
    visual = trimesh.visual.TextureVisuals(uv=uv, image=image)
    textured = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
    cloud = trimesh.PointCloud(vertices, colours)
    header = "ply\nformat ascii 1.0\nelement vertex 12\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
    )
    rows = "\n".join(" ".join(f"{x:.4f}" for x in (*row, *row)) for row in vertices)
    scene = trimesh.Scene()
    for k, part in enumerate((coloured, textured)):
        scene.add_geometry(part, transform=np.diag([1.0, (-1.0) ** k, 1.0, 1.0]))
    ply = [trimesh.exchange.ply.export_ply(coloured, encoding=kind) for kind in ("binary", "ascii")]
    ply += [trimesh.exchange.ply.export_ply(textured), cloud.export(file_type="ply")]
    ply.append(f"{header}end_header\n{rows}\n".encode())
    obj = [
        _beside(folder / "obj", textured, "a.obj"),
        {"a.obj": coloured.export(file_type="obj").encode()},
    ]
    files = scene.export(file_type="gltf")
    named = {"a.gltf" if name == "model.gltf" else name: content for name, content in files.items()}
    whole = json.loads(named["a.gltf"])
    for one in whole["buffers"] + whole.get("images", []):
        if "uri" in one:
            one["uri"] = "data:;base64," + base64.b64encode(named[one["uri"]]).decode()
    gltf = [named, {"a.gltf": json.dumps(whole, indent=1).encode()}]
    stl = [
        trimesh.exchange.stl.export_stl(plain),
        trimesh.exchange.stl.export_stl_ascii(plain).encode(),
    ]
    xyz = "\n".join(" ".join(map(str, row)) for row in vertices)
    return [
        alone("scan.ply", _read_scan, *ply),
        Target("scan.obj", tuple(obj), "a.obj", _read_scan, 1),
        alone(
            "scan.glb",
            _read_scan,
            scene.export(file_type="glb"),
            cloud.scene().export(file_type="glb"),
        ),
        Target("scan.gltf", tuple(gltf), "a.gltf", _read_scan, 2),
        alone("scan.stl", _read_scan, *stl),
        alone("scan.off", _read_scan, trimesh.exchange.off.export_off(plain).encode()),
        alone("scan.xyz", _read_scan, xyz.encode()),
    ]


def _beside(folder: Path, mesh: object, name: str) -> dict[str, bytes]:
    """A mesh with its material and its picture in files of their own."""
    folder.mkdir()
    mesh.export(folder / name)
    return dict(tree_of(folder))


# -- depth folders ---------------------------------------------------------------------------------


def _finite(values: Iterable[float]) -> bool:
    return bool(np.isfinite(np.asarray(list(values), dtype=float)).all())


def _check_camera(camera) -> None:
    assert (camera.focal_length > 0).all() and _finite(camera.focal_length.tolist())
    numbers = [
        *camera.principal_point.tolist(),
        *camera.rotation.tolist(),
        *camera.translation.tolist(),
    ]
    assert _finite(numbers) and max(map(abs, numbers)) <= 1e6
    assert 1 <= camera.width <= 1e6 and 1 <= camera.height <= 1e6
    assert camera.distortion is None or _finite(camera.distortion.tolist())


def _read_views(path: Path) -> None:
    from habitus.io.rgbd.read import read_views

    capture = read_views(path)
    assert capture.name.isprintable() and 1 <= len(capture.views) <= 12
    assert all(note.isprintable() and len(note) < 500 for note in capture.notes)
    for view in capture.views:
        assert np.isfinite(view.depth).all() and (view.depth >= 0).all() and view.name.isprintable()
        assert view.depth.shape == (view.camera.height, view.camera.width)
        assert view.mask is None or view.mask.shape == view.depth.shape
        assert view.background is None or view.background.shape == view.depth.shape
        for camera in filter(None, (view.camera, view.colour_camera)):
            _check_camera(camera)
        if view.colour is not None:
            assert view.colour.shape == (view.colour_camera.height, view.colour_camera.width, 3)
        assert all(_finite(point) for point in view.keypoints.values())


_OWN = {
    "depth_scale": 0.001,
    "depth": {"width": 24, "height": 18, "fx": 30.0, "fy": 30.0, "cx": 12.0, "cy": 9.0},
    "color": {
        "width": 24, "height": 18, "model": "brown_conrady", "fx": 30, "fy": 30, "ppx": 12, "ppy": 9,
        "coeffs": [0.1, -0.2, 0.001, 0.002, 0.05],
    },
    "depth_to_color": {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0.02, 0, 0]},
}  # fmt: skip
_YAML = """\
%YAML:1.0
---
image_width: 24
image_height: 18
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 30., 0., 12., 0., 30., 9., 0., 0., 1. ]
distortion_coefficients: &lens !!opencv-matrix {rows: 1, cols: 5, dt: d, data: [ 1.e-1, -2.e-1, 0., 0., 0. ]}
again: *lens
"""


def _azure() -> dict:
    numbers = [0.5, 0.52, 0.49, 0.49, 0.5, -2.6, 1.5, 0.4, -2.4, 1.4, 0.0, 0.0, 0.0, 0.0]
    turn = {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [-0.03, 0.0, 0.0]}
    cameras = [
        {
            "Purpose": f"CALIBRATION_CameraPurpose{name}",
            "Rt": turn,
            "Intrinsics": {"ModelParameters": numbers},
        }
        for name in ("Depth", "PhotoVideo")
    ]
    return {"CalibrationInformation": {"Cameras": cameras}}


def _openpose(count: int = 25) -> dict:
    return {"people": [{"pose_keypoints_2d": [1.0, 2.0, 0.9] * count}]}


def _depth_folders(folder: Path) -> list[Target]:
    depth = _picture(24, 18, "I;16")
    own = {
        "set/depth/0.png": depth,
        "set/depth/1.png": depth,
        "set/color/0.png": _picture(24, 18),
        "set/color/1.jpg": _picture(24, 18, kind="JPEG"),
        "set/mask/0.png": _picture(24, 18, "L"),
        "set/mask/1.png": _picture(24, 18, "L"),
        "set/keypoints/0.json": json.dumps(_openpose()).encode(),
        "set/keypoints/1.json": json.dumps(_openpose()).encode(),
        "set/background/depth.png": depth,
        "set/cameras.json": json.dumps(_OWN, indent=1).encode(),
    }
    yaml = {
        "set/depth_0.tiff": _picture(24, 18, "F", "TIFF"),
        "set/depth_1.tiff": _picture(24, 18, "F", "TIFF"),
        "set/rgb_0.png": _picture(24, 18, "L"),
        "set/rgb_1.png": _picture(24, 18, "RGBA"),
        "set/camera.yaml": (_YAML + "depth_scale: 1000\n").encode(),
    }
    tum = {
        "set/depth.txt": b"# time file\n1.0 d/a.png\n2.0 d/b.png\n",
        "set/rgb.txt": b"1.01 d/c.png\n",
        "set/d/a.png": _picture(24, 18, "I;16"),
        "set/d/b.png": _picture(24, 18, "I;16"),
        "set/d/c.png": _picture(24, 18),
        "set/calibration.json": b'{"K": [30, 0, 12, 0, 30, 9, 0, 0, 1], "depth_scale": 1000}',
    }
    azure = {
        "set/depth/0.png": _picture(320, 288, "I;16"),
        "set/calibration.json": json.dumps(_azure(), indent=1).encode(),
    }
    frames = ({"a.pcd": _pcd(form)} for form in ("ascii", "binary", "binary_compressed"))
    return [
        Target("depth folder", (own, yaml, tum, azure), "set", _read_views, 3),
        Target("organised cloud", tuple(frames), "a.pcd", _read_views, 3),
    ]


def _pcd(form: str) -> bytes:
    column, row = np.meshgrid(np.arange(16.0), np.arange(12.0))
    points = np.stack([(column - 8) / 10, (row - 6) / 10, np.ones_like(row)], -1).astype("<f4")
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 16\nHEIGHT 12\n"
    header = f"{header}POINTS 192\nDATA {form}\n".encode()
    if form == "ascii":
        return header + "\n".join(map(str, points.ravel())).encode()
    if form == "binary":
        return header + points.tobytes()
    whole = points.reshape(-1, 3).T.tobytes()
    runs = [whole[k : k + 32] for k in range(0, len(whole), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    return header + np.array([len(packed), len(whole)], "<u4").tobytes() + packed


def _descriptions(folder: Path) -> list[Target]:
    from habitus.io.rgbd.cameras import read_rig
    from habitus.io.rgbd.files import read_description
    from habitus.io.rgbd.keypoints import read_keypoints

    def cameras(path: Path) -> None:
        rig = read_rig(read_description(path), "cameras", (320, 288))
        for camera in filter(None, (rig.depth, rig.colour)):
            _check_camera(camera)
        assert rig.metres is None or 0 < rig.metres < 1e3
        assert all(note.isprintable() for note in rig.notes)

    def keypoints(path: Path) -> None:
        found = read_keypoints(path)
        assert all(_finite(point) and 0 < point[2] <= 1 for point in found.values())
        assert all(abs(number) <= 1e6 + 1 for point in found.values() for number in point[:2])

    matrix = {"intrinsics": np.eye(4)[:3].tolist(), "K": np.eye(3).tolist(), "D": [0.0] * 5}
    json_files = [
        _OWN,
        _azure(),
        matrix,
        {"camera_matrix": {"data": [500, 0, 320, 0, 500, 240, 0, 0, 1]}},
    ]
    coco = {"annotations": [{"keypoints": [3, 4, 2] * 17}, {"keypoints": [0] * 51}]}
    kalibr = "cam0: &a {model: pinhole}\nfx: 500\nfy: 5.e+2\ncx: 320.5\ncy: 2.4e2\n<<: [*a, {k: [1, [2, ~]]}]\n"
    return [
        alone("cameras.json", cameras, *(json.dumps(one, indent=1).encode() for one in json_files)),
        alone("cameras.yaml", cameras, _YAML.encode(), kalibr.encode()),
        alone(
            "keypoints.json",
            keypoints,
            *(json.dumps(one, indent=1).encode() for one in (_openpose(), coco)),
        ),
    ]


# -- streams ---------------------------------------------------------------------------------------

_VERSIONS = ((2, 9), (3, 0), (4, 0), (4, 1), (4, 2))


def _natnet(path: Path) -> None:
    """A packet behind a byte that says the version; packets that cannot be read are BadPacket."""
    from habitus.io.streams import natnet_packets as natnet

    content = path.read_bytes()
    version = _VERSIONS[content[0] % len(_VERSIONS)] if content else (3, 0)
    packet = content[1:]
    labels = ("Bob:LFHD", "Bob:RFHD", "Bob:C7", "Bob:T10")
    known = natnet.Model(labels, {"Bob": (0, 4)}, {3: "Bob"})
    try:
        kind = natnet.kind_of(packet)
        if kind == natnet.FRAME:
            frame = natnet.read_frame(packet, version, known)
            assert frame.points.shape == (4, 3)
            assert (np.isfinite(frame.points).all(1) | np.isnan(frame.points).all(1)).all()
        elif kind == natnet.MODEL:
            model = natnet.read_model(packet, version)
            assert all(
                first >= 0 and first + size <= len(model.labels)
                for first, size in model.sets.values()
            )
            assert set(model.ids.values()) <= set(model.sets)
        else:
            natnet.read_server(packet)
    except natnet.BadPacket:
        pass


def _qtm(path: Path) -> None:
    """QTM's description of its markers, as it comes over the wire."""
    from habitus.io.streams import qtm

    heading = qtm._parameters(path.read_bytes(), None, "qtm")
    assert heading.rate_hz is None or 0 < heading.rate_hz < 1e6
    assert all(label.isprintable() and len(label) < 500 for label in heading.labels)


def _qtm_bytes(path: Path) -> None:
    """Bytes of a connection to QTM: frames, events, replies, in pieces."""
    from habitus.io.streams import qtm
    from habitus.io.streams.source import Skipped

    source = qtm.Qtm.__new__(qtm.Qtm)  # without a connection and its thread
    source._heading = qtm._parameters(_parameters_xml().rstrip(b"\0"), None, "qtm")
    source.skipped = Skipped()
    source._frames = SimpleQueue()
    source._describe_again = lambda: None
    source.ended = False
    protocol = qtm._checked_protocol(source._skip)(loop=object(), on_event=source._on_event)
    protocol.set_on_packet(source._on_packet)
    data = path.read_bytes()
    for start in range(0, len(data), 100):
        protocol.data_received(data[start : start + 100])
    for frame in source.poll(0):
        assert frame.points.shape == (len(frame.heading.labels), 3)
        assert (np.isfinite(frame.points).all(1) | np.isnan(frame.points).all(1)).all()


def _parameters_xml() -> bytes:
    from qtm_server import parameters

    return parameters(("LFHD", "RFHD", "C7", "T10"), 120.0).encode() + b"\0"


def _streams(folder: Path) -> list[Target]:
    from natnet_server import frame, model, server_info
    from qtm_server import SETTINGS_CHANGED, SHUTTING_DOWN
    from qtm_server import frame as qtm_frame
    from qtm_server import packet as qtm_packet

    labels = ("LFHD", "RFHD", "C7", "T10")
    points = np.arange(12.0).reshape(4, 3)
    points[2] = np.nan
    packets = [
        bytes([k]) + one
        for k, version in enumerate(_VERSIONS)
        for one in (
            frame(7, points, "Bob", version),
            model("Bob", labels, version),
            server_info(version),
        )
    ]
    stream = b"".join(
        [
            qtm_packet(1, b"QTM RT Interface connected\0"),
            *(qtm_frame(k, points) for k in range(4)),
            qtm_packet(6, bytes([SETTINGS_CHANGED])),
            qtm_packet(2, _parameters_xml()),
            qtm_frame(9, points),
            qtm_packet(4, b""),
            qtm_packet(6, bytes([SHUTTING_DOWN])),
        ]
    )
    return [
        Target("natnet", tuple({"natnet": one} for one in packets), "natnet", _natnet, 8),
        alone("qtm.xml", _qtm, _parameters_xml().rstrip(b"\0")),
        alone("qtm.stream", _qtm_bytes, stream),
    ]


# -- lists of labels -------------------------------------------------------------------------------


def _lists(folder: Path) -> list[Target]:
    from habitus.io.layouts.files import load_layout

    def read(path: Path) -> None:
        layout = load_layout(path)
        assert len(layout.markers) and all(one.label.isprintable() for one in layout.markers)
        assert all(
            label.isprintable() and why.isprintable() for label, why in layout.left_out.items()
        )

    few = ("LFHD", "RFHD", "C7", "STRN", "LASI", "RASI", "LKNE", "RKNE", "OTHER")
    bones = ("head", "head", "torso", "torso", "pelvis", "pelvis", "femur_l", "femur_r", "nothing")
    lines = "! remark\n" + "\n".join(few) + "\n[Autolabel]\nLFHD = C7\n"
    vsk = "".join(f'<Marker NAME="{label}" RADIUS="7"/>' for label in few)
    qtm = "".join(f"<Trajectory><Name>{label}</Name></Trajectory>" for label in few)
    osim = "".join(
        f'<Marker name="{label}"><socket_parent_frame>/bodyset/{bone}</socket_parent_frame>'
        f"<location>0.0{k} 0.05 -0.0{k}</location></Marker>\n"
        for k, (label, bone) in enumerate(zip(few, bones, strict=True))
    )
    return [
        alone("layout.txt", read, lines.encode(), "\t\n".join(few).encode()),
        alone(
            "layout.xml",
            read,
            f"<?xml version='1.0'?>\n<A>{vsk}</A>".encode(),
            f"<A>\n{qtm}</A>".encode(),
        ),
        Target(
            "layout.osim",
            (
                {
                    "layout.osim": f"<OpenSimDocument><MarkerSet><objects>{osim}</objects></MarkerSet></OpenSimDocument>".encode()
                },
            ),
            "layout.osim",
            read,
            1,
        ),
    ]
