"""The pose stage and the soft-tissue stage: poses of a whole sequence of a known body and markers (M 5 and 6).

    cost = 1/2 ( l_D sum_ti w_ti rho_i(|x_i(t) - m_ti|^2) + l_theta (theta - mu)^T P (theta - mu)
                 + l_u |theta_t - 2 theta_{t-1} + theta_{t-2}|^2 + l_Delta |beta_t|^2 )

over pose, trans and, in the soft-tissue stage, beta_t (M equations 3, 7, 8 and 10). MoSh solves frame after frame;
here all frames are solved together (`habitus.solve.sequence`), the optimum that the paper's filter approximates. rho is
Geman-McClure's s^2 d^2 / (s^2 + d^2) with a scale s per marker, or the square where s is infinite.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.observe.kernels import linearize, predict
from habitus.observe.rig import MarkerRig
from habitus.solve.sequence import SequenceOptions
from habitus.solve.sequence import solve_sequence as solve

LONGEST_TURN = 1.5 * np.pi
"""A longer root rotation vector (rad) gives way to its shorter twin: the chart is singular at 2 pi."""


@dataclass(frozen=True)
class SequenceSettings:
    """Weights of the terms (M 6) in metres and radians, and how to solve.

    acceleration is 0 for frames that have nothing to do with each other. trans_acceleration (per m^2) carries trans
    over frames without markers; it is too weak to matter elsewhere.
    """

    data: float = 7500.0
    pose: float = 1.0
    acceleration: float = 6.25
    trans_acceleration: float = 10.0
    soft_tissue: float = 0.25
    soft_tissue_acceleration: float = 0.0
    options: SequenceOptions = field(default_factory=SequenceOptions)


@dataclass(frozen=True)
class SequenceResult:
    """What a stage found.

    pose (T, J, 3) rad, trans (T, 3) m, soft_tissue (T, B) or None; costs by term and frame_costs (T,) without the
    acceleration, all as in the module's formula; weights (T, M): the given ones times the robust ones; status and
    iterations of `habitus.solve.sequence`; history of the total cost.
    """

    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    soft_tissue: Float[np.ndarray, "T B"] | None
    costs: dict[str, float]
    frame_costs: Float[np.ndarray, " T"]
    weights: Float[np.ndarray, "T M"]
    status: str
    iterations: int
    history: tuple[float, ...]


def solve_sequence(
    rig: MarkerRig,
    observed: Float[np.ndarray, "T M 3"],
    weights: Float[np.ndarray, "T M"] | None,
    scales: Float[np.ndarray, " M"] | None,
    prior: Any,
    start_pose: Float[np.ndarray, "T J 3"],
    start_trans: Float[np.ndarray, "T 3"],
    settings: SequenceSettings | None = None,
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
) -> SequenceResult:
    """Pose and trans of T frames; with `soft_tissue` (T, B) to start from, the changes of shape beta_t as well.

    observed: metres, NaN where missing. weights: of each observation, 1 if None. scales: s of each marker in metres,
    None for squares. prior: mean (3 (J - 1),) and precision, root left out. Without acceleration each frame is alone.
    """
    settings = settings or SequenceSettings()
    problem = MarkerSequence(rig, observed, weights, scales, prior, settings, soft_tissue)
    start = problem.pack(start_pose, start_trans, soft_tissue)
    options = settings.options
    if settings.acceleration == 0.0 and options.strides != (1,):
        options = SequenceOptions((1,), options.coarse_sweeps, options.sweeps, options.tolerance, options.damping)
    solution = solve(problem, start, slice(3, 3 + 3 * rig.num_joints), options)
    pose, trans, soft = problem.unpack(solution.states)
    return SequenceResult(
        pose,
        trans,
        soft,
        problem.costs(solution.states, solution.coupling_cost),
        solution.frame_costs,
        problem.robust_weights(solution.states),
        solution.status,
        solution.iterations,
        solution.history,
    )


class MarkerSequence:
    """The frames' own costs: markers, pose prior and soft tissue; unknowns are trans (3), pose (3 J), beta_t (B)."""

    def __init__(self, rig, observed, weights, scales, prior, settings, soft_tissue):
        self.rig, self.settings = rig, settings
        observed = np.asarray(observed, dtype=float)
        if observed.ndim != 3 or observed.shape[1:] != (rig.num_markers, 3):
            raise HabitusError(f"observed markers must be (T, {rig.num_markers}, 3) for this rig, got {observed.shape}")
        seen = np.isfinite(observed).all(axis=2)
        self.weights = np.where(seen, 1.0 if weights is None else weights, 0.0)
        self.observed = np.where(seen[..., None], observed, 0.0)
        self.scales = np.full(rig.num_markers, np.inf) if scales is None else np.asarray(scales, dtype=float)
        self.mean, self.precision = _gaussian(prior, 3 * rig.num_joints - 3)
        self.pose_end = 3 + 3 * rig.num_joints
        self.size = self.pose_end + (0 if soft_tissue is None else np.shape(soft_tissue)[1])

    def pack(self, pose, trans, soft_tissue):
        """States (T, N)."""
        frames = len(self.observed)
        parts = [trans, np.reshape(pose, (frames, -1))] + ([] if soft_tissue is None else [soft_tissue])
        return np.ascontiguousarray(np.concatenate(parts, axis=1), dtype=float)

    def unpack(self, states):
        """Pose (F, J, 3), trans (F, 3) and soft tissue (F, B) or None."""
        soft = states[:, self.pose_end :].copy() if states.shape[1] > self.pose_end else None
        return states[:, 3 : self.pose_end].reshape(len(states), -1, 3).copy(), states[:, :3].copy(), soft

    def _squared(self, distance):
        """rho and its derivative to the squared distance (the re-weighting), (F, M) each."""
        squared_scale = self.scales**2
        share = np.where(np.isinf(squared_scale), 1.0, 1.0 / (1.0 + distance / squared_scale))
        return share * distance, share**2

    def _terms(self, frames, states, markers):
        miss = markers - self.observed[frames]
        rho, weight = self._squared(np.sum(miss**2, axis=2))
        off = states[:, 6 : self.pose_end] - self.mean
        soft = states[:, self.pose_end :]
        data = 0.5 * self.settings.data * np.sum(self.weights[frames] * rho, axis=1)
        pose = 0.5 * self.settings.pose * np.sum((off @ self.precision) * off, axis=1)
        return miss, weight, off, data, pose, 0.5 * self.settings.soft_tissue * np.sum(soft**2, axis=1)

    def cost(self, frames, states):
        """f_t (F,)."""
        pose, trans, soft = self.unpack(states)
        *_, data, prior, tissue = self._terms(frames, states, predict(self.rig, pose, trans, soft))
        return data + prior + tissue

    def linearize(self, frames, states):
        """f_t (F,), gradient (F, N) and Gauss-Newton matrix (F, N, N)."""
        pose, trans, soft = self.unpack(states)
        markers, jacobian = linearize(self.rig, pose, trans, soft)
        miss, weight, off, data, prior, tissue = self._terms(frames, states, markers)
        weight = self.settings.data * weight * self.weights[frames]
        rows = (np.sqrt(weight)[..., None, None] * jacobian).reshape(len(frames), -1, self.size)
        gradient = np.einsum("fr,frn->fn", (np.sqrt(weight)[..., None] * miss).reshape(len(frames), -1), rows)
        matrix = rows.transpose(0, 2, 1) @ rows
        lam, body = self.settings.pose, slice(6, self.pose_end)
        gradient[:, body] += lam * (off @ self.precision)
        matrix[:, body, body] += lam * self.precision
        tail = np.arange(self.pose_end, self.size)
        gradient[:, tail] += self.settings.soft_tissue * states[:, tail]
        matrix[:, tail, tail] += self.settings.soft_tissue
        return data + prior + tissue, gradient, matrix

    def chart(self, frames, states):
        """Root rotation vectors unwrapped and re-expressed where they pass 1.5 pi; second differences are cut there."""
        states, lam = states.copy(), self.settings
        states[:, 3:6], jumps = unwrap(states[:, 3:6])
        links = np.empty_like(states)
        links[:, :3] = lam.trans_acceleration if lam.acceleration > 0.0 else 0.0
        links[:, 3 : self.pose_end] = lam.acceleration
        links[:, self.pose_end :] = lam.soft_tissue_acceleration
        links[jumps | np.roll(jumps, 1), 3:6] = 0.0
        return states, links

    def between(self, left, right, share):
        """Straight from left to right, the root in one chart."""
        right = right.copy()
        right[:, 3:6] = nearest_twin(right[:, 3:6], left[:, 3:6])
        return left + share[:, None] * (right - left)

    def robust_weights(self, states):
        """Given weights times the robust ones (T, M)."""
        pose, trans, soft = self.unpack(states)
        miss = predict(self.rig, pose, trans, soft) - self.observed
        return self.weights * self._squared(np.sum(miss**2, axis=2))[1]

    def costs(self, states, coupling):
        """Cost of each term."""
        pose, trans, soft = self.unpack(states)
        *_, data, prior, tissue = self._terms(np.arange(len(states)), states, predict(self.rig, pose, trans, soft))
        named = {"data": data.sum(), "pose": prior.sum(), "acceleration": coupling, "soft_tissue": tissue.sum()}
        return {name: float(value) for name, value in named.items()}


