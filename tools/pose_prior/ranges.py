"""Ranges of motion of SMPL's joints, from which the pose prior begins.

Sources: American Academy of Orthopaedic Surgeons, "Joint Motion: Method of Measuring and Recording" (1965); D. C. Boone
and S. P. Azen, "Normal range of motion of joints in male subjects", J Bone Joint Surg 61-A:756-759 (1979); I. A.
Kapandji's segment shares for the spine (lumbar, thoracic and cervical parts). Angles in degrees about the axes of the
T-pose: x to the body's left, y up, z forward, for the left side; the right side mirrors y and z. A standard deviation
is a quarter of a range, the mean is its middle, shrunk halfway to a relaxed stance.
"""

import numpy as np

from habitus.body.prior import PosePrior

# joint: ((x low, x high), (y low, y high), (z low, z high)), relaxed stance
MIDLINE = {
    "spine1": (((-12, 30), (-8, 8), (-12, 12)), (0, 0, 0)),
    "spine2": (((-10, 25), (-10, 10), (-12, 12)), (0, 0, 0)),
    "spine3": (((-10, 20), (-15, 15), (-12, 12)), (0, 0, 0)),
    "neck": (((-30, 30), (-35, 35), (-22, 22)), (5, 0, 0)),
    "head": (((-30, 25), (-35, 35), (-20, 20)), (0, 0, 0)),
}
LEFT = {
    "hip": (((-120, 30), (-45, 45), (-30, 45)), (0, 0, 2)),
    "knee": (((0, 140), (-10, 10), (-5, 5)), (5, 0, 0)),
    "ankle": (((-20, 50), (-15, 15), (-25, 20)), (0, 0, 0)),
    "foot": (((-60, 30), (-4, 4), (-4, 4)), (0, 0, 0)),
    "collar": (((-10, 10), (-20, 20), (-12, 35)), (0, 0, -3)),
    "shoulder": (((-70, 70), (-110, 40), (-80, 75)), (0, 0, -70)),
    "elbow": (((-60, 60), (-145, 0), (-6, 6)), (0, -20, 0)),
    "wrist": (((-20, 20), (-20, 30), (-75, 70)), (0, 0, 0)),
    "hand": (((-8, 8), (-8, 8), (-20, 15)), (0, 0, 0)),
}
ORDER = (
    "left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot neck "
    "left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist "
    "left_hand right_hand"
).split()
SMALLEST_SD = np.radians(4.0)


def range_prior() -> PosePrior:
    """The prior of the published ranges: independent axes."""
    mean, sd = zip(*(_joint(name) for name in ORDER), strict=True)
    return PosePrior(tuple(ORDER), np.concatenate(mean), np.diag(np.concatenate(sd) ** 2))


def _joint(name: str) -> tuple[np.ndarray, np.ndarray]:
    side, _, part = name.rpartition("_")
    limits, relaxed = MIDLINE[name] if not side else LEFT[part]
    low, high = np.radians(np.array(limits, dtype=float)).T
    mean = 0.5 * (0.5 * (low + high) + np.radians(np.array(relaxed, dtype=float)))
    mirror = np.array([1.0, -1.0, -1.0]) if side == "right" else np.ones(3)
    return mirror * mean, np.maximum((high - low) / 4, SMALLEST_SD)
