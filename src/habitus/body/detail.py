"""Two levels of detail of one body: a coarse mesh for fits, some of whose vertices are those of the
full one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Int

_SAMPLES = 64
_ALIKE = (
    "parents",
    "joint_names",
    "skinning",
    "pose_features",
    "shape_features",
    "pose_joints",
    "num_betas",
)
_ARRAYS = ("shapedirs", "posedirs", "expressiondirs", "skinning_value")


def in_step(coarse: Any, full: Any, rows: Int[np.ndarray, " V"] | None) -> bool:
    """Whether a body and its full level are one: vertex k of the coarse is vertex ``rows[k]`` of
    the full.

    The template is compared whole, what moves it at a sample of the vertices.
    """
    if (
        rows is None
        or len(rows) != len(coarse.v_template)
        or rows.max(initial=-1) >= len(full.v_template)
    ):
        return False
    if any(getattr(coarse, name) != getattr(full, name) for name in _ALIKE):
        return False
    if not np.array_equal(coarse.v_template, full.v_template[rows]):
        return False
    some = np.linspace(0, len(rows) - 1, min(_SAMPLES, len(rows))).astype(np.int64)
    for name in _ARRAYS:
        ours = getattr(coarse, name)
        theirs = getattr(full, name)
        if (ours is None) != (theirs is None):
            return False
        if ours is not None and not np.array_equal(ours[some], theirs[rows[some]]):
            return False
    return _same_dynamics(coarse.dynamics, full.dynamics, some, rows)


def _same_dynamics(coarse: Any, full: Any, some: np.ndarray, rows: np.ndarray) -> bool:
    if coarse is None or full is None:
        return coarse is full
    if not np.array_equal(coarse.directions[some], full.directions[rows[some]]):
        return False
    return np.array_equal(coarse.regressor.drive, full.regressor.drive)


def then(finer: Callable[[], Any] | None, change: str, *arguments: Any) -> Callable[[], Any] | None:
    """What makes the full level, followed by one of its methods that gives another body."""
    return None if finer is None else partial(_then, finer, change, arguments)


def _then(finer: Callable[[], Any], change: str, arguments: tuple[Any, ...]) -> Any:
    return getattr(finer(), change)(*arguments)
