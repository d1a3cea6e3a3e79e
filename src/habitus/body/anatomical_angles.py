"""Joint angles by the conventions of gait laboratories, in degrees: ISB's (Wu et al. 2002, 2005)
and Plug-in Gait's.

The rotation of a segment against the one above it, P'D = Rz(a) Rx(b) Ry(c) in their anatomical
axes, is Grood and Suntay's joint coordinate system; signs are mirrored so that left and right read
alike. Pelvis and thorax are against the laboratory: X along the way, Y up.

What markers on the skin do not determine (rotations of hip and knee about their long axes, knee
adduction, ankle inversion, …) is computed, and marked as not validated: there it follows the pose
prior, and Plug-in Gait, with which it could be compared, follows wands on the skin.
"""

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from habitus.body.anatomy import SIDES, Anatomy
from habitus.errors import HabitusError
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving

CONVENTIONS = ("isb", "pig", "opensim")
MIN_WAY = 0.5
"""Metres that the pelvis must go for its way to give the direction of progression; else it is where
the person faces."""
CARRIERS: Mapping[str, str] = {
    "pelvis": "pelvis",
    "thorax": "spine3",
    "thigh": "hip",
    "shank": "knee",
    "shank_ankle": "knee",
    "foot": "ankle",
    "upper_arm": "shoulder",
    "forearm": "elbow",
    "hand": "wrist",
}
"""The joint of the body with which each segment moves."""


@dataclass(frozen=True, eq=False)
class AngleTable:
    """Angles of a motion: ``values`` (T, N) in degrees, NaN where there is none, in columns
    ``names``, such as "left_knee_flexion".

    ``validated`` (N,): whether the angle agrees with laboratories' own (docs/for-laboratories.md),
    and both its segments carry markers; the others are shown for completeness. ``sources``:
    landmarks that come from a marker, by its label; all others are the fitted template's.
    """

    convention: str
    rate_hz: float
    names: tuple[str, ...]
    values: Float[np.ndarray, "T N"]
    validated: Bool[np.ndarray, " N"]
    sources: Mapping[str, str]

    def __getitem__(self, name: str) -> Float[np.ndarray, " T"]:
        """One angle. Raises KeyError for a name that is not in ``names``."""
        if name not in self.names:
            raise KeyError(name)
        return self.values[:, self.names.index(name)]


def without_segments(table: AngleTable, guessed: Collection[str]) -> AngleTable:
    """The table with the angles of these joints' segments, which nothing was seen of, marked as not
    validated.
    """
    validated = [
        bool(sure) and not segments_of(name) & set(guessed)
        for name, sure in zip(table.names, table.validated, strict=True)
    ]
    return replace(table, validated=np.array(validated))


def segments_of(name: str) -> set[str]:
    """The joints with which the two segments of an angle move, by the angle's name in any
    convention.
    """
    side, plain = split_side(name)
    return {_sided(part, side) for part in _SEGMENTS.get(plain.partition("_")[0], ())}


def split_side(name: str) -> tuple[str, str]:
    """The side that a column is of, "" for the middle of the body, and its name without it:
    "left_knee_flexion" and OpenSim's "knee_angle_l" are of the left.
    """
    for side in SIDES:
        if name.startswith(f"{side}_"):
            return side, name.removeprefix(f"{side}_")
        if name.endswith(f"_{side[0]}"):
            return side, name.removesuffix(f"_{side[0]}")
    return "", name


_SEGMENTS: Mapping[str, tuple[str, ...]] = {
    "pelvis": ("pelvis",),
    "trunk": ("pelvis", "spine3"),
    "spine": ("pelvis", "spine3"),
    "lumbar": ("pelvis", "spine3"),
    "thorax": ("spine3",),
    "hip": ("pelvis", "*hip"),
    "knee": ("*hip", "*knee"),
    "ankle": ("*knee", "*ankle"),
    "shoulder": ("spine3", "*shoulder"),
    "arm": ("spine3", "*shoulder"),
    "elbow": ("*shoulder", "*elbow"),
    "wrist": ("*elbow", "*wrist"),
}


@dataclass(frozen=True)
class _Part:
    """One angle of three: the sign that it has on the right side and on the left one; ``turned``:
    degrees to be added on the right, where an elevation is taken as positive.
    """

    name: str
    index: int
    right: float
    left: float
    validated: bool = True
    turned: float = 0.0


