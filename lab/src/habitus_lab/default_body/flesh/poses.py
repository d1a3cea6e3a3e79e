"""Poses to simulate: what single joints can do over their range, and combinations.

A *unit* is the way of one limb through a few stops, in degrees on the left side. Limbs that are far
apart move at the same time: a *session* takes one unit for each arm, leg, trunk and neck, in
another pairing and with other amplitudes for each person, so that no joint is bound to another. The
right side's units are mirrored ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

Stops = tuple[dict[str, tuple[float, float, float]], ...]


def _bends(joint: str, *stops: tuple[float, float, float]) -> Stops:
    return tuple({joint: stop} for stop in stops)


ARM: dict[str, Stops] = {
    "elbow": _bends("elbow", (0, -40, 0), (0, -75, 0), (0, -105, 0), (0, -125, 0), (0, -140, 0)),
    "arm_down": tuple(
        {"shoulder": (0, 0, z), "collar": (0, 0, c)}
        for z, c in ((-25, 0), (-50, -3), (-70, -8), (-80, -8))
    ),
    "arm_up": tuple(
        {"shoulder": (0, 0, z), "collar": (0, 0, c)}
        for z, c in ((25, 5), (45, 12), (60, 20), (72, 26))
    ),
    "arm_forward": tuple(
        {"shoulder": (0, y, 0), "collar": (0, c, 0)}
        for y, c in ((-30, 0), (-60, -5), (-90, -12), (-115, -18))
    ),
    "arm_back": (
        {"shoulder": (0, 25, 0)},
        {"shoulder": (0, 40, -30), "collar": (0, 8, 0)},
        {"shoulder": (0, 35, -60), "collar": (0, 8, -5)},
    ),
    "arm_twist": _bends(
        "shoulder", (35, 0, 0), (70, 0, 0), (30, 0, -60), (-35, 0, -60), (-60, 0, 0), (-85, 0, 0)
    ),
    "arm_front_up": (
        {"shoulder": (0, -85, 0), "collar": (0, -10, 0)},
        {"shoulder": (0, -80, 45), "collar": (0, -10, 15)},
        {"shoulder": (0, -60, 75), "collar": (0, -5, 25)},
    ),
    "arm_down_elbow": (
        {"shoulder": (0, 0, -70), "elbow": (0, -60, 0)},
        {"shoulder": (-40, 0, -75), "elbow": (0, -100, 0)},
        {"shoulder": (45, -10, -70), "elbow": (0, -130, 0)},
    ),
    "wrist_twist": _bends(
        "wrist", (45, 0, 0), (75, 0, 0), (92, 0, 0), (-40, 0, 0), (-70, 0, 0), (-90, 0, 0)
    ),
    "wrist": _bends(
        "wrist", (0, 0, -40), (0, 0, -70), (0, 25, 0), (0, -30, 0), (0, 0, 40), (0, 0, 65)
    ),
    "collar": _bends("collar", (0, 0, 14), (0, 0, 28), (0, -20, 0), (0, 18, 0), (0, 0, -10)),
    "behind_head": (
        {"shoulder": (0, 0, 30), "elbow": (0, -60, 0), "collar": (0, 0, 10)},
        {"shoulder": (-40, 10, 45), "elbow": (0, -125, 0), "collar": (0, 0, 20)},
    ),
    "across": (
        {"shoulder": (0, -60, -30), "elbow": (0, -50, 0)},
        {"shoulder": (20, -80, -50), "elbow": (0, -80, 0), "collar": (0, -12, 0)},
        {
            "shoulder": (30, -85, -55),
            "elbow": (0, -110, 0),
            "collar": (0, -16, 0),
            "wrist": (30, 0, 0),
        },
    ),
}
LEG: dict[str, Stops] = {
    "knee": _bends("knee", (40, 0, 0), (75, 0, 0), (105, 0, 0), (125, 0, 0), (140, 0, 0)),
    "hip": (
        {"hip": (-30, 0, 0)},
        {"hip": (-60, 0, 0)},
        {"hip": (-90, 0, 0)},
        {"hip": (-110, 0, 8), "knee": (90, 0, 0)},
        {"hip": (-120, 0, 10), "knee": (130, 0, 0)},
    ),
    "hip_aside": (
        {"hip": (0, 0, 20)},
        {"hip": (0, 0, 42)},
        {"hip": (-50, 0, 40)},
        {"hip": (-80, 0, 35), "knee": (80, 0, 0)},
    ),
    "hip_back": (
        {"hip": (12, 0, 0)},
        {"hip": (22, 0, 0), "knee": (50, 0, 0)},
        {"hip": (15, 0, 8), "knee": (100, 0, 0)},
    ),
    "hip_twist": _bends(
        "hip", (0, 25, 5), (0, 42, 8), (-60, 30, 15), (-60, -25, 5), (0, -25, 2), (0, -38, 4)
    ),
    "ankle": _bends(
        "ankle", (22, 0, 0), (45, 0, 0), (15, 0, 18), (10, 0, -18), (-12, 0, 0), (-24, 0, 0)
    ),
    "toes": (
        {"foot": (-25, 0, 0)},
        {"foot": (-45, 0, 0), "ankle": (35, 0, 0)},
        {"foot": (20, 0, 0), "ankle": (-10, 0, 0)},
    ),
    "crossed": (
        {"hip": (-60, 20, 20), "knee": (60, 0, 0)},
        {"hip": (-80, 40, 40), "knee": (110, 0, 0)},
    ),
    "kick": (
        {"hip": (-50, 0, 0), "knee": (60, 0, 0)},
        {"hip": (-85, 0, 5), "knee": (20, 0, 0), "ankle": (30, 0, 0)},
    ),
    "squat": (
        {"hip": (-50, 0, 10), "knee": (55, 0, 0), "ankle": (-12, 0, 0)},
        {"hip": (-90, 0, 16), "knee": (95, 0, 0), "ankle": (-18, 0, 0)},
        {"hip": (-112, 0, 20), "knee": (130, 0, 0), "ankle": (-24, 0, 0)},
    ),
}


def _spine(
    *stops: tuple[
        tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
    ],
) -> Stops:
    return tuple(dict(zip(("spine1", "spine2", "spine3"), stop, strict=True)) for stop in stops)


TRUNK: dict[str, Stops] = {
    "flexed": _spine(*(((a, 0, 0), (0.9 * a, 0, 0), (0.7 * a, 0, 0)) for a in (12, 22, 30))),
    "extended": _spine(*(((-a, 0, 0), (-0.9 * a, 0, 0), (-0.6 * a, 0, 0)) for a in (8, 16))),
    "aside": _spine(*(((0, 0, a), (0, 0, a), (0, 0, 0.7 * a)) for a in (9, 18))),
    "twisted": _spine(*(((0, 0.7 * a, 0), (0, a, 0), (0, a, 0)) for a in (10, 20))),
    "low": _bends("spine1", (20, 0, 0), (32, 0, 0), (0, 20, 0), (0, 0, 18), (-14, 0, 0)),
    "middle": _bends("spine2", (18, 0, 0), (28, 0, 0), (0, 22, 0), (0, 0, 18), (-14, 0, 0)),
    "high": _bends("spine3", (16, 0, 0), (24, 0, 0), (0, 22, 0), (0, 0, 15), (-12, 0, 0)),
    "turned_down": _spine(
        ((12, 8, 0), (12, 12, 4), (10, 12, 4)),
        ((18, 14, 6), (18, 18, 8), (15, 18, 6)),
    ),
}
NECK: dict[str, Stops] = {
    "flexed": tuple({"neck": (a, 0, 0), "head": (0.6 * a, 0, 0)} for a in (15, 30)),
    "extended": tuple({"neck": (-a, 0, 0), "head": (-0.8 * a, 0, 0)} for a in (15, 28)),
    "aside": tuple({"neck": (0, 0, a), "head": (0, 0, 0.5 * a)} for a in (14, 28)),
    "turned": tuple({"neck": (0, a, 0), "head": (0, 0.8 * a, 0)} for a in (18, 38)),
    "neck": _bends("neck", (30, 0, 0), (0, 40, 0), (0, 0, 28), (-25, 0, 0)),
    "head": _bends("head", (22, 0, 0), (0, 35, 0), (0, 0, 20), (-22, 0, 0)),
}
MORE_ARM: dict[str, Stops] = {
    "elbow_fold": _bends("elbow", *((0, -t, 0) for t in (30, 60, 75, 90, 105, 120, 135, 148))),
    "elbow_twist": _bends(
        "elbow", (30, 0, 0), (60, 0, 0), (80, 0, 0), (-40, 0, 0), (-80, 0, 0), (0, 8, 0)
    ),
    "collar_wide": _bends(
        "collar", (0, 0, 40), (0, -30, 0), (0, 30, 0), (0, 0, -25), (40, 0, 0), (-30, 0, 0)
    ),
}
MORE_LEG: dict[str, Stops] = {
    "knee_fold": _bends("knee", *((t, 0, 0) for t in (30, 60, 75, 90, 105, 120, 135, 148))),
    "knee_sitting": tuple(
        {"hip": (-90, 0, 4), "knee": (t, 0, 0)} for t in (30, 60, 75, 90, 105, 120, 135, 146)
    ),
    "knee_twist": _bends(
        "knee", (0, 30, 0), (0, -30, 0), (0, 0, 25), (0, 0, -25), (-5, 0, 0), (-10, 0, 0)
    ),
}
"""Units of a further round: hinges through all angles of their folds, and about axes that the first
rounds leave out.
"""
SHRUGS: dict[str, Stops] = {
    "shrug": tuple(
        {"shoulder": (0, 0, z), "collar": (0, 0, c)}
        for z, c in ((-70, -8), (-76, 8), (-82, 20), (-88, 33), (-60, -14), (-82, 2))
    ),
    "shrug_fore": tuple(
        {"shoulder": (0, 0, -76), "collar": (0, y, c)}
        for y, c in ((-14, 0), (-28, 0), (-20, 18), (14, -6), (26, 0), (12, 18))
    ),
    "collar_alone": _bends(
        "collar", (0, 0, 20), (0, 0, 36), (0, -28, 0), (0, 28, 0), (22, 0, 0), (-22, 0, 0)
    ),
    "reach": (
        {"shoulder": (0, 0, 30), "collar": (0, 0, 32)},
        {"shoulder": (0, 0, 65), "collar": (0, 0, 10)},
        {"shoulder": (0, -60, 0), "collar": (0, 0, 24)},
        {"shoulder": (0, -90, 0), "collar": (0, -28, 0)},
        {"shoulder": (0, 25, -20), "collar": (0, 22, 0)},
        {"shoulder": (0, 35, -50), "collar": (0, 10, 20)},
    ),
}
"""Units of a round for collars: shrugs with arms down, collars alone, and with arms raised."""
LANES = ("left_arm", "right_arm", "left_leg", "right_leg", "trunk", "neck")
MIDDLE = ("spine1", "spine2", "spine3", "neck", "head", "pelvis", "jaw")
BOTH_LEGS = ("squat",)
STRETCH = (0.85, 1.05)  # amplitudes are drawn between these
SCATTER = 3.0  # degrees of noise on each joint that moves
SEXES = ("female", "male")
ROUNDS = 2  # how often a person goes through every unit, in other pairings


@dataclass(frozen=True, eq=False)
class Session:
    """Poses (K, J, 3) that one path of a person goes through, and their names."""

    name: str
    poses: np.ndarray
    names: tuple[str, ...]


def mirrored_pose(pose: np.ndarray, joint_names: tuple[str, ...]) -> np.ndarray:
    """Poses (..., J, 3) seen in a mirror."""
    return pose[..., _partners(joint_names), :] * [1.0, -1.0, -1.0]


def _partners(joint_names: tuple[str, ...]) -> list[int]:
    swap = {"left": "right", "right": "left"}
    words = [name.split("_", 1) for name in joint_names]
    return [
        joint_names.index(f"{swap[w[0]]}_{w[1]}") if w[0] in swap else k
        for k, w in enumerate(words)
    ]


def sessions(
    rng: np.random.Generator, joint_names: tuple[str, ...], turn: int = 0
) -> list[Session]:
    """The sessions of one person: every unit once, on one side or the other."""
    arms = _shuffled(rng, ARM)
    legs = _shuffled(rng, LEG)
    trunks = _shuffled(rng, TRUNK)
    necks = _shuffled(rng, NECK)
    found = []
    for k in range(max((len(arms) + 1) // 2, (len(legs) + 1) // 2, len(trunks))):
        lanes = {
            "left_arm": (ARM, _pick(arms, 2 * k)),
            "right_arm": (ARM, _pick(arms, 2 * k + 1)),
            "left_leg": (LEG, _pick(legs, 2 * k)),
            "right_leg": (LEG, _pick(legs, 2 * k + 1)),
            "trunk": (TRUNK, _pick(trunks, k)),
            "neck": (NECK, _pick(necks, k)),
        }
        found.append(_session(rng, f"lanes{turn}{k:02d}", lanes, joint_names))
    return found


def further_sessions(
    seed: int, person: int, sex: str, joint_names: tuple[str, ...]
) -> list[Session]:
    """The sessions of one person's further round: every unit of `MORE_ARM` and `MORE_LEG` on both
    sides, the left one's beside another of the right.
    """
    rng = np.random.default_rng([seed, person, SEXES.index(sex), ROUNDS + 1])
    arms = _shuffled(rng, MORE_ARM)
    legs = _shuffled(rng, MORE_LEG)
    found = []
    for k in range(len(arms)):
        lanes = {
            "left_arm": (MORE_ARM, arms[k]),
            "right_arm": (MORE_ARM, arms[k - 1]),
            "left_leg": (MORE_LEG, legs[k]),
            "right_leg": (MORE_LEG, legs[k - 1]),
        }
        found.append(_session(rng, f"further{k:02d}", lanes, joint_names))
    return found


def shrug_sessions(seed: int, person: int, sex: str, joint_names: tuple[str, ...]) -> list[Session]:
    """The sessions of one person's round for collars: every unit of `SHRUGS` on one side."""
    rng = np.random.default_rng([seed, person, SEXES.index(sex), ROUNDS + 2])
    arms = _shuffled(rng, SHRUGS)
    return [
        _session(
            rng,
            f"shrugs{k // 2:02d}",
            {"left_arm": (SHRUGS, arms[k]), "right_arm": (SHRUGS, arms[k + 1])},
            joint_names,
        )
        for k in range(0, len(arms), 2)
    ]


