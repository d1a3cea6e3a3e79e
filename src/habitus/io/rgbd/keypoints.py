"""Keypoints of a person in a picture, as OpenPose and COCO write them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError
from habitus.io.rgbd.files import read_description

MAX_PIXEL = 1e6
"""A keypoint further from the image's corner, or at no number, is one that was not seen."""
_BY_COUNT = {len(names): names for names in CONVENTIONS.values()}


def read_keypoints(path: Path) -> dict[str, tuple[float, float, float]]:
    """u, v (pixels) and confidence of each keypoint that was seen, of the clearest person in a
    file.

    OpenPose's (people, pose_keypoints_2d; 25 points) and COCO's (annotations or a list, keypoints;
    17 points). Raises HabitusError for other files.
    """
    people = [located for one in _people(read_description(path)) if (located := _points(one))]
    if not people:
        raise HabitusError(
            f"{path}: holds no person; expected OpenPose's people or COCO's annotations with "
            "keypoints"
        )
    return max(people, key=lambda points: sum(point[2] for point in points.values()))


def _people(table: Any) -> list[Any]:
    if isinstance(table, Mapping):
        table = next(
            (table[key] for key in ("people", "annotations", "predictions") if key in table),
            [table],
        )
    return table if isinstance(table, list) else []


def _points(person: Any) -> dict[str, tuple[float, float, float]]:
    if not isinstance(person, Mapping):
        return {}
    given = next((person[key] for key in ("pose_keypoints_2d", "keypoints") if key in person), None)
    try:
        flat = [float(value) for value in given] if given is not None else []
    except (TypeError, ValueError, OverflowError):
        return {}
    names = _BY_COUNT.get(len(flat) // 3, ())
    if len(flat) != 3 * len(names):
        return {}
    rows = zip(names, zip(flat[::3], flat[1::3], flat[2::3], strict=True), strict=True)
    scale = (
        0.5 if max(flat[2::3], default=0.0) > 1.0 else 1.0
    )  # COCO's annotators write 2 for visible
    # these conventions count pixels' centres as whole numbers
    return {
        name: (u + 0.5, v + 0.5, min(scale * sure, 1.0))
        for name, (u, v, sure) in rows
        if sure > 0 and abs(u) < MAX_PIXEL and abs(v) < MAX_PIXEL
    }