@dataclass(frozen=True)
class _Joint:
    """A segment against the one above it ("lab": the laboratory), in an order of turns."""

    upper: str
    lower: str
    parts: tuple[_Part, ...]
    order: str = "ZXY"
    sides: tuple[str, ...] = SIDES


def _both(name: str, index: int, sign: float = 1.0, validated: bool = True) -> _Part:
    """About the transverse axis: alike on both sides."""
    return _Part(name, index, sign, sign, validated)


def _mirrored(
    name: str, index: int, sign: float = 1.0, validated: bool = True, turned: float = 0.0
) -> _Part:
    return _Part(name, index, sign, -sign, validated, turned)


_HIP = (
    _both("hip_flexion", 0),
    _mirrored("hip_adduction", 1),
    _mirrored("hip_internal_rotation", 2, validated=False),
)
_KNEE = (
    _both("knee_flexion", 0, -1.0),
    _mirrored("knee_adduction", 1, validated=False),
    _mirrored("knee_internal_rotation", 2, validated=False),
)
_ANKLE = (
    _both("ankle_dorsiflexion", 0),
    _mirrored("ankle_inversion", 1, validated=False),
    _mirrored("ankle_internal_rotation", 2, validated=False),
)
_LEGS = (
    _Joint("pelvis", "*thigh", _HIP),
    _Joint("*thigh", "*shank", _KNEE),
    _Joint("*shank_ankle", "*foot", _ANKLE),
)
_WRIST = _Joint(
    "*forearm",
    "*hand",
    (
        _both("wrist_flexion", 0, validated=False),
        _mirrored("wrist_ulnar_deviation", 1, validated=False),
    ),
)
_MIDDLE = ("",)
_TABLES: Mapping[str, tuple[_Joint, ...]] = {
    "isb": (
        _Joint(
            "lab",
            "pelvis",
            (
                _both("pelvis_rotation_to_the_left", 0),
                _both("pelvis_right_side_up", 1, -1.0),
                _both("pelvis_anterior_tilt", 2, -1.0),
            ),
            order="YXZ",
            sides=_MIDDLE,
        ),
        _Joint(
            "pelvis",
            "thorax",
            (
                _both("trunk_flexion", 0, -1.0),
                _both("trunk_bending_to_the_right", 1),
                _both("trunk_rotation_to_the_left", 2),
            ),
            sides=_MIDDLE,
        ),
        *_LEGS,
        _Joint(
            "thorax",
            "*upper_arm",
            (
                _mirrored("shoulder_plane_of_elevation", 0, validated=False, turned=180.0),
                _both("shoulder_elevation", 1),
                _mirrored("shoulder_internal_rotation", 2, validated=False, turned=180.0),
            ),
            order="YXY",
        ),
        _Joint(
            "*upper_arm",
            "*forearm",
            (
                _both("elbow_flexion", 0),
                _mirrored("elbow_carrying_angle", 1, validated=False),
                _mirrored("elbow_pronation", 2, validated=False),
            ),
        ),
        _WRIST,
    ),
    "pig": (
        _Joint(
            "lab",
            "pelvis",
            (
                _both("pelvis_tilt", 0, -1.0),
                _mirrored("pelvis_obliquity", 1, -1.0),
                _mirrored("pelvis_rotation", 2),
            ),
        ),
        _Joint(
            "lab",
            "thorax",
            (
                _both("thorax_tilt", 0, -1.0),
                _mirrored("thorax_obliquity", 1, -1.0),
                _mirrored("thorax_rotation", 2),
            ),
        ),
        _Joint(
            "pelvis",
            "thorax",
            (
                _both("spine_flexion", 0, -1.0),
                _mirrored("spine_bending", 1),
                _mirrored("spine_rotation", 2, -1.0),
            ),
        ),
        *_LEGS,
        _Joint(
            "thorax",
            "*upper_arm",
            (
                _both("shoulder_flexion", 0),
                _mirrored("shoulder_abduction", 1, -1.0),
                _mirrored("shoulder_internal_rotation", 2, validated=False),
            ),
        ),
        _Joint("*upper_arm", "*forearm", (_both("elbow_flexion", 0),)),
    ),
}


