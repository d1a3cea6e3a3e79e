"""Which groups of unknowns of a least-squares problem matter to data that were left out: backward
elimination.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from jaxtyping import Float, Int


def kept_groups(
    grams: Sequence[Float[np.ndarray, "C C"]],
    pulls: Sequence[Float[np.ndarray, " C"]],
    penalty: Float[np.ndarray, "C C"],
    groups: Int[np.ndarray, "G k"],
    limit: float,
) -> Int[np.ndarray, " g"]:
    """The groups of unknowns left when those are let go of, one by one, that cost least, as long as
    they cost less than ``limit``.

    ``grams`` and ``pulls`` are the normal equations of the two halves of the data, ``penalty`` the
    matrix of a quadratic one of all. A group's cost is by how much the sums of squares of both
    halves rise together, each with the unknowns that the other half gives (with half of the
    penalty): the group's set to zero, the others solved for again.
    """
    left = np.arange(len(groups))
    halves = []
    for (gram, pull), (other, away) in permutations(zip(grams, pulls, strict=True)):
        floor = 1e-10 * max(float(gram.trace()), 1e-3) / len(gram)
        inverse = np.linalg.inv(gram + penalty / 2 + floor * np.eye(len(gram)))
        halves.append(_Half(inverse, inverse @ pull, other, away))
    while len(left):
        moves = [half.without(groups) for half in halves]
        costs = sum(half.rises(move) for half, move in zip(halves, moves, strict=True))
        least = int(np.argmin(costs))
        if costs[least] >= limit:
            break
        halves = [
            half.dropped(groups[least], move[:, least])
            for half, move in zip(halves, moves, strict=True)
        ]
        left = np.delete(left, least)
        groups = _renumbered(groups, least)
    return left


def _renumbered(groups: Int[np.ndarray, "G k"], gone: int) -> Int[np.ndarray, "H k"]:
    """The unknowns of the other groups, numbered without those of one that is gone."""
    rest = np.delete(groups, gone, axis=0)
    return rest - np.searchsorted(np.sort(groups[gone]), rest)


@dataclass(frozen=True, eq=False)
class _Half:
    """One half's inverse matrix and solution over the groups that are left, and the other half's
    normal equations.
    """

    inverse: Float[np.ndarray, "C C"]
    solution: Float[np.ndarray, " C"]
    gram: Float[np.ndarray, "C C"]
    pull: Float[np.ndarray, " C"]

    def without(self, groups: Int[np.ndarray, "g k"]) -> Float[np.ndarray, "C g"]:
        """How the solution moves when each of the groups is set to zero and the others are solved
        for again.
        """
        own = self.inverse[groups[:, :, None], groups[:, None, :]]
        push = np.linalg.solve(own, self.solution[groups][..., None])[..., 0]
        spread = np.zeros((len(self.inverse), len(groups)))
        spread[groups, np.arange(len(groups))[:, None]] = push
        return -self.inverse @ spread

    def rises(self, moves: Float[np.ndarray, "C g"]) -> Float[np.ndarray, " g"]:
        """By how much the other half's sum of squares rises along moves of the solution."""
        return 2 * (self.gram @ self.solution - self.pull) @ moves + (
            moves * (self.gram @ moves)
        ).sum(0)

    def dropped(self, group: Int[np.ndarray, " k"], move: Float[np.ndarray, " C"]) -> "_Half":
        """The same without a group, whose letting go moves the solution so."""
        stay = np.delete(np.arange(len(self.pull)), group)
        both = np.ix_(stay, stay)
        columns = self.inverse[np.ix_(stay, group)]
        inverse = self.inverse[both] - columns @ np.linalg.solve(
            self.inverse[np.ix_(group, group)], columns.T
        )
        return _Half(inverse, (self.solution + move)[stay], self.gram[both], self.pull[stay])
