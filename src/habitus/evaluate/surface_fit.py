"""Fit of a posable model to a registration by least squares of vertex distance (S 5.1).

One Levenberg-Marquardt loop serves every model that gives vertices and their exact derivatives;
derivatives come in blocks of vertices, so that only normal matrices are stored.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.fit.known_points import start_pose
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus.solve.least_squares import (
    Derivatives,
    Levenberg,
    Problem,
    SolveResult,
    Tolerances,
    descend,
)

TOLERANCES = Tolerances(cost=1e-6)
"""Of fits: a step changed the mean squared distance by no more than this share of itself."""
_WRAP = (
    1.5 * np.pi
)  # a rotation vector longer than this is replaced by the short one of the same rotation

Columns = tuple[slice, Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 P"]]
"""Some rows of a surface, their vertices (m), and derivatives by the shape coefficients, if asked,
then by the pose.
"""


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit: shape (the coefficients that were asked for), pose (rad), trans (m),
    vertices (m).
    """

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    vertices: Float[np.ndarray, "V 3"]
    iterations: int = 0
    converged: bool = True


class Surface(Protocol):
    """A model that can be fitted: vertices and derivatives without translation; ``betas`` may be
    fewer than it has.
    """

    @property
    def name(self) -> str:
        """For messages."""
        ...

    @property
    def num_betas(self) -> int:
        """Number of shape coefficients."""
        ...

    @property
    def parents(self) -> tuple[int, ...]:
        """The tree of joints, root first."""
        ...

    @property
    def influence(self) -> Float[np.ndarray, "V J"]:
        """Skinning weights."""
        ...

    def surface(
        self, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "J 3"]
    ) -> Float[np.ndarray, "V 3"]:
        """Vertices (m)."""
        ...

    def columns(
        self, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "J 3"], by_betas: bool
    ) -> Iterator[Columns]:
        """Vertices and derivatives, block by block."""
        ...


class FittedToSurfaces:
    """Gives a `Surface` the method ``fit`` of a `Posable`."""

    def fit(
        self: "Surface",
        target: Float[np.ndarray, "V 3"],
        *,
        num_betas: int,
        betas: Float[np.ndarray, " B"] | None = None,
        start: Fit | None = None,
        weights: Float[np.ndarray, " V"] | None = None,
    ) -> Fit:
        """Least squares of vertex distance (m), by `fit_surface`."""
        return fit_surface(
            self, target, num_betas=num_betas, betas=betas, start=start, weights=weights
        )


