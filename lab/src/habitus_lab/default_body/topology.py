"""The body's mesh in two levels of detail: the base mesh's own quads, and a coarse mesh over some
of their vertices.

The full mesh is the base mesh's group `body` (closed; mouth and eye sockets are lined pockets) and
two eyeballs, each its own closed part. The islands of its texture tell the parts, so the pockets
need no search. The coarse mesh is the full one under half-edge collapses of its left half,
mirrored; eyeballs stay whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from .decimate import decimate
from .landmarks import landmark_vertices
from .rig import JOINTS, bone_joint, bone_weights, surface_places
from .sliders import ANCHORS, MorphSpace
from .sources import BODY_VERTICES, EYEBALLS, Source

COARSE_VERTICES = 7500  # about, eyeballs included
LARGEST_POCKET = (
    450  # quads of a texture island: the mouth's pocket has 398, an eye's 293, a foot's over 1,000
)
# how dear a vertex is by the joint that moves it, times what its part of the surface is worth
IMPORTANCE = {"wrist": 9.0, "finger": 9.0, "head": 3.0, "jaw": 3.0, "foot": 1.0, "ankle": 1.0}
TRUNK_IMPORTANCE = 0.5
POCKET_IMPORTANCE = 1e-3
RIM_IMPORTANCE = 8.0  # times the head's, for lips and lids, which would cross each other
FINGERS = ("thumb", "index", "middle", "ring", "pinky")


@dataclass(frozen=True)
class Topology:
    """Full and coarse mesh; V full vertices, of which the first 13,380 carry the base mesh's own
    numbers.
    """

    base: np.ndarray  # (V,) base index of each vertex
    quads: np.ndarray  # (Q, 4) over 0..V-1, outward
    uv: np.ndarray  # (T, 2)
    quad_uv: np.ndarray  # (Q, 4) over 0..T-1
    hidden: np.ndarray  # (Q,) True for the quads that line mouth and eye sockets
    mirror: np.ndarray  # (V,) left-right twin
    faces: (
        np.ndarray
    )  # (2Q, 3) quads cut along the shorter diagonal of the average body, left and right alike
    coarse: np.ndarray  # (C,) sorted indices into the vertices
    coarse_faces: np.ndarray  # (F, 3) over 0..C-1

    @cached_property
    def full_faces(self) -> np.ndarray:
        """Triangles of the closed skin without eyeballs, over base vertices."""
        return self.faces[(self.faces < BODY_VERTICES).all(1)]


def build_topology(
    source: Source,
    morphs: MorphSpace,
    vertices: int = COARSE_VERTICES,
    coarse_faces: np.ndarray | None = None,
) -> Topology:
    """Both meshes; landmarks stay in the coarse one, which `coarse_faces` (F, 3) over the full
    vertices gives where another file's is to be kept.
    """
    eyes = np.concatenate([source.groups[name] for name in EYEBALLS])
    base = np.concatenate([np.arange(BODY_VERTICES), eyes])
    place = np.full(len(source.vertices), -1)
    place[base] = np.arange(len(base))
    quads = place[np.concatenate([source.quads, source.eye_quads])]
    mirror = place[source.mirror[base]]
    quad_uv = np.concatenate([source.quad_uv, source.eye_quad_uv])
    used, packed = np.unique(quad_uv, return_inverse=True)
    body = morphs.average()[base]
    hidden = np.zeros(len(quads), bool)
    hidden[: len(source.quads)] = pocket_quads(source.quad_uv)
    lining = np.setdiff1d(quads[hidden], quads[~hidden])
    rim = np.unique(quads[~hidden][np.isin(quads[~hidden], quads[hidden]).any(1)])
    left = split_quads(body, quads[_is_left(source.vertices[base], quads)])
    faces = np.concatenate([left, mirror[left][:, ::-1]])
    skin = left[(left < BODY_VERTICES).all(1)]
    if coarse_faces is None:
        skin = _coarse(source, morphs, skin, (lining, rim), mirror, vertices - len(eyes))
        coarse_faces = np.concatenate([skin, faces[(faces >= BODY_VERTICES).all(1)]])
    coarse = np.unique(coarse_faces)
    index = np.full(len(base), -1)
    index[coarse] = np.arange(len(coarse))
    return Topology(
        base=base,
        quads=quads,
        uv=source.uv[used],
        quad_uv=packed.reshape(quad_uv.shape),
        hidden=hidden,
        mirror=mirror,
        faces=faces,
        coarse=coarse,
        coarse_faces=index[coarse_faces],
    )


def split_quads(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Triangles (2Q, 3): each quad (Q, 4) cut along its shorter diagonal on vertices (V, 3)."""
    a, b, c, d = vertices[quads].transpose(1, 0, 2)
    short = np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1)
    first = np.where(short[:, None], quads[:, [0, 1, 2]], quads[:, [0, 1, 3]])
    second = np.where(short[:, None], quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])
    return np.concatenate([first, second])


