"""Azure Kinect's own calibration (the JSON in its recordings), for the resolutions that its modes
cut out.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.observe.camera import Camera

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
    cameras = table.get("CalibrationInformation", table).get("Cameras", [])
    found = {}
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
        found[name] = one
    if size not in _DEPTH_MODES:
        raise HabitusError(
            f"{where}: depth images of {size[0]} x {size[1]}; an Azure Kinect has "
            + ", ".join(f"{w} x {h}" for w, h in _DEPTH_MODES)
        )
    depth = _camera(found["depth"], where, size, _DEPTH_MODES[size])
    colour = _camera(found["colour"], where, (1280, 720), _COLOUR_MODES[(1280, 720)])
    turn, shift = _place(found["colour"], where)
    own_turn, own_shift = _place(found["depth"], where)
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


def _camera(
    table: Mapping[str, Any],
    where: str,
    size: tuple[int, int],
    mode: tuple[tuple[int, int], tuple[int, int]],
) -> Camera:
    """Numbers are in widths and heights of the whole sensor; pixels' centres there are at
    halves.
    """
    try:
        values = [float(value) for value in table["Intrinsics"]["ModelParameters"]][: len(_ORDER)]
        p = dict(zip(_ORDER, values, strict=True))
    except (KeyError, TypeError, ValueError) as error:
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
        turn = np.array(table["Rt"]["Rotation"], dtype=float).reshape(3, 3)
        return turn, np.array(table["Rt"]["Translation"], dtype=float).reshape(3)
    except (KeyError, TypeError, ValueError) as error:
        raise HabitusError(
            f"{where}: its Rt is {shown(error)}; expected Rotation and Translation"
        ) from error
