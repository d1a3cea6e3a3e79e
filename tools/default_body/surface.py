"""One closed skin: the left half of the base mesh, its pockets (eye sockets, mouth) cut out and closed.

All work is done on the left half; its open border is the body's midline, so mirroring it gives an exactly symmetric
closed mesh.
"""

from __future__ import annotations

import igl
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from .sources import Source

FACE_REGION = 0.035  # metres: pockets are looked for this close to the midline or an eye, in front of the ears
RAYS = 3000
HIDDEN = 0.91  # of the rays from a vertex that hit something: few vertices lie near this share, pockets lie above it
SMALLEST_POCKET = 30  # vertices; nostrils and ear folds are smaller and stay
LONGEST_EYE_RIM = 80  # edges


def left_half(source: Source) -> np.ndarray:
    """Triangles (F, 3) of the left half (x >= 0) of the closed skin, indices into the base mesh."""
    hidden = _hidden_vertices(source)
    quads = _left_quads(source)
    triangles = _split_quads(source.vertices, quads)
    pockets = _pocket_triangles(triangles, hidden)
    skin = triangles[~pockets]
    for rim in _open_chains(skin, source.mirror):
        skin = np.concatenate([skin, _close(rim, skin, source)])
    return skin


def whole(half: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Both halves: the left one and its mirror image, turned over to stay outward."""
    return np.concatenate([half, mirror[half][:, ::-1]])


def _left_quads(source: Source) -> np.ndarray:
    side = np.sign(source.vertices[source.quads, 0].round(9))
    if ((side.min(1) < 0) & (side.max(1) > 0)).any():
        raise ValueError("a quad of the base mesh crosses the midline: it cannot be halved")
    return source.quads[side.max(1) > 0]


def _split_quads(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Cut each quad along its shorter diagonal."""
    a, b, c, d = vertices[quads].transpose(1, 0, 2)
    short = np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1)
    first = np.where(short[:, None], quads[:, [0, 1, 2]], quads[:, [0, 1, 3]])
    second = np.where(short[:, None], quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])
    return np.concatenate([first, second])


def _hidden_vertices(source: Source) -> np.ndarray:
    """(19158,) True where nearly every outward ray hits body, eyeball, teeth or tongue, inside the face."""
    v = source.vertices
    faces = np.concatenate([source.quads, source.occluders])
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    normals = igl.per_vertex_normals(v, triangles.astype(np.int64))
    eye = v[source.groups["helper-l-eye"]].mean(0)
    mouth = v[source.groups["helper-upper-teeth"]].mean(0)
    folded = np.abs(v) * [1, 0, 0] + v * [0, 1, 1]
    body = np.arange(len(v)) < source.quads.max() + 1
    near = (np.linalg.norm(folded - eye, axis=1) < FACE_REGION) | (np.linalg.norm(v - mouth, axis=1) < 3 * FACE_REGION)
    face = np.flatnonzero(body & near)
    shade = igl.ambient_occlusion(v, triangles.astype(np.int64), v[face] + 1e-5 * normals[face], normals[face], RAYS)
    hidden = np.zeros(len(v), bool)
    hidden[face] = shade > HIDDEN
    return hidden | hidden[source.mirror]


def _pocket_triangles(triangles: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """(F,) True for triangles with a corner in a large connected patch of hidden vertices."""
    inside = triangles[hidden[triangles].all(1)]
    count = len(hidden)
    links = sparse.coo_matrix((np.ones(len(inside)), (inside[:, 0], inside[:, 1])), (count, count))
    links += sparse.coo_matrix((np.ones(len(inside)), (inside[:, 1], inside[:, 2])), (count, count))
    _, patch = connected_components(links, directed=False)
    deep = np.bincount(patch)[patch] >= SMALLEST_POCKET
    return deep[triangles].any(1)


def _open_chains(triangles: np.ndarray, mirror: np.ndarray) -> list[list[int]]:
    """Borders off the midline: closed loops (an eye), or chains that begin and end on the midline (the mouth)."""
    edges = {(int(a), int(b)) for t in triangles for a, b in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))}
    follow: dict[int, int] = {}
    for a, b in edges:
        on_midline = mirror[a] == a and mirror[b] == b
        if (b, a) not in edges and not on_midline:
            if b in follow:
                raise ValueError(f"vertex {b} lies on two borders: the pocket's rim is not a simple curve")
            follow[b] = a
    chains = []
    while follow:
        ends = [v for v in follow if v not in follow.values()]
        start = ends[0] if ends else next(iter(follow))
        chain = [start]
        while chain[-1] in follow:
            chain.append(follow.pop(chain[-1]))
        chains.append(chain[:-1] if chain[0] == chain[-1] else chain)
    return chains


def _close(rim: list[int], skin: np.ndarray, source: Source) -> np.ndarray:
    """Triangles over a rim: an eye gets the front pole of its eyeball, the mouth is closed by least area."""
    if source.mirror[rim[0]] == rim[0]:
        return _least_area(rim, skin, source.vertices)
    if len(rim) > LONGEST_EYE_RIM:
        raise ValueError(f"a rim of {len(rim)} edges off the midline is no eye: {rim[:5]}...")
    eyeball = source.groups["helper-l-eye"]
    pole = int(eyeball[source.vertices[eyeball, 2].argmax()])
    return np.array([[a, b, pole] for a, b in zip(rim, rim[1:] + rim[:1], strict=True)])


def _least_area(rim: list[int], skin: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Triangulation of the polygon `rim` with the least area (dynamic programming over its chords).

    A chord that is an edge of the skin already is forbidden: four triangles would share it.
    """
    points, count = vertices[rim], len(rim)
    edges = {frozenset(pair) for a, b, c in skin.tolist() for pair in ((a, b), (b, c), (c, a))}
    cost, split = np.zeros((count, count)), np.zeros((count, count), int)
    for span in range(2, count):
        for i in range(count - span):
            k, between = i + span, np.arange(i + 1, i + span)
            area = np.linalg.norm(np.cross(points[between] - points[i], points[k] - points[i]), axis=1)
            total = cost[i, between] + cost[between, k] + area
            split[i, k] = between[total.argmin()]
            taken = k - i < count - 1 and frozenset((rim[i], rim[k])) in edges
            cost[i, k] = np.inf if taken else total.min()
    triangles, todo = [], [(0, count - 1)]
    while todo:
        i, k = todo.pop()
        if k - i > 1:
            m = split[i, k]
            triangles.append([rim[i], rim[m], rim[k]])
            todo += [(i, m), (m, k)]
    return np.array(triangles)
