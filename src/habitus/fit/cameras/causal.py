"""The pose stage of keypoints for live use: each frame from itself and all frames before it.

The energy is that of `habitus.fit.cameras.sequence`. Its minimum over the frames so far, each
linearised once it has come, is the extended Kalman filter (Jazwinski, "Stochastic Processes and
Filtering Theory", sec. 8.3) of the state (z_t, z_(t-1)):

    z_t = 2 z_(t-1) - z_(t-2) + w,   w ~ N(0, (a dt^2)^2)

A frame is an observation with the information H of its Gauss-Newton matrix, which holds the pose
prior, and S is the covariance of z_t before it comes:

    z = m - S (I + H S)^-1 (g + H (m - x)),   W = H (I + S H)^-1,   S <- S - S W S

m: the prediction, g and H: gradient and matrix at x, which is m at first and the last z afterwards.
"""

import numpy as np
from jaxtyping import Float

from habitus.fit.cameras.sequence import KeypointSequence, acceleration_links
from habitus.fit.cameras.settings import CameraSettings
from habitus.fit.markers.sequence_kernels import LONGEST_TURN, WHOLE

ITERATIONS = 2
"""Gauss-Newton steps of a frame, at most."""
CLOSE = 3e-2
"""A step this short (rad and m, root mean square) is the last."""
FIRST_SD = 0.3, 0.5
"""Of the first frame's place (m) and joints (rad),"""
FIRST_SPEED = 2.0, 4.0
"""and of their speeds (m/s, rad/s)."""
ROOT = slice(3, 6)


class PoseFilter:
    """Estimates states, trans (3) and pose (3 J), frame by frame. problem: of one frame, whose data
    hold what the frame shows; state: a start.
    """

    def __init__(
        self,
        problem: KeypointSequence,
        state: Float[np.ndarray, " N"],
        rate_hz: float,
        settings: CameraSettings,
    ):
        joints = len(problem.data.parents)
        size = len(state)
        self._problem = problem
        self._noise = 1.0 / acceleration_links(joints, rate_hz, settings)
        first = np.repeat(FIRST_SD, (3, size - 3)) ** 2
        slow = (np.repeat(FIRST_SPEED, (3, size - 3)) / rate_hz) ** 2
        self.state = np.array(state)
        self._last = np.array(state)
        self._own, self._with_last = np.diag(first), np.diag(first)
        self._of_last = np.diag(first + slow)
        self.cost = 0.0

    def ahead(self) -> Float[np.ndarray, " N"]:
        """The state that is expected next."""
        return 2.0 * self.state - self._last

    def rehearse(self) -> None:
        """Linearise the last state once more; nothing changes."""
        self._problem.linearize(np.zeros(1, np.int64), self.state[None])

    def predict(self, lasts: float = 1.0) -> None:
        """Move on by a frame; ``lasts``: the share of the motion from frame to frame that goes
        on.
        """
        self._unwrap()
        moved = self.state + lasts * (self.state - self._last)
        self.state, self._last = moved, self.state
        mixed = self._with_last
        ahead = 4.0 * self._own - 2.0 * (mixed + mixed.T) + self._of_last
        ahead.flat[:: len(ahead) + 1] += self._noise
        self._with_last, self._of_last = 2.0 * self._own - mixed.T, self._own
        self._own = 0.5 * (ahead + ahead.T)

    def correct(self) -> None:
        """Take in what the frame shows."""
        expected = self.state
        at = expected
        frame = np.zeros(1, np.int64)
        for k in range(ITERATIONS):
            costs, gradients, matrices = self._problem.linearize(frame, at[None])
            information = matrices[0]
            pull = gradients[0] + information @ (expected - at)
            system = information @ self._own
            system.flat[:: len(system) + 1] += 1.0
            right = np.column_stack([pull, information])
            solved = np.linalg.solve(system, right)
            change = solved[:, 0]
            step = expected - self._own @ change - at
            at = at + step
            if k + 1 == ITERATIONS or np.sqrt(np.mean(step**2)) < CLOSE:
                break
        weight = solved[:, 1:]  # (I + H S)^-1 H, which is H (I + S H)^-1 and symmetric
        with_last = self._with_last
        gain = weight @ self._own
        self.state = at
        self._last = self._last - with_last.T @ change
        self._of_last = self._of_last - with_last.T @ (weight @ with_last)
        own = self._own - self._own @ gain
        self._with_last = with_last - gain.T @ with_last
        self._own = 0.5 * (own + own.T)
        self.cost = float(costs[0])

    def _unwrap(self) -> None:
        """A root's rotation vector that is too long gives way to its shorter equivalent, with its
        covariances.
        """
        root = self.state[ROOT]
        angle = float(np.linalg.norm(root))
        if angle <= LONGEST_TURN:
            return
        axis = root / angle
        slope = np.eye(3) - WHOLE / angle * (np.eye(3) - np.outer(axis, axis))
        shift = root * (1.0 - WHOLE / angle) - root
        self.state[ROOT] += shift
        self._last[ROOT] += shift + (slope - np.eye(3)) @ (self._last[ROOT] - root)
        for table in (self._own, self._with_last, self._of_last):
            table[ROOT] = slope @ table[ROOT]
            table[:, ROOT] = table[:, ROOT] @ slope.T
