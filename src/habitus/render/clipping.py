"""Near-plane clipping: what of triangles lies in front of a camera, cut in space, as lenses bend
edges.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.errors import HabitusError
from habitus.render.transforms import outside
from habitus.render.triangles import Triangles, checked_points


@dataclass(frozen=True, eq=False)
class Clipped:
    """What is left of V vertices and their triangles in front of a plane, with K new vertices where
    it cuts edges.

    Values at corners that have an indexing of their own, such as texture coordinates, come from
    ``corner_weights @ values[own_faces[source_face]]``, of shape (F', 3, C).
    """

    triangles: Triangles
    """Whole and cut triangles in the order of what they come from; V + K vertices, welded where
    they were.
    """
    source_face: Int[Tensor, " F"]
    points: Float[Tensor, "N 3"]
    """All V + K vertices, fit to be projected: new ones at z = near, ones behind (no longer used)
    at (0, 0, near).
    """
    cut_ends: Int[Tensor, "K 2"]
    """The vertices behind and in front between which each new vertex lies."""
    cut_fraction: Float[Tensor, " K"]
    """And where: 0 at the one behind, 1 at the one in front."""
    corner_ends: Int[Tensor, "F 3 2"]
    corner_cut: Int[Tensor, "F 3"]
    num_source_faces: int
    """How many triangles there were before."""

    def extend(self, values: Float[Tensor, " V *C"]) -> Float[Tensor, " N *C"]:
        """Values at vertices, with those at the new vertices behind them, linear along the cut
        edges in space.
        """
        if len(values) != self.triangles.num_vertices - len(self.cut_ends):
            vertices = self.triangles.num_vertices - len(self.cut_ends)
            raise HabitusError(
                f"Got values of shape {tuple(values.shape)}; expected a row for each of "
                f"{vertices} vertices"
            )
        return torch.cat([values, _between(values, self.cut_ends, self.cut_fraction)])

    @property
    def corner_weights(self) -> Float[Tensor, "F 3 3"]:
        """Each corner of the triangles as weights of the three corners of its source; rows sum to
        1.
        """
        fraction = torch.cat([self.cut_fraction, self.cut_fraction.new_zeros(1)])[
            self.corner_cut, None
        ]
        behind, front = torch.eye(3, dtype=fraction.dtype, device=fraction.device)[
            self.corner_ends
        ].unbind(2)
        return (1 - fraction) * behind + fraction * front


def clip_near(points: Float[Tensor, "V 3"], triangles: Triangles, near: float) -> Clipped | None:
    """The part of triangles with z >= near > 0 (m) in camera space; None if all vertices are there,
    used or not.

    A triangle that the plane crosses becomes one or two; neighbours share the vertices on their cut
    edge, so that no crack opens. What lies behind is dropped, also a triangle that only touches the
    plane from there. Positions, values and weights are differentiable in `points` and values.
    HabitusError: wrong shapes, a vertex that is not finite.
    """
    if not 0 < near < float("inf"):
        raise HabitusError(f"Got near={near}; expected a positive distance in metres")
    if tuple(points.shape) != (triangles.num_vertices, 3):
        raise HabitusError(
            f"Got points of shape {tuple(points.shape)}; expected ({triangles.num_vertices}, 3)"
        )
    plan = outside(lambda fixed: _plan(fixed, triangles, near), points)
    if plan is None:
        return None
    clipped, source, behind, ends, corner_ends, corner_cut = plan
    z = points[:, 2]
    fraction = (near - z[ends[:, 0]]) / (z[ends[:, 1]] - z[ends[:, 0]])
    axis = torch.tensor([0.0, 0.0, near], dtype=points.dtype, device=points.device)
    flat = _between(points[:, :2], ends, fraction)
    cut = torch.cat([flat, axis[2].expand(len(ends), 1)], 1)
    kept = torch.cat([torch.where(behind[:, None], axis, points), cut])
    return Clipped(
        clipped, source, kept, ends, fraction, corner_ends, corner_cut, len(triangles.faces)
    )


def _between(values: Tensor, ends: Tensor, fraction: Tensor) -> Tensor:
    """Values between two ends. Copies of an edge get bitwise equal ones, as ends are in order and
    products rounded.
    """
    fraction = fraction.to(values.dtype).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - fraction) * values[ends[:, 0]] + fraction * values[ends[:, 1]]


def _plan(
    points: Tensor, triangles: Triangles, near: float
) -> tuple[Triangles, *tuple[Tensor, ...]] | None:
    """What does not vary with small changes: triangles, source_face, vertices behind (V,),
    cut_ends, corner_ends, corner_cut.
    """
    if not len(points) or bool((points[:, 2].amin() >= near) & points.sum().isfinite()):
        return None
    z = checked_points(points)[:, 2]
    near = torch.tensor(near, dtype=points.dtype).item()
    faces = triangles.faces.cpu().numpy()
    weld = triangles.weld.cpu().numpy()
    source, local = _parts((z > near).astype(np.int8)[faces] - (z < near).astype(np.int8)[faces])
    ends, new_faces, corner_cut = _numbered(faces[source[:, None, None], local], len(z))
    _, first, inverse = np.unique(weld[ends] @ [len(z), 1], return_index=True, return_inverse=True)
    new_weld = np.concatenate([weld, len(z) + first[inverse]])
    arrays = (source, z < near, ends, local, corner_cut)
    whole = len(source) == len(faces) and not len(ends)
    new = triangles if whole else Triangles.welded_as(new_faces, new_weld, points.device)
    return new, *(torch.from_numpy(array).to(points.device) for array in arrays)


def _parts(side: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Source faces (F',) of the parts in front, and their corners (F', 3, 2) as corners of the
    source.

    `side` (F, 3) is 1 for a corner in front of the plane, 0 on it, -1 behind. A new corner lies
    between a source's corner behind and one in front, in that order; an old one is given twice.
    """
    front = (side > 0).sum(1)
    back = (side < 0).any(1)
    whole, tips, stumps = (
        np.flatnonzero(kind) for kind in (~back, back & (front == 1), back & (front == 2))
    )
    f = (side[tips] > 0).argmax(1)
    p = (f + 1) % 3
    q = (f + 2) % 3
    p_to, q_to = (
        np.where(np.take_along_axis(side[tips], c[:, None], 1)[:, 0] < 0, f, c) for c in (p, q)
    )
    tip = np.stack([f, f, p, p_to, q, q_to], 1)
    b = (side[stumps] < 0).argmax(1)
    p = (b + 1) % 3
    q = (b + 2) % 3
    first = np.stack([b, p, p, p, q, q], 1)
    second = np.stack([b, p, q, q, b, q], 1)
    old = np.broadcast_to(np.array([0, 0, 1, 1, 2, 2]), (len(whole), 6))
    source = np.concatenate([whole, tips, stumps, stumps])
    order = np.argsort(source, kind="stable")
    return source[order], np.concatenate([old, tip, first, second])[order].reshape(-1, 3, 2)


def _numbered(named: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number the cuts between two different vertices from `count` on: ends (K, 2), faces (F', 3),
    cuts (F', 3) or K.
    """
    behind = named[..., 0]
    front = named[..., 1]
    cut = behind != front
    keys, which = np.unique(behind[cut] * count + front[cut], return_inverse=True)
    corner_cut = np.full(behind.shape, len(keys))
    corner_cut[cut] = which
    return (
        np.stack([keys // count, keys % count], 1),
        np.where(cut, count + corner_cut, behind),
        corner_cut,
    )
