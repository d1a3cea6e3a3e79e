"""The marker fit of a whole sequence as a problem for `habitus.solve.sequence`: compiled, and plain for comparison."""

from typing import Any

import numpy as np
from numba.core import config

from habitus.errors import HabitusError
from habitus.fit.mosh.rotation_charts import nearest_twin, unwrap
from habitus.fit.mosh.sequence_kernels import LevelArrays, MarkerData, costs, revisit, visit
from habitus.kernels.simd import LANES, lane_array
from habitus.observe.marker_prediction import linearize, predict, predict_plainly
from habitus.observe.marker_rig import MarkerRig
from habitus.observe.marker_slots import lane_rig, marker_slots, pack_states, rows
from habitus.solve.sequence.dense_visits import DenseVisits
from habitus.solve.sequence.level import Level


class MarkerSequence:
    """Markers, pose prior and soft tissue; unknowns are trans (3), pose (3 J), beta_t (B) and zeros up to a
    multiple of 3.

    lambda's as in `habitus.fit.mosh.sequence.SequenceSettings`.
    """

    _predict = staticmethod(predict)

    def __init__(self, rig: MarkerRig, observed, weights, scales, prior: Any, lambdas: Any, betas: int):
        self.rig, self.lambdas, self.betas, self.pose_end = rig, lambdas, betas, 3 + 3 * rig.num_joints
        self.threads, self.lanes = int(vars(config)["NUMBA_NUM_THREADS"]), LANES
        self.data = marker_data(rig, observed, weights, scales, prior, lambdas, betas)
        self.fast = lane_rig(rig, betas)
        self.slots = marker_slots(self.fast)
        self.rows = rows(self.fast, self.slots)
        self._rooms: list[np.ndarray] = []

    def pack(self, pose, trans, soft_tissue):
        """States (T, N)."""
        return pack_states(self.fast, trans, pose, soft_tissue)

    def unpack(self, states):
        """Pose (F, J, 3), trans (F, 3) and soft tissue (F, B) or None."""
        soft = states[:, self.pose_end : self.pose_end + self.betas].copy() if self.betas else None
        return states[:, 3 : self.pose_end].reshape(len(states), -1, 3).copy(), states[:, :3].copy(), soft

    def cost(self, frames, states):
        """Own cost of each frame (F,)."""
        out, room = np.empty(len(frames)), self._room()
        costs(self.fast, self.rows, room, self.data, frames, np.ascontiguousarray(states), out)
        self._rooms.append(room)
        return out

    def visit(self, level: Level, block):
        """One damped Gauss-Newton step of the frames `block`."""
        arrays, room = LevelArrays(*(getattr(level, name) for name in LevelArrays._fields)), self._room()
        visit(self.fast, self.slots, self.rows, room, self.data, arrays, block, self.pose_end)
        self._rooms.append(room)

    def visit_again(self, level: LevelArrays, frame: int, times: int, tolerance: float) -> None:
        """Visit one frame of a level up to so many times, until it moves by less than `tolerance`."""
        room = self._room()
        revisit(self.fast, self.slots, self.rows, room, self.data, level, frame, self.pose_end, times, tolerance)
        self._rooms.append(room)

    def _room(self) -> np.ndarray:
        """A workspace that no other thread has."""
        try:
            return self._rooms.pop()
        except IndexError:
            return lane_array(self.rows.end)

    def chart(self, frames, states):
        """Root rotation vectors unwrapped and re-expressed past 1.5 pi; their second differences are cut there."""
        states, links = states.copy(), np.repeat(self.link_weights()[None], len(states), axis=0)
        states[:, 3:6], jumps = unwrap(states[:, 3:6])
        links[jumps | np.roll(jumps, 1), 3:6] = 0.0
        return states, links

    def link_weights(self):
        """Weight of each unknown's second difference (N,)."""
        weights, lambdas = np.zeros(len(self.data.mean)), self.lambdas
        if lambdas.acceleration > 0.0:
            weights[:3], weights[3 : self.pose_end] = lambdas.trans_acceleration, lambdas.acceleration
            weights[self.pose_end : self.pose_end + self.betas] = lambdas.soft_tissue_acceleration
        return weights

    def between(self, left, right, share):
        """Straight from left to right, the root in one chart."""
        right = right.copy()
        right[:, 3:6] = nearest_twin(right[:, 3:6], left[:, 3:6])
        return left + share[:, None] * (right - left)

    def marker_terms(self, frames, states):
        """Miss (F, M, 3), rho (F, M) and its derivative (F, M) for each marker."""
        miss = self._predict(self.rig, *self.unpack(states)) - self.data.observed[frames]
        squared = np.sum(miss**2, axis=2)
        share = 1.0 / (1.0 + squared * self.data.inverse_squared_scales)
        return miss, share * squared, share**2

    def terms(self, states, frame_costs) -> tuple[dict[str, float], np.ndarray]:
        """The data, pose and soft-tissue terms' shares in the frames' own costs, and the weights (T, M) that rho
        left.
        """
        _, rho, slope = self.marker_terms(np.arange(len(states)), states)
        data = 0.5 * self.data.weight * float(np.sum(self.data.weights * rho))
        soft = 0.5 * self.lambdas.soft_tissue * float(np.sum(states[:, self.pose_end :] ** 2))
        pose = float(np.sum(frame_costs)) - data - soft
        return {"data": data, "pose": pose, "soft_tissue": soft}, self.data.weights * slope