def anatomical_angles(moving: "Moving", anatomy: Anatomy, convention: str = "isb") -> AngleTable:
    """The angles of a body in motion by a convention, "isb" or "pig" (Wu et al. 2002, 2005; Grood
    and Suntay 1983). Raises HabitusError for an unknown convention, and for a body without the
    joints that carry segments.
    """
    if convention not in _TABLES:
        raise HabitusError(
            f"convention is {convention!r}; expected one of {', '.join(CONVENTIONS)}"
        )
    pose = np.asarray(moving.pose, np.float64)
    turns = segment_rotations(moving, anatomy, convention, pose)
    turns["lab"] = Rotation.from_matrix(laboratory(moving, turns["pelvis"]))
    names: list[str] = []
    columns: list[np.ndarray] = []
    validated: list[bool] = []
    for joint in _TABLES[convention]:
        for side in joint.sides:
            upper, lower = (_sided(name, side) for name in (joint.upper, joint.lower))
            angles = _split(turns[upper].inv() * turns[lower], joint.order)
            for part in joint.parts:
                own = angles[:, part.index]
                own = part.left * own if side == "left" else part.right * own + part.turned
                names.append(f"{side}_{part.name}" if side else part.name)
                columns.append(_near_zero(own))
                validated.append(part.validated)
    return AngleTable(
        convention,
        moving.rate_hz,
        tuple(names),
        np.column_stack(columns),
        np.array(validated),
        anatomy.sources,
    )


def segment_rotations(
    moving: "Moving", anatomy: Anatomy, convention: str, pose: Float[np.ndarray, "T J 3"]
) -> dict[str, Rotation]:
    """Segments' anatomical axes in the world, frame by frame. Raises HabitusError for a body
    without the joints that carry them.
    """
    names = moving.body.joint_names
    world = world_rotations(moving.body.parents, pose)
    out = {}
    for segment, carrier in CARRIERS.items():
        for side in _MIDDLE if carrier in names else SIDES:
            joint = f"{side}_{carrier}" if side else carrier
            if joint not in names:
                raise HabitusError(
                    f"{moving.body.name} has no joint {joint}; anatomical angles are of bodies "
                    "with SMPL's joints"
                )
            name = f"{side}_{segment}" if side else segment
            axes = Rotation.from_matrix(anatomy.frame(name, convention))
            out[name] = Rotation.from_matrix(world[:, names.index(joint)]) * axes
    return out


def world_rotations(
    parents: Sequence[int], pose: Float[np.ndarray, "T J 3"]
) -> Float[np.ndarray, "T J 3 3"]:
    """Rotations of joints from rest to the world, of rotation vectors relative to their parents
    (rad).
    """
    out = np.empty((*pose.shape, 3))
    for k, parent in enumerate(parents):
        own = Rotation.from_rotvec(pose[:, k]).as_matrix()
        out[:, k] = own if parent < 0 else out[:, parent] @ own
    return out


def laboratory(moving: "Moving", pelvis: Rotation) -> Float[np.ndarray, "3 3"]:
    """The laboratory's axes X (progression), Y (up), Z (to the right) as columns, in the motion's
    world: X is the horizontal axis nearest to the pelvis' way, or to where it faces on the mean
    where it stays.
    """
    upright = up_rotation(moving.up_axis)
    way = upright @ (moving.trans[-1] - moving.trans[0])
    way[1] = 0.0
    if np.linalg.norm(way) < MIN_WAY:
        way = upright @ pelvis.as_matrix()[:, :, 0].mean(0)
    axis = 0 if abs(way[0]) >= abs(way[2]) else 2
    x = np.zeros(3)
    x[axis] = 1.0 if way[axis] >= 0.0 else -1.0
    y = np.array([0.0, 1.0, 0.0])
    return upright.T @ np.column_stack([x, y, np.cross(x, y)])


def _split(rotation: Rotation, order: str) -> Float[np.ndarray, "T 3"]:
    """Euler angles in degrees about intrinsic axes, without jumps of a whole turn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where two axes fall together any split will do
        angles = rotation.as_euler(order, degrees=True)
    return np.unwrap(angles, period=360.0, axis=0)


def _near_zero(angle: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """The usual value as near to zero as whole turns allow."""
    return angle - 360.0 * np.round(np.median(angle) / 360.0)


def _sided(name: str, side: str) -> str:
    return name.replace("*", f"{side}_")
