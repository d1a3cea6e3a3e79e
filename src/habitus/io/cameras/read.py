"""Reads calibrations of several cameras: a `CameraRig`.

| format | files | unit |
|---|---|---|
| Pose2Sim, Anipose (aniposelib) | .toml | m |
| Qualisys | .qca.txt, .xml | mm, 1/64 px |
| Vicon | .xcp | mm |
| EasyMocap | a folder with intri.yml and extri.yml | m |
| OpenCV | .yml, .yaml, .json: a table for each camera, or a folder with a file for each | m or mm |
| OpenCap | a folder with cameraIntrinsicsExtrinsics.pickle for each camera | mm |

Principal points and pixels of all of them count whole numbers at pixel centres; ours lie at halves.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from habitus.errors import HabitusError, listed, shown
from habitus.io.limits import Allowance, read_file, read_text_file, read_toml, read_xml
from habitus.io.models.pickled_arrays import as_array
from habitus.io.models.pickles import read_pickle
from habitus.io.names import plain_name
from habitus.io.rgbd.files import read_description
from habitus.observe.camera_rig import CameraRig, RigCamera
from habitus.rotations import matrix_from_quaternion, matrix_from_rotvec
from habitus.types import PathLike

MAX_CAMERAS = 200
MILLIMETRE = 0.001
MAX_METRES = 60.0
"""Between two cameras of one scene: beyond it numbers are millimetres."""
SUB_PIXEL = 64.0
"""Qualisys counts 64ths of a pixel."""
_NUMBER = r"[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?"
PICKLE = "cameraIntrinsicsExtrinsics.pickle"


def read_calibration(source: PathLike) -> CameraRig:
    """The cameras of a calibration file or folder. Raises HabitusError with the file named."""
    path = Path(source)
    try:
        rig = _folder(path) if path.is_dir() else _file(path)
    except OSError as error:
        raise HabitusError(
            f"{path}: {shown(error.strerror or error)}; expected a calibration of cameras"
        ) from error
    except UnicodeDecodeError as error:
        raise HabitusError(f"{path}: is no text; expected a calibration of cameras") from error
    except HabitusError as error:
        text = str(error)
        raise error if str(path) in text else HabitusError(f"{path}: {text}") from error
    return _in_metres(rig, path)


def _file(path: Path) -> CameraRig:
    ending = path.suffix.lower()
    if ending == ".toml":
        return _toml(read_toml(read_text_file(path)))
    if ending in (".xcp", ".xml") or path.name.lower().endswith(".qca.txt"):
        root = read_xml(read_text_file(path))
        return _vicon(root) if root.find(".//Camera") is not None else _qualisys(root)
    if ending in (".yml", ".yaml", ".json"):
        return _tables(read_description(path), path.stem)
    if ending == ".pickle":
        return CameraRig((_opencap(path, path.parent.name),))
    raise HabitusError(
        "an unknown kind of calibration; expected .toml (Pose2Sim, Anipose), .qca.txt (Qualisys), "
        ".xcp (Vicon), .yml (OpenCV), .pickle (OpenCap), or EasyMocap's folder"
    )


def _folder(path: Path) -> CameraRig:
    if (path / "intri.yml").is_file() and (path / "extri.yml").is_file():
        return _easymocap(
            read_description(path / "intri.yml"), read_description(path / "extri.yml")
        )
    pickles = sorted(path.glob(f"**/{PICKLE}"))[:MAX_CAMERAS]
    if pickles:
        return CameraRig(tuple(_opencap(one, one.parent.name) for one in pickles))
    single = [p for p in sorted(path.iterdir()) if p.suffix.lower() in (".toml", ".xcp")]
    single += sorted(path.glob("*.qca.txt"))
    if len(single) == 1:
        return _file(single[0])
    described = [
        p for p in sorted(path.iterdir()) if p.suffix.lower() in (".yml", ".yaml", ".json")
    ][:MAX_CAMERAS]
    if described and not single:
        cameras = [camera for p in described for camera in _file(p).cameras]
        return CameraRig(tuple(cameras))
    raise HabitusError(
        f"holds {len(single)} calibrations that are understood; expected one .toml, .qca.txt or "
        ".xcp, intri.yml with extri.yml, or a .yml or pickle for each camera"
    )


def _camera(
    name: str,
    size: Any,
    matrix: Any,
    distortion: Any,
    rotation: np.ndarray,
    translation: Any,
) -> RigCamera:
    """A checked camera. matrix: OpenCV's, its principal point at whole pixel centres."""
    try:
        width, height = (round(float(n)) for n in np.ravel(np.asarray(size, float)))
        k = np.asarray(matrix, float).reshape(3, 3)
        lens = np.zeros(8)
        given = np.ravel(np.asarray([] if distortion is None else distortion, float))
        if len(given) > 8 and not np.any(given[8:]):
            given = given[:8]
        lens[: len(given)] = given
        place = np.asarray(translation, float).reshape(3)
        turn = np.asarray(rotation, float).reshape(3, 3)
    except (TypeError, ValueError, OverflowError) as error:
        raise HabitusError(
            f"camera {shown(name, 40)}: numbers are missing or too many; expected an image size, a "
            "3 x 3 matrix, up to 8 distortion terms, a rotation and a translation"
        ) from error
    sound = (
        all(np.isfinite(each).all() for each in (k, lens, place, turn))
        and 0 < width < 100_000
        and 0 < height < 100_000
        and 1.0 < min(k[0, 0], k[1, 1]) <= max(k[0, 0], k[1, 1]) < 1e6
        and np.abs(k[0, 2]) < 1e6
        and np.abs(k[1, 2]) < 1e6
        and np.abs(place).max() < 1e6
        and np.abs(lens).max() < 1e3
    )
    if not sound:
        raise HabitusError(
            f"camera {shown(name, 40)}: numbers that no camera has (size {width} x {height}, focal "
            f"length {k[0, 0]:.4g}); expected pixels and metres"
        )
    if np.abs(turn @ turn.T - np.eye(3)).max() > 0.01 or np.linalg.det(turn) < 0.0:
        raise HabitusError(
            f"camera {shown(name, 40)}: its rotation is mirrored or scaled; expected a rotation "
            "from the world to the camera"
        )
    u, _, v = np.linalg.svd(turn)
    return RigCamera(
        plain_name(str(name)[:100]),
        width,
        height,
        np.array([k[0, 0], k[1, 1]]),
        np.array([k[0, 2], k[1, 2]]) + 0.5,
        u @ v,
        place,
        lens,
    )


