"""Anatomical landmarks, joint centres and segment frames of a person, at rest.

Landmarks are points of the fitted skin, or the person's latent markers where such sit on them.
Frames follow ISB: X anterior, Y proximal, Z to the right, on both sides alike (Wu et al. 2002,
2005; Grood and Suntay 1983). At rest body space is x left, y up, z forward.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError

Point = Float[np.ndarray, "3"]
Frame = Float[np.ndarray, "3 3"]
SACRUM = "sacrum_between_psis"
"""The middle of the posterior superior iliac spines, on which some layouts have one marker."""
SIDES = ("left", "right")
HARRINGTON = np.array([[-0.24, 0.0, -9.9], [0.0, -0.30, -10.9], [0.0, 0.33, 7.3]])
"""Hip centres from pelvic depth and width (mm): rows X, Y, Z; Harrington et al. 2007, table 3."""


@dataclass(frozen=True, eq=False)
class Anatomy:
    """A person at rest. landmarks: points (m) in body space by name; sources: of those that are not
    the template's, the marker's label; joints: the body's own (m).
    """

    landmarks: Mapping[str, Point]
    joints: Mapping[str, Point]
    sources: Mapping[str, str]

    @classmethod
    def of(
        cls,
        body: BodyModel,
        betas: Float[np.ndarray, " B"],
        markers: Mapping[str, tuple[str, Point]] = MappingProxyType({}),
    ) -> "Anatomy":
        """Of a person. markers: by landmark the label and the place (m, at rest) of a marker on it,
        which takes the template's place.

        Raises HabitusError for a body without the landmarks that frames need.
        """
        missing = [name for name in NEEDED if name not in body.landmarks]
        if missing:
            raise HabitusError(
                f"{body.name} has no landmark {missing[0]!r}; anatomical angles need a body with "
                "landmarks, such as the default one"
            )
        own = np.asarray(betas, np.float64)
        surface = body.rest_vertices(own)
        landmarks = {name: surface[body.landmarks[name]] for name in NEEDED}
        kept = {name: pair for name, pair in markers.items() if name in (*NEEDED, SACRUM)}
        places = {name: np.asarray(place, np.float64) for name, (_, place) in kept.items()}
        landmarks |= _moved_partners(landmarks, places) | places
        landmarks.setdefault(SACRUM, _middle(landmarks["left_psis"], landmarks["right_psis"]))
        joints = dict(zip(body.joint_names, body.rest_joints(own), strict=True))
        sources = {name: label for name, (label, _) in kept.items()}
        return cls(MappingProxyType(landmarks), MappingProxyType(joints), MappingProxyType(sources))

    def centre(self, name: str) -> Point:
        """A conventional joint centre (m): ``left_hip``, ``left_shoulder`` are the body's joints,
        ``left_knee``, ``left_ankle``, ``left_elbow`` and ``left_wrist`` the middles of their
        landmarks on both sides.
        """
        side, _, joint = name.partition("_")
        if joint not in _BETWEEN:
            return self.joints[name]
        one, other = _BETWEEN[joint]
        return _middle(self.landmarks[f"{side}_{one}"], self.landmarks[f"{side}_{other}"])

    def harrington_hip(self, side: str) -> Point:
        """The hip's centre (m) by regression from the pelvis' width and depth, to compare with the
        body's (Harrington et al. 2007).
        """
        asis = [self.landmarks[f"{each}_asis"] for each in SIDES]
        front = _middle(*asis)
        width = 1e3 * float(np.linalg.norm(asis[1] - asis[0]))
        depth = 1e3 * float(np.linalg.norm(front - self.landmarks[SACRUM]))
        offset = 1e-3 * (HARRINGTON @ [depth, width, 1.0]) * [1.0, 1.0, _sign(side)]
        return front + self.frame("pelvis") @ offset

    def frame(self, segment: str, convention: str = "isb") -> Frame:
        """A segment's axes X, Y, Z as columns, in body space: ``pelvis``, ``thorax``,
        ``left_thigh``, ``left_shank`` (for the knee), ``left_shank_ankle`` (for the ankle),
        ``left_foot``, ``left_upper_arm``, ``left_forearm``, ``left_hand``, and of the right.

        convention: "isb", or "pig": there the thorax reaches to T10 and the shank's ankle axis is
        square to its long axis.
        """
        if segment == "pelvis":
            return self._pelvis()
        if segment == "thorax":
            return self._thorax(convention)
        side, _, part = segment.partition("_")
        return _LIMBS[part](self, side, convention)

    def _pelvis(self) -> Frame:
        left, right = self.landmarks["left_asis"], self.landmarks["right_asis"]
        across = right - left
        up = np.cross(across, _middle(left, right) - self.landmarks[SACRUM])
        return _columns(np.cross(up, across), up, across)

    def _thorax(self, convention: str) -> Frame:
        notch, c7 = self.landmarks["jugular_notch"], self.landmarks["c7"]
        low = self.landmarks["t10"]
        if convention == "isb":
            low = _middle(self.landmarks["t6"], low)  # T8
        up = _middle(notch, c7) - _middle(self.landmarks["xiphoid"], low)
        across = np.cross(notch - c7, up)
        return _columns(np.cross(up, across), up, across)


def _moved_partners(
    landmarks: Mapping[str, Point], places: Mapping[str, Point]
) -> dict[str, Point]:
    """Medial landmarks of joints with a marker on the lateral landmark alone, and the reverse: they
    move as the marker does, less the component along the axis between the two landmarks, which one
    marker does not determine.
    """
    moved = {}
    for side in SIDES:
        for pair in _BETWEEN.values():
            own = [f"{side}_{name}" for name in pair]
            for one, other in (own, own[::-1]):
                if one in places and other not in places:
                    axis = landmarks[one] - landmarks[other]
                    axis /= np.linalg.norm(axis)
                    shift = places[one] - landmarks[one]
                    moved[other] = landmarks[other] + shift - axis * (axis @ shift)
    return moved


def _sign(side: str) -> float:
    return 1.0 if side == "right" else -1.0


def _middle(one: Point, other: Point) -> Point:
    return 0.5 * (one + other)


def _columns(x: Point, y: Point, z: Point) -> Frame:
    """Three axes, of any length, as the columns of a rotation."""
    return np.column_stack([axis / np.linalg.norm(axis) for axis in (x, y, z)])


def _long(up: Point, right: Point) -> Frame:
    """Y along ``up``, Z as near to ``right`` as is square to it."""
    x = np.cross(up, right)
    return _columns(x, up, np.cross(x, up))


def _right(one: str, other: str, own: Anatomy, side: str) -> Point:
    """From the medial landmark to the lateral one, turned to the right."""
    return _sign(side) * (own.landmarks[f"{side}_{one}"] - own.landmarks[f"{side}_{other}"])


_BETWEEN: Mapping[str, tuple[str, str]] = {
    "knee": ("knee_lateral", "knee_medial"),
    "ankle": ("ankle_lateral", "ankle_medial"),
    "elbow": ("elbow_lateral", "elbow_medial"),
    "wrist": ("wrist_radial", "wrist_ulnar"),
}
"""Joints whose conventional centre lies between two landmarks: lateral or radial, the other."""


def _segment(upper: str, lower: str, joint: str, own: Anatomy, side: str, _: str) -> Frame:
    """A long segment between two joints, its transverse axis that of one of them."""
    up = own.centre(f"{side}_{upper}") - own.centre(f"{side}_{lower}")
    return _long(up, _right(*_BETWEEN[joint], own, side))


def _shank_at_ankle(own: Anatomy, side: str, convention: str) -> Frame:
    up = own.centre(f"{side}_knee") - own.centre(f"{side}_ankle")
    right = _right(*_BETWEEN["ankle"], own, side)
    if convention != "isb":
        return _long(up, right)
    x = np.cross(up, right)
    return _columns(x, np.cross(right, x), right)


def _foot(own: Anatomy, side: str, _: str) -> Frame:
    """Along the sole, which lies on the floor at rest: zero where it is square to the shank."""
    up = np.array([0.0, 1.0, 0.0])
    along = own.landmarks[f"{side}_mt2_head"] - own.landmarks[f"{side}_heel"]
    ahead = along * [1.0, 0.0, 1.0]
    return _columns(ahead, up, np.cross(ahead, up))


def _forearm(own: Anatomy, side: str, convention: str) -> Frame:
    """From the ulnar styloid (Wu et al. 2005), in Plug-in Gait from the wrist's centre."""
    low = own.landmarks[f"{side}_wrist_ulnar"]
    if convention != "isb":
        low = own.centre(f"{side}_wrist")
    up = own.centre(f"{side}_elbow") - low
    return _long(up, _right(*_BETWEEN["wrist"], own, side))


def _hand(own: Anatomy, side: str, _: str) -> Frame:
    up = own.centre(f"{side}_wrist") - own.landmarks[f"{side}_middle_mcp"]
    return _long(up, _right(*_BETWEEN["wrist"], own, side))


_LIMBS: Mapping[str, Callable[[Anatomy, str, str], Frame]] = {
    "thigh": partial(_segment, "hip", "knee", "knee"),
    "shank": partial(_segment, "knee", "ankle", "knee"),
    "shank_ankle": _shank_at_ankle,
    "foot": _foot,
    "upper_arm": partial(_segment, "shoulder", "elbow", "elbow"),
    "forearm": _forearm,
    "hand": _hand,
}
NEEDED = (
    "jugular_notch",
    "c7",
    "xiphoid",
    "t6",
    "t10",
    *(
        f"{side}_{name}"
        for side in SIDES
        for name in (
            "asis", "psis", "knee_lateral", "knee_medial", "ankle_lateral", "ankle_medial", "heel",
            "mt2_head", "elbow_lateral", "elbow_medial", "wrist_radial", "wrist_ulnar",
            "middle_mcp",
        )
    ),
)  # fmt: skip
"""Landmarks of the template that frames are built from."""
