"""What labels themselves say of sides: a pair of names that differ only by an L and an R."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

_WORDS = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("L", "R"), ("l", "r"))
FEWEST = 3
"""Pairs from which on the names of a set are believed to tell sides."""
CLEAR = 0.03
"""Metres from the middle of the body from which on a place is on a side."""


def named_sides(labels: Sequence[str]) -> Float[np.ndarray, " M"]:
    """1 for labels that say left, -1 for right, 0 for what says nothing: only one of a pair
    (``LTHI``, ``RTHI``) does.

    All 0 where fewer than `FEWEST` pairs are named so.
    """
    known = set(labels)
    sides = np.zeros(len(labels))
    for column, label in enumerate(labels):
        for side, (mine, other) in ((s, pair[::s]) for pair in _WORDS for s in (1, -1)):
            if any(
                _exchanged(label, mine, other, start) in known for start in _starts(label, mine)
            ):
                sides[column] = side
                break
    return sides if (sides != 0).sum() >= 2 * FEWEST else np.zeros(len(labels))


def agreement(sides: Float[np.ndarray, " M"], across: Float[np.ndarray, " M"]) -> float | None:
    """Share of the named labels whose place (its x on the template, m) lies on the side they name;
    None without any.
    """
    told = (sides != 0) & (np.abs(across) > CLEAR)
    return (
        float(np.mean(np.sign(across[told]) == sides[told])) if told.sum() >= 2 * FEWEST else None
    )


def _starts(label: str, part: str) -> list[int]:
    return [k for k in range(len(label)) if label.startswith(part, k)]


def _exchanged(label: str, mine: str, other: str, start: int) -> str:
    return label[:start] + other + label[start + len(mine) :]
