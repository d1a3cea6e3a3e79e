"""Writes TRC files: the markers of a capture, or the joints and markers of a motion."""

import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError, shown
from habitus.files import atomic_write
from habitus.io.captures.read import Capture
from habitus.io.captures.trc import FIT_EXPORT
from habitus.parallel.blocks import blocks, drop_pages, empty_array
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving


Unit = Literal["mm", "m"]
_PER_METRE: dict[str, tuple[float, int]] = {
    "mm": (1e3, 5),
    "m": (1.0, 8),
}  # and decimals: both keep 10 nanometres
_BLOCK = 1024


def write_trc(
    capture: Capture, path: str | os.PathLike[str], *, unit: Unit = "mm", y_up: bool = True
) -> None:
    """Write ``capture`` as TRC, whole or not at all; `habitus.read_capture` and OpenSim read it
    back.

    TRC has no word for what is up and its readers take y: the points are turned there, or with
    ``y_up=False`` stay in the capture's own frame. unit: "mm" or "m", which the header names.
    Positions keep 10 nanometres; a missing point is three blank cells. In labels, characters that a
    table of tabs and lines cannot hold are written as escapes (``\\t`` as ``\\x09``). The person's
    name, height and mass have no place in the format.

    Raises HabitusError for another unit, a capture without frames or markers or a rate, labels that
    are empty or repeated, and where the file cannot be written.
    """
    if unit not in get_args(Unit):
        raise HabitusError(f"unit is {unit!r}; a TRC file is written in mm or m")
    _write(capture, _writable_labels(capture), path, unit, y_up, ())


def _write(
    capture: Capture,
    labels: Sequence[str],
    path: str | os.PathLike[str],
    unit: Unit,
    y_up: bool,
    remarks: tuple[str, ...],
) -> None:
    """Write a file; ``remarks`` end its first line, of which readers take the beginning only."""
    scale, decimals = _PER_METRE[unit]
    turn = scale * (up_rotation(capture.up_axis) if y_up else np.eye(3))
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as file,
    ):
        name = shown(os.path.basename(os.fspath(path)), 200)
        file.write(_header((name, *remarks), labels, len(capture), capture.rate_hz, unit))
        for lines in _rows(capture, turn, decimals):
            file.write(lines)


def _writable_labels(capture: Capture) -> list[str]:
    frames, markers = capture.markers.shape[:2]
    labels = [shown(label, 10 * len(label) + 3).strip() for label in capture.labels]
    fault = None
    if not frames or not markers or len(labels) != markers:
        fault = (
            f"holds {frames} frames of {markers} markers and {len(labels)} labels; expected "
            "one label a marker"
        )
    elif not 0 < capture.rate_hz < 1e6:
        fault = f"has a rate of {capture.rate_hz:g} Hz; expected frames a second"
    elif not all(labels):
        fault = f"has no label for marker {labels.index('') + 1}; name it"
    elif len(set(labels)) < markers:
        fault = (
            "names several markers "
            f"{next(label for label in labels if labels.count(label) > 1)}; rename them"
        )
    if fault:
        raise HabitusError(f"{shown(capture.name)}: cannot be written as TRC: it {fault}")
    return labels


def _header(
    name: tuple[str, ...], labels: Sequence[str], frames: int, rate_hz: float, unit: str
) -> str:
    keys = (
        "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame "
        "OrigNumFrames"
    ).split()
    rate = f"{rate_hz:.10g}"
    values = (rate, rate, str(frames), str(len(labels)), unit, rate, "1", str(frames))
    axes = (f"{axis}{k + 1}" for k in range(len(labels)) for axis in "XYZ")
    rows = (
        ("PathFileType", "4", "(X/Y/Z)", *name),
        keys,
        values,
        ("Frame#", "Time", *(cell for label in labels for cell in (label, "", ""))),
        ("", "", *axes),
        (),
    )
    return "".join("\t".join(row) + "\n" for row in rows)


def _rows(capture: Capture, turn: Float[np.ndarray, "3 3"], decimals: int) -> Iterator[str]:
    """The lines of some frames at a time, their points turned and scaled.

    Each ends with a tab, as OpenSim counts cells by the tabs that end them.
    """
    width = 3 * capture.markers.shape[1]
    line = "%d\t%.8f\t" + f"%.{decimals}f\t" * width + "\n"
    for start in range(0, len(capture), _BLOCK):
        block = _without_zeros(capture.markers[start : start + _BLOCK] @ turn.T, 10.0**-decimals)
        numbers = np.arange(start, start + len(block))
        table = np.column_stack(
            [numbers + 1, numbers / capture.rate_hz, block.reshape(len(block), width)]
        )
        yield "".join(line % tuple(row) for row in table.tolist()).replace("nan", "")
        drop_pages(capture.markers)


def _without_zeros(points: Float[np.ndarray, "T M 3"], least: float) -> Float[np.ndarray, "T M 3"]:
    """A copy with NaN in all of a missing point; one at exactly zero, which readers take for
    missing, moves a bit.
    """
    seen = np.all(np.isfinite(points), axis=2)
    rounded = np.where(seen[..., None], points, np.nan)
    rounded[seen & (np.abs(rounded) < least / 2).all(axis=2)] = least
    return rounded


def write_points(fit: "Moving", path: str | os.PathLike[str]) -> Capture:
    """Write the joints, and of a fit its markers where the body carries them, as .trc; what was
    written comes back.

    Millimetres, y up. Joints have the body's names, markers their labels; a joint of the same name
    as a marker is called ``…_joint``. The first line marks the file as an export, so that it is not
    taken for a capture where it lies in a folder of captures. Raises HabitusError where the file
    cannot be written.
    """
    carried: Any = getattr(fit, "predicted_soft_tissue", None)
    carried = getattr(fit, "predicted_pose_stage", None) if carried is None else carried
    labels = () if carried is None else tuple(fit.labels)  # type: ignore[attr-defined]
    names = tuple(f"{name}_joint" if name in labels else name for name in fit.body.joint_names)
    points = empty_array((fit.num_frames, len(labels) + len(names), 3))
    for part in blocks(fit.num_frames):
        if carried is not None:
            points[part, : len(labels)] = carried[part]
        points[part, len(labels) :] = fit.joints(part)
        drop_pages(points, carried, fit.pose, fit.trans, fit.soft_tissue)
    capture = Capture(fit.capture_name, (*labels, *names), points, fit.rate_hz, fit.up_axis)
    _write(capture, _writable_labels(capture), path, "mm", True, (FIT_EXPORT,))
    return capture
