"""ANSUR II's measurements on a body over the base mesh, linear in its points up to each gauge's own
form.

Tapes follow material rings: where a plane cuts the reference body, on fixed places of its edges.
Every measurement is taken in the posture in which the survey took it (`postures.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from .gauges import AboveSole, Distance, Extent, Gauge, Linear, Scales, Tape
from .landmarks import LEFT, MIDLINE
from .postures import Posture, posture
from .rig import JOINTS, bone_weights, joint_points
from .sliders import MorphSpace
from .sources import BODY_VERTICES, Source

DENSITY = 1000.0  # kg per cubic metre, lungs half full
VOLUME_CELL = 0.034  # metres
X = np.array([1.0, 0, 0])
Y = np.array([0, 1.0, 0])
Z = np.array([0, 0, 1.0])


@dataclass(frozen=True)
class Ring:
    """Where a plane cuts the reference body: through a point between two named ones, with a normal,
    near that point.
    """

    start: str
    end: str
    share: float  # 0: at start, 1: at end
    normal: (
        tuple[float, float, float] | tuple[str, str]
    )  # a direction, or from one named point to another
    reach: float  # metres: points further from the centre belong to another limb
    # metres: what the survey measured beyond this ring (muscles flexed there, relaxed here; hair)
    add: float = 0.0
    part: str = "limb"  # "trunk": both sides without the arms; "limb": the left side


RINGS = {
    "chest": Ring("breast", "breast", 0.0, (0, 1, 0), 0.40, part="trunk"),
    "waist": Ring("navel", "navel", 0.0, (0, 1, 0), 0.40, part="trunk"),
    "naturalwaist": Ring("navel", "xiphoid", 0.3, (0, 1, 0), 0.40, part="trunk"),
    "buttock": Ring("buttock_peak", "buttock_peak", 0.0, (0, 1, 0), 0.40, part="trunk"),
    "thigh": Ring("crotch_left", "left_knee", 0.06, ("left_knee", "left_hip"), 0.17),
    "midthigh": Ring("left_knee", "left_hip", 0.50, ("left_knee", "left_hip"), 0.17),
    "lowerthigh": Ring("left_knee", "left_hip", 0.10, ("left_knee", "left_hip"), 0.13),
    "calf": Ring("calf", "shin_front", 0.0, (0, 1, 0), 0.20),
    "ankle": Ring("left_ankle", "left_knee", 0.22, (0, 1, 0), 0.10),
    "neck": Ring("neck", "head", 0.25, (0, 1, 0.45), 0.13, part="trunk"),
    "biceps": Ring(
        "left_shoulder", "left_elbow", 0.60, ("left_shoulder", "left_elbow"), 0.10, add=0.015
    ),
    "forearm": Ring(
        "left_elbow", "left_wrist", 0.22, ("left_elbow", "left_wrist"), 0.09, add=0.006
    ),
    "wrist": Ring("left_elbow", "left_wrist", 0.97, ("left_elbow", "left_wrist"), 0.07),
    # the survey's tape lies over hair, the body is bald
    "head": Ring("glabella", "head_back", 0.5, (0, 1, 0.05), 0.2, add=0.010, part="trunk"),
    "ball": Ring("mt1_head", "mt5_head", 0.5, (-0.3, 0.5, 1), 0.09),
}
TAPES = {
    "chestcircumference": "chest",
    "waistcircumference": "waist",
    "naturalwaistcircumference": "naturalwaist",
    "buttockcircumference": "buttock",
    "thighcircumference": "thigh",
    "midthighcircumference": "midthigh",
    "lowerthighcircumference": "lowerthigh",
    "calfcircumference": "calf",
    "anklecircumference": "ankle",
    "neckcircumference": "neck",
    "bicepscircumferenceflexed": "biceps",
    "forearmcircumferenceflexed": "forearm",
    "wristcircumference": "wrist",
    "headcircumference": "head",
    "balloffootcircumference": "ball",
}
HEIGHTS = {  # above the sole
    "stature": "head_top",
    "cervicaleheight": "c7",
    "suprasternaleheight": "jugular_notch",
    "crotchheight": "crotch",
    "kneeheightmidpatella": "patella",
    "waistheightomphalion": "navel",
    "iliocristaleheight": "iliac_crest",
    "trochanterionheight": "trochanter",
    "lateralmalleolusheight": "ankle_lateral",
    "acromialheight": "acromion",
    "chestheight": "breast",
}
LENGTHS = {  # straight distances
    "radialestylionlength": ("elbow_lateral", "wrist_radial"),
    "handlength": ("left_wrist", "middle_tip"),
    "headlength": ("glabella", "head_back"),
    "handbreadth": ("hand_radial", "hand_ulnar"),
    "acromionradialelength": ("left_shoulder", "left_elbow"),
}
# metres: from the acromion down to the shoulder's centre, and from the elbow's to the radius' head
ADDED = {"acromionradialelength": 0.055}
HALF_BREADTHS = {"biacromialbreadth": "acromion", "headbreadth": "head_side", "span": "middle_tip"}
RING_EXTENTS = {"chestdepth": ("chest", Z), "waistbreadth": ("waist", X)}
# a beam caliper's blade lies across both ridges of the back, not in the furrow between them
RING_EXTENTS |= {"waistdepth": ("waist", Z), "buttockdepth": ("buttock", Z)}
REGION_EXTENTS = ("hipbreadth", "bideltoidbreadth", "footbreadthhorizontal", "bimalleolarbreadth")
STANDING_TAPES = ("waistcircumference", "naturalwaistcircumference", "buttockcircumference")
POSTURE = {
    name: "rest" for name in TAPES if name not in STANDING_TAPES
}  # limbs keep their girths wherever they point
POSTURE |= {
    "headheight": "rest",
    "span": "span",
    "breastprominence": "rest",
    "chestdepth": "rest",
    "weightkg": "rest",
}
# all others: standing, arms down, heels together where the survey's measurers put their marks, as
# base vertices, where marker technicians aim elsewhere
SURVEY_MARKS = {"acromion": 8235, "hand_ulnar": 9876, "trochanter": 10926}
SOLES = ("heel_sole", "ball_sole")
# what the survey has no column of, but a body must have (`survey.py`): how far the breast lies
# before the midline at its level, and the head from vertex to menton; the tapes around the natural
# waist and the middle of the thigh
UNSURVEYED = ("breastprominence", "headheight")
MEASURES = (
    *HEIGHTS,
    *LENGTHS,
    *HALF_BREADTHS,
    "footlength",
    *TAPES,
    *RING_EXTENTS,
    *REGION_EXTENTS,
    *UNSURVEYED,
    "weightkg",
)


class Tapes:
    """All measurements of a batch of bodies given by the few points that they need, flat (N,
    3P).
    """

    def __init__(self, source: Source, reference: np.ndarray, triangles: np.ndarray):
        """reference (W, 3): tells where rings lie; triangles (F, 3) of the closed skin over base
        vertices.
        """
        self._find = _Finder(source, reference, triangles)
        parts = {name: self._find(name) for name in MEASURES}
        self.gauges: dict[str, Gauge] = {name: gauge for name, (gauge, _) in parts.items()}
        ends = np.cumsum([0] + [rows.shape[0] for _, rows in parts.values()])
        self.where = {
            name: slice(a, b) for name, a, b in zip(MEASURES, ends[:-1], ends[1:], strict=True)
        }
        self.matrix = sparse.vstack([rows for _, rows in parts.values()]).tocsr()  # (3P, 3W)

    def values(self, points: Callable[[slice], np.ndarray]) -> np.ndarray:
        """(N, M) in metres and kg, in the order of MEASURES; `points` gives a slice (N, 3p) of the
        flat points.
        """
        return np.stack([self._measured(name, points)[0] for name in MEASURES], 1)

    def slopes(
        self, points: Callable[[slice], np.ndarray], offsets: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values (N, M) and derivatives (N, M, K) with respect to weights of the offsets (K,
        3P).
        """
        values = []
        slopes = []
        for name in MEASURES:
            value, slope = self._measured(name, points)
            values.append(value)
            slopes.append(
                slope.reshape(len(slope), -1).astype(np.float32) @ offsets[:, self.where[name]].T
            )
        return np.stack(values, 1), np.stack(slopes, 1)

    def over(self, morphs: MorphSpace) -> MorphSpace:
        """The sliders over the measuring points alone, as (P, 3) points."""

        def posed(offsets: np.ndarray) -> np.ndarray:
            flat = offsets.reshape(-1, self.matrix.shape[1])
            return (self.matrix @ flat.T).T.astype(np.float32).reshape(*offsets.shape[:-2], -1, 3)

        base = (self.matrix @ morphs.base.ravel()).reshape(-1, 3)
        macro = posed(morphs.macro_offsets)
        local = posed(morphs.local_offsets)
        return replace(morphs, base=base, macro_offsets=macro, local_offsets=local)

    def _measured(
        self, name: str, points: Callable[[slice], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        here = points(self.where[name])
        return self.gauges[name](here.reshape(len(here), -1, 3))


class _Finder:
    """Gauge and points (rows of flat base points) of each measurement."""

    def __init__(self, source: Source, reference: np.ndarray, triangles: np.ndarray):
        self.source = source
        self.reference = reference
        self.triangles = triangles
        self.postures: dict[str, Posture] = {
            name: posture(name, source, reference) for name in ("rest", "standing", "span")
        }
        self.points = measuring_points(source, reference, triangles)
        self.place = {name: (row @ reference)[0] for name, row in self.points.items()}
        self.arms = _arm_share(source) > 0.5
        self.rings = {name: self._ring(ring) for name, ring in RINGS.items()}

    def __call__(self, name: str) -> tuple[Gauge, sparse.csr_matrix]:
        gauge, rows = self._gauge(name)
        return gauge, self.postures[POSTURE.get(name, "standing")].rows(rows)

    def _gauge(self, name: str) -> tuple[Gauge, sparse.csr_matrix]:
        if name in HEIGHTS:
            return AboveSole(), self._rows(HEIGHTS[name], *SOLES)
        if name in LENGTHS:
            return Distance(ADDED.get(name, 0.0)), self._rows(*LENGTHS[name])
        if name in HALF_BREADTHS:
            return Linear(2 * X[None]), self._rows(HALF_BREADTHS[name])
        if name in TAPES:
            rows, basis = self.rings[TAPES[name]]
            return Tape(basis, RINGS[TAPES[name]].add), rows
        if name in RING_EXTENTS:
            ring, axis = RING_EXTENTS[name]
            return Extent(axis), self.rings[ring][0]
        if name in REGION_EXTENTS:
            axis, region = self._region(name)
            return Extent(axis, twice=name in ("hipbreadth", "bideltoidbreadth")), _corners(
                region, len(self.reference)
            )
        if name == "footlength":
            return Extent(Z), self._rows("heel", "toe_tip", "big_toe_tip")
        if name == "headheight":
            return Linear(np.stack([Y, -Y])), self._rows("head_top", "chin")
        if name == "breastprominence":
            return Linear(np.stack([Z, -Z])), self._rows("breast", "between_breasts")
        if name == "weightkg":
            left = self.triangles[(self.reference[self.triangles, 0] > 1e-7).any(1)]
            coarse = self._clustered(left)
            used, index = np.unique(coarse, return_inverse=True)
            shrunk = _cone_volume(self.reference, left) / _cone_volume(self.reference, coarse)
            return Scales(index.reshape(coarse.shape), DENSITY * shrunk), _corners(
                used, len(self.reference)
            )
        raise KeyError(name)

    def _clustered(self, triangles: np.ndarray) -> np.ndarray:
        """The same closed surface over fewer vertices: all of a small cell of one limb go to one of
        them.

        Vertices on the midline stay on it. Collapsed triangles have no volume and are dropped.
        """
        used = np.unique(triangles)
        at = self.reference[used]
        limb = np.argmax(list(self.postures["standing"].weights.values()), axis=0)[used]
        key = np.column_stack([np.round(at / VOLUME_CELL), limb, np.abs(at[:, 0]) < 1e-7])
        _, cell = np.unique(key, axis=0, return_inverse=True)
        cell = cell.ravel()
        middle = (
            np.stack([np.bincount(cell, at[:, k]) for k in range(3)], 1)
            / np.bincount(cell)[:, None]
        )
        order = np.argsort(-np.linalg.norm(at - middle[cell], axis=1), kind="stable")
        chosen = np.zeros(len(middle), int)
        chosen[cell[order]] = used[
            order
        ]  # the last one written is the nearest to the cell's middle
        image = np.zeros(used[-1] + 1, int)
        image[used] = chosen[cell]
        moved = image[triangles]
        a, b, c = moved.T
        return moved[(a != b) & (b != c) & (c != a)]

    def _rows(self, *names: str) -> sparse.csr_matrix:
        return sparse.vstack([self.points[name] for name in names]).tocsr()

    def _region(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Axis (3,) and the base vertices among which the calipers touch."""
        used = np.unique(self.triangles)
        at = self.reference[used]
        place = self.place
        if name == "hipbreadth":
            near = (
                (at[:, 1] < place["iliac_crest"][1])
                & (at[:, 1] > place["crotch"][1] - 0.08)
                & ~self.arms[used]
            )
            return X, used[near & (at[:, 0] > 0.7 * place["trochanter"][0])]
        if name == "bideltoidbreadth":
            shoulder = np.linalg.norm(at - place["left_shoulder"], axis=1) < 0.14
            return X, used[shoulder & (at[:, 0] > place["left_shoulder"][0]) & self.arms[used]]
        if name == "footbreadthhorizontal":
            along = (place["mt2_head"] - place["heel"]) * [1, 0, 1]
            along /= np.linalg.norm(along)
            near = (
                (at[:, 0] > 0)
                & (at[:, 1] < place["ankle_lateral"][1])
                & (at[:, 2] < place["mt1_head"][2] + 0.015)
            )
            return np.array([along[2], 0, -along[0]]), used[
                near & (at[:, 2] > place["left_ankle"][2] + 0.03)
            ]
        near = (np.abs(at[:, 1] - place["left_ankle"][1]) < 0.025) & (at[:, 0] > 0)
        return X, used[near & (np.abs(at[:, 2] - place["left_ankle"][2]) < 0.035)]

    def _ring(self, ring: Ring) -> tuple[sparse.csr_matrix, np.ndarray]:
        """Rows (K, W) of the ring's points, and the plane's two axes (2, 3)."""
        a = self.place[ring.start]
        b = self.place[ring.end]
        centre = a + ring.share * (b - a)
        aimed = isinstance(ring.normal[0], str)
        normal = (
            self.place[ring.normal[1]] - self.place[ring.normal[0]]
            if aimed
            else np.array(ring.normal, float)
        )
        normal = normal / np.linalg.norm(normal)
        height = (self.reference - centre) @ normal
        t = self.triangles
        edges = np.unique(
            np.sort(np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]]), 1), axis=0
        )
        edges = edges[(height[edges[:, 0]] > 0) != (height[edges[:, 1]] > 0)]
        share = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
        spots = self.reference[edges[:, 0]] + share[:, None] * (
            self.reference[edges[:, 1]] - self.reference[edges[:, 0]]
        )
        near = np.linalg.norm(spots - centre, axis=1) < ring.reach
        near &= ~self.arms[edges].any(1) if ring.part == "trunk" else spots[:, 0] > 0.001
        edges = edges[near]
        share = share[near]
        index = (np.tile(np.arange(len(edges)), 2), np.concatenate([edges[:, 0], edges[:, 1]]))
        rows = sparse.csr_matrix(
            (np.concatenate([1 - share, share]), index), (len(edges), len(self.reference))
        )
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first /= np.linalg.norm(first)
        return rows, np.stack([first, np.cross(normal, first)])


def _cone_volume(points: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return float(np.einsum("fc,fc->", a, np.cross(b, c)) / 6)


def _corners(vertices: np.ndarray, count: int) -> sparse.csr_matrix:
    return sparse.csr_matrix(
        (np.ones(len(vertices)), (np.arange(len(vertices)), vertices)), (len(vertices), count)
    )


def _arm_share(source: Source) -> np.ndarray:
    """(W,) skinning weight of the arm's bones below the shoulder's joint."""
    stems = ("upperarm", "lowerarm", "wrist", "metacarpal", "finger")
    return sum(value for bone, value in bone_weights(source).items() if bone.startswith(stems))


def measuring_points(
    source: Source, reference: np.ndarray, skin: np.ndarray
) -> dict[str, sparse.csr_matrix]:
    """Name -> row (1, W): landmarks of the left side, joints, and places found on the reference
    body (sole, crotch, toe, the buttock's furthest point).
    """
    count = len(reference)
    used = np.unique(skin)
    midline = used[source.mirror[used] == used]
    centres = joint_points(source)
    ankle = (centres[JOINTS.index("left_ankle")] @ reference)[0]
    left = used[(reference[used, 0] > 0.01) & (reference[used, 1] < ankle[1])]
    behind = left[reference[left, 2] < ankle[2]]
    before = left[reference[left, 2] > ankle[2] + 0.06]
    inner = left[reference[left, 0] < reference[LEFT["toe_tip"], 0] - 0.012]
    crotch = midline[reference[midline, 1].argmin()]
    knee, hip = ((centres[JOINTS.index(j)] @ reference)[0] for j in ("left_knee", "left_hip"))
    seat = used[(np.abs(reference[used, 1] - hip[1]) < 0.12) & (reference[used, 0] > 0)]
    points = {
        name: _corners(np.array([v]), count) for name, v in (MIDLINE | LEFT | SURVEY_MARKS).items()
    }
    points |= {name: centres[k] for k, name in enumerate(JOINTS)}
    points["crotch"] = _corners(np.array([crotch]), count)
    front = midline[reference[midline, 2] > reference[MIDLINE["head_top"], 2]]
    level = np.abs(reference[front, 1] - reference[LEFT["breast"], 1])
    points["between_breasts"] = _corners(front[[level.argmin()]], count)
    share = (hip[1] - reference[crotch, 1]) / (hip[1] - knee[1])
    points["crotch_left"] = (1 - share) * points["left_hip"] + share * points["left_knee"]
    points["heel_sole"] = _corners(behind[[reference[behind, 1].argmin()]], count)
    points["ball_sole"] = _corners(before[[reference[before, 1].argmin()]], count)
    points["big_toe_tip"] = _corners(inner[[reference[inner, 2].argmax()]], count)
    points["buttock_peak"] = _corners(seat[[reference[seat, 2].argmin()]], count)
    return points


def body_triangles(source: Source) -> np.ndarray:
    """(F, 3) triangles of the base mesh's body, each quad cut along its first diagonal."""
    quads = source.quads[(source.quads < BODY_VERTICES).all(1)]
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
