"""Where the blocks of a sparse symmetric matrix over the free nodes lie, worked out once for a
cage.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int


@dataclass(frozen=True)
class Pattern:
    """Rows of 3 x 3 blocks in compressed storage: `columns[starts[n]:starts[n + 1]]` are the
    neighbours of node n.
    """

    starts: Int[np.ndarray, " N1"]
    columns: Int[np.ndarray, " K"]
    diagonal: Int[np.ndarray, " N"]

    def slots(self, corners: Int[np.ndarray, "T 4"]) -> Int[np.ndarray, "T 16"]:
        """Where the block of each pair of corners lies; -1 where one of them is held (its number is
        N or more).
        """
        free = len(self.diagonal)
        rows = np.repeat(corners, 4, 1)
        columns = np.tile(corners, (1, 4))
        known = np.repeat(np.arange(free), np.diff(self.starts)) * free + self.columns
        held = (rows >= free) | (columns >= free)
        place = np.searchsorted(known, np.where(held, 0, rows * free + columns))
        return np.where(held, -1, place).astype(np.int32)


def pattern_of(tets: Int[np.ndarray, "T 4"], free: int) -> Pattern:
    """The pattern of tetrahedra whose nodes below `free` move."""
    rows = np.repeat(tets, 4, 1).ravel()
    columns = np.tile(tets, (1, 4)).ravel()
    both = (rows < free) & (columns < free)
    alone = np.arange(free)
    keys = np.unique(np.concatenate([rows[both] * free + columns[both], alone * (free + 1)]))
    row = keys // free
    column = keys % free
    starts = np.searchsorted(row, np.arange(free + 1))
    return Pattern(starts, column.astype(np.int32), np.flatnonzero(row == column))
