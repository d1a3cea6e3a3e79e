"""Coarse bodies for toy-sized training: some of a body's own vertices, so that all its arrays carry
over by number.

Vertices of the left half are moved onto neighbours, those first that change the surface least, and
the result is mirrored: closed and exactly symmetric. Garland, Heckbert 1997 ("Surface
simplification using quadric error metrics").
"""

import heapq
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from habitus.body.model import BodyModel
from habitus.errors import HabitusError

# share of squared edge length (times area) in the cost: it keeps flat regions from emptying
LENGTH_COST = 0.02
TURN = 0.2  # smallest cosine between a triangle's normals before and after a collapse
SHARPEST = np.cos(
    np.radians(12.0)
)  # no collapse may leave a sharper corner, unless it was there before
NEAREST = 200  # vertices that a coarse body's joint may be regressed from


def coarse_body(body: BodyModel, vertices: int) -> BodyModel:
    """``body`` (closed, symmetric, its ``mirror`` known) with about ``vertices`` of its vertices.

    Template, shape directions and weights are those of the vertices kept; joints are regressed anew
    from the vertices near them: within 1 mm of the template's own, further off for unusual people.
    Eyes and other parts apart from the skin are left out, as are landmarks whose vertex is gone,
    pose blend shapes (for others to be planted), ages, faces, expressions and dynamics. Raises
    HabitusError where the body has no exact mirror image or so few vertices cannot be reached.
    """
    if body.mirror is None:
        raise HabitusError(f"{body.name} cannot be made coarse: expected one that knows its mirror")
    mirror = body.mirror
    points = body.v_template
    half = _left_half(_skin(body.faces), mirror, points, body.name)
    left = collapse_half(points, half, mirror == np.arange(len(mirror)), vertices)
    faces = np.concatenate([left, mirror[left][:, ::-1]])
    keep = np.unique(faces)
    place = np.full(len(points), -1)
    place[keep] = np.arange(len(keep))
    partner = place[mirror[keep]]
    return replace(
        body,
        name=f"{body.name}, {len(keep)} vertices",
        v_template=body.v_template[keep],
        shapedirs=body.shapedirs[keep],
        posedirs=None,
        pose_joints=None,
        joint_regressor=_regress_joints(body, keep, partner),
        skinning_index=body.skinning_index[keep],
        skinning_value=body.skinning_value[keep],
        faces=place[faces],
        landmarks=MappingProxyType(
            {k: int(place[v]) for k, v in body.landmarks.items() if place[v] >= 0}
        ),
        part=None if body.part is None else body.part[keep],
        mirror=partner,
        expressiondirs=None,
        face=None,
        dynamics=None,
        ages=None,
        mesh=None,
        finer=None,
        full_vertices=None,
        pockets=None,
    )


def _skin(faces: np.ndarray) -> np.ndarray:
    """The faces of the largest part that hangs together."""
    size = int(faces.max()) + 1
    edges = coo_array(
        (np.ones(2 * len(faces)), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())),
        (size, size),
    )
    part = connected_components(edges, directed=False)[1][faces[:, 0]]
    return faces[part == np.bincount(part).argmax()]


def _left_half(faces: np.ndarray, mirror: np.ndarray, points: np.ndarray, name: str) -> np.ndarray:
    left = np.all((points[faces][..., 0] > 0) | (mirror[faces] == faces), axis=1)
    whole = np.concatenate([faces[left], mirror[faces[left]]])
    if {tuple(sorted(face)) for face in whole.tolist()} != {
        tuple(sorted(face)) for face in faces.tolist()
    }:
        raise HabitusError(
            f"{name} cannot be made coarse: its faces are no two mirror images that meet at x = 0"
        )
    return faces[left]


def _regress_joints(
    body: BodyModel, rows: Int[np.ndarray, " K"], partner: Int[np.ndarray, " K"]
) -> Float[np.ndarray, "J K"]:
    """Convex weights of near vertices that give the body's joints in its template and along its
    shape directions.
    """
    vertices = body.v_template[rows]
    moved = body.shapedirs[rows].swapaxes(1, 2)  # (K, B, 3)
    surfaces = np.concatenate([vertices[:, None], vertices[:, None] + moved], 1).reshape(
        len(rows), -1
    )
    template = body.joint_template
    joints = template[:, None] + body.joint_shapedirs.swapaxes(1, 2)
    joints = np.concatenate([template[:, None], joints], 1).reshape(body.num_joints, -1)
    regressor = np.zeros((body.num_joints, len(rows)))
    for row, target, joint in zip(regressor, joints, template, strict=True):
        near = np.argsort(np.linalg.norm(vertices - joint, axis=1), kind="stable")[:NEAREST]
        row[near] = nnls(
            np.vstack([surfaces[near].T, np.full(len(near), 10.0)]), np.append(target, 10.0)
        )[0]
        row /= row.sum()
    regressor = (regressor + regressor[mirrored_names(body.joint_names)][:, partner]) / 2
    return regressor / regressor.sum(1, keepdims=True)


def mirrored_names(joint_names: tuple[str, ...]) -> Int[np.ndarray, " J"]:
    """The joint on the other side, by the names left_ and right_; itself in the middle."""
    other = {"left": "right", "right": "left"}
    names = ["_".join(other.get(word, word) for word in name.split("_")) for name in joint_names]
    return np.array(
        [joint_names.index(name) if name in joint_names else k for k, name in enumerate(names)]
    )


