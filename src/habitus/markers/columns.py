"""Which columns of one set of markers are those of another: by what they hold, whatever they are
called.
"""

import numpy as np
from jaxtyping import Float, Int

SAME = 1e-3
"""Metres within which two samples are one."""
_LOOKED_AT = 40


def same_columns(
    wanted: Float[np.ndarray, "T M 3"], found: Float[np.ndarray, "T N 3"]
) -> Int[np.ndarray, " M"]:
    """For each marker ``wanted`` the column of ``found`` that holds every sample of it, NaN where
    missing; else -1.

    ``found`` may hold more samples. Of several equal columns it is the first.
    """
    return np.array(
        [_column(wanted[:, marker], found) for marker in range(wanted.shape[1])], dtype=np.int64
    )


def _column(track: np.ndarray, found: np.ndarray) -> int:
    seen = np.flatnonzero(np.isfinite(track[:, 0]))
    if not len(seen):
        return -1
    some = seen[np.linspace(0, len(seen) - 1, min(_LOOKED_AT, len(seen))).astype(int)]
    near = _same(track[some, None], found[some]).all(axis=0)
    return next(
        (int(k) for k in np.flatnonzero(near) if _same(track[seen], found[seen, k]).all()), -1
    )


def _same(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.abs(one - other).max(axis=-1) < SAME  # false for NaN
