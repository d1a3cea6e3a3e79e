"""Pose blend shapes, given everything else: a large linear least-squares problem (S 4.1, E_D +
E_P).

With residuals y_j - A_j P f_j, A_j the blended rotations and f_j the pose features, the gradient is
a sum of outer products over registrations. Blended rotations do not lengthen, A'A <= I, so that the
features' Gram matrix, the same for all vertices, bounds the curvature from above and nearly equals
it: it preconditions conjugate gradients, and a step by its inverse never raises the energy where
rank or sparsity are constrained. Local ones are solved for vertex by vertex
(``local_pose_shapes.py``).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from habitus.learn.energy import pose_shape_term
from habitus.learn.estimate import Estimate, Problem, posed_targets, weighted
from habitus.learn.options import SETTINGS
from habitus.learn.posing.surface import pose_feature, posed, surface
from habitus.learn.steps.local_pose_shapes import solve_local
from habitus.mesh.registrations import Registrations
from habitus.parallel.workers import Workers, in_blocks
from habitus.solve.terms import Term

Table = Float[np.ndarray, "U F"]
Linear = Callable[[np.ndarray], np.ndarray]


class Penalty(Protocol):
    """E_P in one of its forms, and how to lower E_D + E_P over the pose blend shapes, a table (3V,
    F).
    """

    @property
    def term(self) -> Term:
        """E_P of eq. 14."""
        ...

    def solve(
        self, start: Table, gram: Float[np.ndarray, "F F"], descent: Linear, curvature: Linear
    ) -> Table:
        """A better table; ``descent`` and ``curvature`` are the data term's halved derivatives,
        bounded by ``gram``.
        """
        ...


@dataclass(frozen=True)
class Full:
    """lambda_P |P|^2 (E_P)."""

    weight: float
    steps: int = SETTINGS.gradient_steps

    @property
    def term(self) -> Term:
        """E_P: squares."""
        return pose_shape_term(self.weight)

    def solve(
        self, start: Table, gram: Float[np.ndarray, "F F"], descent: Linear, curvature: Linear
    ) -> Table:
        """Conjugate gradients, preconditioned by the Gram matrix."""
        factor = cho_factor(_bound(gram, self.weight))
        return _conjugate_gradients(
            start,
            self.weight,
            descent,
            curvature,
            lambda r: cho_solve(factor, r.T).T,
            self.steps,
        )


@dataclass(frozen=True, eq=False)
class Sparse:
    """The same where a vertex is driven by some features only: those where ``driven`` (V, F) holds
    (S 5.2).
    """

    weight: float
    driven: Bool[np.ndarray, "V F"]
    steps: int = SETTINGS.gradient_steps

    @property
    def term(self) -> Term:
        """E_P: squares."""
        return pose_shape_term(self.weight)

    def solve(
        self, start: Table, gram: Float[np.ndarray, "F F"], descent: Linear, curvature: Linear
    ) -> Table:
        """Conjugate gradients over the features that may drive a vertex; others stay at zero."""
        matrix = _bound(gram, self.weight)
        kinds, kind = np.unique(self.driven, axis=0, return_inverse=True)
        rows = [np.flatnonzero(np.repeat(kind.ravel() == k, 3)) for k in range(len(kinds))]
        columns = [np.flatnonzero(driven) for driven in kinds]
        factors = [cho_factor(matrix[np.ix_(few, few)]) if len(few) else None for few in columns]

        def precondition(residual: np.ndarray) -> np.ndarray:
            out = np.zeros_like(residual)
            for row, few, factor in zip(rows, columns, factors, strict=True):
                if factor is not None:
                    out[np.ix_(row, few)] = cho_solve(factor, residual[np.ix_(row, few)].T).T
            return out

        open_ = np.repeat(self.driven, 3, axis=0)
        return _conjugate_gradients(
            start * open_,
            self.weight,
            lambda table: descent(table) * open_,
            lambda along: curvature(along) * open_,
            precondition,
            self.steps,
        )


@dataclass(frozen=True)
class LowRank:
    """lambda_P |P|^2 among tables of some rank: fewer blend shapes at run time (T 5.6, future
    work).
    """

    weight: float
    rank: int
    steps: int = SETTINGS.majorised_steps

    @property
    def term(self) -> Term:
        """E_P: squares."""
        return pose_shape_term(self.weight)

    def solve(
        self, start: Table, gram: Float[np.ndarray, "F F"], descent: Linear, curvature: Linear
    ) -> Table:
        """Steps to the minimum of the bound, each the nearest table of that rank in the bound's own
        metric.
        """
        matrix = _bound(gram, self.weight)
        factor = cho_factor(matrix)
        root = np.linalg.cholesky(matrix)
        table = start
        for _ in range(self.steps):
            goal = table + cho_solve(factor, (descent(table) - self.weight * table).T).T
            stretched = goal @ root
            _, turn = np.linalg.eigh(stretched.T @ stretched)
            kept = turn[:, -self.rank :]
            table = np.linalg.solve(root.T, (stretched @ kept @ kept.T).T).T
        return table


@dataclass(frozen=True)
class SparseL1:
    """A weight times the sum of absolute values, in place of squares: most numbers become zero (S
    4.1's remark).
    """

    weight: float
    steps: int = SETTINGS.majorised_steps
    sweeps: int = SETTINGS.coordinate_sweeps

    @property
    def term(self) -> Term:
        """E_P: absolute values."""
        return pose_shape_term(self.weight, absolute=True)

    def solve(
        self, start: Table, gram: Float[np.ndarray, "F F"], descent: Linear, curvature: Linear
    ) -> Table:
        """Steps that lower the bound by sweeps over its coordinates."""
        table = start.copy()
        for _ in range(self.steps):
            slope = descent(table)
            moved = table.copy()
            change = np.zeros_like(table)
            for _ in range(self.sweeps):
                for f in range(len(gram)):
                    if gram[f, f] > 0:
                        pull = slope[:, f] - change @ gram[:, f] + gram[f, f] * moved[:, f]
                        new = (
                            np.sign(pull)
                            * np.maximum(np.abs(pull) - 0.5 * self.weight, 0)
                            / gram[f, f]
                        )
                        change[:, f] += new - moved[:, f]
                        moved[:, f] = new
            table = moved
        return table


def _bound(gram: Float[np.ndarray, "F F"], weight: float) -> Float[np.ndarray, "F F"]:
    """The bound on the curvature, kept invertible where fewer registrations than features leave
    some of them free.
    """
    floor = 1e-10 * max(float(gram.trace()), 1.0) / len(gram)
    return gram + max(weight, floor) * np.eye(len(gram))


def _conjugate_gradients(
    start: Table,
    weight: float,
    descent: Linear,
    curvature: Linear,
    precondition: Linear,
    steps: int,
) -> Table:
    """Minimise |y - A P|^2 + weight |P|^2 by a few preconditioned steps; every step lowers it."""
    table = start
    residual = descent(table) - weight * table
    ready = precondition(residual)
    along = ready
    size = float((residual * ready).sum())
    for step in range(steps):
        if size <= 0.0:
            break
        product = curvature(along) + weight * along
        length = size / float((along * product).sum())
        table = table + length * along
        if step + 1 == steps:
            break
        residual = residual - length * product
        ready = precondition(residual)
        new = float((residual * ready).sum())
        along = ready + (new / size) * along
        size = new
    return table


_BLOCK = 32


def solve_pose_shapes(
    problem: Problem, estimate: Estimate, workers: Workers
) -> Float[np.ndarray, "V 3 F"]:
    """Better pose blend shapes (m): data term and penalty together never rise."""
    start = estimate.rig.posedirs
    assert start is not None
    features = extended_features(problem, estimate)
    if problem.options.pose_shapes == "local":
        return solve_local(problem, estimate, features, workers)
    table = penalty(problem, features.shape[1]).solve(
        start.reshape(-1, start.shape[-1]),
        features.T @ features,
        lambda table: _descent(problem, estimate, features, table, workers),
        lambda along: _curvature(problem, estimate, features, along, workers),
    )
    return table.reshape(start.shape)


def let_go(problem: Problem, estimate: Estimate, workers: Workers) -> Estimate:
    """Local pose blend shapes without the joints that matter less than the options'
    ``least_effect``.
    """
    if problem.options.pose_shapes != "local" or "posedirs" in problem.held:
        return estimate
    features = extended_features(problem, estimate)
    posedirs = solve_local(problem, estimate, features, workers, choose=True)
    return replace(estimate, rig=replace(estimate.rig, posedirs=posedirs))


def extended_features(problem: Problem, estimate: Estimate) -> Float[np.ndarray, "N F"]:
    """Every registration's pose features times one and times each number that describes its
    person.
    """
    features = pose_feature(estimate.rig, estimate.pose)
    numbers = estimate.descriptors[problem.registrations.subject_index]
    factors = np.concatenate([np.ones((len(features), 1)), numbers], 1)
    return (factors[:, :, None] * features[:, None, :]).reshape(len(features), -1)


def penalty(problem: Problem, features: int) -> Penalty:
    """The penalty that the options name, for so many features."""
    options = problem.options
    settings = options.settings
    weight = options.weights.pose_shapes
    if options.pose_shapes == "sparse":
        return Sparse(weight, _driven(problem, features), settings.gradient_steps)
    return {
        "full": Full(weight, settings.gradient_steps),
        "low_rank": LowRank(weight, options.rank, settings.majorised_steps),
        "l1": SparseL1(options.l1, settings.majorised_steps, settings.coordinate_sweeps),
    }[options.pose_shapes]


def allowed_pose_shapes(
    problem: Problem, posedirs: Float[np.ndarray, "V 3 F"]
) -> Float[np.ndarray, "V 3 F"]:
    """The nearest pose blend shapes of the kind that the options name: of lower rank, or driven by
    nearby joints.
    """
    options = problem.options
    if options.pose_shapes == "sparse":
        return posedirs * _driven(problem, posedirs.shape[-1])[:, None]
    if options.pose_shapes == "low_rank":
        u, s, vt = np.linalg.svd(posedirs.reshape(-1, posedirs.shape[-1]), full_matrices=False)
        return ((u[:, : options.rank] * s[: options.rank]) @ vt[: options.rank]).reshape(
            posedirs.shape
        )
    return posedirs


def _driven(problem: Problem, features: int) -> Bool[np.ndarray, "V F"]:
    """Features that may drive a vertex in sparse blend shapes: those of its initial weights' joints
    (S 5.2).
    """
    joints = problem.initial_weights[:, 1:] > 0
    blocks = 1 + problem.options.shape_features
    return np.tile(np.repeat(joints, features // (blocks * joints.shape[1]), axis=1), (1, blocks))


def _descent(
    problem: Problem, estimate: Estimate, features: np.ndarray, table: np.ndarray, workers: Workers
) -> Float[np.ndarray, "U F"]:
    """Half the negative gradient of the data term: sum of A'r f'."""
    rig = replace(estimate.rig, posedirs=table.reshape(-1, 3, table.shape[1]))
    shared = (problem, replace(estimate, rig=rig), features)
    return sum(
        workers.map(_descent_of, shared, in_blocks(len(features), _BLOCK)), np.zeros_like(table)
    )


def _descent_of(
    shared: tuple[Problem, Estimate, np.ndarray], rows: range
) -> Float[np.ndarray, "U F"]:
    problem, estimate, features = shared
    pulls = []
    for person, target in posed_targets(problem, estimate, rows):
        turn = posed(estimate.rig, target.pose).turn
        left = target.vertices - target.trans - surface(estimate.rig, person, target.pose)
        left = weighted(left, target.weight)
        pulls.append((turn.transpose(0, 2, 1) @ left[..., None]).ravel())
    return np.stack(pulls, 1) @ features[rows.start : rows.stop]


def _curvature(
    problem: Problem, estimate: Estimate, features: np.ndarray, along: np.ndarray, workers: Workers
) -> Float[np.ndarray, "U F"]:
    """Half the data term's second derivative applied to a direction: sum of A'A D f f'."""
    shared = (problem.registrations if problem.weighted else None, estimate, features, along)
    return sum(
        workers.map(_curvature_of, shared, in_blocks(len(features), _BLOCK)), np.zeros_like(along)
    )


def _curvature_of(
    shared: tuple[Registrations | None, Estimate, np.ndarray, np.ndarray], rows: range
) -> Float[np.ndarray, "U F"]:
    registrations, estimate, features, along = shared
    few = features[rows.start : rows.stop]
    offsets = along @ few.T
    for column, row in enumerate(rows):
        turn = posed(estimate.rig, estimate.pose[row]).turn
        weight = None if registrations is None else registrations.read_seen(row)[1]
        offset = weighted(offsets[:, column].reshape(-1, 3, 1), weight)
        offsets[:, column] = (turn.transpose(0, 2, 1) @ (turn @ offset)).ravel()
    return offsets @ few
