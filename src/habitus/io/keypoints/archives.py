"""Detections in archives of arrays: SAM 3D Body's .npz of each frame."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError, shown
from habitus.io.archives import open_archive
from habitus.io.limits import check_count
from habitus.io.names import numeric_order

MAX_PIXEL = 1e6
MAX_PEOPLE = 20
"""In one frame of one camera."""
MAX_FRAMES = 1_000_000

Frame = list[Float[np.ndarray, "K 3"]]
"""The people of one frame: u, v, confidence of each keypoint."""

_BODY = dict(enumerate(CONVENTIONS["mhr70"][:21]))
_HANDS = {21 + 3: "thumb", 21 + 7: "index", 21 + 19: "pinky", 21 + 20: "wrist"}
_ROWS = (
    _BODY
    | {row: f"right_{name}" for row, name in _HANDS.items()}
    | {row + 21: f"left_{name}" for row, name in _HANDS.items()}
    | {69: "neck"}
)
MHR70 = tuple(_ROWS.get(row, "") for row in range(70))
"""The names of SAM 3D Body's 70 keypoints, "" of those that are not used: finger joints, and
second places of elbows and shoulders."""


def checked(row: np.ndarray) -> Float[np.ndarray, "K 3"]:
    """With confidence 0 where there is no pixel."""
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(row).all(1) & (row[:, 2] > 0) & (np.abs(row[:, :2]) < MAX_PIXEL).all(1)
    return np.where(seen[:, None], row, 0.0)


def sam3d_frames(folder: Path) -> tuple[dict[int, Frame], tuple[str, ...]]:
    """SAM 3D Body's ``pred_keypoints_2d`` (70, 2) of each frame of one camera."""
    paths = sorted(folder.glob("*.npz"), key=lambda p: numeric_order(p.name))
    check_count(len(paths), MAX_FRAMES, f"{folder}: frames")
    frames: dict[int, Frame] = {}
    for k, path in enumerate(paths):
        try:
            with open_archive(path) as archive:
                at = np.asarray(archive.read("pred_keypoints_2d"))
        except (OSError, KeyError, HabitusError) as error:
            raise HabitusError(
                f"{path}: {shown(error, 120)}; expected pred_keypoints_2d of SAM 3D Body"
            ) from error
        if at.shape != (len(MHR70), 2) or at.dtype.kind != "f":
            raise HabitusError(
                f"{path}: pred_keypoints_2d {at.shape}; expected (70, 2): one person a file"
            )
        digits = "".join(c if c.isdigit() else " " for c in path.stem).split()
        number = int(digits[-1][-9:]) if digits else k
        frames[number] = [checked(np.column_stack([at.astype(float), np.ones(len(at))]))]
    return frames, MHR70
