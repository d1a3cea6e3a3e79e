"""A C3D file with other points under other names: analog channels, events, rates, units and all
else stay.
"""

import os
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
    try:
        file = ezc3d.c3d(str(source))
    except Exception as error:  # what ezc3d raises at files that it does not like is of any kind
        raise HabitusError(
            f"{Path(source).name}: ezc3d cannot copy it ({error}); give --out a .trc file"
        ) from error
    others = [k for k in range(file["data"]["points"].shape[1]) if k not in set(capture.columns)]
    names = [
        name for key in _label_keys(file) for name in file["parameters"]["POINT"][key]["value"]
    ]
    frames = file["data"]["points"].shape[2]
    placed = np.ones((4, points.shape[1], frames))
    missing = ~np.all(np.isfinite(points), axis=2).T
    placed[:3] = np.nan_to_num(points.transpose(2, 1, 0)[:, :, :frames] / METRES[capture.unit])
    meta = file["data"]["meta_points"]
    residuals = np.expand_dims(np.where(missing[:, :frames], -1.0, 0.0), 0)
    masks = np.zeros((7, points.shape[1], frames), bool)
    file["data"]["points"] = np.concatenate([placed, file["data"]["points"][:, others]], axis=1)
    meta["residuals"] = np.concatenate([residuals, meta["residuals"][:, others]], axis=1)
    meta["camera_masks"] = np.concatenate([masks, meta["camera_masks"][:, others]], axis=1)
    _name(file, [*labels, *(names[k] for k in others)])
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
