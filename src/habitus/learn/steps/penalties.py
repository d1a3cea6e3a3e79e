"""Solvers for E_D + E_P over the pose blend shapes: full (S 4.1), sparse (S 5.2), low rank, L1 (T
5.6).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from habitus.learn.terms import pose_shape_term
from habitus.solve.terms import Term

Table = Float[np.ndarray, "U F"]
Linear = Callable[[np.ndarray], np.ndarray]

_GRADIENT_STEPS = 5
_MAJORISED_STEPS = 5
_SWEEPS = 4


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
            start, self.weight, descent, curvature, lambda r: cho_solve(factor, r.T).T
        )


@dataclass(frozen=True, eq=False)
class Sparse:
    """The same where a vertex is driven by some features only: those where ``driven`` (V, F) holds
    (S 5.2).
    """

    weight: float
    driven: Bool[np.ndarray, "V F"]

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
        )


@dataclass(frozen=True)
class LowRank:
    """lambda_P |P|^2 among tables of some rank: fewer blend shapes at run time (T 5.6, future
    work).
    """

    weight: float
    rank: int

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
        for _ in range(_MAJORISED_STEPS):
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

    @property
    def term(self) -> Term:
        """E_P: absolute values."""
        return pose_shape_term(self.weight, absolute=True)

    def solve(
        self, start: Table, gram: Float[np.ndarray, "F F"], descent: Linear, curvature: Linear
    ) -> Table:
        """Steps that lower the bound by sweeps over its coordinates."""
        table = start.copy()
        for _ in range(_MAJORISED_STEPS):
            slope = descent(table)
            moved = table.copy()
            change = np.zeros_like(table)
            for _ in range(_SWEEPS):
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
    start: Table, weight: float, descent: Linear, curvature: Linear, precondition: Linear
) -> Table:
    """Minimise |y - A P|^2 + weight |P|^2 by a few preconditioned steps; every step lowers it."""
    table = start
    residual = descent(table) - weight * table
    ready = precondition(residual)
    along = ready
    size = float((residual * ready).sum())
    for step in range(_GRADIENT_STEPS):
        if size <= 0.0:
            break
        product = curvature(along) + weight * along
        length = size / float((along * product).sum())
        table = table + length * along
        if step + 1 == _GRADIENT_STEPS:
            break
        residual = residual - length * product
        ready = precondition(residual)
        new = float((residual * ready).sum())
        along = ready + (new / size) * along
        size = new
    return table