def rounds_of_sessions(
    seed: int, person: int, sex: str, joint_names: tuple[str, ...]
) -> Iterator[list[Session]]:
    """The sessions of one person, a list for each of `ROUNDS` rounds; the same ones for the same
    numbers.
    """
    for turn in range(ROUNDS):
        rng = np.random.default_rng([seed, person, SEXES.index(sex), turn])
        yield sessions(rng, joint_names, turn)


def _shuffled(rng: np.random.Generator, units: dict[str, Stops]) -> list[str]:
    names = sorted(units)
    return [names[k] for k in rng.permutation(len(names))]


def _pick(names: list[str], k: int) -> str | None:
    return names[k] if k < len(names) else None


def _session(
    rng: np.random.Generator, name: str, lanes: dict, joint_names: tuple[str, ...]
) -> Session:
    legs = [lanes[lane][1] for lane in ("left_leg", "right_leg") if lane in lanes]
    for both in BOTH_LEGS:
        if both in legs:
            lanes = {**lanes, "left_leg": (LEG, both), "right_leg": (LEG, both)}
    used = {lane: (unit, units[unit]) for lane, (units, unit) in lanes.items() if unit is not None}
    count = max(len(stops) for _, stops in used.values())
    poses = np.zeros((count, len(joint_names), 3))
    names = []
    for lane, (_, stops) in used.items():
        side = lane.split("_")[0] + "_" if "_" in lane else ""
        flip = rng.random() < 0.5 if not side else side == "right_"
        scale = rng.uniform(*STRETCH)
        for k in range(count):
            where = round(k * (len(stops) - 1) / max(1, count - 1))
            for joint, degrees in stops[where].items():
                turn = np.radians(scale * np.array(degrees) + SCATTER * rng.normal(size=3))
                full = joint if joint in MIDDLE else side + joint
                poses[k, joint_names.index(full)] = turn * ([1, -1, -1] if flip else [1, 1, 1])
    for k in range(count):
        names.append(
            f"{name}_{k}: " + ", ".join(f"{lane} {unit}" for lane, (unit, _) in used.items())
        )
    return Session(name, poses, tuple(names))


def named(
    joint_names: tuple[str, ...], degrees: dict[str, tuple[float, float, float]]
) -> np.ndarray:
    """(J, 3) from degrees by joint."""
    pose = np.zeros((len(joint_names), 3))
    for joint, turn in degrees.items():
        pose[joint_names.index(joint)] = np.radians(turn)
    return pose
