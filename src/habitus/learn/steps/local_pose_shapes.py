"""Local pose blend shapes: each vertex is driven by the joints near it that matter (S 5.2's idea,
the errors of S 3).

With residuals y - A P f of a vertex in all registrations, A its blended rotation and f the features
of the joints that may drive it, E_D + E_P is a quadratic in the few numbers of P: it is formed and
solved exactly, in posed space, where the creases of linear blend skinning (A nearly singular) ask
for little. So is E_R, the prior on rotations that no registration shows (`rotation_prior`). Joints
are let go of by what that costs people left out: those of one half of the people, with what the
other half says.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve

from habitus.body.pose_features import POSE_FEATURES
from habitus.learn.estimate import Estimate, Problem, posed_targets, weighted
from habitus.learn.posing.rig import RestPerson, kinship
from habitus.learn.posing.rotation_prior import rotation_gram
from habitus.learn.posing.surface import posed
from habitus.learn.steps.skeletons import subset_rig
from habitus.parallel.workers import Workers, in_blocks


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
        rises = [half.rises(move) for half, move in zip(halves, moves, strict=True)]
        costs = np.asarray(sum(rises))
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


_CHUNK = 1024
"""Vertices of a chunk: every registration is posed once for each."""
_FEW = 64
"""Vertices whose normal equations are formed at once."""


@dataclass(frozen=True, eq=False)
class _Task:
    """What all chunks share: features of the registrations, joints that may drive each vertex,
    columns of each joint, and which half of the people a registration is of; ``least`` is None
    where no joint is to be let go of.
    """

    problem: Problem
    estimate: Estimate
    features: Float[np.ndarray, "N F"]
    driven: Bool[np.ndarray, "V D"]
    columns: Int[np.ndarray, "D k"]
    half: Int[np.ndarray, " N"]
    least: float | None

    @cached_property
    def penalty(self) -> Float[np.ndarray, "k k"]:
        """Half the second derivative of E_P and E_R by one joint's row of blend shapes."""
        options = self.problem.options
        features = POSE_FEATURES[options.pose_features]
        gram = options.rotation_prior * len(self.features) * rotation_gram(features)
        return gram + options.weights.pose_shapes * np.eye(features.per_joint)


def solve_local(
    problem: Problem,
    estimate: Estimate,
    features: Float[np.ndarray, "N F"],
    workers: Workers,
    *,
    choose: bool = False,
) -> Float[np.ndarray, "V 3 F"]:
    """The local pose blend shapes (m) of least E_D + E_P + E_R; vertices that no registration
    shows keep theirs.

    ``features`` are those of every registration, times what describes its person. With ``choose``
    joints are let go of where that costs people left out less than the options' ``least_effect``.
    """
    rig = estimate.rig
    assert rig.posedirs is not None
    joints = rig.num_joints - 1
    columns = (
        np.arange(features.shape[1]).reshape(1 + rig.shape_features, joints, -1).transpose(1, 0, 2)
    )
    columns = columns.reshape(joints, -1)
    driven = neighbourhoods(
        problem, estimate, np.abs(features).max(0)[columns].max(1) > 1e-9, columns
    )
    half = halves(problem.registrations.subject_index)
    least = problem.options.least_effect if choose else None
    task = _Task(problem, estimate, features, driven, columns, half, least)
    order = np.lexsort(driven.T)
    chunks = [order[block.start : block.stop] for block in in_blocks(len(order), _CHUNK)]
    table = rig.posedirs.copy()
    for chunk, solution in zip(chunks, workers.map(_chunk, task, chunks), strict=True):
        table[chunk] = solution
    return table


