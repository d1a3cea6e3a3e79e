"""The energy of T eq. 4.3 without colour, as named terms over one shape and a pose and place for
each view.

Each term gives a cost, a gradient and a Gauss-Newton matrix over betas (B), then trans (3) and pose
(3 J) of each view.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.fit.rgbd.settings import STIFF, RgbdSettings
from habitus.residuals.surface_points import PointMatches, SurfacePointSolver
from habitus.solve.arrow import ArrowMatrix

LONGEST = (0.5, 0.4, 1.5)
"""The longest step at once: m of place, rad of a joint, sd of shape."""
TINY = 1e-9


@dataclass(frozen=True, eq=False)
class State:
    """Betas (B,), pose (K, J, 3) and trans (K, 3) of K views."""

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "K J 3"]
    trans: Float[np.ndarray, "K 3"]

    @property
    def vector(self) -> Float[np.ndarray, " n"]:
        """All numbers, in the energy's order."""
        views = np.concatenate([self.trans, self.pose.reshape(len(self.pose), -1)], 1)
        return np.concatenate([self.betas, views.ravel()])

    def moved(self, step: Float[np.ndarray, " n"]) -> "State":
        """The state a step further, cut short where it would leap."""
        head = step[: len(self.betas)]
        views = step[len(self.betas) :].reshape(len(self.pose), -1)
        place = views[:, :3]
        turn = views[:, 3:].reshape(self.pose.shape)
        longest = (place, turn, head)
        share = min(
            [
                1.0,
                *(
                    most / max(np.abs(part).max(initial=0.0), TINY)
                    for part, most in zip(longest, LONGEST, strict=True)
                ),
            ]
        )
        return State(
            self.betas + share * head, self.pose + share * turn, self.trans + share * place
        )


@dataclass(frozen=True, eq=False)
class Priors:
    """E_S and E_P: Gaussians over betas and over each view's pose (T 4.6.1)."""

    betas_mean: Float[np.ndarray, " B"]
    pose_mean: Float[np.ndarray, "K J 3"]
    pose_sd: Float[np.ndarray, " J"]
    settings: RgbdSettings

    @staticmethod
    def of(body: BodyModel, start: State, settings: RgbdSettings) -> "Priors":
        """Those around a start."""
        stiff = [any(part in name for part in STIFF) for name in body.joint_names]
        sd = np.where(stiff, settings.stiff_sd, settings.pose_sd)
        mean = np.zeros(body.num_betas) if body.people_mean is None else body.people_mean
        return Priors(mean, start.pose, sd, settings)

    def weights(self) -> Float[np.ndarray, " n"]:
        """The matrix, which is diagonal; the root is free."""
        joints = self.settings.pose / np.repeat(self.pose_sd, 3) ** 2
        joints[:3] = 0.0
        view = np.concatenate([np.zeros(3), joints])
        return np.concatenate(
            [np.full(len(self.betas_mean), self.settings.shape), np.tile(view, len(self.pose_mean))]
        )

    def apart(self, state: State) -> Float[np.ndarray, " n"]:
        """The state less the means."""
        return (
            state.vector - State(self.betas_mean, self.pose_mean, np.zeros_like(state.trans)).vector
        )

    def costs(self, state: State) -> dict[str, float]:
        """E_S and E_P."""
        each = 0.5 * self.weights() * self.apart(state) ** 2
        count = len(self.betas_mean)
        return {"shape": float(each[:count].sum()), "pose": float(each[count:].sum())}


def merged(terms: Mapping[str, PointMatches]) -> PointMatches:
    """Terms of one view as one, with as many directions a point as the most of them."""
    given = [one for one in terms.values() if len(one.face)]
    if not given:
        return NOTHING
    most = max(one.direction.shape[1] for one in given)
    padded = [
        replace(
            one,
            direction=np.pad(one.direction, ((0, 0), (0, most - one.direction.shape[1]), (0, 0))),
        )
        for one in given
    ]
    return PointMatches(
        *(np.concatenate([getattr(one, name) for one in padded]) for name in _FIELDS)
    )


NOTHING = PointMatches(
    np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 1, 3))
)
"""No points at all."""
_FIELDS = ("face", "barycentric", "target", "direction")


def gauss_newton_step(
    solver: SurfacePointSolver,
    state: State,
    terms: list[Mapping[str, PointMatches]],
    priors: Priors,
    moves: str,
) -> tuple[State, float]:
    """One step of all that ``moves`` ("place", "pose", "all"); the state it leads to, and the cost
    before it.
    """
    cost, gradient, matrix = data_equations(solver, state, terms)
    weights = priors.weights()
    gradient = gradient + weights * priors.apart(state)
    free = _free(state, moves)
    damping = np.where(free, weights + 1e-6 * (1.0 + matrix.diagonal()), 0.0)
    matrix = _restricted(matrix, free)
    step = matrix.solve(damping + ~free, np.where(free, -gradient, 0.0))
    return state.moved(step), cost + sum(priors.costs(state).values())


def data_equations(
    solver: SurfacePointSolver, state: State, terms: list[Mapping[str, PointMatches]]
) -> tuple[float, np.ndarray, ArrowMatrix]:
    """Each term apart, as one with few directions need not pay for one with many."""
    found = [
        solver.together(
            state.betas, state.pose, state.trans, [merged({name: one[name]}) for one in terms]
        )
        for name in terms[0]
        if any(len(one[name].face) for one in terms)
    ]
    cost, gradient, matrix = found[0]
    for more, slope, other in found[1:]:
        cost = cost + more
        gradient = gradient + slope
        matrix = ArrowMatrix(
            matrix.shared + other.shared, matrix.border + other.border, matrix.blocks + other.blocks
        )
    return cost, gradient, matrix


def costs_of(
    solver: SurfacePointSolver, state: State, terms: list[Mapping[str, PointMatches]]
) -> dict[str, float]:
    """The cost of each term, all views together."""
    return {
        name: solver.together(
            state.betas, state.pose, state.trans, [merged({name: one[name]}) for one in terms]
        )[0]
        for name in terms[0]
    }


def _free(state: State, moves: str) -> Bool[np.ndarray, " n"]:
    views = len(state.pose)
    width = 3 + state.pose[0].size
    own = np.arange(width) < (6 if moves == "place" else width)
    return np.concatenate([np.full(len(state.betas), moves == "all"), np.tile(own, views)])


def _restricted(matrix: ArrowMatrix, free: Bool[np.ndarray, " n"]) -> ArrowMatrix:
    """The matrix without the rows and columns of what does not move."""
    head = free[: len(matrix.shared)].astype(float)
    tail = free[len(matrix.shared) :].reshape(matrix.blocks.shape[:2]).astype(float)
    return ArrowMatrix(
        matrix.shared * head[:, None] * head,
        matrix.border * tail[:, :, None] * head,
        matrix.blocks * tail[:, :, None] * tail[:, None, :],
    )
