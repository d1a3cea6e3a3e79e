"""Cameras of depth folders: OpenCV, ROS, JSON and YAML descriptions, Azure Kinect calibrations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError, listed, shown
from habitus.observe.camera import Camera
from habitus.rotations import matrix_from_rotvec

# size of a mode's image: the size that the whole sensor is scaled to, and the first pixel of the
# part that is kept
_DEPTH_MODES = {
    (640, 576): ((1024, 1024), (192, 180)),
    (320, 288): ((512, 512), (96, 90)),
    (1024, 1024): ((1024, 1024), (0, 0)),
    (512, 512): ((512, 512), (0, 0)),
}
_COLOUR_MODES = {
    (1280, 720): ((1280, 960), (0, 120)),
    (1920, 1080): ((1920, 1440), (0, 180)),
    (2560, 1440): ((2560, 1920), (0, 240)),
    (2048, 1536): ((2048, 1536), (0, 0)),
    (3840, 2160): ((3840, 2880), (0, 360)),
    (4096, 3072): ((4096, 3072), (0, 0)),
}
_ORDER = ("cx", "cy", "fx", "fy", "k1", "k2", "k3", "k4", "k5", "k6", "codx", "cody", "p2", "p1")


def is_azure(table: Mapping[str, Any]) -> bool:
    """Whether a description is the calibration of an Azure Kinect."""
    return "CalibrationInformation" in table or "Cameras" in table


def azure_cameras(
    table: Mapping[str, Any], where: str, size: tuple[int, int]
) -> tuple[Camera, Camera]:
    """Depth and colour camera; size: of the depth images. The colour camera is for 1280 x 720
    (`resized`).

    Raises HabitusError where one is missing or the resolution is none of the sensor's.
    """
    inner = table.get("CalibrationInformation", table)
    listed_cameras = inner.get("Cameras") if isinstance(inner, Mapping) else None
    cameras = [
        each
        for each in (listed_cameras if isinstance(listed_cameras, list) else [])
        if isinstance(each, Mapping)
    ]
    by_sensor = {}
    for name, purpose in (("depth", "Depth"), ("colour", "PhotoVideo")):
        one = next(
            (
                each
                for each in cameras
                if purpose in str(each.get("Purpose", each.get("Location", "")))
            ),
            None,
        )
        if one is None:
            raise HabitusError(
                f"{where}: holds no {name} camera; expected an Azure Kinect's calibration"
            )
        by_sensor[name] = one
    if size not in _DEPTH_MODES:
        raise HabitusError(
            f"{where}: depth images of {size[0]} x {size[1]}; an Azure Kinect has "
            + ", ".join(f"{w} x {h}" for w, h in _DEPTH_MODES)
        )
    depth = _azure_camera(by_sensor["depth"], where, size, _DEPTH_MODES[size])
    colour = _azure_camera(by_sensor["colour"], where, (1280, 720), _COLOUR_MODES[(1280, 720)])
    turn, shift = _place(by_sensor["colour"], where)
    own_turn, own_shift = _place(by_sensor["depth"], where)
    between = turn @ own_turn.T
    way = Camera.from_opencv(np.eye(3), None, between, shift - between @ own_shift, 1, 1)
    return depth, colour.replace(rotation=way.rotation, translation=way.translation)


def resized(camera: Camera, size: tuple[int, int]) -> Camera | None:
    """The colour camera, made for 1280 x 720, for images of another of the sensor's resolutions;
    None for others.
    """
    if size not in _COLOUR_MODES:
        return None
    whole, first = _COLOUR_MODES[size]
    factor = whole[0] / 1280
    principal = (camera.principal_point + camera.principal_point.new_tensor([0.0, 120.0])) * factor
    principal = principal - principal.new_tensor(first)
    return camera.replace(
        width=size[0],
        height=size[1],
        focal_length=camera.focal_length * factor,
        principal_point=principal,
    )


def _azure_camera(
    table: Mapping[str, Any],
    where: str,
    size: tuple[int, int],
    mode: tuple[tuple[int, int], tuple[int, int]],
) -> Camera:
    """Numbers are in widths and heights of the whole sensor; pixels' centres there are at
    halves.
    """
    try:
        values = _numbers(table["Intrinsics"]["ModelParameters"])[: len(_ORDER)].tolist()
        p = dict(zip(_ORDER, values, strict=True))
    except (LookupError, TypeError, ValueError, HabitusError) as error:
        raise HabitusError(
            f"{where}: its ModelParameters are {shown(error)}; expected 14 numbers a camera"
        ) from error
    (width, height), (left, top) = mode
    lens = [p["k1"], p["k2"], p["p1"], p["p2"], p["k3"], p["k4"], p["k5"], p["k6"]]
    return Camera.of(
        size[0],
        size[1],
        (p["fx"] * width, p["fy"] * height),
        (p["cx"] * width - left, p["cy"] * height - top),
        distortion=lens,
    )


def _place(table: Mapping[str, Any], where: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        turn = _numbers(table["Rt"]["Rotation"]).reshape(3, 3)
        return _checked_rotation(turn, where), _numbers(table["Rt"]["Translation"]).reshape(3)
    except (LookupError, TypeError, ValueError) as error:
        raise HabitusError(
            f"{where}: its Rt is {shown(error)}; expected Rotation and Translation"
        ) from error


DEPTH = ("depth", "ir", "depth_camera", "depth_intrinsics", "infrared")
COLOUR = (
    "color",
    "colour",
    "rgb",
    "color_camera",
    "colour_camera",
    "rgb_camera",
    "color_intrinsics",
)
_MATRIX = (
    "intrinsic_matrix",
    "camera_matrix",
    "K",
    "k",
    "matrix",
    "cameraMatrix",
    "intrinsics",
    "intrinsic",
)
_LENS = (
    "distortion_coefficients",
    "dist_coeffs",
    "distortion",
    "D",
    "d",
    "coeffs",
    "distCoeffs",
    "dist",
)
_WIDTH = ("width", "image_width")
_HEIGHT = ("height", "image_height")
_WAY = (
    "depth_to_color",
    "depth_to_colour",
    "depth_to_rgb",
    "extrinsics",
    "extrinsic",
    "T_color_depth",
    "T_colour_depth",
)
_FROM_COLOUR = ("color_to_depth", "colour_to_depth", "T_depth_color", "T_depth_colour")
_SCALES = (
    "depth_scale",
    "depth_unit",
    "depth_units",
    "depth_factor",
    "depth_map_factor",
    "DepthMapFactor",
)
BENT = (
    "brown_conrady",
    "modified_brown_conrady",
    "plumb_bob",
    "rational_polynomial",
    "opencv",
    "radtan",
)
STRAIGHT = ("none", "pinhole", "")
FARTHEST_APART = 1.0
"""Metres between the cameras of one sensor; a larger number is millimetres."""
MAX_PIXEL = 1e6
"""Of focal lengths, principal points and sizes of images."""
MAX_LENS = 1e4
"""Of distortion coefficients; those of rational models reach hundreds."""


@dataclass(frozen=True)
class Rig:
    """The cameras of a sensor: depth's, colour's if told (points of the depth camera's frame to
    colour pixels), and metres of one step of depth if told. ``notes``: what was taken for granted.
    """

    depth: Camera | None
    colour: Camera | None
    metres: float | None
    notes: tuple[str, ...] = ()


def read_rig(table: Any, where: str, size: tuple[int, int]) -> Rig:
    """The cameras in a description. size: width and height of depth images, where the file does not
    tell its own.

    Raises HabitusError where it holds no intrinsics, or lenses that OpenCV's model does not know.
    """
    if not isinstance(table, Mapping):
        raise HabitusError(
            f"{where}: holds {type(table).__name__}; expected a table of camera intrinsics"
        )
    rig = (
        Rig(*azure_cameras(table, where, size), None)
        if is_azure(table)
        else _rig(table, where, size)
    )
    for camera in (rig.depth, rig.colour):
        _check_camera(camera, where)
    return rig


def _check_camera(camera: Camera | None, where: str) -> None:
    """Raise HabitusError for numbers that no camera has."""
    if camera is None:
        return
    focal = camera.focal_length.tolist()
    size = (camera.width, camera.height)
    if not np.linalg.norm(camera.translation.numpy()) <= FARTHEST_APART:
        raise HabitusError(
            f"{where}: the cameras are {np.linalg.norm(camera.translation.numpy()):.3g} m apart; "
            f"expected at most {FARTHEST_APART:g} m"
        )
    principal = camera.principal_point.tolist()
    lens = [] if camera.distortion is None else camera.distortion.tolist()
    if not (
        all(0.0 < length <= MAX_PIXEL for length in focal)
        and all(abs(number) <= MAX_PIXEL for number in principal)
        and all(1 <= number <= MAX_PIXEL for number in size)
        and all(abs(number) <= MAX_LENS for number in lens)
    ):
        raise HabitusError(
            f"{where}: focal lengths {focal}, principal point {principal}, size {size}, lens "
            f"{lens}; expected a camera's, in pixels"
        )


def _rig(table: Mapping[str, Any], where: str, size: tuple[int, int]) -> Rig:
    metres = scale_of(table, where)
    depth_part = _part(table, DEPTH)
    colour_part = _part(table, COLOUR)
    if depth_part is None and colour_part is None:
        return Rig(_camera(table, where, size), None, metres)
    depth = None if depth_part is None else _camera(depth_part, f"{where}: depth", size)
    colour = None if colour_part is None else _camera(colour_part, f"{where}: colour", size)
    for part in (depth_part, colour_part):
        metres = scale_of(part, where) if metres is None and part is not None else metres
    way, notes = _way(table, where)
    if colour is not None and depth is not None:
        if way is None:
            notes = (
                *notes,
                f"{where}: no transformation from the depth to the colour camera; they are taken "
                "as "
                "one place",
            )
        else:
            colour = colour.replace(**_placed(way))
    return Rig(depth, colour, metres, notes)


def placed(camera: Camera, table: Any, where: str) -> tuple[Camera, tuple[str, ...]]:
    """A colour camera at the place that a description of its own tells."""
    way, notes = _way(table, where) if isinstance(table, Mapping) else (None, ())
    return (camera if way is None else camera.replace(**_placed(way))), notes


def _part(table: Mapping[str, Any], names: tuple[str, ...]) -> Mapping[str, Any] | None:
    for key, value in table.items():
        if str(key).lower() in names and isinstance(value, Mapping):
            inner = value.get("intrinsics", value.get("intrinsic"))
            return {**value, **inner} if isinstance(inner, Mapping) else value
    return None


def _camera(table: Mapping[str, Any], where: str, size: tuple[int, int]) -> Camera:
    inner = table.get("intrinsics", table.get("intrinsic"))
    table = {**table, **inner} if isinstance(inner, Mapping) else table
    width, height = (
        _whole(table, names, default)
        for names, default in zip((_WIDTH, _HEIGHT), size, strict=True)
    )
    fx, fy, cx, cy = _focal(table, where)
    model = (
        str(table.get("model", table.get("distortion_model", "opencv")))
        .lower()
        .removeprefix("distortion.")
    )
    lens = next((_numbers(table[name]) for name in _LENS if name in table), None)
    if lens is not None and not np.any(lens):
        lens = None
    if lens is not None and model not in BENT + STRAIGHT:
        raise HabitusError(
            f"{where}: lens model {shown(model)!r}; expected one of {listed(BENT)}, or no "
            "distortion"
        )
    if lens is not None and (lens.size > 14 or lens.size < 4):
        raise HabitusError(
            f"{where}: {lens.size} distortion coefficients; expected 4, 5 or 8: k1 k2 p1 p2 k3 k4 "
            "k5 k6"
        )
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera.from_opencv(matrix, lens, np.zeros(3), np.zeros(3), width, height)


def _focal(table: Mapping[str, Any], where: str) -> tuple[float, float, float, float]:
    for names in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy")):
        if all(name in table for name in names):
            numbers = [_numbers(table[name]) for name in names]
            if all(one.size == 1 for one in numbers):
                return tuple(one.item() for one in numbers)  # type: ignore[return-value]
    matrix = next((_numbers(table[name]) for name in _MATRIX if name in table), None)
    if matrix is not None and matrix.size == 9:
        k = matrix.reshape(3, 3)
        k = k.T if k[0, 2] == 0.0 and k[2, 0] != 0.0 else k  # Open3D writes columns
        return float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
    if matrix is not None and matrix.size == 4:
        return tuple(matrix.tolist())  # type: ignore[return-value]
    raise HabitusError(
        f"{where}: no intrinsics; expected fx, fy, cx, cy (or ppx, ppy), or a camera matrix "
        "of nine numbers"
    )


def _way(
    table: Mapping[str, Any], where: str
) -> tuple[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]] | None, tuple[str, ...]]:
    """Rotation and translation (m) from the depth camera to the colour camera, if given."""
    for names, backwards in ((_WAY, False), (_FROM_COLOUR, True)):
        for name in names:
            if name in table:
                return _in_metres(*_rigid(table[name], where, _by_columns(table)), backwards, where)
    if "R" in table and "T" in table:
        return _in_metres(*_rigid(table, where, False), False, where)
    return None, ()


def _by_columns(table: Mapping[str, Any]) -> bool:
    """Whether this is RealSense's, which writes matrices by columns."""
    parts = [table, *(value for value in table.values() if isinstance(value, Mapping))]
    return any("ppx" in part for part in parts)


