"""Bones of the default body as points that springs hold: placed on the mean woman and man, carried
to people by joints.

A point lies between two joints, at a share of the way and an offset that grows with the skeleton,
not with the flesh. Offsets come from landmarks over bones (crest, trochanter, epicondyles,
olecranon, kneecap, shoulder blade, clavicle), moved inward by the tissue over them; ribs lie under
the skin of the chest, a breast left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np

from habitus.body.model import BodyModel

from .frames import QUARTERS, SIDES, Frames

STATION = 0.012  # metres between stations along a bone
LIMB = 0.09
RIB = 0.135
PELVIS = 0.135  # mu m a point
CLAVICLE = 0.045
COVER = 0.010  # metres of tissue over a bone at least
SCALES = {
    "limb": ("hip", "ankle"),
    "trunk": ("left_shoulder", "right_shoulder"),
    "pelvis": ("left_hip", "right_hip"),
}


@dataclass(frozen=True)
class Bones:
    """S points: between which joints, how far along, offset (m) and by what it scales; which frames
    they follow.
    """

    between: np.ndarray  # (S, 2) joints
    along: np.ndarray  # (S,)
    offset: np.ndarray  # (S, 3)
    scale: np.ndarray  # (S,) words of SCALES
    frames: np.ndarray  # (S, 2)
    shares: np.ndarray  # (S, 2)
    stiffness: np.ndarray  # (S,)
    group: np.ndarray  # (S,) words: limb, spine, ribs, pelvis

    def points(self, joints: np.ndarray, mean: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
        """(S, 3) of a person with these joints; offsets are those of the `mean` ones."""
        sizes = {word: _size(word, joints, names) / _size(word, mean, names) for word in SCALES}
        factor = np.array([sizes[word] for word in self.scale])
        ends = joints[self.between]
        way = ends[:, 0] + self.along[:, None] * (ends[:, 1] - ends[:, 0])
        return way + factor[:, None] * self.offset

    def places(self, points: np.ndarray, motions: np.ndarray) -> np.ndarray:
        """(S, 3) where the frames' motions (K, 3, 4) take rest points."""
        moved = motions[self.frames]
        each = np.einsum("skij,sj->ski", moved[..., :3], points) + moved[..., 3]
        return np.einsum("sk,ski->si", self.shares, each)


def _size(word: str, joints: np.ndarray, names: tuple[str, ...]) -> float:
    if word == "limb":
        chain = [names.index(f"left_{name}") for name in ("hip", "knee", "ankle")]
        return float(np.linalg.norm(np.diff(joints[chain], axis=0), axis=1).sum())
    a, b = (names.index(name) for name in SCALES[word])
    return float(np.linalg.norm(joints[a] - joints[b]))


class _Drawing:
    """Points gathered on the left side and the middle of a body; `mirrored` adds the right."""

    def __init__(self, body: BodyModel):
        self.body = body
        self.joints = body.rest_joints()
        self.frames = Frames(body.joint_names, body.parents, self.joints).names
        self.rows: list[tuple] = []

    def mark(self, name: str) -> np.ndarray:
        return self.body.v_template[self.body.landmarks[name]]

    def place(self, name: str) -> np.ndarray:
        return self.joints[self.body.joint_names.index(name)]

    def add(
        self,
        point: np.ndarray,
        ends: tuple[str, str],
        frames: tuple[tuple[str, float], ...],
        group: str,
        scale: str = "limb",
        stiffness: float = LIMB,
    ) -> None:
        """A point, told by the projection on the way between two joints."""
        a = self.place(ends[0])
        b = self.place(ends[1])
        along = float((point - a) @ (b - a) / ((b - a) @ (b - a)))
        frames = frames if len(frames) == 2 else (frames[0], (frames[0][0], 0.0))
        self.rows.append(
            (ends, along, point - a - along * (b - a), scale, frames, stiffness, group)
        )

    def mirrored(self) -> Bones:
        rows = list(self.rows)
        for ends, along, offset, scale, frames, stiffness, group in self.rows:
            words = [name for name, _ in frames] + list(ends)
            if any(word.startswith("left_") for word in words):
                other = tuple((_other(name), share) for name, share in frames)
                turned = offset * np.array([-1, 1, 1])
                rows.append(
                    (tuple(map(_other, ends)), along, turned, scale, other, stiffness, group)
                )
        joint = self.body.joint_names.index
        return Bones(
            np.array([[joint(name) for name in row[0]] for row in rows]),
            np.array([row[1] for row in rows]),
            np.array([row[2] for row in rows]),
            np.array([row[3] for row in rows]),
            np.array([[self.frames.index(name) for name, _ in row[4]] for row in rows]),
            np.array([[share for _, share in row[4]] for row in rows]),
            np.array([row[5] for row in rows]),
            np.array([row[6] for row in rows]),
        )


