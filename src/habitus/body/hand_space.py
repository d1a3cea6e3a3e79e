"""A hand in six numbers, and the Gaussian and the limits of its angles that fits take.

    angles = mean + coordinates . directions + rest of each angle        (degrees, `HandPose`)

Coordinates and rests are independent and normal, so that the angles are too: factor analysis with
factors from anatomy. "curl" bends all fingers, the joints together as they do around objects of
different size, and draws them together at the palm (M. Santello, M. Flanders, J. F. Soechting,
"Postural hand synergies for tool use", J Neurosci 18:10105-10115, 1998: two such synergies explain
80 % of 57 grasps); "knuckles" bends the MCP joints against the others (lumbrical against hook);
"index" bends the index finger apart from the rest; "spread" fans the fingers, knuckles extended;
"thumb" bends the thumb's MCP and IP joints; "opposition" carries it across the palm. A DIP joint
follows its PIP joint (H. Rijpkema and M. Girard, 1991). Limits are those of the American Academy of
Orthopaedic Surgeons (1965) as C. C. Norkin and D. J. White print them ("Measurement of Joint
Motion"). The thumb's angles count from rest.

Angles become rotations about the axes of a body's own skeleton (`habitus.body.hands.HandAxes`), so
that nothing here belongs to one body, and the right hand is the left one's mirror image.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.hands import (
    FINGERS,
    HAND_JOINTS,
    NUM_ANGLES,
    SIDES,
    FingeredBody,
    HandAxes,
    HandPose,
)

OFF_AXIS = np.radians(2.5)
"""Standard deviation of what turns a joint beside its axes (rad): fingers hardly twist."""
_STEP = 1e-4


@dataclass(frozen=True)
class HandSpace:
    """Coordinates of a hand. Angles are rows of `HandPose.angles`, degrees.

    names (6,): the coordinates, each in standard deviations. directions (6, 20): change of angles
    for one of each. rest (20,): standard deviation of what they leave of each angle. low, high
    (20,): limits of the angles.
    """

    names: tuple[str, ...]
    mean: Float[np.ndarray, "20"]
    directions: Float[np.ndarray, "6 20"]
    rest: Float[np.ndarray, "20"]
    low: Float[np.ndarray, "20"]
    high: Float[np.ndarray, "20"]

    def pose(self, coordinates: Sequence[float] | Float[np.ndarray, "6"]) -> HandPose:
        """The hand of these coordinates, kept within the limits."""
        angles = self.mean + np.asarray(coordinates, dtype=float) @ self.directions
        return HandPose.of(np.clip(angles, self.low, self.high))

    def coordinates(self, pose: HandPose) -> Float[np.ndarray, "6"]:
        """Those of the nearest hand, angles weighed by ``rest``."""
        away = (pose.angles - self.mean) / self.rest
        return np.linalg.lstsq((self.directions / self.rest).T, away, rcond=None)[0]


def _row(
    fingers: Sequence[tuple[float, float, float]],
    thumb: tuple[float, float, float] = (0, 0, 0),
    abduction: float = 0,
    spread: tuple[float, float, float, float] = (0, 0, 0, 0),
) -> Float[np.ndarray, "20"]:
    alike = [*fingers] * len(FINGERS)
    index, middle, ring, pinky = fingers if len(fingers) == len(FINGERS) else alike
    return HandPose(index, middle, ring, pinky, thumb, abduction, spread).angles


HAND_SPACE = HandSpace(
    ("curl", "knuckles", "index", "spread", "thumb", "opposition"),
    mean=_row([(22, 30, 15), (25, 31, 16), (27, 32, 16), (29, 31, 16)], (4, 10, 12), 15),
    directions=np.array(
        [
            _row([(22, 29, 15), (23, 29, 15), (23, 29, 15), (23, 28, 15)], spread=(-2, 0, 2, 3)),
            _row([(18, -16, -10)]),
            _row([(18, 16, 12), (0, 0, 0), (0, 0, 0), (0, 0, 0)]),
            _row([(-4, 0, 0)], spread=(8, 1, -5, -11)),
            _row([(0, 0, 0)], (2, 14, 20)),
            _row([(0, 0, 0)], (2, 0, 0), 15),
        ]
    ),
    rest=_row([(8, 8, 6)], (8, 8, 10), 8, (3, 3, 3, 3)),
    low=_row([(-30, -10, -10)], (-25, -10, -20), -15, (-20, -20, -20, -20)),
    high=_row([(90, 110, 90)], (25, 55, 80), 70, (20, 20, 20, 20)),
)


def has_hands(body: FingeredBody) -> bool:
    """Whether a body has the joints of two hands."""
    return {f"{side}_{joint}" for side in SIDES for joint in HAND_JOINTS} <= {*body.joint_names}


def hand_joints() -> tuple[str, ...]:
    """Finger joints of both hands, in the order of `hand_gaussian`."""
    return tuple(f"{side}_{joint}" for side in SIDES for joint in HAND_JOINTS)


def hand_gaussian(
    body: FingeredBody, space: HandSpace = HAND_SPACE
) -> tuple[Float[np.ndarray, "90"], Float[np.ndarray, "90 90"]]:
    """Mean and covariance of the rotation vectors (rad) of `hand_joints` of a body, to first order
    about the mean hand.
    """
    mean = np.zeros((len(SIDES), 3 * len(HAND_JOINTS)))
    covariance = np.zeros((*mean.shape, *mean.shape))
    factors = np.radians(np.concatenate([space.directions, np.diag(space.rest)]))
    for k, side in enumerate(SIDES):
        axes = HandAxes.of(body, side)
        mean[k] = axes.rotations(np.radians(space.mean)).ravel()
        spread = factors @ _slopes(axes, np.radians(space.mean))
        covariance[k, :, k] = spread.T @ spread + OFF_AXIS**2 * np.eye(mean.shape[1])
    return mean.ravel(), covariance.reshape(mean.size, mean.size)


def _slopes(axes: HandAxes, angles: Float[np.ndarray, "20"]) -> Float[np.ndarray, "20 45"]:
    """Derivatives of the rotation vectors to the angles, central differences."""
    ends = angles + _STEP * np.array([[[1.0]], [[-1.0]]]) * np.eye(NUM_ANGLES)
    ahead, behind = axes.rotations(ends).reshape(2, NUM_ANGLES, -1)
    return (ahead - behind) / (2.0 * _STEP)