def _rigid(value: Any, where: str, columns: bool) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(value, Mapping) and "data" not in value:
        turn = next(
            (_numbers(value[name]) for name in ("rotation", "R", "r") if name in value),
            np.eye(3).ravel(),
        )
        shift = next(
            (_numbers(value[name]) for name in ("translation", "T", "t") if name in value),
            np.zeros(3),
        )
    else:
        flat = _numbers(value)
        if flat.size not in (12, 16):
            raise HabitusError(
                f"{where}: extrinsics of {flat.size} numbers; expected a matrix of 3 x 4 or 4 x 4"
            )
        matrix = flat.reshape(-1, 4)
        turn = matrix[:3, :3].ravel()
        shift = matrix[:3, 3]
    if turn.size == 3:
        turn = np.asarray(matrix_from_rotvec(turn)).ravel()
    if turn.size != 9 or shift.size != 3:
        raise HabitusError(
            f"{where}: rotation of {turn.size} and translation of {shift.size} numbers; expected "
            "9 and 3"
        )
    turn = turn.reshape(3, 3).T if columns else turn.reshape(3, 3)
    return _checked_rotation(turn, where), shift


def _checked_rotation(turn: np.ndarray, where: str) -> np.ndarray:
    if (
        np.abs(turn).max() > 1.1
        or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-2)
        or np.linalg.det(turn) < 0
    ):
        raise HabitusError(
            f"{where}: the extrinsics' rotation is none; expected three orthogonal rows"
        )
    return turn