def fit_surface(
    model: Surface,
    target: Float[np.ndarray, "V 3"],
    *,
    num_betas: int,
    betas: Float[np.ndarray, " B"] | None = None,
    start: Fit | None = None,
    weights: Float[np.ndarray, " V"] | None = None,
    max_iterations: int = 100,
    tolerances: Tolerances = TOLERANCES,
) -> Fit:
    """Least squares of vertex distance over pose (rad), trans (m) and the first ``num_betas``
    coefficients (S 5.1).

    ``betas`` fixes the shape. ``start`` may have fewer coefficients; without it, the fit starts
    from `start_pose`. ``weights`` are those of squared distances, 0 where a vertex was not
    observed; None: all 1. Raises HabitusError where target or numbers do not fit the model.
    """
    target = _checked(model, target, num_betas, weights)
    influence = model.influence if weights is None else model.influence * weights[:, None]
    shape = (
        _first(start.betas if start else np.zeros(0), num_betas)
        if betas is None
        else np.asarray(betas, float)
    )
    if start is None:
        pose = start_pose(
            model.surface(shape, np.zeros((len(model.parents), 3))),
            target,
            influence,
            model.parents,
        )
        trans = np.average(target - model.surface(shape, pose), axis=0, weights=weights)
    else:
        pose = start.pose
        trans = start.trans
    root = None if weights is None else np.sqrt(weights)[:, None]
    unknowns = _Unknowns(model, target, None if betas is None else shape, root)
    x = np.concatenate([np.zeros(0) if betas is not None else shape, _short(pose).ravel(), trans])
    result = _solve(unknowns, x, max_iterations, tolerances)
    shape, pose, trans = unknowns.split(result.x)
    return Fit(
        shape, pose, trans, model.surface(shape, pose) + trans, result.iterations, result.converged
    )


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """The fit as a least-squares problem in one vector: [betas, unless fixed | pose | trans].

    root_weights (V, 1) of distances, None: all 1.
    """

    model: Surface
    target: Float[np.ndarray, "V 3"]
    fixed: Float[np.ndarray, " B"] | None
    root_weights: Float[np.ndarray, "V 1"] | None = None

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shape, pose (J, 3) and trans."""
        count = len(x) - 3 * len(self.model.parents) - 3
        shape = x[:count].copy() if self.fixed is None else self.fixed
        return shape, x[count:-3].reshape(-1, 3).copy(), x[-3:].copy()

    def problem(self, x: np.ndarray) -> tuple[float, Derivatives]:
        """Half the sum of squared distances (m^2), and its derivatives when asked."""
        betas, pose, trans = self.split(x)
        residual = self.model.surface(betas, pose) + trans - self.target
        if self.root_weights is not None:
            residual = self.root_weights * residual
        return 0.5 * float(np.vdot(residual, residual)), lambda: self._normal_equations(
            betas, pose, trans
        )

    def _normal_equations(
        self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        gradient = 0.0
        matrix = 0.0
        for rows, vertices, by in self.model.columns(betas, pose, self.fixed is None):
            by_trans = np.broadcast_to(np.eye(3), (len(vertices), 3, 3))
            jacobian = np.concatenate([by, by_trans], -1).reshape(3 * len(vertices), -1)
            residual = (vertices + trans - self.target[rows]).ravel()
            if self.root_weights is not None:
                root = np.repeat(self.root_weights[rows], 3, axis=0)
                jacobian = root * jacobian
                residual = root[:, 0] * residual
            gradient = gradient + residual @ jacobian
            matrix = matrix + jacobian.T @ jacobian
        return np.asarray(gradient), np.asarray(matrix)


def _solve(
    unknowns: _Unknowns, x: np.ndarray, max_iterations: int, tolerances: Tolerances
) -> SolveResult:
    """Levenberg-Marquardt, interrupted wherever a rotation vector grows long enough to come near 2
    pi.
    """
    problem: Problem = unknowns.problem

    def long(_: int, x: np.ndarray, __: float) -> bool:
        return bool((np.linalg.norm(unknowns.split(x)[1], axis=-1) > _WRAP).any())

    done = 0
    while True:
        steps = Levenberg()
        result = descend(
            problem,
            x,
            steps,
            max_iterations=max_iterations - done,
            tolerances=tolerances,
            callback=long,
        )
        done += result.iterations
        turns = unknowns.split(result.x)[1].size
        x = np.concatenate(
            [result.x[: -3 - turns], _short(result.x[-3 - turns : -3]).ravel(), result.x[-3:]]
        )
        if result.status != "stopped" or done >= max_iterations:
            return replace(result, x=x, iterations=done)


def _short(pose: np.ndarray) -> Float[np.ndarray, "J 3"]:
    """The same rotations as vectors no longer than pi."""
    turns = np.asarray(pose, float).reshape(-1, 3)
    far = np.linalg.norm(turns, axis=-1, keepdims=True) > np.pi
    return np.where(far, rotvec_from_matrix(matrix_from_rotvec(turns)), turns)


def _first(betas: np.ndarray, count: int) -> np.ndarray:
    shape = np.zeros(count)
    shape[: len(betas)] = betas[:count]
    return shape


def _checked(
    model: Surface, target: np.ndarray, num_betas: int, weights: np.ndarray | None
) -> Float[np.ndarray, "V 3"]:
    if not 0 <= num_betas <= model.num_betas:
        raise HabitusError(
            f"{num_betas} shape coefficients asked of {model.name}; expected 0 to {model.num_betas}"
        )
    target = np.asarray(target, float)
    expected = (len(model.influence), 3)
    if target.shape != expected:
        raise HabitusError(
            f"the registration has shape {target.shape}; expected {expected}, as {model.name} has"
        )
    if weights is not None:
        if not weights.any():
            raise HabitusError("no vertex of the registration was observed; leave such meshes out")
        target = np.where(weights[:, None] > 0.0, target, 0.0)
    if not np.isfinite(target).all():
        raise HabitusError(
            "the registration has vertices that are not finite; expected metres: leave such "
            "meshes out"
        )
    return target