def _gaussian(prior: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    mean, precision = np.asarray(prior.mean, dtype=float), np.asarray(prior.precision, dtype=float)
    if mean.shape != (size,) or precision.shape != (size, size):
        raise HabitusError(f"the pose prior must have {size} unknowns for this body, got {mean.shape}; see for_joints")
    return mean, precision


def nearest_twin(vectors: Float[np.ndarray, "*F 3"], reference: Float[np.ndarray, "*F 3"]) -> Float[np.ndarray, "*F 3"]:
    """The same rotations by the vectors (theta + 2 pi k along their axes) closest to `reference`."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = np.where(angle > 1e-12, vectors / np.maximum(angle, 1e-300), 0.0)
    turns = np.round((np.sum(axis * reference, axis=-1, keepdims=True) - angle) / (2.0 * np.pi))
    return vectors + 2.0 * np.pi * turns * axis


def unwrap(vectors: Float[np.ndarray, "T 3"]) -> tuple[Float[np.ndarray, "T 3"], np.ndarray]:
    """Rotation vectors that follow each other, and where (T,) they jump to a shorter twin past `LONGEST_TURN`."""
    out, jumps = np.array(vectors), np.zeros(len(vectors), dtype=bool)
    for t in range(len(out)):
        if t > 0:
            out[t] = nearest_twin(out[t], out[t - 1])
        angle = np.linalg.norm(out[t])
        if angle > LONGEST_TURN:
            out[t] *= (angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))) / angle
            jumps[t] = t > 0
    return out, jumps
