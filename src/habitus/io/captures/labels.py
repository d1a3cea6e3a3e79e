"""Which labels of a capture are not physical markers, judged by name alone: computed points and
unlabelled ones.

The tests go from the surest to the least: what the file itself declares, names that can mean
nothing else, names that are computed only in the company of others (a Plug-in Gait bone LFEO comes
with LFEA, LFEL, LFEP).
"""

import re
from collections.abc import Callable, Collection, Mapping

_UNLABELLED = re.compile(
    r"(\*\d*|uname\*?\d*|u_?\d+|unlabell?ed[ _:-]?\d*|unidentified[ _-]?\d*|unknown[ _-]?\d*|new[ "
    r"_-]?\d+|ghost\d*"
    r"|nan|m?\d+|c_?\d{2,}|h\d+b\d+m\d+|(marker|point|channel)[ _-]*\d+|traj\w*[ _-]?\d+|)",
    re.IGNORECASE,
)
_MODEL_OUTPUT = re.compile(r".*(Angles?|Ang|Force|Moment|Power|GRF)")
_MASS_CENTRE = re.compile(r"(CentreOfMass|CenterOfMass|CoM|COM)(Floor)?")
_BONE = re.compile(r"(HED|TRX|PEL|CSP|SAC|[LR](?:CL|FE|FO|HN|HU|RA|TI|TO))([OALP])")
_JOINT_CENTRE = re.compile(
    r"([LR]?[_.]?(HJC|KJC|AJC|SJC|EJC|WJC|FJC|GHJC)([_.]?\w*)?"
    r"|.*_CGM_?\d.*|.*_projection|mid_.*|proj[A-Z].*|[LR][._]?\w*(Joint|Ground))"
)
_OXFORD = re.compile(
    r"[LR](ANK1|D1M0|FOF[0-3]|HDF[0-3]|HLX[0-3]|HE1|TIB[123]|PROXFF|HFplantar|ArchHeight(Index)?|ViconLegLength)"
)
_OXFORD_ANGLE = re.compile(
    r"[LR](FETBA|TIBA|HFTFL|HFTBA|FFTBA|FFHFA|HXFFA|HPA|KNA|ANA|FTA)|TrunkOffsetA|Belfast.*Angles|OxfordTrunk.*Angles"
)
_SOLVER = re.compile(r"SolvingHips|LabelingHips|[OXYZ]global")
_SKELETON = frozenset(
    [
        "Hips",
        "Spine",
        "Spine1",
        "Spine2",
        "Spine3",
        "Neck",
        "Head",
        "LeftShoulder",
        "LeftArm",
        "LeftForeArm",
        "LeftHand",
        "LeftUpLeg",
        "LeftLeg",
        "LeftFoot",
        "LeftToeBase",
        "RightShoulder",
        "RightArm",
        "RightForeArm",
        "RightHand",
        "RightUpLeg",
        "RightLeg",
        "RightFoot",
        "RightToeBase",
    ]
)
_KEYPOINT = re.compile(
    r"Neck|Nose|[mM]idHip|[LR](Shoulder|Elbow|Wrist|Hip|Knee|Ankle|Eye|Ear|BigToe|SmallToe|Heel)",
    re.IGNORECASE,
)


def is_unlabelled(label: str) -> bool:
    """Whether a label is a system's filler for a trajectory that nobody named."""
    return _UNLABELLED.fullmatch(label.strip()) is not None


def computed_labels(labels: Collection[str], declared: Mapping[str, str]) -> dict[str, str]:
    """The labels that name computed points, each with the reason.

    ``declared`` is what the file says of its labels (label -> group such as "ANGLES").
    """
    names = frozenset(labels)
    video = sum(label.endswith("_study") for label in labels) >= 5
    tests: tuple[tuple[Callable[[str], object], str], ...] = (
        (_MODEL_OUTPUT.fullmatch, "its name is that of an angle, force, moment or power"),
        (_MASS_CENTRE.fullmatch, "a centre of mass is computed"),
        (lambda label: _is_bone(label, names), "a Plug-in Gait bone axis is computed"),
        (lambda label: _is_joint_centre(label), "a joint centre or projection is computed"),
        (lambda label: _is_oxford(label, names), "an Oxford Foot Model point is computed"),
        (lambda label: _is_oxford_angle(label, names), "an Oxford Foot Model angle is no place"),
        (
            lambda label: _is_copy_by_name(label, names),
            "a copy or mean of other markers, by its name",
        ),
        (
            lambda label: _KEYPOINT.fullmatch(label) and video,
            "a keypoint that a network saw in video, no marker",
        ),
        (_SOLVER.fullmatch, "a solver's helper point is computed"),
        (
            lambda label: label in _SKELETON and len(names & _SKELETON) >= 8,
            "a skeleton's bone is computed",
        ),
    )
    found: dict[str, str] = {}
    for label in labels:
        if label in declared:
            found[label] = f"the file lists it among its {declared[label]}"
            continue
        reason = next((reason for test, reason in tests if test(label)), None)
        if reason:
            found[label] = reason
    return found


def _is_bone(label: str, names: Collection[str]) -> bool:
    bone = _BONE.fullmatch(label)
    return bone is not None and sum(f"{bone[1]}{letter}" in names for letter in "OALP") >= 3


def _is_joint_centre(label: str) -> bool:
    return "__" not in label and _JOINT_CENTRE.fullmatch(label) is not None


def _is_oxford(label: str, names: Collection[str]) -> bool:
    """Oxford names mean real markers elsewhere (TIB1..3 of a cluster, HLX): only with the model's
    own origins.
    """
    return _OXFORD.fullmatch(label) is not None and any(
        f"{side}{name}" in names for side in "LR" for name in ("HDF0", "FOF0")
    )


def _is_oxford_angle(label: str, names: Collection[str]) -> bool:
    """RFTA is a foot marker where RFTB stands beside it (cluster sets)."""
    return _OXFORD_ANGLE.fullmatch(label) is not None and f"{label[:-1]}B" not in names


def _is_copy_by_name(label: str, names: Collection[str]) -> bool:
    if label in ("LKAX", "RKAX"):
        return f"{label[0]}KD1" not in names and f"{label[0]}KD2" not in names
    if label == "MIHD":
        return len({"LFHD", "RFHD", "LBHD", "RBHD"} & set(names)) >= 2
    if label == "JUG":
        return "CLAV" in names
    if label.endswith("_study"):
        return label.removesuffix("_study") in names
    return False