def _checked_number(count: int) -> None:
    if not 0 < count <= MAX_CAMERAS:
        raise HabitusError(f"{count} cameras; expected 1 to {MAX_CAMERAS}")


def _toml(table: Mapping[str, Any]) -> CameraRig:
    """Pose2Sim's and aniposelib's table: one section a camera."""
    sections = {
        key: value
        for key, value in table.items()
        if isinstance(value, Mapping) and "matrix" in value
    }
    _checked_number(len(sections))
    cameras = []
    for key, value in sections.items():
        if value.get("fisheye") is True:
            raise HabitusError(
                f"camera {shown(key, 40)} is a fish-eye; undistort its images and calibrate anew"
            )
        turn = _rotation(value.get("rotation"))
        cameras.append(
            _camera(
                str(value.get("name", key)),
                value.get("size"),
                value["matrix"],
                value.get("distortions"),
                turn,
                value.get("translation"),
            )
        )
    return CameraRig(tuple(cameras))


def _rotation(value: Any) -> np.ndarray:
    """A rotation vector or matrix as a matrix."""
    try:
        given = np.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise HabitusError("a rotation that is no numbers; expected a vector or matrix") from error
    if given.size == 3 and np.isfinite(given).all():
        return np.asarray(matrix_from_rotvec(given.reshape(3)))
    return given.reshape(3, 3) if given.size == 9 else np.zeros((3, 3))


def _matrix(value: Any) -> np.ndarray:
    """OpenCV's matrix in YAML or JSON: nested lists, or rows, cols and data."""
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise HabitusError("a matrix that is no numbers; expected rows, cols and data") from error


def _first(table: Mapping[str, Any], *names: str) -> Any:
    return next((table[name] for name in names if name in table), None)


