"""What joints are called in skeletons that are in use, as data.

A table has a pattern for each joint of SMPL's layout; {} is the side's word. Spine and neck joints
need no names: they are those between pelvis, chest and head (`habitus.fit.retarget.rig_matching`).
Names are compared without case, prefixes of a character ("mixamorig:", "Bip01 ") and punctuation.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

FINGERS = ("thumb", "index", "middle", "ring", "pinky")
LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist", "hand")
REQUIRED = tuple(
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("hip", "knee", "ankle", "shoulder", "elbow")
)
"""Joints without which a skeleton is no person's; pelvis and head are found from the tree."""
_SEPARATORS = re.compile(r"[^a-z0-9]+")
_PREFIX = re.compile(r"^(.*[:|]|mixamorig\d*_?|bip0*1?\s|bip0*1?_|valve_?biped_?|def-|cc_base_)")


@dataclass(frozen=True)
class RigTable:
    """Names of a kind of skeleton; ``parts`` holds a pattern by our joint's name, sides apart."""

    name: str
    sides: tuple[str, str]
    parts: Mapping[str, str]
    fingers: str = ""
    """Pattern of finger joints: {} side, {finger}, {k} from 1 on."""
    finger_words: tuple[str, ...] = FINGERS
    first: int = 1
    """The number of a finger's first joint in names."""

    def names(self) -> dict[str, str]:
        """Our joint's name by the plain name of theirs."""
        out = {}
        for ours, pattern in self.parts.items():
            if ours not in LIMBS:
                out[plain_name(pattern)] = ours
                continue
            for side, word in zip(("left", "right"), self.sides, strict=True):
                out[plain_name(pattern.format(word))] = f"{side}_{ours}"
        for side, word in zip(("left", "right"), self.sides, strict=True):
            for finger, theirs in zip(FINGERS, self.finger_words, strict=True):
                for k in range(3) if self.fingers else ():
                    name = self.fingers.format(word, finger=theirs, k=_number(k, self.first))
                    out[plain_name(name)] = f"{side}_{finger}{k + 1}"
        return out


def _number(k: int, first: int) -> str:
    """A joint's number in a finger's name; 3ds Max leaves out the first one's."""
    return str(k + first) if first else ("" if k == 0 else str(k))


def plain_name(name: str) -> str:
    """A joint's name without case, prefix and punctuation."""
    lower = name.strip().lower()
    return _SEPARATORS.sub("", _PREFIX.sub("", lower, count=1)) or _SEPARATORS.sub("", lower)


def _table(name: str, sides: tuple[str, str], limbs: str, **more) -> RigTable:
    """``limbs``: patterns in the order of `LIMBS`; "-" where a skeleton has no such joint."""
    parts = {part: text for part, text in zip(LIMBS, limbs.split(), strict=True) if text != "-"}
    return RigTable(name, sides, {**parts, **more.pop("middle", {})}, **more)


_LEFT = ("Left", "Right")
_L = ("L", "R")
_HIPS = {"pelvis": "Hips", "head": "Head"}
_PELVIS = {"pelvis": "Pelvis", "head": "Head"}

TABLES = (
    _table(
        "habitus (SMPL)",
        ("left", "right"),
        "{}_hip {}_knee {}_ankle {}_foot {}_collar {}_shoulder {}_elbow {}_wrist {}_hand",
        middle={"pelvis": "pelvis", "head": "head", "jaw": "jaw"}
        | {f"{side}_eye_smplhf": f"{side}_eye_smplhf" for side in ("left", "right")},
        fingers="{}_{finger}{k}",
    ),
    _table(
        "Mixamo",
        _LEFT,
        "{}UpLeg {}Leg {}Foot {}ToeBase {}Shoulder {}Arm {}ForeArm {}Hand -",
        middle=_HIPS,
        fingers="{}Hand{finger}{k}",
    ),
    _table(
        "LAFAN1",
        _LEFT,
        "{}UpLeg {}Leg {}Foot {}Toe {}Shoulder {}Arm {}ForeArm {}Hand -",
        middle=_HIPS,
    ),
    _table(
        "Rokoko",
        _LEFT,
        "{}Thigh {}Shin {}Foot {}Toe {}Shoulder {}Arm {}ForeArm {}Hand -",
        middle=_HIPS,
    ),
    _table(
        "Xsens BVH",
        _LEFT,
        "{}Hip {}Knee {}Ankle {}Toe {}Collar {}Shoulder {}Elbow {}Wrist -",
        middle=_HIPS,
    ),
    _table(
        "Xsens MVN",
        _LEFT,
        "{}UpperLeg {}LowerLeg {}Foot {}Toe {}Shoulder {}UpperArm {}ForeArm {}Hand -",
        middle=_PELVIS,
    ),
    _table(
        "Unreal",
        _L,
        "thigh_{} calf_{} foot_{} ball_{} clavicle_{} upperarm_{} lowerarm_{} hand_{} -",
        middle=_PELVIS,
        fingers="{finger}_0{k}_{}",
    ),
    _table(
        "3ds Max Biped",
        _L,
        "{}Thigh {}Calf {}Foot {}Toe0 {}Clavicle {}UpperArm {}Forearm {}Hand -",
        middle=_PELVIS,
        fingers="{}Finger{finger}{k}",
        finger_words=("0", "1", "2", "3", "4"),
        first=0,
    ),
    _table(
        "Unity Humanoid",
        _LEFT,
        "{}UpperLeg {}LowerLeg {}Foot {}Toes {}Shoulder {}UpperArm {}LowerArm {}Hand -",
        middle=_HIPS,
    ),
    _table(
        "VRoid",
        _L,
        "J_Bip_{}_UpperLeg J_Bip_{}_LowerLeg J_Bip_{}_Foot J_Bip_{}_ToeBase J_Bip_{}_Shoulder "
        "J_Bip_{}_UpperArm J_Bip_{}_LowerArm J_Bip_{}_Hand -",
        middle={"pelvis": "J_Bip_C_Hips", "head": "J_Bip_C_Head"},
        fingers="J_Bip_{}_{finger}{k}",
        finger_words=("Thumb", "Index", "Middle", "Ring", "Little"),
    ),
    _table(
        "Poser",
        ("l", "r"),
        "{}Thigh {}Shin {}Foot {}Toe {}Collar {}Shldr {}ForeArm {}Hand -",
        middle={"pelvis": "hip", "head": "head"},
    ),
    _table(
        "Blender",
        _L,
        "thigh.{} shin.{} foot.{} toe.{} shoulder.{} upper_arm.{} forearm.{} hand.{} -",
        middle={"head": "head"},
    ),
)
"""CMU's skeletons of cgspeed have Mixamo's names and a hip joint more; Geno has Mixamo's."""

VRM_PARTS = {
    **{"hips": "pelvis", "head": "head", "jaw": "jaw"},
    **{
        f"{side}{theirs}": f"{side}_{ours}"
        for side in ("left", "right")
        for theirs, ours in {
            "UpperLeg": "hip",
            "LowerLeg": "knee",
            "Foot": "ankle",
            "Toes": "foot",
            "Shoulder": "collar",
            "UpperArm": "shoulder",
            "LowerArm": "elbow",
            "Hand": "wrist",
        }.items()
    },
}
"""Bones of VRM's humanoid and of Unity's, by the names that VRM files list."""
