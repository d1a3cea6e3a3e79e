"""From MakeHuman's A-pose to SMPL's T-pose, person by person, so that every shape rests in the same
pose.

Every bone is turned to a fixed direction and every limb to a fixed twist; the body is symmetric, so
the left side is computed and the right one mirrored. The forearm's pronation is spread along it as
in a real arm (its two bones share it).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from .elastic import Elastic
from .fair import Flank
from .rig import FINGERS, JOINTS, bone_weights, joint_points, joint_weights, place_hips
from .sources import EYEBALLS, Source

COLLAR_RAISE = np.radians(8.0)  # the clavicle's share of raising the arm from 41 to 90 degrees
ELBOW_BOW = np.tan(
    np.radians(2.6)
)  # straightening carries the epicondyles back: then they lie between both ends
THIGH = np.array([np.tan(np.radians(5.0)), -1.0, np.tan(np.radians(1.5))])  # from hip to knee
SHANK = np.array(
    [0.0, -1.0, -np.tan(np.radians(3.0))]
)  # from knee to ankle: feet come to stand under the hips
JAW_OPEN = np.radians(1.5)  # the lips of many bodies cross each other by up to 2 mm
# base vertices of the webs between the left foot's toes 1-2 and 2-3 that touch at rest, and which
# way they part
WEBS = dict.fromkeys((12391, 12397, 12452, 12457, 12463), -1)
WEBS |= dict.fromkeys((12451, 12458, 12462, 12583, 12593, 12597), 1)
EPICONDYLES = [10039, 10062]  # base vertices of the left arm
WEB_GAP = 5e-4  # metres that each of them moves
MIDLINE_GAP = 5e-4  # metres: how far from it a vertex of one side stays
FOOT_YAW = np.radians(5.0)  # toes point a little outward
PRONATION_SHARE = {"forearm_upper": 0.25, "forearm_lower": 0.75}

# segment -> stems of the bones that move with it (left and right); all others stay with the trunk
SEGMENTS = {
    "collar": ("clavicle", "shoulder01"),
    "upper_arm": ("upperarm01", "upperarm02"),
    "forearm_upper": ("lowerarm01",),
    "forearm_lower": ("lowerarm02",),
    "hand": ("wrist", "metacarpal", "finger"),
    "thigh": ("upperleg01", "upperleg02"),
    "shank": ("lowerleg01", "lowerleg02"),
    "foot": ("foot",),
    **{f"toe{k}": (f"toe{k}-",) for k in range(1, 6)},
}
EXTRA_CUBES = (
    "l-finger-2-1",
    "l-finger-5-1",
)  # index and little knuckle: they tell where the palm looks
EXTRA_CUBES += tuple(f"l-toe-{k}-1" for k in range(1, 6))  # roots of the toes
TOE_FAN = np.radians(
    [-3.0, -2.5, 2.5, 6.0, 9.0]
)  # outward, big toe first: toes that touch at rest come apart


class RestPose:
    """Takes bodies of one mesh from MakeHuman's A-pose into the T-pose."""

    def __init__(
        self,
        source: Source,
        base: np.ndarray,
        faces: np.ndarray,
        mirror: np.ndarray,
        average: np.ndarray,
        toes_apart: bool = True,
    ):
        """base (V,) base index of each vertex, faces (F,3), mirror (V,); average (W,3): an average
        body's points.
        """
        self.toes_apart = toes_apart
        count = len(source.vertices)
        pick = sparse.csr_matrix(
            (np.ones(len(base)), (np.arange(len(base)), base)), (len(base), count)
        )
        corners = np.array([source.groups["joint-" + name] for name in EXTRA_CUBES])
        rows = np.repeat(np.arange(len(corners)), 8)
        extra = sparse.csr_matrix(
            (np.full(corners.size, 1 / 8), (rows, corners.ravel())), (len(corners), count)
        )
        self.points = sparse.vstack(
            [pick, joint_points(source), extra]
        ).tocsr()  # what __call__ needs of a body
        self.vertices = len(base)
        self.weights = {name: value[base] for name, value in segment_weights(source).items()}
        self.elastic = Elastic(average[base], faces, self.weights, mirror)
        self.left = source.vertices[base, 0] > 1e-6
        self.mirror = mirror
        self.jaw = joint_weights(source, base, mirror)[:, JOINTS.index("jaw")]
        self.flank = Flank(
            self._skinned((self.points @ average)[None])[1][0], faces, self.weights, mirror
        )

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (N,V,3) float32 and joints (N,55,3) in the T-pose, pelvis at the origin, from
        points (N,P,3).
        """
        body, posed, moved = self._skinned(points.astype(float))
        refined = [
            self.elastic.refine(rest, there) for rest, there in zip(body, posed, strict=True)
        ]
        vertices = self._apart(self.flank(np.array(refined)).astype(np.float32))
        for side, flip in (("left", 1), ("right", -1)):
            moved[:, JOINTS.index(f"{side}_elbow")] = vertices[:, EPICONDYLES].mean(1) * [
                flip,
                1,
                1,
            ]
        return vertices, moved

    def _skinned(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (N,V,3) in the A-pose, and in the T-pose by skinning alone; joints (N,55,3)."""
        body, centres, extra = np.split(
            points, [self.vertices, self.vertices + len(JOINTS)], axis=1
        )
        centres = place_hips(centres, body)
        fan = TOE_FAN * self.toes_apart
        lips = self._lips_apart(body, centres)
        posed, moved = to_tpose(lips, centres, extra, self.weights, fan)
        return body, posed, moved

    def _lips_apart(self, vertices: np.ndarray, joints: np.ndarray) -> np.ndarray:
        arm = vertices - joints[:, None, JOINTS.index("jaw")]
        opened = np.einsum(
            "ij,nvj->nvi", _about(np.array([1.0, 0, 0]), np.array([JAW_OPEN]))[0], arm
        )
        return vertices + self.jaw[None, :, None] * (opened - arm)

    def _apart(self, vertices: np.ndarray) -> np.ndarray:
        """The webs between toes a little wider; and no vertex past the midline, where the groin
        would cross itself.
        """
        left = np.flatnonzero(self.left)
        vertices[:, list(WEBS), 0] += self.toes_apart * WEB_GAP * np.array(list(WEBS.values()))
        vertices[:, left, 0] = np.maximum(vertices[:, left, 0], MIDLINE_GAP)
        vertices[:, self.mirror[left]] = vertices[:, left] * np.float32([-1, 1, 1])
        return vertices


