"""Seated body dimensions of ISO 7250-1.

The person sits upright on a level plane: thighs level and straight ahead, shanks upright, feet
flat, upper arms hanging, forearms level and straight ahead with the palms to each other. Joint
rotations follow from each person's own joints. The body function moves the skin; flesh under load
is not simulated: buttocks and thighs keep their unloaded shape, and the seat is a plane through
them at a fixed share of stature below the hips. Judged on adults only (`benchmarks/seated.py`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.body.measurement_names import Definition
from habitus.body.prepared import PreparedBody
from habitus.body.tapes import COLLAR, HANGING, SIDES
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

SEATED_POSTURE = "seated upright, hips, knees and elbows at 90 degrees"
SEATED = MappingProxyType(
    {
        "sitting_height_m": Definition("seat to crown", "sitting height", "sittingheight"),
        "eye_height_sitting_m": Definition(
            "seat to the outer corner of the eye", "eye height, sitting", "eyeheightsitting"
        ),
        "shoulder_height_sitting_m": Definition("seat to the acromion", "shoulder height, sitting"),
        "elbow_rest_height_m": Definition(
            "seat to the underside of the elbow", "elbow height, sitting", "elbowrestheight"
        ),
        "thigh_clearance_m": Definition(
            "seat to the highest place of the thigh", "thigh clearance", "thighclearance"
        ),
        "knee_height_sitting_m": Definition(
            "sole to the top of the knee", "knee height, sitting", "kneeheightsitting"
        ),
        "popliteal_height_m": Definition(
            "sole to the hollow of the knee",
            "lower leg length (popliteal height)",
            "poplitealheight",
        ),
        "buttock_knee_length_m": Definition(
            "rear of the buttocks to the front of the knee",
            "buttock-knee length",
            "buttockkneelength",
        ),
        "buttock_popliteal_length_m": Definition(
            "rear of the buttocks to the hollow of the knee",
            "buttock-popliteal length (seat depth)",
            "buttockpopliteallength",
        ),
        "hip_breadth_sitting_m": Definition(
            "across hips and thighs at the broadest", "hip breadth, sitting", "hipbreadthsitting"
        ),
        "abdominal_depth_sitting_m": Definition(
            "foremost place of the belly to the back at its level",
            "abdominal depth, sitting",
            "abdominalextensiondepthsitting",
        ),
        "forearm_forearm_breadth_m": Definition(
            "across both forearms at the broadest", "", "forearmforearmbreadth"
        ),
        "shoulder_elbow_length_m": Definition(
            "acromion to the underside of the elbow", "shoulder-elbow length", "shoulderelbowlength"
        ),
        "elbow_fingertip_length_m": Definition(
            "rear of the elbow to the tip of the middle finger",
            "elbow-fingertip length",
            "forearmhandlength",
        ),
    }
)
"""By name, with the unit as suffix: definition, ISO 7250-1's term, ANSUR II's column."""
UNRELIABLE = ("elbow_rest_height_m", "abdominal_depth_sitting_m", "forearm_forearm_breadth_m")
"""Dimensions whose errors are too large for use (``benchmarks/seated.py``): arms hang at one angle
instead of resting on the trunk."""
SEAT = 0.052
"""Share of stature by which the seat is below the centres of the hips: people sit on their ischia,
and the flesh below these gives way. Fitted to four heights above the seat of 200 soldiers of ANSUR
II (.0533 women, .0512 men; ``benchmarks/seated.py``)."""
_JOINTS = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_MARKS = ("acromion", "eye", "middle_tip")
_AT_KNEE = 0.03
"""Metres ahead of and behind the knee's centre within which its top is sought."""
_AT_ELBOW = 0.07
"""Metres around the elbow's centre within which its underside and its rear are sought."""
_THIGH = (0.15, 0.85)
"""Shares of the way from hip to knee between which the thigh's highest place is sought."""