def _in_metres(
    turn: np.ndarray, shift: np.ndarray, backwards: bool, where: str
) -> tuple[Any, tuple[str, ...]]:
    notes = ()
    if np.linalg.norm(shift) > FARTHEST_APART:
        shift = shift / 1000.0
        notes = (f"{where}: the colour camera's place was taken as millimetres",)
    if not np.linalg.norm(shift) <= FARTHEST_APART:
        raise HabitusError(
            f"{where}: the colour camera is {np.linalg.norm(shift):.3g} m from the depth camera; "
            f"expected at most {FARTHEST_APART:g} m"
        )
    return ((turn.T, -turn.T @ shift) if backwards else (turn, shift)), notes


def _placed(way: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
    camera = Camera.from_opencv(np.eye(3), None, _orthogonal(way[0]), way[1], 1, 1)
    return {"rotation": camera.rotation, "translation": camera.translation}


def _orthogonal(turn: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(turn)
    return u @ vt


def scale_of(table: Any, where: str) -> float | None:
    """Metres of one step of depth: given as such (0.001), or as steps per metre (1000, 5000)."""
    for name in _SCALES:
        if isinstance(table, Mapping) and name in table:
            value = _numbers(table[name])
            if value.size != 1 or not np.isfinite(value).all() or value.ravel()[0] <= 0:
                raise HabitusError(
                    f"{where}: {name} is {shown(table[name])}; expected 0.001 (m), or 1000 (steps "
                    "a m)"
                )
            return (
                float(value.ravel()[0]) if value.ravel()[0] < 1 else 1.0 / float(value.ravel()[0])
            )
    return None


def _whole(table: Mapping[str, Any], names: tuple[str, ...], default: int) -> int:
    numbers = next((_numbers(table[name]) for name in names if name in table), None)
    return default if numbers is None or numbers.size != 1 else int(numbers.ravel()[0])


def _numbers(value: Any) -> np.ndarray:
    """Numbers of a list, of nested lists, or of OpenCV's table of rows, cols and data."""
    if isinstance(value, Mapping):
        value = value.get("data", ())
    try:
        numbers = np.asarray(value, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        raise HabitusError(f"{shown(value)} where numbers of a camera are expected") from None
    if not np.isfinite(numbers).all():
        raise HabitusError(f"{shown(value)} where finite numbers of a camera are expected")
    return numbers
