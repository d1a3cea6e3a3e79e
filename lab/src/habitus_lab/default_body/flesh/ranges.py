"""How far joints turn in people, and what a body does at these limits and beyond.

    python -m habitus_lab.default_body.flesh.ranges [female male neutral] [--bodies FOLDER] [--all]

A row for each rotation of one joint about one axis, at its limit (60 degrees at most) and at 60
degrees: the longest offset of pose blend shapes, the change of volume with and without them, and
new pairs of triangles that meet, with and without them. Rows that miss the gate are printed: within
the range 40 mm, .3 litres and no more pairs than skinning alone; beyond it 40 mm, and .3 litres
more than skinning alone changes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.body.model import BodyModel
from habitus.body.pose_features import pose_coefficients
from habitus.mesh.intersections import intersecting_pairs
from habitus.rotations import matrix_from_rotvec
from habitus_lab.default_body.flesh.gates import volume
from habitus_lab.repository import BODIES

Limits = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]

RANGES: dict[str, Limits] = {
    "spine1": ((-20, 40), (-20, 20), (-25, 25)),
    "spine2": ((-15, 30), (-25, 25), (-25, 25)),
    "spine3": ((-15, 25), (-35, 35), (-20, 20)),
    "neck": ((-40, 40), (-45, 45), (-35, 35)),
    "head": ((-25, 25), (-45, 45), (-20, 20)),
    "collar": ((-35, 20), (-30, 30), (-12, 40)),
    "shoulder": ((-90, 90), (-130, 45), (-90, 70)),
    "elbow": ((-85, 85), (-150, 10), (-10, 10)),
    "wrist": ((-90, 90), (-30, 25), (-75, 70)),
    "hip": ((-120, 22), (-45, 45), (-30, 45)),
    "knee": ((-10, 145), (-30, 30), (-10, 10)),
    "ankle": ((-25, 50), (-20, 20), (-20, 20)),
    "foot": ((-65, 40), (-10, 10), (-10, 10)),
}
"""Degrees about x, y, z from the T-pose, of the left side, the left arm along +x.

Limbs: normal ranges of the American Academy of Orthopaedic Surgeons (1965) and of Boone and Azen
1979 (J Bone Joint Surg 61-A:756-759), from the T-pose instead of the anatomical position; twists of
the forearm count at wrist and elbow, as poses of SMPL's family use both. Collar: the
sternoclavicular joint rises by up to 45 and falls by 10 degrees, goes 15 to 30 forward and back,
and turns back by 20 to 35 (Neumann, Kinesiology of the Musculoskeletal System). Spine and neck:
sums over segments (White and Panjabi 1990, Clinical Biomechanics of the Spine): spine1 L2-S1,
spine2 T10-L2, spine3 T1-T10, neck C2-T1, head C0-C2; turns of the spine are shared out more evenly
than segments do it, as fitted poses have it. Numbers are rounded, and from memory of these books.
"""
FAR = 60.0  # degrees that the gate goes to
LARGEST_OFFSET = 40.0  # mm
LARGEST_CHANGE = 0.3  # litres
TRUNK = ("spine1", "spine2", "spine3", "neck", "head")


@dataclass(frozen=True)
class Rotation:
    """One joint turned about one axis (0, 1, 2) by some degrees, and whether people can."""

    joint: str
    axis: int
    degrees: float
    within: bool

    def rotvec(self) -> np.ndarray:
        """(3,) rad."""
        return np.radians(self.degrees) * np.eye(3)[self.axis]

    def __str__(self) -> str:
        return f"{self.joint} {'xyz'[self.axis]} {self.degrees:+.0f}"


def limits(name: str) -> np.ndarray:
    """(3, 2) degrees of a joint, of the right side too: its y and z are the left side's turned
    round.
    """
    side, _, joint = name.rpartition("_")
    found = np.array(RANGES[joint], float)
    if side == "right":
        found[1:] = -found[1:, ::-1]
    return found


def rotations(name: str) -> Iterator[Rotation]:
    """Those of the gate of a joint: at its limits, and at `FAR` where these are nearer."""
    for axis, both in enumerate(limits(name)):
        for limit in both:
            yield Rotation(name, axis, float(np.clip(limit, -FAR, FAR)), True)
            if abs(limit) < FAR:
                yield Rotation(name, axis, float(np.copysign(FAR, limit)), False)


def gate_rotations() -> list[Rotation]:
    """Those of all joints, one side for both."""
    return [
        rotation
        for joint in RANGES
        for rotation in rotations(joint if joint in TRUNK else f"left_{joint}")
        if not (joint in TRUNK and rotation.axis and rotation.degrees > 0)
    ]


@dataclass(frozen=True)
class Row:
    """What a body does at a rotation: longest offset (mm), changes of volume (litres) and new
    pairs, of the body and of skinning alone.
    """

    rotation: Rotation
    offset: float
    change: float
    skinned: float
    pairs: int
    skinned_pairs: int

    @property
    def passes(self) -> bool:
        """Whether the gate holds."""
        most = LARGEST_CHANGE + (0.0 if self.rotation.within else abs(self.skinned))
        fits = self.offset <= LARGEST_OFFSET and abs(self.change) <= most
        return fits and self.pairs <= self.skinned_pairs + 1

    def __str__(self) -> str:
        where = "within" if self.rotation.within else "beyond"
        return (
            f"{self.rotation} {where}: {self.offset:.0f} mm, {self.change:+.2f} l "
            f"({self.skinned:+.2f}), {self.pairs} pairs ({self.skinned_pairs})"
        )


def turned(body: BodyModel, rotation: Rotation) -> np.ndarray:
    """(J, 3) rad."""
    pose = np.zeros((body.num_joints, 3))
    pose[body.joint_names.index(rotation.joint)] = rotation.rotvec()
    return pose


def offsets(body: BodyModel, pose: np.ndarray) -> np.ndarray:
    """(V, 3) of the mean person's pose blend shapes, m."""
    driven = (body.features, body.hinges, 0, body.drivers)
    rotations = matrix_from_rotvec(pose)
    return body.pose_directions @ pose_coefficients(
        *driven, pose, rotations, np.zeros(body.num_betas)
    )


def measure(body: BodyModel) -> list[Row]:
    """The rows of the gate."""
    faces = np.asarray(body.faces)
    plain = replace(body, posedirs=None, hinges=None, pose_joints=None, finer=None)
    rest = np.asarray(body().vertices, float)
    own, met = volume(rest, faces), len(intersecting_pairs(rest, faces))
    rows = []
    for rotation in gate_rotations():
        pose = turned(body, rotation)
        longest = 1e3 * float(np.linalg.norm(offsets(body, pose), axis=1).max())
        both = [np.asarray(one(pose=pose).vertices, float) for one in (body, plain)]
        changes = [1e3 * (volume(vertices, faces) - own) for vertices in both]
        pairs = [len(intersecting_pairs(vertices, faces)) - met for vertices in both]
        rows.append(Row(rotation, longest, *changes, *pairs))
    return rows


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("spaces", nargs="*", default=["female", "male", "neutral"])
    parser.add_argument("--bodies", type=Path, default=BODIES)
    parser.add_argument("--all", action="store_true", help="also rows that pass")
    options = parser.parse_args()
    for space in options.spaces:
        path = str(options.bodies / f"{space}.npz")
        rows = measure(load_body(path, detail="full", joints="smplx"))
        missed = sum(not row.passes for row in rows)
        print(f"{space}: {missed} of {len(rows)} rotations miss the gate")
        for row in rows:
            if options.all or not row.passes:
                print("  ", row, flush=True)


if __name__ == "__main__":
    main()