@dataclass(frozen=True, eq=False)
class SeatedKit:
    """Vertices from which seated dimensions are measured; for limbs one array per side.

    ``hollow``: the vertex behind each knee's centre. ``marks``: acromion, eye, fingertip by side.
    """

    names: tuple[str, ...]
    prepared: PreparedBody
    trunk: Int[np.ndarray, " _"]
    seat: Int[np.ndarray, " _"]
    thighs: tuple[Int[np.ndarray, " _"], ...]
    knees: tuple[Int[np.ndarray, " _"], ...]
    elbows: tuple[Int[np.ndarray, " _"], ...]
    forearms: Int[np.ndarray, " _"]
    feet: Int[np.ndarray, " _"]
    hollow: tuple[int, int]
    marks: Mapping[str, tuple[int, int]]

    def sit(
        self, rest: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
    ) -> tuple[Float[np.ndarray, "V 3"], dict[str, Float[np.ndarray, " 3"]]]:
        """A person's skin (m) in the seated posture, and their joints at rest by name."""
        at = dict(zip(self.names, joints, strict=True))
        posed = self.prepared.carried(rest[None], joints[None], seated_pose(at))
        return np.asarray(posed)[0], at

    def measure(
        self, rest: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
    ) -> dict[str, float]:
        """Seated dimensions (m) of one person at rest."""
        skin, at = self.sit(rest, joints)
        x, y, z = skin.T
        hips = np.mean([at[f"{side}hip"][1] for side in SIDES])
        seat = float(hips - SEAT * np.ptp(rest[:, 1]))
        sole, rear = float(y[self.feet].min()), float(z[self.seat].min())
        knees = [at[f"{side}hip"][2] + _long(at, side, "hip", "knee") for side in SIDES]
        thighs = [
            y[rows][_between(z[rows], at[f"{side}hip"][2], end)].max()
            for side, rows, end in zip(SIDES, self.thighs, knees, strict=True)
        ]
        tops = [
            y[rows][np.abs(z[rows] - end) < _AT_KNEE].max()
            for rows, end in zip(self.knees, knees, strict=True)
        ]
        hollow, elbow = list(self.hollow), np.mean([y[rows].min() for rows in self.elbows])
        found = {
            "sitting_height_m": y.max() - seat,
            "elbow_rest_height_m": elbow - seat,
            "thigh_clearance_m": np.mean(thighs) - seat,
            "knee_height_sitting_m": np.mean(tops) - sole,
            "popliteal_height_m": y[hollow].mean() - sole,
            "buttock_knee_length_m": np.mean([z[rows].max() for rows in self.knees]) - rear,
            "buttock_popliteal_length_m": z[hollow].mean() - rear,
            "hip_breadth_sitting_m": np.ptp(x[self.seat]),
            "abdominal_depth_sitting_m": self._belly(y, z, max(thighs)),
            "forearm_forearm_breadth_m": np.ptp(x[self.forearms]),
        }
        marks = {name: list(rows) for name, rows in self.marks.items()}
        if "eye" in marks:
            found["eye_height_sitting_m"] = y[marks["eye"]].mean() - seat
        if "acromion" in marks:
            found["shoulder_height_sitting_m"] = y[marks["acromion"]].mean() - seat
            found["shoulder_elbow_length_m"] = y[marks["acromion"]].mean() - elbow
        if "middle_tip" in marks:
            behind = np.mean([z[rows].min() for rows in self.elbows])
            found["elbow_fingertip_length_m"] = z[marks["middle_tip"]].mean() - behind
        return {name: float(found[name]) for name in SEATED if name in found}

    def _belly(self, y: np.ndarray, z: np.ndarray, above: float) -> float:
        """Depth (m) of the trunk at its foremost point above the thighs."""
        rows = self.trunk[y[self.trunk] > above]
        front = rows[z[rows].argmax()]
        level = self.trunk[np.abs(y[self.trunk] - y[front]) < 0.02]
        return float(z[front] - z[level].min())


def _long(at: Mapping[str, np.ndarray], side: str, one: str, other: str) -> float:
    return float(np.linalg.norm(at[f"{side}{other}"] - at[f"{side}{one}"]))


def _between(z: np.ndarray, hip: float, knee: float) -> np.ndarray:
    share = (z - hip) / (knee - hip)
    return (share > _THIGH[0]) & (share < _THIGH[1])