def pocket_quads(quad_uv: np.ndarray) -> np.ndarray:
    """(Q,) True for quads of small texture islands: the linings of the mouth and the eye
    sockets.
    """
    count = int(quad_uv.max()) + 1
    links = sparse.coo_matrix(
        (np.ones(3 * len(quad_uv)), (np.repeat(quad_uv[:, 0], 3), quad_uv[:, 1:].ravel())),
        (count, count),
    )
    _, label = connected_components(links, directed=False)
    island = label[quad_uv[:, 0]]
    return np.bincount(island)[island] < LARGEST_POCKET


def _is_left(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    side = np.sign(vertices[quads, 0].round(9))
    if ((side.min(1) < 0) & (side.max(1) > 0)).any():
        raise ValueError("a quad of the base mesh crosses the midline: it cannot be halved")
    return side.max(1) > 0


def _coarse(
    source: Source,
    morphs: MorphSpace,
    left: np.ndarray,
    pockets: tuple[np.ndarray, np.ndarray],
    mirror: np.ndarray,
    vertices: int,
) -> np.ndarray:
    """Faces over full vertices of the coarse skin; pockets: inner and rim vertices."""
    bodies = _extremes(morphs)[:, :BODY_VERTICES]
    midline = mirror[:BODY_VERTICES] == np.arange(BODY_VERTICES)
    fixed = np.zeros(BODY_VERTICES, bool)
    for space in ("female", "male"):
        fixed[list(landmark_vertices(source.mirror, space).values())] = True
    fixed[list(surface_places("jaw", source.mirror))] = True
    weight = _importance(source)
    weight[pockets[0]] *= POCKET_IMPORTANCE
    weight[pockets[1]] *= RIM_IMPORTANCE
    half = decimate(bodies, left, weight, fixed, midline, vertices)
    return np.concatenate([half, mirror[half][:, ::-1]])


def _importance(source: Source) -> np.ndarray:
    """(13380,) what an error costs at each vertex of the body."""
    weight = np.zeros(BODY_VERTICES)
    for bone, value in bone_weights(source).items():
        part = JOINTS[bone_joint(bone)].removeprefix("left_").removeprefix("right_")
        part = "finger" if part.startswith(FINGERS) else part
        weight += value[:BODY_VERTICES] * IMPORTANCE.get(part, TRUNK_IMPORTANCE)
    return weight


def _extremes(morphs: MorphSpace) -> np.ndarray:
    """(S, W, 3) bodies far apart: a collapse must be cheap on all of them."""
    macro = {name: np.full(8, 0.5) for name in ANCHORS}
    macro["gender"] = np.array([0.5, 0, 1, 0, 1, 0, 1, 0.5])
    macro["weight"] = np.array([0.5, 0.1, 0.2, 1, 1, 0.6, 0.6, 1])
    macro["muscle"] = np.array([0.5, 0.5, 0.5, 0.3, 0.5, 0.5, 1, 0.2])
    macro["age"] = np.array([0.5, 0.5, 0.5, 0.5, 0.75, 0.9, 0.65, 0.9])
    return morphs.bodies(
        macro, np.full((8, 3), 1 / 3), np.zeros((8, len(morphs.local_names)))
    ).astype(float)