def halves(person: Int[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Which half of the people a registration is of, two neighbours together: they may be one and
    its mirror image.

    Of fewer than four people each gives every other registration to a half.
    """
    return (person // 2 if person.max() >= 3 else np.arange(len(person))) % 2


def neighbourhoods(
    problem: Problem,
    estimate: Estimate,
    moving: Bool[np.ndarray, " D"],
    columns: Int[np.ndarray, "D k"],
) -> Bool[np.ndarray, "V D"]:
    """The joints (all but the root) that may drive each vertex: within some bones of its strongest
    one, or next to one that moves it, as far as they move in the data; and those that drive it
    already.
    """
    far = kinship(estimate.rig.parents)
    weights = problem.initial_weights
    near = (far[weights.argmax(1)] <= problem.options.settings.joint_reach) | (
        (weights > 0).astype(float) @ (far <= 1) > 0
    )
    assert estimate.rig.posedirs is not None
    driving = np.any(estimate.rig.posedirs, 1)[:, columns].any(2)
    return (near[:, 1:] & moving) | driving


def _chunk(task: _Task, ids: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 F"]:
    assert task.estimate.rig.posedirs is not None
    square, right = _gathered(task, ids)
    out = task.estimate.rig.posedirs[ids].copy()
    seen = np.any(square[:, :, 0], 0)
    for rows in _alike(task.driven[ids], seen):
        columns = task.columns[task.driven[ids[rows[0]]]]
        out[rows] = 0.0
        if columns.size:
            out[np.ix_(rows, np.arange(3), columns.ravel())] = _solved(
                task, square[:, rows], right[:, rows], columns
            )
    return out


def _alike(
    driven: Bool[np.ndarray, "n D"], seen: Bool[np.ndarray, " n"]
) -> Iterator[Int[np.ndarray, " m"]]:
    """Vertices that are seen, a few at a time, driven by the same joints."""
    for kind in np.unique(driven[seen], axis=0):
        rows = np.flatnonzero((driven == kind).all(1) & seen)
        for first in range(0, len(rows), _FEW):
            yield rows[first : first + _FEW]


_UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _gathered(
    task: _Task, ids: np.ndarray
) -> tuple[Float[np.ndarray, "N n 6"], Float[np.ndarray, "N n 3"]]:
    """Each registration's A'A and A'y of some vertices, times their weights."""
    count = len(task.features)
    few = replace(task.estimate, rig=replace(subset_rig(task.estimate.rig, ids), posedirs=None))
    square = np.empty((count, len(ids), 6), np.float32)
    right = np.empty((count, len(ids), 3), np.float32)
    for row, (person, target) in enumerate(
        posed_targets(task.problem, task.estimate, range(count))
    ):
        applied = posed(few.rig, target.pose)
        some = RestPerson(person.template[ids], person.joints, person.descriptor)
        left = target.vertices[ids] - target.trans - applied.vertices(some.template, some.joints)
        weight = None if target.weight is None else target.weight[ids]
        back = weighted(applied.turn.transpose(0, 2, 1), weight)
        right[row] = (back @ left[..., None])[..., 0]
        both = back @ applied.turn
        square[row] = np.stack([both[:, a, b] for a, b in _UPPER], 1)
    return square, right


def _solved(
    task: _Task,
    square: Float[np.ndarray, "N m 6"],
    right: Float[np.ndarray, "N m 3"],
    columns: Int[np.ndarray, "g k"],
) -> Float[np.ndarray, "m 3 G"]:
    """Pose blend shapes of vertices that the same joints may drive, by the columns of these
    joints.
    """
    features = task.features[:, columns.ravel()]
    weight = task.problem.options.weights.pose_shapes
    halves = (
        [np.flatnonzero(task.half == k) for k in (0, 1)]
        if task.least is not None
        else [slice(None)]
    )
    equations = [_normal_equations(features[rows], square[rows], right[rows]) for rows in halves]
    size = features.shape[1]
    solution = np.zeros((square.shape[1], 3, columns.size))
    penalty = np.kron(np.eye(3 * size // len(task.penalty)), task.penalty)
    groups = (
        np.arange(3 * size).reshape(3, *columns.shape).transpose(1, 0, 2).reshape(len(columns), -1)
    )
    for k in range(len(solution)):
        grams = [gram[k] for gram, _ in equations]
        pulls = [pull[k] for _, pull in equations]
        use = np.arange(3 * size)
        if task.least is not None:
            limit = task.least**2 * float(square[:, k, :3].sum()) / 3
            use = np.sort(groups[kept_groups(grams, pulls, penalty, groups, limit)].ravel())
        gram = np.asarray(sum(grams))[np.ix_(use, use)]
        floor = 1e-10 * max(float(gram.trace()), 1e-3) / max(len(use), 1)
        if len(use):
            ridge = penalty[np.ix_(use, use)] + max(floor - weight, 0.0) * np.eye(len(use))
            factor = cho_factor(gram + ridge)
            solution[k].reshape(-1)[use] = cho_solve(factor, np.asarray(sum(pulls))[use])
    return solution


def _normal_equations(
    features: Float[np.ndarray, "N G"],
    square: Float[np.ndarray, "N m 6"],
    right: Float[np.ndarray, "N m 3"],
) -> tuple[Float[np.ndarray, "m R R"], Float[np.ndarray, "m R"]]:
    """Of each vertex (R = 3 G): sums over registrations of A'A (x) f f' and of A'y (x) f."""
    count = square.shape[1]
    size = features.shape[1]
    row, two = np.triu_indices(size)
    products = features[:, row] * features[:, two]
    sums = (square.reshape(len(square), -1).astype(np.float64).T @ products).reshape(count, 6, -1)
    gram = np.empty((count, 3, size, 3, size))
    for c, (a, b) in enumerate(_UPPER):
        gram[:, a, row, b, two] = gram[:, a, two, b, row] = sums[:, c]
        gram[:, b, row, a, two] = gram[:, b, two, a, row] = sums[:, c]
    pull = np.tensordot(right.astype(np.float64), features, (0, 0))
    return gram.reshape(count, 3 * size, 3 * size), pull.reshape(count, -1)