def _other(name: str) -> str:
    """The name on the other side."""
    ahead, _, rest = name.partition("_")
    return {"left": "right_", "right": "left_"}[ahead] + rest if ahead in SIDES else name


def draw_bones(body: BodyModel) -> Bones:
    """The bones of a mean body (full detail, SMPL-X's joints)."""
    drawing = _Drawing(body)
    _legs(drawing)
    _arms(drawing)
    _shoulder(drawing)
    _spine(drawing)
    _pelvis(drawing)
    _ribs(drawing)
    return drawing.mirrored()


def _ring(centre: np.ndarray, axis: np.ndarray, radius: float, count: int) -> np.ndarray:
    axis = axis / np.linalg.norm(axis)
    side = np.cross(axis, [0.0, 0.0, 1.0])
    side = side / np.linalg.norm(side)
    angles = 2 * np.pi * np.arange(count) / count
    around = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)
    return centre + radius * around


def _by(*offset: float) -> np.ndarray:
    """Metres outward to the left, up, and forward."""
    return np.array(offset)


def _legs(drawing: _Drawing) -> None:
    hip, knee, ankle = (drawing.place(f"left_{name}") for name in ("hip", "knee", "ankle"))
    top = drawing.mark("left_trochanter") * [1, 0, 1] + _by(-0.032, hip[1], 0)
    length = np.linalg.norm(knee - hip)
    for t in np.arange(0.0, 1 - 0.03 / length, STATION / length):
        centre = hip + t * (knee - hip) + (1 - t) ** 3 * (top - hip)
        for point in (centre, *_ring(centre, knee - hip, 0.014, 6)):
            drawing.add(point, ("left_hip", "left_knee"), (("left_hip", 1.0),), "limb")
    wide = [drawing.mark(f"left_knee_{name}")[0] for name in ("medial", "lateral")]
    for x in (wide[0] + 0.018, wide[1] - 0.018):
        for y in (0.012, 0.027):
            point = np.array([x, knee[1] + y, knee[2]])
            drawing.add(point, ("left_hip", "left_knee"), (("left_hip", 1.0),), "limb")
    length = np.linalg.norm(ankle - knee)
    for t in np.arange(0.03 / length, 1 - 0.02 / length, STATION / length):
        centre = knee + t * (ankle - knee)
        for point in (centre, *_ring(centre, ankle - knee, 0.016 - 0.005 * t, 6)):
            drawing.add(point, ("left_knee", "left_ankle"), (("left_knee", 1.0),), "limb")
    cap = drawing.mark("left_patella") - [0, 0, 0.015]
    for dx, dy in ((0, 0), (0.017, 0), (-0.017, 0), (0, 0.015), (0, -0.015)):
        point = np.array([knee[0] + dx, knee[1] + dy, cap[2]])
        drawing.add(point, ("left_hip", "left_knee"), (("left_patella", 1.0),), "limb")


