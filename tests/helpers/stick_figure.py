"""A moving stick figure with markers at landmarks: joints bend the way joints do, nothing else is
anatomical.
"""

import numpy as np

FRAMES = 240


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _angle(rng, low, high):
    """(T,) a smooth angle that sweeps from low to high degrees and back, a few times."""
    phase = np.linspace(0, 2 * np.pi * rng.uniform(1.5, 3.0), FRAMES) + rng.uniform(0, 6.28)
    return np.radians(low + (high - low) * (0.5 + 0.5 * np.sin(phase)))[:, None]


def stick_figure(seed: int = 0) -> dict[str, np.ndarray]:
    """Landmark name -> (T, 3) positions, metres, in an arbitrary world: somebody who walks about
    and moves the arms.
    """
    rng = np.random.default_rng(seed)
    trunk = {
        "c7": (0, 1.45, -0.07),
        "t10": (0, 1.2, -0.1),
        "jugular_notch": (0, 1.4, 0.06),
        "xiphoid": (0, 1.2, 0.1),
        "right_scapula_mid": (-0.1, 1.33, -0.11),
    }
    for name, (x, y, z) in {
        "asis": (0.12, 1.0, 0.1), "psis": (0.05, 1.02, -0.1), "acromion": (0.18, 1.42, 0.0),
        "temple": (0.07, 1.63, 0.08), "back_head": (0.06, 1.65, -0.1),
        "shoulder_front": (0.17, 1.36, 0.06), "shoulder_back": (0.17, 1.36, -0.07),
    }.items():  # fmt: skip
        trunk |= {f"left_{name}": (x, y, z), f"right_{name}": (-x, y, z)}
    points = {
        name: np.tile(np.array(place, dtype=float), (FRAMES, 1)) for name, place in trunk.items()
    }
    for side, outward in (("left", 1.0), ("right", -1.0)):
        points |= _arm(rng, side, outward) | _leg(rng, side, outward)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    walk = np.linspace(0, 1, FRAMES)[:, None] * rng.normal(size=3)
    noise = {name: rng.normal(scale=0.001, size=(FRAMES, 3)) for name in points}
    return {name: place @ turn.T + walk + noise[name] for name, place in points.items()}


def _arm(rng, side, outward):
    lateral = np.array([outward, 0.0, 0.0])
    swing = _angle(rng, -30, 60)
    bend = _angle(rng, 5, 110)
    roll = _angle(rng, -60, 60)
    upper = np.concatenate([0 * swing, -np.cos(swing), np.sin(swing)], axis=1)
    ahead = np.concatenate([0 * swing, np.sin(swing), np.cos(swing)], axis=1)
    lower = np.cos(bend) * upper + np.sin(bend) * ahead
    thumb = np.cos(roll) * (np.cos(bend) * ahead - np.sin(bend) * upper) + np.sin(roll) * lateral
    shoulder = np.array([outward * 0.18, 1.4, 0.0])
    elbow = shoulder + 0.3 * upper
    wrist = elbow + 0.25 * lower
    places = {
        "elbow_lateral": elbow + 0.045 * lateral,
        "elbow_medial": elbow - 0.045 * lateral,
        "wrist_radial": wrist + 0.03 * thumb,
        "wrist_ulnar": wrist - 0.03 * thumb,
        "hand_radial": wrist + 0.08 * lower + 0.035 * thumb,
        "hand_ulnar": wrist + 0.08 * lower - 0.035 * thumb,
        "upper_arm": shoulder + 0.2 * upper + 0.05 * lateral,
        "hand_back": wrist + 0.085 * lower,
    }
    return {f"{side}_{name}": place for name, place in places.items()}


def _leg(rng, side, outward):
    lateral = np.array([outward, 0.0, 0.0])
    swing = _angle(rng, -20, 40)
    bend = _angle(rng, 0, 70)
    thigh = np.concatenate([0 * swing, -np.cos(swing), np.sin(swing)], axis=1)
    shin = np.concatenate([0 * swing, -np.cos(swing - bend), np.sin(swing - bend)], axis=1)
    ahead = np.concatenate([0 * swing, np.sin(swing - bend), np.cos(swing - bend)], axis=1)
    knee = np.array([outward * 0.1, 0.95, 0.0]) + 0.42 * thigh
    ankle = knee + 0.4 * shin
    places = {
        "knee_lateral": knee + 0.05 * lateral, "knee_medial": knee - 0.05 * lateral,
        "ankle_lateral": ankle + 0.035 * lateral, "ankle_medial": ankle - 0.035 * lateral,
        "shank_lateral": knee + 0.16 * shin + 0.06 * lateral,
        "heel": ankle - 0.04 * ahead + 0.05 * shin,
        "mt1_head": ankle + 0.14 * ahead + 0.06 * shin - 0.04 * lateral,
        "mt5_head": ankle + 0.12 * ahead + 0.06 * shin + 0.05 * lateral,
        "mt2_head": ankle + 0.15 * ahead + 0.05 * shin,
        "big_toe": ankle + 0.18 * ahead + 0.06 * shin - 0.03 * lateral,
        "little_toe": ankle + 0.15 * ahead + 0.06 * shin + 0.05 * lateral,
    }  # fmt: skip
    return {f"{side}_{name}": place for name, place in places.items()}
