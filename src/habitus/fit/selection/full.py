"""The fits themselves (M eq. 12): state from some vertices of a surface, by Gauss-Newton with
MoSh's priors.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.selection.problem import NOISE, Posed, by_state, precision

STEPS = 12
_ENOUGH = 1e-5  # change of the state at which it is the best


def fit_surface(
    body: BodyModel,
    prior: PosePrior,
    start: Posed,
    vertices: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
    noise: float = NOISE,
) -> Posed:
    """The likeliest state of a body of whose ``vertices`` the places ``points`` (m) are known,
    begun at ``start``.
    """
    trust = precision(body, prior)
    mean = _mean(body, prior)
    state = _vector(start)
    for _ in range(STEPS):
        now = _posed(body, state, start.surface)
        moved = by_state(body, now, vertices).reshape(3 * len(vertices), -1) / noise
        here = body(now.betas, now.pose, now.trans, vertices=vertices).vertices
        left = (points - here).ravel() / noise
        step = np.linalg.solve(moved.T @ moved + trust, moved.T @ left + trust @ (mean - state))
        state = state + step
        if np.abs(step).max() < _ENOUGH:
            break
    return _posed(body, state, start.surface)


def best_states(
    body: BodyModel,
    prior: PosePrior,
    people: Sequence[Posed],
    vertices: Int[np.ndarray, " n"],
    noise: float = NOISE,
) -> tuple[Posed, ...]:
    """Each person at the state that fits many ``vertices`` of their surface best."""
    return tuple(
        fit_surface(body, prior, one, vertices, one.surface[vertices], noise) for one in people
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
    for one, off in zip(people, offsets, strict=True):
        found = fit_surface(body, prior, one, chosen, one.surface[chosen] + off[chosen], noise)
        here = body(found.betas, found.pose, found.trans, vertices=judged).vertices
        squares.append(((here - one.surface[judged]) ** 2).sum(-1).mean())
    return float(np.sqrt(np.mean(squares)))


def _mean(body: BodyModel, prior: PosePrior) -> np.ndarray:
    pose = np.zeros(3 * body.num_joints)
    pose[3:] = prior.for_joints(body.joint_names).mean
    return np.concatenate([np.zeros(body.num_betas), pose, np.zeros(3)])


def _vector(person: Posed) -> np.ndarray:
    return np.concatenate([person.betas, person.pose.ravel(), person.trans])


def _posed(body: BodyModel, state: np.ndarray, surface: np.ndarray) -> Posed:
    count = body.num_betas
    return Posed(state[:count], state[count:-3].reshape(-1, 3), state[-3:], surface)
