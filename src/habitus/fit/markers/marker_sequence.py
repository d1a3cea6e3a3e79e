"""The marker fit of a whole sequence as a problem for `habitus.solve.sequence`.

`KernelSequence` has compiled visits of several frames at once; `DenseSequence` goes by the body
itself, for bodies that the kernels do not cover. `marker_sequence` chooses.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.markers.energy import for_markers
from habitus.fit.markers.sequence_kernels import (
    LevelArrays,
    MarkerData,
    costs,
    nearest_equivalent,
    unwrap,
    visit,
)
from habitus.fit.markers.settings import SequenceSettings
from habitus.kernels.simd import lane_array, num_lanes
from habitus.observe.marker_kernels import predict_frames
from habitus.observe.marker_prediction import BATCH, BodyMarkers, MarkedBody, predict
from habitus.observe.marker_rig import (
    MarkerRig,
    Offsets,
    SimdRig,
    Slots,
    marker_slots,
    simd_rig,
    workspace_offsets,
)
from habitus.solve.sequence import NOISE, NOISE_32, DenseVisits, LevelFrames


class MarkerSequence:
    """Markers, pose prior and soft tissue of T frames.

    A state holds trans (3), pose (3 J), beta_t (B) and zeros up to a multiple of 3. observed (T, M,
    3), NaN where missing; weights (T, M) of the observations, None for 1; scales (M,) of the robust
    loss (m), None for squares.
    """

    parallel = False
    lanes = 1

    def __init__(
        self,
        marked: MarkedBody,
        observed: Float[np.ndarray, "T M 3"],
        weights: Float[np.ndarray, "T M"] | None,
        scales: Float[np.ndarray, " M"] | None,
        prior: PosePrior,
        settings: SequenceSettings,
        betas: int,
    ):
        self.marked = marked
        self.settings = settings
        self.betas = betas
        self.pose_end = 3 + 3 * marked.num_joints
        self.data = marker_data(marked, observed, weights, scales, prior, settings, betas)

    def pack(self, pose, trans, soft_tissue):
        """States (T, N)."""
        states = np.zeros((len(trans), len(self.data.mean)))
        states[:, :3], states[:, 3 : self.pose_end] = (
            trans,
            np.reshape(pose, (len(trans), self.pose_end - 3)),
        )
        if soft_tissue is not None:
            states[:, self.pose_end : self.pose_end + self.betas] = soft_tissue
        return states

    def unpack(self, states):
        """Pose (F, J, 3), trans (F, 3) and soft tissue (F, B) or None."""
        soft = states[:, self.pose_end : self.pose_end + self.betas].copy() if self.betas else None
        return (
            states[:, 3 : self.pose_end].reshape(len(states), -1, 3).copy(),
            states[:, :3].copy(),
            soft,
        )

    def chart(self, frames, states):
        """Root rotation vectors unwrapped and re-expressed past 1.5 pi; their second differences
        are cut there.
        """
        states, links = states.copy(), np.repeat(self.link_weights()[None], len(states), axis=0)
        states[:, 3:6], jumps = unwrap(states[:, 3:6])
        links[jumps | np.roll(jumps, 1), 3:6] = 0.0
        return states, links

    def link_weights(self):
        """Weight of each unknown's second difference (N,)."""
        weights = np.zeros(len(self.data.mean))
        settings = self.settings
        if settings.acceleration > 0.0:
            weights[:3], weights[3 : self.pose_end] = (
                settings.trans_acceleration,
                settings.acceleration,
            )
            weights[self.pose_end : self.pose_end + self.betas] = settings.soft_tissue_acceleration
        return weights

    def between(self, left, right, share):
        """Straight from left to right, the root in one chart."""
        right = right.copy()
        right[:, 3:6] = nearest_equivalent(right[:, 3:6], left[:, 3:6])
        return left + share[:, None] * (right - left)

    def marker_terms(self, frames, states):
        """Residual (F, M, 3), rho (F, M) and its derivative (F, M) for each marker."""
        residual = predict(self.marked, *self.unpack(states)) - self.data.observed[frames]
        squared = np.sum(residual**2, axis=2)
        share = 1.0 / (1.0 + squared * self.data.inverse_squared_scales)
        return residual, share * squared, share**2

    def markers(self, states):
        """Predicted markers (F, M, 3) of states (F, N)."""
        return predict(self.marked, *self.unpack(states))

    def terms(self, states, frame_costs, first=0) -> tuple[dict[str, float], np.ndarray]:
        """The data, pose and soft-tissue terms' shares in the frames' own costs, and the weights
        (F, M) that rho left; of F frames from ``first`` on.
        """
        frames = np.arange(first, first + len(states))
        weights = self.data.weights[frames]
        _, rho, slope = self.marker_terms(frames, states)
        data = 0.5 * self.data.weight * float(np.sum(weights * rho))
        soft = 0.5 * self.settings.soft_tissue * float(np.sum(states[:, self.pose_end :] ** 2))
        pose = float(np.sum(frame_costs)) - data - soft
        return {"data": data, "pose": pose, "soft_tissue": soft}, weights * slope


