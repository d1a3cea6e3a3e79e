"""The fits themselves (M eq. 12): state from some vertices of a surface with MoSh's priors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.selection.problem import NOISE, Posed, by_state, precision
from habitus.solve.least_squares import Tolerances
from habitus.solve.minimize import minimize
from habitus.solve.terms import Term

_STEPS = 40  # accepted and refused
_TOLERANCES = Tolerances(cost=1e-10, step=1e-8)


class SurfaceFit(NamedTuple):
    """The likeliest state, and how the solve ended (`habitus.solve.least_squares.SolveResult`)."""

    person: Posed
    status: str


def fit_surface(
    body: BodyModel,
    prior: PosePrior,
    start: Posed,
    vertices: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
    noise: float = NOISE,
) -> SurfaceFit:
    """The likeliest state of a body whose ``vertices`` are observed at ``points`` (m), begun at
    ``start``.
    """
    solution = minimize(
        surface_terms(body, prior, vertices, points, noise),
        {"betas": start.betas, "pose": start.pose, "trans": start.trans},
        "dogleg",
        max_iterations=_STEPS,
        tolerances=_TOLERANCES,
    )
    return SurfaceFit(Posed(**solution.values, surface=start.surface), solution.status)


def surface_terms(
    body: BodyModel,
    prior: PosePrior,
    vertices: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
    noise: float = NOISE,
) -> dict[str, Term]:
    """The energy of betas (B,), pose (J, 3) and trans (3,): vertices against points with the
    standard deviation ``noise`` (m), and MoSh's priors (`habitus.fit.selection.problem.precision`).
    """
    trust = precision(body, prior)
    root = np.linalg.cholesky(trust).T
    mean = _mean(body, prior)
    split = [body.num_betas, len(mean) - 3]

    def by_name(jacobian: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(("betas", "pose", "trans"), np.split(jacobian, split, axis=1), strict=True))

    def data(betas, pose, trans):
        def jacobians():
            moved = by_state(body, Posed(betas, pose, trans, points), vertices)
            return by_name(moved.reshape(3 * len(vertices), -1))

        return body(betas, pose, trans, vertices=vertices).vertices - points, jacobians

    def priors(betas, pose, trans):
        state = np.concatenate([betas, pose.ravel(), trans])
        return root @ (state - mean), by_name(root)

    return {"data": Term(data, 1.0 / noise**2), "priors": Term(priors)}


def best_states(
    body: BodyModel,
    prior: PosePrior,
    people: Sequence[Posed],
    vertices: Int[np.ndarray, " n"],
    noise: float = NOISE,
) -> tuple[Posed, ...]:
    """Each person at the state that fits many ``vertices`` of their surface best."""
    return tuple(
        fit_surface(body, prior, person, vertices, person.surface[vertices], noise).person
        for person in people
    )


def full_error(
    body: BodyModel,
    prior: PosePrior,
    people: Sequence[Posed],
    chosen: Int[np.ndarray, " n"],
    judged: Int[np.ndarray, " m"],
    offsets: Float[np.ndarray, "Z V 3"],
    noise: float = NOISE,
) -> float:
    """The error of eq. 13 (m, root mean square over people and ``judged`` vertices) by fits to
    ``chosen`` vertices.

    ``offsets`` (m) is the noise that each vertex would have as a marker.
    """
    squares = []
    for person, off in zip(people, offsets, strict=True):
        fitted = fit_surface(
            body, prior, person, chosen, person.surface[chosen] + off[chosen], noise
        ).person
        here = body(fitted.betas, fitted.pose, fitted.trans, vertices=judged).vertices
        squares.append(((here - person.surface[judged]) ** 2).sum(-1).mean())
    return float(np.sqrt(np.mean(squares)))


def _mean(body: BodyModel, prior: PosePrior) -> np.ndarray:
    pose = np.zeros(3 * body.num_joints)
    pose[3:] = prior.for_joints(body.joint_names).mean
    return np.concatenate([np.zeros(body.num_betas), pose, np.zeros(3)])