def seated_pose(
    at: Mapping[str, Float[np.ndarray, " 3"]],
) -> dict[str, tuple[float, float, float]]:
    """Rotation vectors of the seated posture, by joint; at: the person's joints at rest (m)."""
    pose = {}
    for side, sign in (("left_", -1.0), ("right_", 1.0)):
        joint = {name: at[f"{side}{name}"] for name in _JOINTS}
        thigh = _turn(joint["knee"] - joint["hip"], np.array([0.0, 0.0, 1.0]))
        shank = _turn(joint["ankle"] - joint["knee"], np.array([0.0, -1.0, 0.0]))
        way = joint["elbow"] - joint["shoulder"]
        down = HANGING + float(np.arctan2(way[1], abs(way[0])))
        collar, upper = (_about_z(sign * share * down) for share in (COLLAR, 1.0))
        ahead = _turn(upper @ (joint["wrist"] - joint["elbow"]), np.array([0.0, 0.0, 1.0])) @ upper
        turns = {"hip": thigh, "knee": thigh.T @ shank, "ankle": shank.T}
        turns |= {"collar": collar, "shoulder": collar.T @ upper, "elbow": upper.T @ ahead}
        pose |= {f"{side}{name}": tuple(rotvec_from_matrix(turn)) for name, turn in turns.items()}
    return pose


def _about_z(angle: float) -> Float[np.ndarray, "3 3"]:
    return matrix_from_rotvec(np.array([0.0, 0.0, angle]))


def _turn(one: Float[np.ndarray, " 3"], other: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation from a direction to a unit direction."""
    one = one / np.linalg.norm(one)
    axis = np.cross(one, other)
    sine = np.linalg.norm(axis)
    angle = float(np.arctan2(sine, one @ other))
    return matrix_from_rotvec(axis / max(sine, 1e-12) * angle)


def lay_seated(body: Any) -> SeatedKit | None:
    """The kit of a body; None where it lacks joints of arms or legs."""
    if not {f"{side}{name}" for side in SIDES for name in _JOINTS} <= set(body.joint_names):
        return None
    template = body.v_template
    joints = dict(zip(body.joint_names, body.joint_regressor @ template, strict=True))
    strongest = body.skinning_weights.argmax(axis=1)
    part = np.array([name.partition("_")[2] or name for name in body.joint_names])[strongest]
    left = template[:, 0] > 0.0
    used = np.zeros(len(template), bool)
    used[np.unique(body.faces)] = True
    near = {
        name: [np.linalg.norm(template - joints[f"{side}{name}"], axis=1) for side in SIDES]
        for name in ("elbow", "knee")
    }
    sides = (left & used, ~left & used)
    legs = np.isin(part, ("hip", "knee"))
    arms = np.isin(part, ("shoulder", "elbow"))
    hollow = []
    for side, own in zip(SIDES, sides, strict=True):
        knee = joints[f"{side}knee"]
        level = own & legs & (np.abs(template[:, 1] - knee[1]) < 0.02)
        level &= np.abs(template[:, 0] - knee[0]) < 0.02
        if not level.any():
            return None
        rows = np.flatnonzero(level)
        hollow.append(int(rows[template[rows, 2].argmin()]))
    trunk = np.flatnonzero(used & np.isin(part, ("pelvis", "spine1", "spine2")))
    marks = {
        name: (body.landmarks[f"left_{name}"], body.landmarks[f"right_{name}"])
        for name in _MARKS
        if {f"left_{name}", f"right_{name}"} <= set(body.landmarks)
    }
    return SeatedKit(
        names=tuple(body.joint_names),
        prepared=body.prepare(()),
        trunk=trunk,
        seat=np.flatnonzero(used & np.isin(part, ("pelvis", "hip"))),
        thighs=tuple(np.flatnonzero(own & (part == "hip")) for own in sides),
        knees=tuple(
            np.flatnonzero(own & legs & (far < 0.12))
            for own, far in zip(sides, near["knee"], strict=True)
        ),
        elbows=tuple(
            np.flatnonzero(own & arms & (far < _AT_ELBOW))
            for own, far in zip(sides, near["elbow"], strict=True)
        ),
        forearms=np.flatnonzero(used & arms),
        feet=np.flatnonzero(used & np.isin(part, ("ankle", "foot"))),
        hollow=(hollow[0], hollow[1]),
        marks=MappingProxyType(marks),
    )
