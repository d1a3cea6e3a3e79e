"""A simple model of muscles that bulge: flesh around a muscle's belly is to be shorter along its
bone, and thicker.

A muscle lies at a share of the way between two joints, on one side of the bone. Where it is fully
contracted, its belly wants a length of 1 - `strength`, and a width of the inverse root, so that its
volume stays. How far it contracts is a smooth step of one joint's angle. These are choices, not
measurements; what they stand for is in `lab/README.md`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from habitus_lab.population.flesh.flesh import Flesh

from .frames import SIDES, Frames


@dataclass(frozen=True)
class Muscle:
    """Belly between two joints at `along`, on the side `towards` (x is outward), and what contracts
    it.
    """

    start: str
    end: str
    along: float
    length: float  # of the belly, as a share of the bone
    towards: tuple[float, float, float]
    joint: str
    axis: tuple[float, float, float]  # of the left side; contraction grows with the angle about it
    span: tuple[float, float]  # degrees
    strength: float


MUSCLES = (
    Muscle(
        "shoulder", "elbow", 0.55, 0.22, (0, 0, 1), "elbow", (0, -1, 0), (20, 130), 0.25
    ),  # biceps
    Muscle("hip", "knee", 0.60, 0.22, (0, 0, -1), "knee", (1, 0, 0), (30, 130), 0.15),  # hamstrings
    Muscle("knee", "ankle", 0.28, 0.16, (0, 0, -1), "ankle", (1, 0, 0), (5, 40), 0.20),  # calf
    Muscle(
        "shoulder", "elbow", 0.12, 0.20, (0, 1, 0), "shoulder", (0, 0, 1), (10, 80), 0.20
    ),  # deltoid
    Muscle(
        "hip", "knee", 0.45, 0.25, (0, 0, 1), "hip", (-1, 0, 0), (40, 110), 0.08
    ),  # rectus femoris
)


@dataclass(frozen=True, eq=False)
class Muscles:
    """M muscles in T tetrahedra: how much of each is muscle, along which direction, and what
    contracts them.
    """

    share: np.ndarray  # (M, T)
    direction: np.ndarray  # (M, 3) at rest
    joint: np.ndarray  # (M,)
    axis: np.ndarray  # (M, 3)
    span: np.ndarray  # (M, 2) rad
    strength: np.ndarray  # (M,)

    def effort(self, pose: np.ndarray) -> np.ndarray:
        """(M,) 0 to 1."""
        angle = (pose[self.joint] * self.axis).sum(1)
        share = np.clip((angle - self.span[:, 0]) / (self.span[:, 1] - self.span[:, 0]), 0, 1)
        return share * share * (3 - 2 * share)

    def contract(self, inverse: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(T, 3, 3) inverses of rest edges with the wanted shape taken for rest."""
        effort = self.effort(pose) * self.strength
        if not effort.any():
            return inverse
        changed = inverse
        for m in np.flatnonzero(effort):
            some = np.flatnonzero(self.share[m] > 1e-3)
            length = 1 - effort[m] * self.share[m, some]
            u = self.direction[m]
            along = np.outer(u, u)
            back = (
                np.sqrt(length)[:, None, None] * (np.eye(3) - along) + along / length[:, None, None]
            )
            changed = changed.copy() if changed is inverse else changed
            changed[some] = changed[some] @ back
        return changed


def draw_muscles(flesh: Flesh, frames: Frames, muscles: tuple[Muscle, ...] = MUSCLES) -> Muscles:
    """The muscles of a person."""
    centres = flesh.cage.nodes[flesh.tets].mean(1)
    rows = [_belly(muscle, side, centres, frames) for muscle in muscles for side in SIDES]
    both = [(muscle, side) for muscle in muscles for side in SIDES]
    return Muscles(
        np.stack([row[0] for row in rows]),
        np.stack([row[1] for row in rows]),
        np.array([frames.joint_names.index(f"{side}_{muscle.joint}") for muscle, side in both]),
        np.stack([_of_side(muscle.axis, side, True) for muscle, side in both]),
        np.radians([muscle.span for muscle, _ in both]),
        np.array([muscle.strength for muscle, _ in both]),
    )


def _of_side(vector: tuple[float, float, float], side: str, turns: bool = False) -> np.ndarray:
    flip = (
        np.ones(3) if side == "left" else np.array([1, -1, -1]) if turns else np.array([-1, 1, 1])
    )
    return np.asarray(vector, float) * flip


def _belly(
    muscle: Muscle, side: str, centres: np.ndarray, frames: Frames
) -> tuple[np.ndarray, np.ndarray]:
    start = frames.place(f"{side}_{muscle.start}")
    end = frames.place(f"{side}_{muscle.end}")
    bone = end - start
    length = np.linalg.norm(bone)
    direction = bone / length
    towards = _of_side(muscle.towards, side)
    towards = towards - (towards @ direction) * direction
    towards = towards / np.linalg.norm(towards)
    along = (centres - start) @ direction / length
    off = centres - start - np.outer((centres - start) @ direction, direction)
    aside = np.linalg.norm(off, axis=1)
    cosine = off @ towards / np.maximum(aside, 1e-9)
    ring = np.clip((aside - 0.012) / 0.012, 0, 1) * (aside < 0.12)
    share = np.exp(-(((along - muscle.along) / muscle.length) ** 2)) * np.clip(cosine, 0, 1) * ring
    same_side = centres[:, 0] * (1 if side == "left" else -1) > 0
    return share * same_side, direction