def _arms(drawing: _Drawing) -> None:
    shoulder, elbow, wrist = (
        drawing.place(f"left_{name}") for name in ("shoulder", "elbow", "wrist")
    )
    length = np.linalg.norm(elbow - shoulder)
    for t in np.arange(0.02 / length, 1 - 0.02 / length, STATION / length):
        centre = shoulder + t * (elbow - shoulder)
        for point in (centre, *_ring(centre, elbow - shoulder, 0.009, 4)):
            drawing.add(point, ("left_shoulder", "left_elbow"), (("left_shoulder", 1.0),), "limb")
    length = np.linalg.norm(wrist - elbow)
    names = ("left_elbow", *(f"left_forearm{k}" for k in range(1, QUARTERS + 1)))
    for t in np.arange(0.025 / length, 1 - 0.015 / length, STATION / length):
        k = min(int(QUARTERS * t), QUARTERS - 1)
        part = QUARTERS * t - k
        for point in _ring(elbow + t * (wrist - elbow), wrist - elbow, 0.011, 4):
            frames = ((names[k], 1 - part), (names[k + 1], part))
            drawing.add(point, ("left_elbow", "left_wrist"), frames, "limb")
    back = drawing.mark("left_olecranon")[2] + 0.009
    for dx, dy in ((0, 0), (0.01, 0), (-0.01, 0), (0, 0.008), (0, -0.008)):
        point = np.array([elbow[0] + dx, elbow[1] + dy, back])
        drawing.add(point, ("left_elbow", "left_wrist"), (("left_elbow", 1.0),), "limb")


def _shoulder(drawing: _Drawing) -> None:
    inner = drawing.mark("left_clavicle_medial") + _by(0.012, -0.008, -0.012)
    outer = drawing.mark("left_acromion") + _by(-0.012, -0.024, -0.004)
    ends = ("left_collar", "left_shoulder")
    for t in np.linspace(0.1, 1, int(np.linalg.norm(outer - inner) / STATION)):
        drawing.add(
            inner + t * (outer - inner), ends, (("left_collar", 1.0),), "limb", "trunk", CLAVICLE
        )
    upper, middle, lower = (
        drawing.mark(f"left_scapula_{name}") + _by(0, 0, 0.016)
        for name in ("upper", "mid", "lower")
    )
    spine = drawing.mark("left_acromion") * [0.6, 1, 0] + _by(
        0.4 * upper[0], -0.03, middle[2] + 0.012
    )
    for a, b in ((upper, lower), (upper, middle), (spine, upper), (spine, lower), (middle, lower)):
        for t in (0.0, 0.35, 0.7):
            drawing.add(a + t * (b - a), ends, (("left_scapula", 1.0),), "ribs", "trunk")


def _spine(drawing: _Drawing) -> None:
    names = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
    places = [drawing.place(name) for name in names]
    places[0] = np.array([0, places[0][1], places[1][2] - 0.02])
    for k in range(5):
        a = places[k]
        b = places[k + 1]
        length = np.linalg.norm(b - a)
        slim = names[k] == "neck"
        for t in np.arange(0, 1, STATION / length):
            other, part = (k - 1, 0.5 - t) if t < 0.5 else (k + 1, t - 0.5)
            if other < 0:
                other = k
                part = 0.0
            frames = ((names[k], 1 - part), (names[other], part))
            for dx, dz in ((0, 0), (0.018, -0.006), (-0.018, -0.006), (0, -0.016)):
                offset = np.array([dx, 0, dz]) * (0.6 if slim else 1.0)
                drawing.add(
                    a + t * (b - a) + offset, (names[k], names[k + 1]), frames, "spine", "trunk"
                )