def _tables(table: Any, name: str) -> CameraRig:
    """OpenCV's tables, one camera each."""
    if not isinstance(table, Mapping):
        raise HabitusError("no table; expected a camera matrix, distortion, rotation, translation")
    if _first(table, "camera_matrix", "K", "matrix") is None:
        inner = {key: value for key, value in table.items() if isinstance(value, Mapping)}
        _checked_number(len(inner))
        return CameraRig(
            tuple(camera for key, value in inner.items() for camera in _tables(value, key).cameras)
        )
    size = _first(table, "size", "image_size", "imgSize")
    if size is None:
        size = [_first(table, "image_width", "width"), _first(table, "image_height", "height")]
    camera = _camera(
        str(_first(table, "name", "camera_name") or name),
        size,
        _matrix(_first(table, "camera_matrix", "K", "matrix")),
        _matrix(
            _first(table, "distortion_coefficients", "dist", "D", "distortion", "distortions") or []
        ),
        _rotation(_matrix(_first(table, "R", "rotation", "rotation_matrix", "rvec"))),
        _matrix(_first(table, "T", "t", "translation", "tvec")),
    )
    return CameraRig((camera,))


def _easymocap(inner: Any, outer: Any) -> CameraRig:
    """EasyMocap's intri.yml and extri.yml: K_name, dist_name, Rot_name or R_name, T_name."""
    if not (isinstance(inner, Mapping) and isinstance(outer, Mapping)):
        raise HabitusError("intri.yml or extri.yml holds no table; expected EasyMocap's")
    names = inner.get("names") or [key[2:] for key in inner if str(key).startswith("K_")]
    if not isinstance(names, list):
        raise HabitusError("names is no list; expected the cameras' names")
    _checked_number(len(names))
    cameras = []
    for name in map(str, names):
        k = _matrix(inner.get(f"K_{name}"))
        size = [inner.get(f"W_{name}"), inner.get(f"H_{name}")]
        if (
            None in size and k.size == 9
        ):  # older files have no size: the middle is the principal point
            size = [2.0 * k.ravel()[2], 2.0 * k.ravel()[5]]
        turn = outer.get(f"Rot_{name}", outer.get(f"R_{name}"))
        cameras.append(
            _camera(
                name,
                size,
                k,
                _matrix(inner.get(f"dist_{name}") or []),
                _rotation(_matrix(turn)),
                _matrix(outer.get(f"T_{name}")),
            )
        )
    return CameraRig(tuple(cameras))


def _opencap(path: Path, name: str) -> RigCamera:
    """OpenCap's pickle of one camera, read without running any code."""
    content = read_file(path)
    table = read_pickle(content)
    keys = ("imageSize", "intrinsicMat", "distortion", "rotation", "translation")
    if not isinstance(table, Mapping) or not set(keys) <= set(table):
        raise HabitusError(f"{path}: has not {', '.join(keys)}; expected OpenCap's camera")
    allowance = Allowance(len(content))
    size, *rest = (as_array(table[key], allowance) for key in keys)
    return _camera(name, np.ravel(size)[::-1], *rest)


