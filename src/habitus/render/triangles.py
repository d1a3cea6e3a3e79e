"""The renderer's currency: triangles, and the faces around each of their edges."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from habitus.errors import HabitusError
from habitus.render.kernels.structs import EdgeLists
from habitus.render.transforms import outside

Array = Tensor | np.ndarray | Sequence
"""What is accepted where numbers arrive from a user."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles between vertices, and for each edge the faces around it: 1 at a border, 2 as a
    rule, more at a fork.

    Faces ``edge_face[edge_start[e]:edge_start[e + 1]]`` lie around edge e, in ascending order; the
    k-th runs along it from ``faces[edge_face[k], edge_corner[k]]`` to the corner after that. Ends
    of edges are compared after welding, so that copies of a vertex at the seam of a texture make no
    borders; ``faces`` keeps the copies' own numbers.
    """

    faces: Int[Tensor, "F 3"]
    num_vertices: int
    edge_start: Int[Tensor, " starts"]
    edge_face: Int[Tensor, " K"]
    edge_corner: Int[Tensor, " K"]
    edge_seam: Bool[Tensor, " E"]
    """Two or more faces that do not all name the same two vertices."""
    weld: Int[Tensor, " V"]
    """For each vertex the first one that is welded to it, often itself."""

    @classmethod
    def of(
        cls, faces: Array, positions: Array | None = None, num_vertices: int | None = None
    ) -> "Triangles":
        """Triangles of `faces` (F, 3), integers; none at all is allowed.

        Vertices with exactly equal `positions` (V, 3) are welded; without positions each is its
        own. A face with two welded corners stays in its place, but it has no edge between these and
        comes twice around its other edge. Everything lies on the device of `faces`. HabitusError:
        wrong shapes, other numbers than integers, indices out of range, a vertex that is not
        finite.
        """
        corners = _tensor("faces", faces)
        tensors = []
        if positions is not None:
            tensors = [_tensor("positions", positions)]
        return outside(lambda *plain: cls._of(num_vertices, *plain), corners, *tensors)

    @classmethod
    def _of(
        cls, num_vertices: int | None, faces: Tensor, positions: Tensor | None = None
    ) -> "Triangles":
        points = None if positions is None else checked_points(positions)
        corners, count = _checked_faces(
            faces, None if points is None else len(points), num_vertices
        )
        return cls.welded_as(
            corners, np.arange(count) if points is None else welded(points), faces.device
        )

    @classmethod
    def welded_as(
        cls, faces: np.ndarray, weld: np.ndarray, device: torch.device | str = "cpu"
    ) -> "Triangles":
        """Triangles of sound faces (F, 3) between vertices that are welded where `weld` (V,) has
        the same vertex.
        """
        welded = [
            torch.from_numpy(array).to(device) for array in (faces, *_edges(faces, weld), weld)
        ]
        return cls(welded[0], len(weld), *welded[1:])

    @cached_property
    def edge_pair(self) -> Int[Tensor, "E 2"]:
        """The two faces of an edge that both name its two vertices and run along it opposite ways;
        else -1, -1.

        Both sides of such an edge show, or its border does, according to whether both faces show
        the same side.
        """
        first = self.edge_start[:-1]
        many = self.edge_start.diff()
        simple = (many == 2) & ~self.edge_seam
        last = torch.where(simple, first + 1, first)
        faces = self.edge_face
        corners = self.edge_corner
        simple &= self.faces[faces[first], corners[first]] != self.faces[faces[last], corners[last]]
        return torch.where(simple[:, None], torch.stack([faces[first], faces[last]], 1), -1)

    @cached_property
    def edges(self) -> EdgeLists:
        """Faces and edges as kernels take them."""
        around = (self.edge_corner[:, None] + torch.arange(3, device=self.device)) % 3
        corners = self.faces[self.edge_face].gather(1, around)
        lists = self.faces, self.edge_start, self.edge_face, corners, self.edge_pair
        faces, start, face, ends, pair = (
            np.ascontiguousarray(array.cpu().numpy(), np.int32) for array in lists
        )
        return EdgeLists(faces, start, face, ends, self.edge_seam.cpu().numpy(), pair)

    @property
    def device(self) -> torch.device:
        """Where the triangles lie."""
        return self.faces.device

    def to(self, device: torch.device | str) -> "Triangles":
        """The same triangles on another device."""
        fields = (self.edge_start, self.edge_face, self.edge_corner, self.edge_seam, self.weld)
        return Triangles(
            self.faces.to(device), self.num_vertices, *(field.to(device) for field in fields)
        )


def join(*parts: Triangles) -> Triangles:
    """Several meshes as one: vertices and faces of the second come after those of the first, and so
    on.

    Edges stay as they are in each part: vertices of different parts are never welded.
    """
    if not parts:
        raise HabitusError("join got no triangles; expected at least one mesh")

    vertices, triangles, sides = (
        np.cumsum([0, *(measure(part) for part in parts)]).tolist()
        for measure in (
            lambda part: part.num_vertices,
            lambda part: len(part.faces),
            lambda part: len(part.edge_face),
        )
    )
    last = parts[-1].edge_start[-1:] + sides[-2]
    return Triangles(
        faces=torch.cat(
            [part.faces + offset for part, offset in zip(parts, vertices, strict=False)]
        ),
        num_vertices=vertices[-1],
        edge_start=torch.cat(
            [*(p.edge_start[:-1] + offset for p, offset in zip(parts, sides, strict=False)), last]
        ),
        edge_face=torch.cat(
            [part.edge_face + offset for part, offset in zip(parts, triangles, strict=False)]
        ),
        edge_corner=torch.cat([part.edge_corner for part in parts]),
        edge_seam=torch.cat([part.edge_seam for part in parts]),
        weld=torch.cat([part.weld + offset for part, offset in zip(parts, vertices, strict=False)]),
    )


def welded(points: np.ndarray) -> np.ndarray:
    """For each of (V, 3) points the first that has exactly the same coordinates."""
    order = np.lexsort(points.T)
    ordered = points[order]
    first = np.ones(len(points), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(1)
    result = np.empty(len(points), np.int64)
    result[order] = order[first][np.cumsum(first) - 1]
    return result


def _edges(
    faces: np.ndarray, weld: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """edge_start, edge_face, edge_corner, edge_seam."""
    count = len(weld)
    tail = faces.ravel()
    head = np.roll(faces, -1, 1).ravel()
    key = _pair(weld[tail], weld[head], count)
    real = np.flatnonzero(weld[tail] != weld[head])
    side = real[np.argsort(key[real], kind="stable")]
    key = key[side]
    names = _pair(tail, head, count)[side]
    first = np.ones(len(side), bool)
    first[1:] = key[1:] != key[:-1]
    start = np.append(np.flatnonzero(first), len(side))
    edge = np.cumsum(first) - 1
    seam = np.zeros(len(start) - 1, bool)
    seam[edge[names != names[start[edge]]]] = True
    return start, side // 3, side % 3, seam


def _pair(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """One number for two of `count`, whichever comes first."""
    return np.minimum(a, b) * count + np.maximum(a, b)


def _tensor(name: str, array: Array) -> Tensor:
    if isinstance(array, Tensor):
        return array
    try:
        return torch.from_numpy(np.array(array))
    except (TypeError, ValueError) as error:
        raise HabitusError(
            f"Got {name} that are no array of numbers; expected three numbers a row"
        ) from error


def checked_points(positions: Tensor) -> np.ndarray:
    """Plain positions (V, 3) as float64; HabitusError: another shape, no real numbers, a vertex
    that is not finite.
    """
    shape = tuple(positions.shape)
    kind = positions.dtype
    if len(shape) != 2 or shape[1] != 3:
        raise HabitusError(
            f"Got positions of shape {shape}; expected (V, 3): x, y, z of each vertex"
        )
    if kind.is_complex or kind == torch.bool:
        raise HabitusError(f"Got positions of type {kind}; expected real numbers")
    points = positions.cpu().double().numpy()
    if not np.isfinite(points).all():
        bad = np.flatnonzero(~np.isfinite(points).all(1))
        place = ", ".join(str(x) for x in points[bad[0]])
        raise HabitusError(
            f"Vertex {bad[0]} is at ({place}); expected finite numbers ({len(bad)} vertices have "
            "others)"
        )
    return points


def _checked_faces(
    faces: Tensor, points: int | None, num_vertices: int | None
) -> tuple[np.ndarray, int]:
    shape = tuple(faces.shape)
    kind = faces.dtype
    if len(shape) != 2 or shape[1] != 3:
        raise HabitusError(
            f"Got faces of shape {shape}; expected (F, 3): three vertices a triangle"
        )
    if kind.is_floating_point or kind.is_complex or kind == torch.bool:
        raise HabitusError(
            f"Got faces of type {kind}; expected whole numbers, the indices of vertices"
        )
    if points is not None and num_vertices not in (None, points):
        raise HabitusError(
            f"Got {points} positions and num_vertices={num_vertices}; expected the same number"
        )
    corners = faces.cpu().to(torch.int64, copy=True).numpy()
    count = points if points is not None else num_vertices
    if count is None:
        count = int(corners.max(initial=-1)) + 1
    if corners.size and (corners.min() < 0 or corners.max() >= count):
        row, corner = np.argwhere((corners < 0) | (corners >= count))[0]
        raise HabitusError(
            f"Face {row} names vertex {corners[row, corner]}; expected 0 to {count - 1}, as there "
            f"are {count} vertices"
        )
    return corners, count
