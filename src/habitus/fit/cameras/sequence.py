"""The pose stage of keypoints: poses of all frames of a known person under known cameras.

    E = sum_t f_t(trans_t, pose_t) + 1/2 sum_t |z_t - 2 z_(t-1) + z_(t-2)|^2 / (a dt^2)^2

f_t is that of `habitus.residuals.keypoint_kernels`; a is the standard deviation of accelerations.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.fit.cameras.sequence_kernels import visit
from habitus.fit.cameras.settings import CameraSettings
from habitus.fit.markers.sequence_kernels import LevelArrays, nearest_equivalent, unwrap
from habitus.kernels.simd import LANES, lane_array
from habitus.observe.camera_rig import CameraRig
from habitus.observe.keypoints import ShapedKeypoints
from habitus.residuals.keypoint_kernels import (
    KeypointData,
    KeypointOffsets,
    keypoint_costs,
    normal_equations,
)
from habitus.solve.sequence import LevelFrames, SequenceSolution, solve_sequence


def keypoint_data(
    person: ShapedKeypoints,
    rig: CameraRig | None,
    pixels: Float[np.ndarray, "T C K 2"] | None,
    weights: Float[np.ndarray, "T C K"] | None,
    mean: Float[np.ndarray, " n"],
    precision: Float[np.ndarray, "n n"],
    reach: float,
    points: Float[np.ndarray, "T K 3"] | None = None,
    point_weights: Float[np.ndarray, "T K"] | None = None,
) -> KeypointData:
    """What the kernels take. pixels: ideal ones, NaN where missing; weights: 1 / px^2; None of all
    three where there are no cameras. points: places (m) of keypoints that are known otherwise,
    ``point_weights`` 1 / m^2. mean, precision: of
    all joints but the root.
    """
    keypoints = len(person.bone)
    if rig is None or pixels is None or weights is None:
        frames = 0 if points is None else len(points)
        pixels, weights = np.zeros((frames, 0, keypoints, 2)), np.zeros((frames, 0, keypoints))
    seen = np.asarray(np.isfinite(pixels).all(-1))
    if points is None or point_weights is None:
        points = np.zeros((len(pixels), keypoints, 3))
        point_weights = np.zeros((len(pixels), keypoints))
    found = np.asarray(np.isfinite(points).all(-1))
    size = 6 + len(mean)
    whole = np.zeros((size, size))
    whole[6:, 6:] = precision
    return KeypointData(
        person.parents,
        person.bone,
        np.ascontiguousarray(person.joints),
        np.ascontiguousarray(person.places),
        np.zeros((0, 2)) if rig is None else np.ascontiguousarray(rig.focal),
        np.zeros((0, 2)) if rig is None else np.ascontiguousarray(rig.centre),
        np.zeros((0, 3, 3)) if rig is None else np.ascontiguousarray(rig.rotation),
        np.zeros((0, 3)) if rig is None else np.ascontiguousarray(rig.translation),
        np.ascontiguousarray(np.where(seen[..., None], pixels, 0.0)),
        np.ascontiguousarray(np.where(seen, weights, 0.0)),
        np.ascontiguousarray(np.where(found[..., None], points, 0.0)),
        np.ascontiguousarray(np.where(found, point_weights, 0.0)),
        float(reach),
        np.concatenate([np.zeros(6), mean]),
        whole,
    )


class KeypointSequence:
    """`habitus.solve.sequence.SequenceProblem` of keypoints: states hold trans (3) and pose
    (3 J).
    """

    parallel = True
    lanes = LANES

    def __init__(self, data: KeypointData, links: Float[np.ndarray, " N"]):
        self.data = data
        self.links = links
        self.offsets = KeypointOffsets.of(len(data.parents), len(data.bone), len(data.focal))
        self._workspaces: list[np.ndarray] = []

    def visit(self, level: LevelFrames, block: np.ndarray) -> None:
        """One damped Gauss-Newton step of the frames ``block``."""
        arrays = LevelArrays(
            level.frames,
            level.states,
            level.links,
            level.costs,
            level.damping,
            level.moved,
            level.cost_decrease,
            level.relaxations,
        )
        with self._workspace() as workspace:
            visit(self.data, self.offsets, workspace, arrays, block)

    def cost(self, frames: np.ndarray, states: np.ndarray) -> np.ndarray:
        """f_t of each frame."""
        out = np.empty(len(frames))
        with self._workspace() as workspace:
            states = np.ascontiguousarray(states)
            keypoint_costs(self.data, self.offsets, workspace, frames, states, out)
        return out

    def linearize(
        self, frames: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """f_t, gradients and Gauss-Newton matrices, frame by frame."""
        count, size = states.shape
        out = np.empty(count), np.empty((count, size)), np.empty((count, size, size))
        with self._workspace() as workspace:
            states = np.ascontiguousarray(states)
            normal_equations(self.data, self.offsets, workspace, frames, states, *out)
        return out

    def chart(self, frames: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Root rotation vectors unwrapped; second differences are cut where they jump."""
        states = np.array(states)
        links = np.repeat(self.links[None], len(states), axis=0)
        states[:, 3:6], jumps = unwrap(states[:, 3:6])
        links[jumps | np.roll(jumps, 1), 3:6] = 0.0
        return states, links

    def between(self, left: np.ndarray, right: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Straight from left to right, the root in one chart."""
        right = right.copy()
        right[:, 3:6] = nearest_equivalent(right[:, 3:6], left[:, 3:6])
        return left + share[:, None] * (right - left)

    @contextmanager
    def _workspace(self) -> Iterator[np.ndarray]:
        """A workspace that no other thread has."""
        try:
            own = self._workspaces.pop()
        except IndexError:
            own = lane_array(self.offsets.end)
        yield own
        self._workspaces.append(own)


def acceleration_links(
    joints: int, rate_hz: float, settings: CameraSettings
) -> Float[np.ndarray, " N"]:
    """Weights of second differences: 1 / (a dt^2)^2."""
    links = np.full(3 + 3 * joints, (rate_hz**2 / settings.angular_acceleration) ** 2)
    links[:3] = (rate_hz**2 / settings.acceleration) ** 2
    return links


def solve_poses(
    data: KeypointData,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    rate_hz: float,
    settings: CameraSettings,
    warm: bool = False,
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"], SequenceSolution]:
    """Poses and places of all frames from a start; a ``warm`` one is near the solution."""
    joints = len(data.parents)
    links = acceleration_links(joints, rate_hz, settings)
    options = replace(settings.options, strides=(1,), damping=1.0) if warm else settings.options
    problem = KeypointSequence(data, links)
    start = np.concatenate([trans, pose.reshape(len(pose), -1)], axis=1)
    solution = solve_sequence(problem, start, slice(3, None), options)
    states = solution.states
    return states[:, 3:].reshape(len(pose), joints, 3).copy(), states[:, :3].copy(), solution
