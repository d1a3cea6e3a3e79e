"""Which groups of unknowns of a least-squares problem matter to data that were left out: backward elimination."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int


def kept_groups(
    grams: Sequence[Float[np.ndarray, "C C"]],
    pulls: Sequence[Float[np.ndarray, " C"]],
    ridge: float,
    groups: Int[np.ndarray, "G k"],
    limit: float,
) -> Bool[np.ndarray, " G"]:
    """The groups of unknowns left when those are let go of, one by one, that cost least, as long as they cost less than
    ``limit``.

    ``grams`` and ``pulls`` are the normal equations of the two halves of the data. A group's cost is by how much the
    sums of squares of both halves rise together, each with the unknowns that the other half gives (with half of the
    ``ridge``): the group's set to zero, the others solved for again.
    """
    kept = np.ones(len(groups), bool)
    halves = [_Half.of(gram, pull, ridge / 2) for gram, pull in zip(grams, pulls, strict=True)]
    while kept.any():
        left = np.flatnonzero(kept)
        moves = [half.without(groups[left]) for half in halves]
        costs = sum(
            _rises(gram, pull, half.solution, move)
            for half, move, gram, pull in zip(halves, moves, grams[::-1], pulls[::-1], strict=True)
        )
        least = int(np.argmin(costs))
        if costs[least] >= limit:
            break
        kept[left[least]] = False
        halves = [half.dropped(groups[left[least]], move[:, least]) for half, move in zip(halves, moves, strict=True)]
    return kept


class _Half:
    """The inverse of one half's matrix over the groups that are left, zero elsewhere, and its solution."""

    def __init__(self, inverse: Float[np.ndarray, "C C"], solution: Float[np.ndarray, " C"]):
        self.inverse, self.solution = inverse, solution

    @staticmethod
    def of(gram: Float[np.ndarray, "C C"], pull: Float[np.ndarray, " C"], ridge: float) -> "_Half":
        floor = 1e-10 * max(float(gram.trace()), 1e-3) / len(gram)
        inverse = np.linalg.inv(gram + max(ridge, floor) * np.eye(len(gram)))
        return _Half(inverse, inverse @ pull)

    def without(self, groups: Int[np.ndarray, "g k"]) -> Float[np.ndarray, "C g"]:
        """How the solution moves when each of the groups is set to zero and the others are solved for again."""
        own = self.inverse[groups[:, :, None], groups[:, None, :]]
        push = np.linalg.solve(own, self.solution[groups][..., None])[..., 0]
        return -np.stack([self.inverse[:, group] @ one for group, one in zip(groups, push, strict=True)], 1)

    def dropped(self, group: Int[np.ndarray, " k"], move: Float[np.ndarray, " C"]) -> "_Half":
        """The same without a group, whose letting go moves the solution so."""
        columns = self.inverse[:, group]
        inverse = self.inverse - columns @ np.linalg.solve(self.inverse[np.ix_(group, group)], columns.T)
        inverse[group], inverse[:, group] = 0.0, 0.0
        solution = self.solution + move
        solution[group] = 0.0
        return _Half(inverse, solution)


def _rises(
    gram: Float[np.ndarray, "C C"], pull: Float[np.ndarray, " C"], at: Float[np.ndarray, " C"], moves: np.ndarray
) -> Float[np.ndarray, " g"]:
    """By how much x' gram x - 2 pull' x rises along moves from a point."""
    return 2 * (gram @ at - pull) @ moves + (moves * (gram @ moves)).sum(0)
