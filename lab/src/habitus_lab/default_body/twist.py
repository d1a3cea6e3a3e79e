"""Twist shared along forearm, upper arm and thigh, as pose blend shapes of wrist, shoulder and hip.

Skinning turns all of a forearm's twist about at the wrist, which shrinks it there. In a real arm
the skin turns with its place along the limb: vertex by vertex the twist gets a share t, 0 at the
upper end, 1 at the lower one. With the joint's rotation R = swing * twist (by the angle a about the
limb's axis u, seen at rest), the vertex should go where the same swing and a twist by t a take it.
What skinning misses is fitted by two features that are linear in R - I,

    f_sin = u . axial(R) = cos^2(b/2) sin a,    f_cos = (tr R - 2 u'R u - 1) / 2 = cos^2(b/2) (cos a - 1),

b the swing's angle: both are zero for every pure swing, so that bending a wrist or raising an arm
adds nothing. Each vertex has one offset per feature, by least squares over twists and swings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .rig import JOINT_MIRROR, JOINTS, PARENTS

LIMBS = (
    ("wrist", "elbow", "wrist"),
    ("shoulder", "shoulder", "elbow"),
    ("hip", "hip", "knee"),
)  # driver, from, to
TWISTS = {"wrist": 100.0, "shoulder": 85.0, "hip": 65.0}  # degrees either way that are sampled
SWINGS = {"wrist": 40.0, "shoulder": 60.0, "hip": 60.0}
TWIST_STEPS = 15
SWING_STEPS = 4
SWING_DIRECTIONS = 8
SMALLEST_OFFSET = 1e-5  # metres a unit of a feature: less is left out
RIDGE = 1e-3
RADIAL = 2.0  # how much more an error of girth counts than one of twist


@dataclass(frozen=True)
class TwistShapes:
    """joints (K,) numbers of the joints that drive, posedirs (V, 3, 9K) metres per entry of vec(R -
    I).
    """

    joints: np.ndarray
    posedirs: np.ndarray


def twist_shapes(
    vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray, mirror: np.ndarray
) -> TwistShapes:
    """Pose blend shapes of a symmetric body at rest: vertices (V,3), joints (55,3), weights (V,55),
    mirror (V,).
    """
    names = []
    blocks = []
    for driver, start, end in LIMBS:
        joint = JOINTS.index("left_" + driver)
        upper = joints[JOINTS.index("left_" + start)]
        lower = joints[JOINTS.index("left_" + end)]
        axis = (lower - upper) / np.linalg.norm(lower - upper)
        share = np.clip((vertices - upper) @ axis / np.linalg.norm(lower - upper), 0, 1)
        limb = weights[:, _below(JOINTS.index("left_" + start))].sum(1)
        follow = np.divide(
            weights[:, _below(joint)].sum(1), limb, out=np.zeros(len(limb)), where=limb > 0
        )
        used = np.flatnonzero((limb > 1e-3) & ~((share >= 1) & (follow >= 1)))
        offsets = _fit(
            vertices[used] - joints[joint], axis, share[used], limb[used], follow[used], driver
        )
        left = np.zeros((len(vertices), 3, 9))
        left[used] = offsets @ _features(axis)
        left[np.abs(left).max((1, 2)) < SMALLEST_OFFSET] = 0
        flip = np.array([-1.0, 1.0, 1.0])
        right = left[mirror] * flip[:, None] * np.outer(flip, flip).ravel()
        names += [joint, int(JOINT_MIRROR[joint])]
        blocks += [left, right]
    order = np.argsort(names)
    return TwistShapes(np.array(names)[order], np.concatenate([blocks[k] for k in order], 2))


def _below(joint: int) -> list[int]:
    """The joint and all that hang from it."""
    found = [joint]
    for k in range(joint + 1, len(JOINTS)):
        if PARENTS[k] in found:
            found.append(k)
    return found


def _features(axis: np.ndarray) -> np.ndarray:
    """(2, 9): f_sin and f_cos from vec(R - I), row by row."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.stack([0.5 * skew.ravel(), 0.5 * np.eye(3).ravel() - np.outer(axis, axis).ravel()])


def _fit(
    offset: np.ndarray,
    axis: np.ndarray,
    share: np.ndarray,
    limb: np.ndarray,
    follow: np.ndarray,
    driver: str,
) -> np.ndarray:
    """(V, 3, 2) offsets of each vertex for both features.

    offset (V,3) from the driving joint; limb (V,) how much of a vertex belongs to the limb, follow
    (V,) how much of that to what the joint carries.
    """
    angles = np.radians(np.linspace(-TWISTS[driver], TWISTS[driver], TWIST_STEPS))
    normal = np.zeros((len(offset), 6, 6))
    right = np.zeros((len(offset), 6))
    carried = (limb * follow)[:, None, None]
    for angle in angles[np.abs(angles) > 1e-9]:
        turned = _shared_twist(offset, axis, share * angle)
        twist = _rotation(axis, np.array([angle]))[0]
        for swing in _swings(axis, np.radians(SWINGS[driver])):
            turn = swing @ twist
            feature = _features(axis) @ (turn - np.eye(3)).ravel()
            skinning = (1 - carried) * np.eye(3) + carried * turn
            bent = (1 - follow)[:, None] * turned + follow[:, None] * (turned @ swing.T)
            goal = (1 - limb)[:, None] * offset + limb[:, None] * bent
            miss = goal - np.einsum("vij,vj->vi", skinning, offset)
            stress = _radial(bent, (1 - follow)[:, None] * axis + follow[:, None] * (swing @ axis))
            design = stress @ (skinning[..., None] * feature).reshape(len(offset), 3, 6)
            normal += design.transpose(0, 2, 1) @ design
            right += np.einsum("vik,vij,vj->vk", design, stress, miss)
    normal += RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None, None] / 6 * np.eye(6)
    return np.linalg.solve(normal, right[..., None])[..., 0].reshape(-1, 3, 2)


def _radial(offset: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(V,3,3) matrices that stress an error towards or away from the limb's axis (V,3), which
    changes its girth.
    """
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    out = offset - (offset * axis).sum(1, keepdims=True) * axis
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    return np.eye(3) + (RADIAL - 1) * out[:, :, None] * out[:, None, :]


def _shared_twist(offset: np.ndarray, axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Offsets (V,3) turned about the axis by angles (V,)."""
    return np.einsum("vij,vj->vi", _rotation(axis, angle), offset)


def _rotation(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations (N,3,3) by angle (N,) about one unit axis."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (
        np.eye(3) + np.sin(angle)[:, None, None] * k + (1 - np.cos(angle))[:, None, None] * (k @ k)
    )


def _swings(axis: np.ndarray, largest: float) -> list[np.ndarray]:
    """No swing, and rotations about axes across the limb by up to `largest` (rad)."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    found = [np.eye(3)]
    for way in np.arange(SWING_DIRECTIONS) * 2 * np.pi / SWING_DIRECTIONS:
        across = np.cos(way) * first + np.sin(way) * second
        found += list(_rotation(across, np.linspace(0, largest, SWING_STEPS + 1)[1:]))
    return found