def segment_weights(source: Source) -> dict[str, np.ndarray]:
    """Segment -> (19158,) weight; left segments carry the prefix `left_`, right ones `right_`, the
    rest is `trunk`.
    """
    table: dict[str, np.ndarray] = {}
    for bone, value in bone_weights(source).items():
        stem, _, side = bone.partition(".")
        names = [s for s, stems in SEGMENTS.items() if stem.startswith(stems)]
        name = {"L": "left_", "R": "right_"}[side] + names[0] if names else "trunk"
        table[name] = table.get(name, 0) + value
    eyes = np.concatenate([source.groups[name] for name in EYEBALLS])
    for name, value in table.items():
        value[eyes] = name == "trunk"
    return table


def tpose_transforms(
    joints: np.ndarray, extra: np.ndarray, fan: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Left segment -> (rotation (N,3,3), translation (N,3)) from joints (N,55,3) and the extra
    cubes (N,7,3).

    fan (5,): how far each toe turns outward, rad.
    """
    at = {name: joints[:, k] for k, name in enumerate(JOINTS)}
    collar = at["left_collar"]
    shoulder = at["left_shoulder"]
    elbow = at["left_elbow"]
    wrist = at["left_wrist"]
    hand = at["left_middle1"]
    hip = at["left_hip"]
    knee = at["left_knee"]
    ankle = at["left_ankle"]
    count = len(joints)
    flexion = np.cross(elbow - shoulder, wrist - elbow)
    x_axis, y_axis, z_axis = np.eye(3)

    turn_collar = np.broadcast_to(_about(z_axis, np.full(count, COLLAR_RAISE)), (count, 3, 3))
    turn_arm = _frame_to_frame(elbow - shoulder, flexion, x_axis + ELBOW_BOW * z_axis, -y_axis)
    turn_forearm = _frame_to_frame(wrist - elbow, flexion, x_axis - ELBOW_BOW * z_axis, -y_axis)
    turn_hand = _frame_to_frame(hand - wrist, extra[:, 1] - extra[:, 0], x_axis, -z_axis)
    pronation = _twist_about_x(turn_hand @ turn_forearm.transpose(0, 2, 1))
    turn_thigh = _shortest(knee - hip, THIGH)
    turn_shank = _shortest(ankle - knee, SHANK)
    toe = at["left_foot"] - ankle
    turn_foot = _about(y_axis, FOOT_YAW - np.arctan2(toe[:, 0], toe[:, 2]))

    moved: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def attach(name: str, turn: np.ndarray, pivot: np.ndarray, parent: str | None) -> None:
        place = pivot if parent is None else _move(moved[parent], pivot)
        moved[name] = (turn, place - np.einsum("nij,nj->ni", turn, pivot))

    attach("collar", turn_collar, collar, None)
    attach("upper_arm", turn_arm, shoulder, "collar")
    attach("forearm", turn_forearm, elbow, "upper_arm")
    for name, share in PRONATION_SHARE.items():
        attach(name, _about(x_axis, share * pronation) @ turn_forearm, elbow, "upper_arm")
    attach("hand", turn_hand, wrist, "forearm")
    attach("thigh", turn_thigh, hip, None)
    attach("shank", turn_shank, knee, "thigh")
    attach("foot", turn_foot, ankle, "shank")
    for k, angle in enumerate(fan):
        attach(
            f"toe{k + 1}",
            _about(y_axis, np.full(count, angle)) @ turn_foot,
            extra[:, 2 + k],
            "foot",
        )
    return moved


def to_tpose(
    vertices: np.ndarray,
    joints: np.ndarray,
    extra: np.ndarray,
    weights: dict[str, np.ndarray],
    fan: np.ndarray = TOE_FAN,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N,V,3) and joints (N,55,3) in the T-pose, pelvis joint at the origin; weights are
    (V,) a segment.
    """
    left = tpose_transforms(joints, extra, fan)
    posed = weights["trunk"][None, :, None] * vertices
    for name in SEGMENTS:
        turn, shift = left[name]
        for side, sign in (("left_", 1.0), ("right_", -1.0)):
            flip = np.array([sign, 1.0, 1.0])
            moving = np.flatnonzero(weights[side + name])
            there = np.einsum("nij,nvj->nvi", turn, vertices[:, moving] * flip) + shift[:, None]
            posed[:, moving] += weights[side + name][moving][None, :, None] * there * flip
    centres = _posed_joints(joints, left)
    return posed - centres[:, :1], centres - centres[:, :1]


def _posed_joints(joints: np.ndarray, left: dict[str, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    driver = {"shoulder": "collar", "elbow": "upper_arm", "wrist": "forearm"}
    driver |= {"knee": "thigh", "ankle": "shank", "foot": "foot"}
    driver |= {f"{finger}{k}": "hand" for finger in FINGERS for k in (1, 2, 3)}
    centres = joints.copy()
    for part, segment in driver.items():
        here = _move(left[segment], joints[:, JOINTS.index("left_" + part)])
        centres[:, JOINTS.index("left_" + part)] = here
        centres[:, JOINTS.index("right_" + part)] = here * [-1, 1, 1]
    return centres


def _move(transform: tuple[np.ndarray, np.ndarray], points: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", transform[0], points) + transform[1]


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Right-handed frames (...,3,3), columns: along `first`, `second` made perpendicular to it,
    their cross product.
    """
    a = _unit(first)
    b = _unit(second - (second * a).sum(-1, keepdims=True) * a)
    return np.stack([a, b, np.cross(a, b)], -1)


def _frame_to_frame(
    first: np.ndarray, second: np.ndarray, to_first: np.ndarray, to_second: np.ndarray
) -> np.ndarray:
    return _frame(to_first, to_second) @ _frame(first, second).swapaxes(-1, -2)


def _shortest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotations (N,3,3) that take directions a (N,3) to b (3,) by the shortest way."""
    axis = np.cross(_unit(a), _unit(b))
    cosine = (_unit(a) * _unit(b)).sum(-1)
    k = _cross_matrix(axis)
    return np.eye(3) + k + k @ k / (1 + cosine)[:, None, None]


def _about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations (N,3,3) by angle (N,) about a unit axis."""
    k = _cross_matrix(axis)
    return (
        np.eye(3) + np.sin(angle)[:, None, None] * k + (1 - np.cos(angle))[:, None, None] * (k @ k)
    )


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack(
        [np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2
    )


def _twist_about_x(turn: np.ndarray) -> np.ndarray:
    """Angle (N,) of the rotation about x that lies nearest to `turn` (N,3,3)."""
    return np.arctan2(turn[:, 2, 1] - turn[:, 1, 2], turn[:, 1, 1] + turn[:, 2, 2])
