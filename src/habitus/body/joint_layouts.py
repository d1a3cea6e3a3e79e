"""Joint layouts of the SMPL family, as data: names and parents by number of joints (S 3 and the
models' own papers).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class JointLayout:
    """Names and parents (-1 for the root) of a family of bodies, in the order of its pose."""

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]


_BODY = (
    ("pelvis", None),
    ("left_hip", "pelvis"),
    ("right_hip", "pelvis"),
    ("spine1", "pelvis"),
    ("left_knee", "left_hip"),
    ("right_knee", "right_hip"),
    ("spine2", "spine1"),
    ("left_ankle", "left_knee"),
    ("right_ankle", "right_knee"),
    ("spine3", "spine2"),
    ("left_foot", "left_ankle"),
    ("right_foot", "right_ankle"),
    ("neck", "spine3"),
    ("left_collar", "spine3"),
    ("right_collar", "spine3"),
    ("head", "neck"),
    ("left_shoulder", "left_collar"),
    ("right_shoulder", "right_collar"),
    ("left_elbow", "left_shoulder"),
    ("right_elbow", "right_shoulder"),
    ("left_wrist", "left_elbow"),
    ("right_wrist", "right_elbow"),
)


def _chain(start: str, *names: str) -> tuple[tuple[str, str], ...]:
    """Joints that hang one on the other, the first on ``start``."""
    return tuple(zip(names, (start, *names), strict=False))


def _hand(wrist: str, prefix: str) -> tuple[tuple[str, str], ...]:
    """Fifteen finger joints of a hand: three a finger."""
    fingers = ("index", "middle", "pinky", "ring", "thumb")
    return tuple(
        bone
        for finger in fingers
        for bone in _chain(wrist, *(f"{prefix}{finger}{k}" for k in (1, 2, 3)))
    )


def _layout(name: str, bones: tuple[tuple[str, str | None], ...]) -> JointLayout:
    names = tuple(bone for bone, _ in bones)
    return JointLayout(
        name, names, tuple(-1 if parent is None else names.index(parent) for _, parent in bones)
    )


_HANDS = _hand("left_wrist", "left_") + _hand("right_wrist", "right_")
_FACE = (("jaw", "head"), ("left_eye_smplhf", "head"), ("right_eye_smplhf", "head"))
_SMAL = (
    ("pelvis", None),
    ("pelvis0", "pelvis"),
    ("spine", "pelvis0"),
    ("spine0", "spine"),
    ("spine1", "spine0"),
    ("spine2", "spine1"),
    ("spine3", "spine2"),
    *_chain("spine3", "left_fore_leg1", "left_fore_leg2", "left_fore_leg3", "left_fore_foot"),
    *_chain("spine3", "right_fore_leg1", "right_fore_leg2", "right_fore_leg3", "right_fore_foot"),
    ("neck", "spine3"),
    ("head", "neck"),
    *_chain("pelvis", "left_hind_leg1", "left_hind_leg2", "left_hind_leg3", "left_hind_foot"),
    *_chain("pelvis", "right_hind_leg1", "right_hind_leg2", "right_hind_leg3", "right_hind_foot"),
    *_chain("pelvis", *(f"tail{k}" for k in range(1, 8))),
    ("mouth", "head"),
)

SMPL = _layout("smpl", (*_BODY, ("left_hand", "left_wrist"), ("right_hand", "right_wrist")))
SMPLH = _layout("smplh", (*_BODY, *_HANDS))
SMPLX = _layout("smplx", (*_BODY, *_FACE, *_HANDS))
MANO = _layout("mano", (("wrist", None), *_hand("wrist", "")))
SMAL = _layout("smal", _SMAL)

LAYOUTS = {layout.name: layout for layout in (SMPL, SMPLH, SMPLX, MANO, SMAL)}


def find_layout(parents: tuple[int, ...]) -> JointLayout | None:
    """The known layout with these parents, or None."""
    return next((layout for layout in LAYOUTS.values() if layout.parents == parents), None)