def collapse_half(
    points: Float[np.ndarray, "V 3"],
    half: Int[np.ndarray, "F 3"],
    middle: np.ndarray,
    vertices: int,
) -> Int[np.ndarray, "G 3"]:
    """Faces left of a half body (m), its border the ``middle`` vertices, when both halves have
    about ``vertices``.
    """
    mesh = _Half(points, half, middle)
    count = sum(1 if middle[v] else 2 for v in mesh.around)
    queue = [(mesh.cost(u, v), u, v) for u in mesh.around for v in mesh.neighbours(u)]
    heapq.heapify(queue)
    while count > vertices and queue:
        cost, u, v = heapq.heappop(queue)
        if u not in mesh.around or v not in mesh.neighbours(u):
            continue
        if (now := mesh.cost(u, v)) > cost:  # costs only grow: this one has its turn later
            heapq.heappush(queue, (now, u, v))
        elif mesh.allowed(u, v):
            count -= 1 if middle[u] else 2
            mesh.collapse(u, v)
            for w in mesh.neighbours(v):
                heapq.heappush(queue, (mesh.cost(w, v), w, v))
                heapq.heappush(queue, (mesh.cost(v, w), v, w))
    if count > vertices:
        raise HabitusError(
            f"{vertices} vertices asked of a coarse body; {count} is as few as stay closed and "
            "well shaped"
        )
    return np.array(list(mesh.faces.values()))


class _Half:
    """A triangle mesh with an open border, under collapses of one vertex onto another."""

    def __init__(self, points: np.ndarray, half: np.ndarray, middle: np.ndarray):
        self.points = points
        self.middle = middle
        self.faces = {k: tuple(face) for k, face in enumerate(half.tolist())}
        self.around: dict[int, set[int]] = {}
        for k, face in self.faces.items():
            for v in face:
                self.around.setdefault(v, set()).add(k)
        normals = _normals(points[half])
        area = np.linalg.norm(normals, axis=1, keepdims=True)
        plane = normals / np.maximum(area, 1e-30)
        plane = np.concatenate([plane, -(plane * points[half[:, 0]]).sum(1, keepdims=True)], 1)
        self.quadrics = np.zeros(
            (len(points), 4, 4)
        )  # squared distances to the planes that meet at a vertex
        for corner in half.T:
            np.add.at(
                self.quadrics, corner, plane[:, :, None] * plane[:, None, :] * area[:, :, None]
            )
        self.areas = np.trace(self.quadrics[:, :3, :3], axis1=1, axis2=2)

    def cost(self, u: int, v: int) -> float:
        """Cost of collapsing u onto v: distance of v from the planes at either, plus a little for
        long edges.
        """
        place = np.append(self.points[v], 1.0)
        edge = self.points[u] - self.points[v]
        off = place @ (self.quadrics[u] + self.quadrics[v]) @ place
        return float(max(off, 0.0) + LENGTH_COST * (edge @ edge) * self.areas[u])

    def neighbours(self, v: int) -> set[int]:
        """Vertices that share an edge with v."""
        return {u for k in self.around[v] for u in self.faces[k]} - {v}

    def allowed(self, u: int, v: int) -> bool:
        """True if the half and its mirror image stay one closed manifold of well shaped
        triangles.
        """
        shared = self.around[u] & self.around[v]
        if self.middle[u] and (not self.middle[v] or len(shared) != 1):
            return False
        around_u = self.neighbours(u)
        around_v = self.neighbours(v)
        opposite = {w for k in shared for w in self.faces[k]} - {u, v}
        if around_u & around_v != opposite:
            return False
        if any(len(self.around[w]) <= (2 if self.middle[w] else 3) for w in opposite):
            return False
        if (
            self.middle[v]
            and not self.middle[u]
            and any(self.middle[w] for w in around_u - around_v - {v})
        ):
            return False
        return self._keeps_shape(u, v, shared)

    def _keeps_shape(self, u: int, v: int, shared: set[int]) -> bool:
        before = np.array([self.faces[k] for k in self.around[u] - shared])
        if not len(before):
            return False
        old = self.points[before]
        new = self.points[np.where(before == u, v, before)]
        was = _normals(old)
        now = _normals(new)
        turned = (was * now).sum(1) < TURN * np.linalg.norm(was, axis=1) * np.linalg.norm(
            now, axis=1
        )
        return not turned.any() and _sharpest(new) <= max(SHARPEST, _sharpest(old))

    def collapse(self, u: int, v: int) -> None:
        """Move u onto v."""
        for k in self.around.pop(u):
            if v in self.faces[k]:
                for w in self.faces.pop(k):
                    if w != u:
                        self.around[w].discard(k)
            else:
                self.faces[k] = tuple(v if w == u else w for w in self.faces[k])
                self.around[v].add(k)
        self.quadrics[v] += self.quadrics[u]
        self.areas[v] += self.areas[u]


def _normals(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _sharpest(corners: np.ndarray) -> float:
    """Largest cosine of any corner of triangles (K, 3, 3)."""
    edge = corners[:, [1, 2, 0]] - corners
    edge = edge / np.maximum(np.linalg.norm(edge, axis=-1, keepdims=True), 1e-12)
    return float(-(edge * edge[:, [2, 0, 1]]).sum(-1).min())
