"""Writing a capture as a C3D file that any other program reads: millimetres, real numbers, missing
points flagged.
"""

import os

import ezc3d
import numpy as np

from habitus.errors import HabitusError, shown
from habitus.files import atomic_write
from habitus.io.captures.read import Capture

_MAX_LABELS = 255
_MAX_FRAMES = 65535
_MAX_LENGTH = 120
_SCREEN_X = {"x": "+Y", "y": "+X", "z": "+X"}


def write_c3d(capture: Capture, path: str | os.PathLike[str], *, note: str = "") -> None:
    """Writes ``capture`` to ``path``, whole or not at all. Positions keep 32 bits: better than a
    micrometre.

    ``note`` describes every marker to who opens the file (POINT:DESCRIPTIONS): that they are
    virtual, say.

    Raises HabitusError where the capture has nothing that C3D can hold, or the folder cannot be
    written to.
    """
    _refuse_unwritable(capture)
    frames, markers = capture.markers.shape[:2]
    file = ezc3d.c3d()
    points = np.nan_to_num(np.moveaxis(capture.markers, 2, 0).transpose(0, 2, 1) * 1000.0)
    missing = ~np.isfinite(capture.markers).all(axis=2).T
    points[:, missing] = 0.0
    file["data"]["points"] = np.concatenate([points, np.ones((1, markers, frames))])
    file["data"]["meta_points"]["residuals"] = np.where(missing, -1.0, 0.0)[None]
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, markers, frames), bool)
    _add_parameters(file, capture)
    if note:
        text = shown(note, _MAX_LENGTH).encode()[:_MAX_LENGTH].decode(errors="ignore")
        descriptions = [text] * min(markers, _MAX_LABELS)
        file["parameters"]["POINT"]["DESCRIPTIONS"]["value"] = descriptions
    with atomic_write(path) as temporary:
        written = temporary.with_name(f"{temporary.stem}.c3d")  # ezc3d writes to no other ending
        file.write(str(written))
        os.replace(written, temporary)


def _refuse_unwritable(capture: Capture) -> None:
    """ezc3d ends the process at some of these, so they must not reach it."""
    frames, markers = capture.markers.shape[:2]
    fault = None
    if frames == 0 or markers == 0:
        fault = f"holds {frames} frames of {markers} markers; expected at least one of each"
    elif len(capture.labels) != markers:
        fault = f"has {len(capture.labels)} labels for {markers} markers; expected one each"
    elif not 0.1 < capture.rate_hz < 1e5:
        fault = f"has a rate of {capture.rate_hz:g} Hz; expected 0.1 to 100,000"
    elif max(len(label.encode()) for label in capture.labels) > _MAX_LENGTH:
        fault = f"has labels of more than {_MAX_LENGTH} letters; shorten them"
    if fault:
        raise HabitusError(f"{capture.name}: cannot be written as C3D: it {fault}")


def _add_parameters(file: ezc3d.c3d, capture: Capture) -> None:
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [capture.rate_hz]
    point["UNITS"]["value"] = ["mm"]
    if len(capture.markers) > _MAX_FRAMES:
        file.add_parameter("POINT", "LONG_FRAMES", [float(len(capture.markers))])
    point["LABELS"]["value"] = list(capture.labels[:_MAX_LABELS])
    for start in range(_MAX_LABELS, len(capture.labels), _MAX_LABELS):
        name = f"LABELS{start // _MAX_LABELS + 1}"
        file.add_parameter("POINT", name, list(capture.labels[start : start + _MAX_LABELS]))
    file.add_parameter("POINT", "X_SCREEN", [_SCREEN_X[capture.up_axis[1]]])
    file.add_parameter("POINT", "Y_SCREEN", [capture.up_axis.upper()])
    if capture.subject:
        file.add_parameter("SUBJECTS", "USED", 1)
        file.add_parameter("SUBJECTS", "NAMES", [capture.subject[:_MAX_LENGTH]])
    for key, name, factor in (("height_m", "HEIGHT", 1000.0), ("mass_kg", "BODYMASS", 1.0)):
        value = capture.recorded.get(key)
        if isinstance(value, float | int) and value > 0:
            file.add_parameter("PROCESSING", name, [float(value) * factor])
    diameter = capture.recorded.get("marker_diameter_m")
    if isinstance(diameter, float | int) and diameter > 0:
        file.add_parameter("SEG", "MARKER_DIAMETER", [float(diameter) * 1000.0])
    if isinstance(age := capture.recorded.get("age_years"), float | int) and age > 0:
        file.add_parameter("SUBJECTS", "AGE", [float(age)])
    if capture.recorded.get("sex") in ("female", "male"):
        file.add_parameter("SUBJECTS", "SEX", [str(capture.recorded["sex"])])