class PlainMarkerSequence(DenseVisits, MarkerSequence):
    """The slow twin: the same problem by the plain kernels and NumPy."""

    _predict = staticmethod(predict_plainly)

    def __init__(self, *problem):
        super().__init__(*problem)
        self.threads, self.lanes = 1, 1

    def cost(self, frames, states):
        """Own cost of each frame (F,)."""
        rho = self.marker_terms(frames, states)[1]
        off = states - self.data.mean
        prior = 0.5 * np.sum((off @ self.data.precision) * off, axis=1)
        return 0.5 * self.data.weight * np.sum(self.data.weights[frames] * rho, axis=1) + prior

    def linearize(self, frames, states):
        """Own cost (F,), gradient (F, N) and Gauss-Newton matrix (F, N, N)."""
        miss, _, weight = self.marker_terms(frames, states)
        _, jacobian = linearize(self.rig, *self.unpack(states))
        jacobian = np.pad(jacobian, ((0, 0), (0, 0), (0, 0), (0, states.shape[1] - jacobian.shape[3])))
        half = np.sqrt(self.data.weight * weight * self.data.weights[frames])[..., None]
        table = (half[..., None] * jacobian).reshape(len(frames), -1, states.shape[1])
        gradient = np.einsum("fr,frn->fn", (half * miss).reshape(len(frames), -1), table)
        gradient += (states - self.data.mean) @ self.data.precision
        return self.cost(frames, states), gradient, table.transpose(0, 2, 1) @ table + self.data.precision


def marker_data(rig: MarkerRig, observed, weights, scales, prior: Any, lambdas: Any, betas: int) -> MarkerData:
    """Observations with gaps at weight 0, and one Gaussian over all unknowns: the pose prior and the soft tissue's."""
    observed = np.ascontiguousarray(observed, dtype=float)  # another layout would compile all kernels once more
    if observed.ndim != 3 or observed.shape[1:] != (rig.num_markers, 3):
        raise HabitusError(f"observed markers must be (T, {rig.num_markers}, 3) for this rig, got {observed.shape}")
    seen = np.all(np.isfinite(observed), axis=2, keepdims=True)
    scales = np.full(rig.num_markers, np.inf) if scales is None else np.asarray(scales, dtype=float)
    pose_end, size = 3 + 3 * rig.num_joints, 3 + 3 * rig.num_joints + 3 * (-(-betas // 3))
    mean, precision = np.zeros(size), np.zeros((size, size))
    body = slice(6, pose_end)
    mean[body], precision[body, body] = _gaussian(prior, pose_end - 6)
    precision[body, body] *= lambdas.pose
    np.fill_diagonal(precision[pose_end:, pose_end:], lambdas.soft_tissue)
    return MarkerData(
        observed=np.where(seen, observed, 0.0),
        weights=np.where(seen[..., 0], 1.0 if weights is None else weights, 0.0),
        inverse_squared_scales=1.0 / scales**2,
        weight=float(lambdas.data),
        mean=mean,
        precision=precision,
    )


def _gaussian(prior: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    mean, precision = np.asarray(prior.mean, dtype=float), np.asarray(prior.precision, dtype=float)
    if mean.shape != (size,) or precision.shape != (size, size):
        raise HabitusError(f"the pose prior must have {size} unknowns for this body, got {mean.shape}; see for_joints")
    return mean, precision