class _ByIdentity:
    """A rig, compared by identity."""

    def __init__(self, rig: MarkerRig):
        self.rig = rig

    def __hash__(self) -> int:
        return id(self.rig)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByIdentity) and other.rig is self.rig


@lru_cache(maxsize=2)
def _laid_out(
    same: _ByIdentity, betas: int, dtype: type
) -> tuple[SimdRig, Slots, Offsets, tuple[SimdRig, Offsets]]:
    """The kernels' layout of a rig; cached, since a fit asks for it repeatedly and it takes as
    long as many frames.
    """
    rig = simd_rig(same.rig, betas)
    slots = marker_slots(rig)
    exact = rig, workspace_offsets(rig)
    return _cast(rig, dtype), _cast(slots, dtype), workspace_offsets(rig, slots), exact


def _cast(arrays, dtype: type):
    """The same named tuple with its float64 arrays in another type."""
    return arrays._make(a.astype(dtype) if a.dtype == float else a for a in arrays)


class KernelSequence(MarkerSequence):
    """The problem by the compiled kernels, for what a `MarkerRig` covers.

    They compute in ``dtype``. Positions are relative to the body's translation, so that float32
    resolves a micrometre at any distance from the origin; steps are added to states in float64.
    """

    parallel = True
    dtype: type = np.float32

    def __init__(self, marked: MarkerRig, *problem):
        super().__init__(marked, *problem)
        self.lanes = num_lanes(self.dtype)
        layout = _laid_out(_ByIdentity(marked), self.betas, self.dtype)
        self.simd_rig, self.slots, self.offsets, self._prediction = layout
        self._workspaces: list[np.ndarray] = []

    def markers(self, states):
        """Predicted markers (F, M, 3) of states (F, N)."""
        out = np.empty((len(states), self.marked.num_markers, 3))
        rig, offsets = self._prediction
        predict_frames(rig, offsets, lane_array(offsets.end), np.ascontiguousarray(states), out)
        return out

    def cost(self, frames, states):
        """Own cost of each frame (F,)."""
        out = np.empty(len(frames))
        workspace = self._workspace()
        costs(
            self.simd_rig,
            self.offsets,
            workspace,
            self.data,
            frames,
            np.ascontiguousarray(states),
            out,
        )
        self._workspaces.append(workspace)
        return out

    def visit(self, level: LevelFrames, block):
        """One damped Gauss-Newton step of the frames `block`."""
        self._visit(
            LevelArrays(*(getattr(level, name) for name in LevelArrays._fields)), block, 1, 0.0
        )

    def visit_again(self, level: LevelArrays, frame: int, times: int, tolerance: float) -> None:
        """Visit one frame of a level up to so many times, until it moves by less than
        `tolerance`.
        """
        self._visit(level, np.array([frame]), times, tolerance)

    def _visit(self, level: LevelArrays, block: np.ndarray, times: int, tolerance: float) -> None:
        workspace = self._workspace()
        fixed = (self.simd_rig, self.slots, self.offsets)
        rounding = NOISE if self.dtype is np.float64 else NOISE_32
        how = (self.pose_end, times, tolerance, rounding)
        visit(*fixed, workspace, self.data, level, block, *how)
        self._workspaces.append(workspace)

    def _workspace(self) -> np.ndarray:
        """A workspace that no other thread has."""
        try:
            return self._workspaces.pop()
        except IndexError:
            return lane_array(self.offsets.end, dtype=self.dtype)