def _pelvis(drawing: _Drawing) -> None:
    hip = drawing.place("left_hip")
    asis = drawing.mark("left_asis") + _by(-0.012, -0.004, -0.018)
    crest = drawing.mark("left_iliac_crest") + _by(-0.028, -0.012, 0)
    psis = drawing.mark("left_psis") + _by(-0.004, 0, 0.018)
    sacrum = drawing.mark("sacrum") + _by(0, 0, 0.018)
    pubis = np.array([0.018, hip[1] - 0.012, asis[2] - 0.035])
    wing = hip + _by(-0.005, 0.055, -0.02)
    lines = [
        (asis, crest),
        (crest, psis),
        (psis, sacrum),
        (wing, asis),
        (wing, crest),
        (wing, psis),
    ]
    lines += [(sacrum, sacrum + _by(0, -0.05, 0.01)), (pubis, pubis * [-1, 1, 1])]
    for a, b in lines:
        for t in np.linspace(0, 1, max(2, int(np.linalg.norm(b - a) / 0.016))):
            ends = ("pelvis", "spine1")
            point = a + t * (b - a)
            frame = (("pelvis", 1.0),)
            if point[0] < 1e-3:
                drawing.add(point, ends, frame, "pelvis", "pelvis", PELVIS)
            else:
                drawing.add(point, ("left_hip", "right_hip"), frame, "pelvis", "pelvis", PELVIS)


def _ribs(drawing: _Drawing) -> None:
    body = drawing.body
    spacing = 0.026
    depth = 0.028
    vertices = body.v_template
    faces = body.faces
    normals = igl.per_vertex_normals(vertices, faces)
    names = body.joint_names
    trunk = [names.index(name) for name in ("spine1", "spine2", "spine3", "neck")]
    weights = np.zeros((len(vertices), len(names)))
    np.put_along_axis(weights, body.skinning_index, body.skinning_value, 1)
    high = drawing.mark("jugular_notch")[1]
    low = drawing.mark("xiphoid")[1]
    back = drawing.mark("t12")[1]
    front = np.clip((vertices[:, 2] + 0.03) / 0.12, 0, 1)
    over = vertices[:, 1] > back + front * (low - back)
    chosen = over & (vertices[:, 1] < high + 0.02 * (1 - front)) & (weights[:, trunk].sum(1) > 0.6)
    points = vertices - depth * normals
    heights = [drawing.mark(name) for name in ("xiphoid", "sternum_mid", "jugular_notch")]
    limit = np.interp(vertices[:, 1], [p[1] for p in heights], [p[2] for p in heights]) - 0.012
    points[:, 2] = np.minimum(
        points[:, 2], limit - 0.25 * np.abs(points[:, 0]) * (normals[:, 2] > 0)
    )
    kept: list[np.ndarray] = []
    ends = ("spine2", "spine3")
    for v in np.flatnonzero(chosen & (vertices[:, 0] > 0.004)):
        if kept and np.linalg.norm(np.array(kept) - points[v], axis=1).min() < spacing:
            continue
        kept.append(points[v])
        share = weights[v, trunk] / weights[v, trunk].sum()
        two = np.argsort(-share)[:2]
        part = share[two] / share[two].sum()
        frames = tuple(
            (("spine1", "spine2", "spine3", "neck")[k], float(p))
            for k, p in zip(two, part, strict=True)
        )
        drawing.add(points[v], ends, frames, "ribs", "trunk", RIB)
        mirror = points[v] * [-1, 1, 1]
        drawing.add(mirror, ends, frames, "ribs", "trunk", RIB)


def under_skin(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Points (S, 3) moved inward until COVER of tissue lies over them."""
    points = points.copy()
    for _ in range(8):
        signed, _, closest, _ = igl.signed_distance(points, vertices, faces)
        out = signed > -COVER
        if not out.any():
            break
        inward = np.where((signed > 0)[:, None], closest - points, points - closest)
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-9)
        points[out] += (COVER + np.maximum(signed, -COVER) + 0.001)[out, None] * inward[out]
    return points


def only(bones: Bones, some: np.ndarray) -> Bones:
    """Those of some points."""
    return replace(
        bones, **{name: getattr(bones, name)[some] for name in bones.__dataclass_fields__}
    )