def _qualisys(root: Any) -> CameraRig:
    """Qualisys' XML: places in mm, intrinsics in 64ths of a pixel. r11 to r33 take the world to the
    camera's frame, row by row.
    """
    found = root.findall(".//camera")
    _checked_number(len(found))
    cameras = []
    for k, one in enumerate(found):
        place, lens, view = one.find("transform"), one.find("intrinsic"), one.find("fov_video")
        view = one.find("fov_marker") if view is None else view
        if place is None or lens is None or view is None:
            raise HabitusError("a camera without transform, intrinsic or field of view")

        def number(element: Any, *names: str) -> float:
            text = next((element.get(name) for name in names if element.get(name)), None)
            try:
                return float(str(text)[:60])
            except ValueError as error:
                raise HabitusError(f"a camera has no number {names[0]}") from error

        turn = np.array([[number(place, f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)])
        turn = np.diag([1.0, -1.0, -1.0]) @ turn  # its cameras look along -z, y up
        at = MILLIMETRE * np.array([number(place, axis) for axis in "xyz"])
        left, top = number(view, "left"), number(view, "top")
        size = [number(view, "right") - left + 1.0, number(view, "bottom") - top + 1.0]
        matrix = np.eye(3)
        for i, axis in enumerate("UV"):
            matrix[i, i] = number(lens, f"focalLength{axis}") / SUB_PIXEL
            matrix[i, 2] = number(lens, f"centerPoint{axis}") / SUB_PIXEL - (left, top)[i]
        distortion = [
            number(lens, "radialDistortion1"),
            number(lens, "radialDistortion2"),
            number(lens, "tangentalDistortion1", "tangentialDistortion1"),
            number(lens, "tangentalDistortion2", "tangentialDistortion2"),
            number(lens, "radialDistortion3"),
        ]
        name = one.get("serial") or f"camera_{k + 1}"
        cameras.append(_camera(name, size, matrix, distortion, turn, -turn @ at))
    return CameraRig(tuple(cameras))


def _vicon(root: Any) -> CameraRig:
    """Vicon's .xcp: orientation as a quaternion (x, y, z, w) from world to camera, place in mm."""
    found = root.findall(".//Camera")
    _checked_number(len(found))
    cameras = []
    for k, one in enumerate(found):
        frame = one.find(".//KeyFrame")
        if frame is None:
            raise HabitusError("a camera without KeyFrame; expected a calibrated system")
        try:
            x, y, z, w = _floats(frame.get("ORIENTATION"), 4)
            at = MILLIMETRE * np.array(_floats(frame.get("POSITION"), 3))
            focal = float(frame.get("FOCAL_LENGTH"))
            middle = _floats(frame.get("PRINCIPAL_POINT"), 2)
            aspect = float(one.get("PIXEL_ASPECT_RATIO") or 1.0)
            size = _floats(one.get("SENSOR_SIZE"), 2)
            radial = [float(n) for n in re.findall(_NUMBER, frame.get("VICON_RADIAL2") or "")]
            k1, k2 = np.clip(radial[3:5] if len(radial) >= 5 else [0.0, 0.0], -1.0, 1.0)
            sane = all(abs(n) < 1e6 for n in (*middle, *size, focal)) and aspect > 1e-3
            if not sane:
                raise ValueError
        except (TypeError, ValueError) as error:
            raise HabitusError(
                "a camera without orientation, position, focal length or size; expected .xcp"
            ) from error
        quaternion = np.array([w, x, y, z])
        turn = np.asarray(
            matrix_from_quaternion(quaternion / max(1e-12, float(np.linalg.norm(quaternion))))
        )
        matrix = np.array([[focal, 0, middle[0]], [0, focal / aspect, middle[1]], [0, 0, 1.0]])
        # Vicon's radial terms count pixels from the measured point to the ideal one; to first order
        # OpenCV's go the other way.
        distortion = [-k1 * focal**2, (3.0 * k1**2 - k2) * focal**4]
        name = one.get("USERID") or one.get("DEVICEID") or str(k + 1)
        cameras.append(_camera(name, size, matrix, distortion, turn, -turn @ at))
    return CameraRig(tuple(cameras))


def _floats(text: str | None, count: int) -> list[float]:
    numbers = [float(word) for word in (text or "").split()]
    if len(numbers) != count:
        raise ValueError
    return numbers


def _in_metres(rig: CameraRig, path: Path) -> CameraRig:
    """The rig in metres: coordinates larger than `MAX_METRES` are taken as millimetres."""
    if len(set(rig.names)) < len(rig.names):
        raise HabitusError(f"{path}: cameras share a name: {listed(rig.names)}")
    far = max(
        float(np.linalg.norm(rig.places - rig.places.mean(0), axis=1).max()),
        float(np.linalg.norm(rig.translation, axis=1).max()),
    )
    if far < MAX_METRES:
        return rig
    cameras = tuple(
        replace(camera, translation=MILLIMETRE * camera.translation) for camera in rig.cameras
    )
    note = f"{path.name}: cameras {far:.0f} apart were read as millimetres"
    return CameraRig(cameras, (*rig.notes, note))