class DenseSequence(DenseVisits, MarkerSequence):
    """The same problem by the body's surface Jacobian and NumPy, for bodies of every kind."""

    marked: BodyMarkers

    def cost(
        self, frames: Int[np.ndarray, " F"], states: Float[np.ndarray, "F N"]
    ) -> Float[np.ndarray, " F"]:
        """Own cost of each frame (F,)."""
        rho = self.marker_terms(frames, states)[1]
        off = states - self.data.mean
        prior = 0.5 * np.sum((off @ self.data.precision) * off, axis=1)
        return 0.5 * self.data.weight * np.sum(self.data.weights[frames] * rho, axis=1) + prior

    def linearize(
        self, frames: Int[np.ndarray, " F"], states: Float[np.ndarray, "F N"]
    ) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F N"], Float[np.ndarray, "F N N"]]:
        """Own cost (F,), gradient (F, N) and Gauss-Newton matrix (F, N, N)."""
        parts = [slice(first, first + BATCH) for first in range(0, len(frames), BATCH)]
        blocks = [self._linearize(frames[part], states[part]) for part in parts]
        costs, gradients, matrices = (np.concatenate(each) for each in zip(*blocks, strict=True))
        return costs, gradients, matrices

    def _linearize(
        self, frames: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pose, trans, soft_tissue = self.unpack(states)
        derivatives = self.marked.jacobian(pose, trans, soft_tissue)
        residual = derivatives.markers - self.data.observed[frames]
        share = 1.0 / (1.0 + np.sum(residual**2, axis=2) * self.data.inverse_squared_scales)
        jacobian = np.zeros((*residual.shape, states.shape[1]))
        jacobian[..., :3], jacobian[..., 3 : self.pose_end] = np.eye(3), derivatives.by_pose
        jacobian[..., self.pose_end : self.pose_end + self.betas] = derivatives.by_betas[
            ..., : self.betas
        ]
        half = np.sqrt(self.data.weight * share**2 * self.data.weights[frames])[..., None]
        table = (half[..., None] * jacobian).reshape(len(frames), -1, states.shape[1])
        off = states - self.data.mean
        pull = off @ self.data.precision
        gradient = np.einsum("frn,fr->fn", table, (half * residual).reshape(len(frames), -1)) + pull
        rho = share * np.sum(residual**2, axis=2)
        cost = 0.5 * self.data.weight * np.sum(
            self.data.weights[frames] * rho, axis=1
        ) + 0.5 * np.sum(pull * off, axis=1)
        return cost, gradient, table.transpose(0, 2, 1) @ table + self.data.precision

    def visit_again(self, level: LevelArrays, frame: int, times: int, tolerance: float) -> None:
        """Visit one frame of a level up to so many times, until it moves by less than
        `tolerance`.
        """
        arrays = LevelFrames(**level._asdict(), measured=slice(3, self.pose_end))
        for _ in range(times):
            self.visit(arrays, np.array([frame]))
            if level.moved[frame] < tolerance:
                break


def marker_sequence(
    marked: MarkedBody,
    observed: Float[np.ndarray, "T M 3"],
    weights: Float[np.ndarray, "T M"] | None,
    scales: Float[np.ndarray, " M"] | None,
    prior: PosePrior,
    settings: SequenceSettings,
    betas: int,
) -> KernelSequence | DenseSequence:
    """The problem in the form that suits the body; arguments as in `MarkerSequence`."""
    problem = (observed, weights, scales, prior, settings, betas)
    if isinstance(marked, MarkerRig):
        return KernelSequence(marked, *problem)
    return DenseSequence(marked, *problem)


def marker_data(
    marked: MarkedBody,
    observed: Float[np.ndarray, "T M 3"],
    weights: Float[np.ndarray, "T M"] | None,
    scales: Float[np.ndarray, " M"] | None,
    prior: PosePrior,
    settings: SequenceSettings,
    betas: int,
) -> MarkerData:
    """Observations with gaps at weight 0, and one Gaussian over all unknowns: the pose prior and
    the soft tissue's.
    """
    observed = np.ascontiguousarray(
        observed, dtype=float
    )  # another layout would compile all kernels once more
    if observed.ndim != 3 or observed.shape[1:] != (marked.num_markers, 3):
        raise HabitusError(
            f"observed markers must be (T, {marked.num_markers}, 3) for this rig, got "
            f"{observed.shape}"
        )
    seen = np.all(np.isfinite(observed), axis=2, keepdims=True)
    scales = (
        np.full(marked.num_markers, np.inf) if scales is None else np.asarray(scales, dtype=float)
    )
    pose_end = 3 + 3 * marked.num_joints
    size = 3 + 3 * marked.num_joints + 3 * (-(-betas // 3))
    mean = np.zeros(size)
    precision = np.zeros((size, size))
    body = slice(6, pose_end)
    mean[body], precision[body, body] = _gaussian(for_markers(prior), pose_end - 6)
    precision[body, body] *= settings.pose
    np.fill_diagonal(precision[pose_end:, pose_end:], settings.soft_tissue)
    return MarkerData(
        observed=np.where(seen, observed, 0.0),
        weights=np.where(seen[..., 0], 1.0 if weights is None else weights, 0.0),
        inverse_squared_scales=1.0 / scales**2,
        weight=float(settings.data),
        mean=mean,
        precision=precision,
    )


def _gaussian(prior: PosePrior, size: int) -> tuple[np.ndarray, np.ndarray]:
    mean = np.asarray(prior.mean, dtype=float)
    precision = np.asarray(prior.precision, dtype=float)
    if mean.shape != (size,) or precision.shape != (size, size):
        raise HabitusError(
            f"the pose prior must have {size} unknowns for this body, got {mean.shape}; see "
            "for_joints"
        )
    return mean, precision
