"""Ranges of motion of SMPL's and SMPL-X's joints, from which the pose prior begins.

Sources: American Academy of Orthopaedic Surgeons, "Joint Motion: Method of Measuring and Recording"
(1965); D. C. Boone and S. P. Azen, "Normal range of motion of joints in male subjects", J Bone
Joint Surg 61-A:756-759 (1979); I. A. Kapandji's segment shares for the spine (lumbar, thoracic and
cervical parts). Fingers: AAOS's values as C. C. Norkin and D. J. White print them ("Measurement of
Joint Motion": MCP 90 of flexion and 45 of extension, 20 to either side, PIP 100, DIP 90; thumb CMC
15, 20 and 70, MCP 50, IP 80 and 20), the DIP joint following the PIP joint (H. Rijpkema and M.
Girard, "Computer animation of knowledge-based human grasping", 1991). Jaw: an opening of 32.2 (sd
6.0) degrees (B. Kordass et al., Int J Comput Dent 17:9-20, 2014). Eyes: 44.9 inward, 44.2 outward,
27.9 up, 47.1 down (W. J. Lee et al., "Differences in eye movement range based on age and gaze
direction", Eye 33:1145-1151, 2019).

Angles in degrees about the axes of the T-pose, palms down: x to the left, y up, z forward, for the
left side; the right side mirrors y and z. A standard deviation is a quarter of a range, the mean is
its middle, shrunk halfway to a relaxed stance; the face is relaxed. Ranges are from the template's
rest pose, whose fingers are bent a little already.
"""

import numpy as np
from scipy.linalg import block_diag

from habitus.body.joint_layouts import SMPLX
from habitus.body.prior import PosePrior

FINGERS = ("index", "middle", "ring", "pinky")
# joint: ((x low, x high), (y low, y high), (z low, z high)), relaxed stance
MIDLINE = {
    "spine1": (((-12, 30), (-8, 8), (-12, 12)), (0, 0, 0)),
    "spine2": (((-10, 25), (-10, 10), (-12, 12)), (0, 0, 0)),
    "spine3": (((-10, 20), (-15, 15), (-12, 12)), (0, 0, 0)),
    "neck": (((-30, 30), (-35, 35), (-22, 22)), (5, 0, 0)),
    "head": (((-30, 25), (-35, 35), (-20, 20)), (0, 0, 0)),
    "jaw": (((0, 32), (-6, 6), (-2, 2)), (0, 0, 0)),
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
    **{
        f"{finger}1": (((-10, 10), (-20, 20), (-70, 45)), (0, 0, -5))
        for finger in ("index", "middle", "ring", "pinky")
    },
    **{f"{finger}2": (((-5, 5), (-5, 5), (-90, 0)), (0, 0, -10)) for finger in FINGERS},
    **{f"{finger}3": (((-5, 5), (-5, 5), (-80, 0)), (0, 0, -5)) for finger in FINGERS},
    "thumb1": (((-35, 35), (-30, 30), (-30, 30)), (0, 0, 0)),
    "eye_smplhf": (((-28, 47), (-45, 45), (-2, 2)), (0, 0, 0)),
}
HINGES = {"thumb2": ((0.0, 0.75, 0.66), (-10, 50)), "thumb3": ((0.2, 0.82, 0.53), (-20, 80))}
"""Joints that turn about one axis (left side) only: that axis, lowest and highest angle."""
RELAXED = ("jaw", "eye_smplhf")
FOLLOWS = 0.9
"""Correlation of the flexion of a finger's last joint with that of the one before."""
BODY = (
    "left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 "
    "left_foot right_foot neck "
    "left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist "
    "right_wrist "
    "left_hand right_hand"
).split()
MORE = tuple(name for name in SMPLX.joint_names[1:] if name not in BODY)
"""Jaw, eyes and fingers: the joints of SMPL-X that SMPL lacks."""
SMALLEST_SD = np.radians(4.0)


def range_prior() -> PosePrior:
    """The prior of the published ranges: joints are independent but for the last ones of
    fingers.
    """
    order = (*BODY, *MORE)
    means, covariances = zip(*(_joint(name) for name in order), strict=True)
    covariance = block_diag(*covariances)
    for k, name in enumerate(order):
        if name.endswith("3") and "thumb" not in name and "spine" not in name:
            last = 3 * k + 2
            before = 3 * order.index(f"{name[:-1]}2") + 2
            shared = FOLLOWS * np.sqrt(covariance[last, last] * covariance[before, before])
            covariance[last, before] = covariance[before, last] = shared
    return PosePrior(order, np.concatenate(means), covariance)


def _joint(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean (3,) and covariance (3, 3) of a joint's rotation vector, rad."""
    side, _, part = ("", "", name) if name in MIDLINE else name.partition("_")
    mirror = np.array([1.0, -1.0, -1.0]) if side == "right" else np.ones(3)
    if part in HINGES:
        axis, (low, high) = np.array(HINGES[part][0]), np.radians(HINGES[part][1])
        axis /= np.linalg.norm(axis)
        mean = (low + high) / 4 * axis
        spread = np.outer(axis, axis) * (((high - low) / 4) ** 2 - SMALLEST_SD**2)
        return mirror * mean, np.outer(mirror, mirror) * spread + SMALLEST_SD**2 * np.eye(3)
    limits, relaxed = MIDLINE[name] if not side else LEFT[part]
    low, high = np.radians(np.array(limits, dtype=float)).T
    relaxed = np.radians(np.array(relaxed, dtype=float))
    mean = relaxed if part in RELAXED else 0.5 * (0.5 * (low + high) + relaxed)
    return mirror * mean, np.diag(np.maximum((high - low) / 4, SMALLEST_SD) ** 2)
