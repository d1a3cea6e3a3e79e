"""Which labels keep their distance from each other: markers of one rigid part of the body."""

import numpy as np
from jaxtyping import Float

RIGID = 0.004
"""Metres: the spread of a distance within one part, skin moving over bone included."""
MOVED = 0.02
"""Metres: a label all of whose distances spread less than this in the middle tells nothing: nobody
moved.
"""
_MOST = 4


def companions(markers: Float[np.ndarray, "F M 3"]) -> list[tuple[int, ...]]:
    """For each label the columns of those that keep their distance to it, the most rigid first;
    none where most do.
    """
    count = markers.shape[1]
    spread = np.full((count, count), np.inf)
    for column in range(count):
        apart = np.linalg.norm(markers - markers[:, column : column + 1], axis=2)
        seen = np.isfinite(apart).sum(axis=0)
        some = seen >= 3
        spread[column, some] = np.nanstd(apart[:, some], axis=0)
    np.fill_diagonal(spread, np.inf)
    found = []
    for row in spread:
        known = row[np.isfinite(row)]
        moved = len(known) > 0 and float(np.median(known)) > MOVED
        order = np.argsort(row, kind="stable")[:_MOST]
        found.append(tuple(int(k) for k in order if row[k] < RIGID) if moved else ())
    return found
