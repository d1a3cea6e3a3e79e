"""Tape, calipers and scales: ANSUR II's measurements on a body in the A-pose, differentiable in its points.

Tapes follow material rings: where a plane cuts the reference body, on fixed places of its edges. A tape's length is
that of the ring's convex hull (Cauchy: the perimeter is the integral of the support function). Weight is the volume
of a coarse skin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse

from .landmarks import LEFT, MIDLINE
from .rig import JOINTS, bone_joint, bone_weights, joint_points
from .sources import Source

TAPE_DIRECTIONS = 48
DENSITY = 1.0  # kg per litre, lungs half full


@dataclass(frozen=True)
class Tape:
    """A ring: the plane through `centre` (a landmark or joint, or points between two) with a normal, near the
    centre.
    """

    name: str
    start: str
    end: str
    share: float  # 0: at start, 1: at end
    normal: tuple[float, float, float] | tuple[str, str]  # a direction, or from one named point to another
    reach: float  # metres: points further from the centre belong to another limb
    add: float = 0.0  # metres: what the survey measured beyond this ring (muscles flexed there, relaxed here)


TAPES = (
    Tape("chestcircumference", "spine3", "breast", 0.5, (0, 1, 0), 0.24),
    Tape("waistcircumference", "navel", "waist_back", 0.5, (0, 1, 0), 0.40),
    Tape("buttockcircumference", "buttock", "left_hip", 0.0, (0, 1, 0), 0.40),
    Tape("thighcircumference", "left_hip", "left_knee", 0.27, (0, 1, 0), 0.17),
    Tape("calfcircumference", "calf", "shin_front", 0.0, (0, 1, 0), 0.20),
    Tape("anklecircumference", "left_ankle", "left_knee", 0.22, (0, 1, 0), 0.10),
    Tape("neckcircumference", "neck", "head", 0.25, (0, 1, 0.45), 0.13),
    Tape(
        "bicepscircumferenceflexed", "left_shoulder", "left_elbow", 0.60, ("left_shoulder", "left_elbow"), 0.10, 0.015
    ),
    Tape("forearmcircumferenceflexed", "left_elbow", "left_wrist", 0.22, ("left_elbow", "left_wrist"), 0.09, 0.006),
    Tape("wristcircumference", "left_elbow", "left_wrist", 0.97, ("left_elbow", "left_wrist"), 0.07),
    Tape("headcircumference", "glabella", "head_back", 0.5, (0, 1, 0.05), 0.2),
    Tape("balloffootcircumference", "mt1_head", "mt5_head", 0.5, (-0.3, 0.5, 1), 0.09),
)
TRUNK_TAPES = ("chestcircumference", "waistcircumference", "buttockcircumference")
HEIGHTS = {  # above the sole
    "stature": "head_top", "cervicaleheight": "c7", "suprasternaleheight": "jugular_notch", "crotchheight": "crotch",
    "kneeheightmidpatella": "patella", "waistheightomphalion": "navel", "iliocristaleheight": "iliac_crest",
    "trochanterionheight": "trochanter", "lateralmalleolusheight": "ankle_lateral",
}  # fmt: skip
LENGTHS = {  # straight distances
    "radialestylionlength": ("elbow_lateral", "wrist_radial"), "handlength": ("wrist_crease", "middle_tip"),
    "headlength": ("glabella", "head_back"),
    "handbreadth": ("hand_radial", "hand_ulnar"),
}  # fmt: skip
ACROMION_TO_RADIALE = (
    0.055  # metres: from the acromion down to the shoulder's centre, and from the elbow's to the radius' head
)
BREADTHS = {"biacromialbreadth": "acromion", "headbreadth": "head_side"}  # twice the distance from the midline
# where the survey's measurers put their marks, as base vertices, where marker technicians aim elsewhere
SURVEY_MARKS = {"acromion": 8276, "hand_ulnar": 9876, "trochanter": 10926}
MEASURES = (*HEIGHTS, *LENGTHS, *BREADTHS, "acromionradialelength", "footlength", *(t.name for t in TAPES), "weightkg")


class Tapes:
    """All measurements of a batch of bodies given by the few points that they need."""

    def __init__(
        self,
        points: dict[str, np.ndarray],
        reference: np.ndarray,
        skin: np.ndarray,
        coarse: np.ndarray,
        arms: np.ndarray,
    ):
        """points: name -> sparse row (1, W) over base vertices; reference (W, 3); skin and coarse triangles over base
        vertices; arms (W,) True for vertices of the arms, which trunk tapes pass by.
        """
        place = {name: (row @ reference)[0] for name, row in points.items()}
        self.names = _single_points()
        rows = [points[name] for name in self.names]
        self.rings: list[tuple[Tape, slice, np.ndarray]] = []
        for tape in TAPES:
            ring, basis = _ring(tape, place, reference, skin, arms)
            start = sum(r.shape[0] for r in rows)
            rows.append(ring)
            self.rings.append((tape, slice(start, start + ring.shape[0]), basis))
        used, local = np.unique(coarse, return_inverse=True)
        start = sum(r.shape[0] for r in rows)
        self.flesh = slice(start, start + len(used))
        rows.append(sparse.csr_matrix((np.ones(len(used)), (np.arange(len(used)), used)), (len(used), len(reference))))
        self.coarse = torch.as_tensor(local.reshape(coarse.shape))
        self.matrix = sparse.vstack(rows).tocsr()  # (P, W)
        full = _volume(torch.as_tensor(reference)[None], torch.as_tensor(skin))
        self.volume_scale = float(full / _volume(torch.as_tensor(reference[used])[None], self.coarse))

    def __call__(self, points: Callable[[slice], torch.Tensor]) -> list[torch.Tensor]:
        """Measurements (each (N,)) in metres and kilograms, in the order of MEASURES.

        `points` gives some rows (N, p, 3) of all points, so that a derivative costs only what its measurement looks at.
        """
        marks = points(slice(0, len(self.names)))
        at = {name: marks[:, k] for k, name in enumerate(self.names)}
        sole = torch.minimum(at["heel_sole"][:, 1], at["ball_sole"][:, 1])
        out = {name: at[mark][:, 1] - sole for name, mark in HEIGHTS.items()}
        out |= {name: (at[a] - at[b]).norm(dim=1) for name, (a, b) in LENGTHS.items()}
        out |= {name: 2 * at[mark][:, 0] for name, mark in BREADTHS.items()}
        out["acromionradialelength"] = (at["left_elbow"] - at["left_shoulder"]).norm(dim=1) + ACROMION_TO_RADIALE
        heel, toe = at["heel"], torch.maximum(at["toe_tip"][:, 2], at["big_toe_tip"][:, 2])
        out["footlength"] = toe - heel[:, 2]
        for tape, where, basis in self.rings:
            out[tape.name] = _hull_length(points(where) @ torch.as_tensor(basis.T)) + tape.add
        out["weightkg"] = 1000 * DENSITY * self.volume_scale * _volume(points(self.flesh), self.coarse)
        return [out[name] for name in MEASURES]


def _single_points() -> tuple[str, ...]:
    """Names of the points that heights, lengths and breadths need."""
    ends = {end for pair in LENGTHS.values() for end in pair} | set(HEIGHTS.values()) | set(BREADTHS.values())
    ends |= {"heel_sole", "ball_sole", "heel", "toe_tip", "big_toe_tip", "left_shoulder", "left_elbow"}
    return tuple(sorted(ends))


def _ring(tape: Tape, place: dict[str, np.ndarray], reference: np.ndarray, skin: np.ndarray, arms: np.ndarray):
    """Sparse rows of the ring's points, and the plane's two axes (2, 3)."""
    a, b = place[tape.start], place[tape.end]
    centre = a + tape.share * (b - a)
    aimed = isinstance(tape.normal[0], str)
    normal = place[tape.normal[1]] - place[tape.normal[0]] if aimed else np.array(tape.normal, float)
    normal /= np.linalg.norm(normal)
    height = (reference - centre) @ normal
    edges = np.unique(np.sort(np.concatenate([skin[:, [0, 1]], skin[:, [1, 2]], skin[:, [2, 0]]]), 1), axis=0)
    edges = edges[height[edges[:, 0]] * height[edges[:, 1]] < 0]
    share = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
    spots = reference[edges[:, 0]] + share[:, None] * (reference[edges[:, 1]] - reference[edges[:, 0]])
    near = np.linalg.norm(spots - centre, axis=1) < tape.reach
    if tape.name in TRUNK_TAPES:
        near &= ~arms[edges].any(1)
    if "thigh" in tape.name or "calf" in tape.name or "ankle" in tape.name or "foot" in tape.name:
        near &= spots[:, 0] > 0.001
    edges, share = edges[near], share[near]
    count = len(edges)
    values = np.concatenate([1 - share, share])
    index = (np.tile(np.arange(count), 2), np.concatenate([edges[:, 0], edges[:, 1]]))
    helper = np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return sparse.csr_matrix((values, index), (count, len(reference))), np.stack([first, np.cross(normal, first)])


def _hull_length(flat: torch.Tensor) -> torch.Tensor:
    """Perimeter (N,) of the convex hulls of flat points (N, K, 2)."""
    angle = torch.arange(TAPE_DIRECTIONS, dtype=flat.dtype) * (2 * torch.pi / TAPE_DIRECTIONS)
    towards = torch.stack([torch.cos(angle), torch.sin(angle)])
    return (flat @ towards).amax(1).sum(1) * (2 * torch.pi / TAPE_DIRECTIONS)


def _volume(points: torch.Tensor, triangles: torch.Tensor) -> torch.Tensor:
    """Volume (N,) enclosed by triangles over points (N, P, 3), cubic metres."""
    a, b, c = (points[:, triangles[:, k]] for k in range(3))
    return (a * torch.linalg.cross(b, c)).sum((1, 2)) / 6


def measuring_points(source: Source, reference: np.ndarray, skin: np.ndarray) -> dict[str, sparse.csr_matrix]:
    """Name -> row (1, W): landmarks of the left side, joints, and places found on the reference body (sole, crotch,
    toe).
    """

    def corner(vertex: int) -> sparse.csr_matrix:
        return sparse.csr_matrix(([1.0], ([0], [vertex])), (1, len(reference)))

    used = np.unique(skin)
    midline = used[source.mirror[used] == used]
    centres = joint_points(source)
    ankle = (centres[JOINTS.index("left_ankle")] @ reference)[0]
    left = used[(reference[used, 0] > 0.01) & (reference[used, 1] < ankle[1])]
    behind, before = left[reference[left, 2] < ankle[2]], left[reference[left, 2] > ankle[2] + 0.06]
    inner = left[reference[left, 0] < reference[LEFT["toe_tip"], 0] - 0.012]
    points = {name: corner(vertex) for name, vertex in (MIDLINE | LEFT | SURVEY_MARKS).items()}
    points |= {name: centres[k] for k, name in enumerate(JOINTS)}
    points["wrist_crease"] = points["left_wrist"]
    points["crotch"] = corner(midline[reference[midline, 1].argmin()])
    points["heel_sole"] = corner(behind[reference[behind, 1].argmin()])
    points["ball_sole"] = corner(before[reference[before, 1].argmin()])
    points["big_toe_tip"] = corner(inner[reference[inner, 2].argmax()])
    return points


def build_tapes(source: Source, reference: np.ndarray, full_faces: np.ndarray, coarse_faces: np.ndarray) -> Tapes:
    """All measuring tools for bodies over the base mesh's vertices; `reference` (W, 3) tells where rings lie."""
    arms = np.zeros(len(reference))
    for bone, value in bone_weights(source).items():
        if JOINTS[bone_joint(bone)].endswith(("shoulder", "elbow", "wrist", "hand")):
            arms += value
    points = measuring_points(source, reference, full_faces)
    return Tapes(points, reference, full_faces, coarse_faces, arms > 0.5)
