"""A C3D file with other points under other names, or with more of them: analog channels, events,
rates, units and all else stay.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import ezc3d
import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.io.captures.unlabelled import UnlabelledCapture
from habitus.io.units import METRES

_MAX_LABELS = 255


def write_relabelled(
    source: str | os.PathLike[str],
    capture: UnlabelledCapture,
    labels: tuple[str, ...],
    points: Float[np.ndarray, "T M 3"],
    path: str | os.PathLike[str],
) -> None:
    """``source`` with the points that ``capture`` has of it replaced by these (metres, NaN
    missing), under ``labels``.

    What the source holds beside them (computed points, analog channels, parameters) is written as
    it is. Raises HabitusError where it cannot be read a second time or the folder cannot be written
    to.
    """
    file = _copied(source)
    others = [k for k in range(file["data"]["points"].shape[1]) if k not in set(capture.columns)]
    names = _labels(file)
    _put(file, points / METRES[capture.unit], others)
    _name(file, [*labels, *(names[k] for k in others)])
    _write(file, path)


def write_with_outputs(
    source: str | os.PathLike[str],
    outputs: Mapping[str, Mapping[str, Float[np.ndarray, "T 3"]]],
    path: str | os.PathLike[str],
) -> None:
    """``source`` with more points that are no markers: by their group (ANGLES, MOMENTS, POWERS, …)
    and label, numbers in the group's units, NaN where there are none.

    Whoever reads C3D files shows them as a model's outputs. Raises HabitusError where the source
    cannot be read or has one of these labels already, and where the file cannot be written.
    """
    file = _copied(source)
    names = _labels(file)
    own = {label: values for group in outputs.values() for label, values in group.items()}
    taken = sorted(set(own) & set(names))
    if taken:
        raise HabitusError(
            f"{Path(source).name}: has {taken[0]} already; give the capture without earlier outputs"
        )
    frames = file["data"]["points"].shape[2]
    values = np.full((frames, len(own), 3), np.nan)
    for k, column in enumerate(own.values()):
        count = min(frames, len(column))
        values[:count, k] = column[:count]
    _put(file, values, range(len(names)), after=True)
    _name(file, [*names, *own])
    for group, members in outputs.items():
        point = file["parameters"]["POINT"]
        before = list(point[group]["value"]) if group in point else []
        file.add_parameter("POINT", group, [*before, *members])
    _write(file, path)


def _copied(source: str | os.PathLike[str]) -> ezc3d.c3d:
    try:
        return ezc3d.c3d(str(source))
    except Exception as error:  # what ezc3d raises at files that it does not like is of any kind
        raise HabitusError(
            f"{Path(source).name}: ezc3d cannot copy it ({error}); give --out a .trc file"
        ) from error


def _labels(file: ezc3d.c3d) -> list[str]:
    return [n for key in _label_keys(file) for n in file["parameters"]["POINT"][key]["value"]]


def _put(
    file: ezc3d.c3d,
    points: Float[np.ndarray, "T M 3"],
    kept: Sequence[int],
    after: bool = False,
) -> None:
    """Points in the file's units, NaN missing, beside those of its own that are kept."""
    frames = file["data"]["points"].shape[2]
    placed = np.ones((4, points.shape[1], frames))
    missing = ~np.all(np.isfinite(points), axis=2).T
    placed[:3] = np.nan_to_num(points.transpose(2, 1, 0)[:, :, :frames])
    residuals = np.expand_dims(np.where(missing[:, :frames], -1.0, 0.0), 0)
    masks = np.zeros((7, points.shape[1], frames), bool)
    meta, rows = file["data"]["meta_points"], list(kept)
    order = -1 if after else 1
    file["data"]["points"] = np.concatenate([placed, file["data"]["points"][:, rows]][::order], 1)
    meta["residuals"] = np.concatenate([residuals, meta["residuals"][:, rows]][::order], axis=1)
    meta["camera_masks"] = np.concatenate([masks, meta["camera_masks"][:, rows]][::order], axis=1)


def _write(file: ezc3d.c3d, path: str | os.PathLike[str]) -> None:
    with atomic_write(path) as temporary:
        written = temporary.with_name(f"{temporary.stem}.c3d")  # ezc3d writes to no other ending
        file.write(str(written))
        os.replace(written, temporary)


def _label_keys(file: ezc3d.c3d) -> list[str]:
    point = file["parameters"]["POINT"]
    return [key for key in ("LABELS", *(f"LABELS{k}" for k in range(2, 100))) if key in point]


def _name(file: ezc3d.c3d, labels: list[str]) -> None:
    """Labels into as many parameters as they need, descriptions dropped with the points that they
    described.
    """
    point = file["parameters"]["POINT"]
    for key in [key for key in point if key.startswith(("LABELS", "DESCRIPTIONS"))]:
        if key not in ("LABELS", "DESCRIPTIONS"):
            del point[key]
    if "DESCRIPTIONS" in point:
        point["DESCRIPTIONS"]["value"] = [""] * min(len(labels), _MAX_LABELS)
    point["LABELS"]["value"] = labels[:_MAX_LABELS]
    for start in range(_MAX_LABELS, len(labels), _MAX_LABELS):
        file.add_parameter(
            "POINT", f"LABELS{start // _MAX_LABELS + 1}", labels[start : start + _MAX_LABELS]
        )
