"""Keypoints of a person in a picture, as OpenPose, COCO and detectors of their forms write them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.keypoints import CONVENTIONS, convention_of
from habitus.errors import HabitusError
from habitus.io.rgbd.files import read_description

MAX_PIXEL = 1e6
"""A keypoint further from the image's corner, or at no number, is one that was not seen."""


def read_keypoints(path: Path) -> dict[str, tuple[float, float, float]]:
    """u, v (pixels) and confidence of each keypoint that was seen, of the clearest person in a
    file.

    OpenPose's (people, pose_keypoints_2d) and COCO's (annotations or a list, keypoints), in any of
    the orders `habitus.body.keypoints.CONVENTIONS`: which, their anatomy says
    (`habitus.body.keypoints.convention_of`). Raises HabitusError for other files.
    """
    people = [row for one in _people(read_description(path)) if (row := _row(one)) is not None]
    if not people:
        raise HabitusError(
            f"{path}: holds no person; expected OpenPose's people or COCO's annotations with "
            "keypoints"
        )
    clearest = max(people, key=lambda row: row[:, 2].sum())
    together = np.stack([row for row in people if len(row) == len(clearest)])
    try:
        names = CONVENTIONS[convention_of(together[..., :2], together[..., 2])]
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}") from error
    # these conventions count pixels' centres as whole numbers
    return {
        names[k]: (float(u) + 0.5, float(v) + 0.5, float(sure))
        for k, (u, v, sure) in enumerate(clearest)
        if sure > 0
    }


def _people(table: Any) -> list[Any]:
    if isinstance(table, Mapping):
        table = next(
            (table[key] for key in ("people", "annotations", "predictions") if key in table),
            [table],
        )
    return table if isinstance(table, list) else []


def _row(person: Any) -> Float[np.ndarray, "K 3"] | None:
    """u, v and confidence (0: not seen) of a person's keypoints; None where none was seen."""
    if not isinstance(person, Mapping):
        return None
    given = next((person[key] for key in ("pose_keypoints_2d", "keypoints") if key in person), None)
    try:
        flat = np.array(given, np.float64).ravel() if given is not None else np.zeros(0)
    except (TypeError, ValueError, OverflowError):
        return None
    if len(flat) == 0 or len(flat) % 3:
        return None
    row = flat.reshape(-1, 3)
    seen = (row[:, 2] > 0) & (np.abs(row[:, :2]) < MAX_PIXEL).all(1)
    scale = 0.5 if row[:, 2].max() > 1.0 else 1.0  # COCO's annotators write 2 for visible
    row[:, 2] = np.where(seen, np.minimum(scale * row[:, 2], 1.0), 0.0)
    row[~seen] = 0.0
    return row if seen.any() else None
