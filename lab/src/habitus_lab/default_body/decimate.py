"""Fewer vertices: half-edge collapses on the left half, ordered by quadrics summed over several
bodies.

A collapse moves a vertex onto a neighbour, so every kept vertex is an original one and all targets
and weights carry over by index. Vertices on the midline collapse only along it; mirroring the
result therefore gives a closed symmetric mesh. Garland, Heckbert 1997 ("Surface simplification
using quadric error metrics"), with one set of quadrics over all bodies.
"""

from __future__ import annotations

import heapq

import numpy as np

# share of squared edge length (times area) in the cost: it keeps flat regions from emptying
LENGTH_COST = 2e-3
SMALLEST_ANGLE = np.cos(
    np.radians(14.0)
)  # no collapse may leave a sharper corner than this, unless it was there before


class HalfMesh:
    """A triangle mesh with an open border, under half-edge collapses."""

    def __init__(
        self, bodies: np.ndarray, triangles: np.ndarray, weight: np.ndarray, fixed: np.ndarray
    ):
        """bodies (S,V,3) metres, triangles (F,3), weight (V,) importance, fixed (V,) vertices that
        must stay.
        """
        self.bodies = bodies
        self.faces = {k: tuple(map(int, t)) for k, t in enumerate(triangles)}
        self.around: dict[int, set[int]] = {}
        for k, t in self.faces.items():
            for v in t:
                self.around.setdefault(v, set()).add(k)
        self.weight = weight
        self.fixed = fixed
        self.border = self._border_vertices()
        self.quadrics = self._vertex_quadrics(triangles)

    def neighbours(self, v: int) -> set[int]:
        """Vertices that share an edge with v."""
        return {u for k in self.around[v] for u in self.faces[k]} - {v}

    def _border_vertices(self) -> set[int]:
        found = set()
        for v in self.around:
            for u in self.neighbours(v):
                if len(self.around[v] & self.around[u]) == 1:
                    found |= {u, v}
        return found

    def _vertex_quadrics(self, triangles: np.ndarray) -> np.ndarray:
        """(S,V,4,4): area-weighted squared distance to the planes of the triangles around each
        vertex, in each body.
        """
        quadrics = np.zeros((*self.bodies.shape[:2], 4, 4), np.float32)
        for body, out in zip(self.bodies, quadrics, strict=True):
            a, b, c = body[triangles].transpose(1, 0, 2)
            normal = np.cross(b - a, c - a)
            area = np.linalg.norm(normal, axis=1, keepdims=True)
            normal = normal / np.maximum(area, 1e-15)
            plane = np.concatenate([normal, -(normal * a).sum(1, keepdims=True)], 1)
            each = plane[:, :, None] * plane[:, None, :] * area[:, :, None]
            for corner in triangles.T:
                np.add.at(out, corner, each)
        return quadrics

    def cost(self, u: int, v: int) -> float:
        """Price of moving u onto v: mean over bodies of the quadric error, plus a little for long
        edges.
        """
        place = np.concatenate([self.bodies[:, v], np.ones((len(self.bodies), 1))], 1)
        quadric = self.quadrics[:, u] + self.quadrics[:, v]
        error = np.einsum("si,sij,sj->", place, quadric, place)
        edge = ((self.bodies[:, u] - self.bodies[:, v]) ** 2).sum(1)
        area = np.trace(self.quadrics[:, u, :3, :3], axis1=1, axis2=2)
        return float(
            self.weight[u]
            * (max(error, 0.0) + LENGTH_COST * (edge * area).sum())
            / len(self.bodies)
        )

    def allowed(self, u: int, v: int) -> bool:
        """True if moving u onto v keeps the half a manifold, the border straight and the triangles
        well shaped.
        """
        if self.fixed[u]:
            return False
        shared = self.around[u] & self.around[v]
        if u in self.border and (v not in self.border or len(shared) != 1):
            return False
        around_u = self.neighbours(u)
        around_v = self.neighbours(v)
        opposite = [w for k in shared for w in self.faces[k] if w not in (u, v)]
        if sorted(around_u & around_v) != sorted(opposite):
            return False
        if v in self.border and u not in self.border and (around_u & self.border) - around_v - {v}:
            return False
        if any(len(self.around[w]) <= 3 and w not in self.border for w in around_u & around_v):
            return False
        return self._keeps_shape(u, v, shared)

    def _keeps_shape(self, u: int, v: int, shared: set[int]) -> bool:
        changed = [self.faces[k] for k in self.around[u] - shared]
        if not changed:
            return False
        before = np.array(changed)
        after = np.where(before == u, v, before)
        old = self.bodies[:, before]
        new = self.bodies[:, after]  # (S,K,3 corners,3)
        old_normal = _normals(old)
        new_normal = _normals(new)
        turned = (old_normal * new_normal).sum(-1)
        size = np.linalg.norm(old_normal, axis=-1) * np.linalg.norm(new_normal, axis=-1)
        if (turned < 0.3 * size).any():
            return False
        return bool(_sharpest(new[0]) <= max(SMALLEST_ANGLE, _sharpest(old[0])))

    def collapse(self, u: int, v: int) -> set[int]:
        """Move u onto v; returns the vertices whose costs changed."""
        for k in self.around.pop(u):
            if v in self.faces[k]:
                for w in self.faces.pop(k):
                    if w != u:
                        self.around[w].discard(k)
            else:
                self.faces[k] = tuple(v if w == u else w for w in self.faces[k])
                self.around[v].add(k)
        self.quadrics[:, v] += self.quadrics[:, u]
        self.border.discard(u)
        return self.neighbours(v) | {v}


def decimate(
    bodies: np.ndarray,
    half: np.ndarray,
    weight: np.ndarray,
    fixed: np.ndarray,
    midline: np.ndarray,
    vertices: int,
) -> np.ndarray:
    """Triangles (F,3) of the left half such that both halves together have about `vertices`
    vertices.
    """
    mesh = HalfMesh(bodies, half, weight, fixed)
    stamp = dict.fromkeys(mesh.around, 0)
    queue = [(mesh.cost(u, v), 0, 0, u, v) for u in mesh.around for v in mesh.neighbours(u)]
    heapq.heapify(queue)
    count = sum(1 if midline[v] else 2 for v in mesh.around)
    while count > vertices and queue:
        _, stamp_u, stamp_v, u, v = heapq.heappop(queue)
        if stamp.get(u) != stamp_u or stamp.get(v) != stamp_v or not mesh.allowed(u, v):
            continue
        count -= 1 if midline[u] else 2
        stamp.pop(u)
        for w in mesh.collapse(u, v):
            stamp[w] += 1
        for w in mesh.neighbours(v) | {v}:
            for x in mesh.neighbours(w):
                heapq.heappush(queue, (mesh.cost(w, x), stamp[w], stamp[x], w, x))
                heapq.heappush(queue, (mesh.cost(x, w), stamp[x], stamp[w], x, w))
    return np.array(list(mesh.faces.values()))


def _normals(corners: np.ndarray) -> np.ndarray:
    return np.cross(
        corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    )


def _sharpest(corners: np.ndarray) -> float:
    """Largest cosine of any corner angle of triangles (K,3,3)."""
    edge = corners[:, [1, 2, 0]] - corners
    edge = edge / np.maximum(np.linalg.norm(edge, axis=-1, keepdims=True), 1e-12)
    return float(-(edge * edge[:, [2, 0, 1]]).sum(-1).min())
