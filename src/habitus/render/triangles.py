"""The renderer's currency: triangles with the faces around each of their edges, and what of them is
where on the screen: the nearest face at each pixel, the edges that jump, and where images take
their values.

Nothing here is differentiable: these are the choices that the differentiable operators build on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from habitus.errors import HabitusError
from habitus.kernels.threads import run_chunks
from habitus.render.kernels import images as image_kernels
from habitus.render.kernels.samples import LONG
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


@dataclass(frozen=True, eq=False)
class EdgeFragments:
    """S edge fragments, each within one pixel and sorted by pixel, and what an image jumps by
    there.

    ``image[pixel] += weight * (value at outer_point - value at inner_point)`` turns values at pixel
    centres into averages over pixels (`render/README.md`). All are decisions: none carries a
    derivative.
    """

    pixel: Int[Tensor, " S"]
    """row * width + column."""
    tail: Int[Tensor, " S"]
    """The vertex from where the edge runs, in the order of its face's corners."""
    head: Int[Tensor, " S"]
    """The vertex to where it runs."""
    face: Int[Tensor, " S"]
    """The face whose border the edge is: it lies inside."""
    seam: Bool[Tensor, " S"]
    """Whether the surface goes on outside: vertices are doubled there, and values may jump, but
    nothing is in front.
    """
    start: Float[Tensor, " S"]
    """Where the fragment begins: 0 at the tail, 1 at the head, linear on the screen."""
    end: Float[Tensor, " S"]
    """Where it ends."""
    outward: Float[Tensor, " S"]
    """1 or -1: with (du, dv) from tail to head, outward * (dv, -du) points to the outside."""
    weight: Float[Tensor, " S"]
    """The area of the pixel that the fragment cuts off, as seen from the centre; negative where
    that lies outside.
    """
    inner_face: Int[Tensor, " S"]
    """The face that shows at ``inner_point``; -1 where the background does."""
    outer_face: Int[Tensor, " S"]
    """The same at ``outer_point``."""
    inner_point: Float[Tensor, "S 2"]
    """A point (u, v) of the pixel on the inside, away from the edge."""
    outer_point: Float[Tensor, "S 2"]
    """The same on the outside."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """What is where on the screen: the nearest face at each pixel, -1 for none, and where images
    jump, if asked for.

    Samples, where images take their values, are listed when first wanted: the centres of `pixels`,
    those that show a face, then points beside fragments; `inner` and `outer` are the rows of the
    samples on the two sides of each fragment, -1 where the background shows. inverse: 1 / depth at
    the centres of pixels that show a face, where it is at hand. exact: whether fragments hold the
    areas of all faces in a pixel; then slivers count in full, as each counts for its area.
    """

    ids: Int[Tensor, "H W"]
    fragments: EdgeFragments | None
    inverse: Float[Tensor, "H W"] | None = None
    exact: bool = False

    def to(self, device: torch.device) -> "Visibility":
        """The same on another device."""
        fragments = self.fragments
        inverse = self.inverse
        if fragments is not None:
            fragments = EdgeFragments(*(field.to(device) for field in vars(fragments).values()))
        return Visibility(
            self.ids.to(device),
            fragments,
            None if inverse is None else inverse.to(device),
            self.exact,
        )

    @cached_property
    def _listed(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return outside(lambda ids: _list_samples(ids, self.fragments), self.ids)

    @property
    def pixels(self) -> Int[Tensor, " P"]:
        """The numbers (row * width + column) of pixels that show a face, ascending."""
        return self._listed[0]

    @property
    def faces(self) -> Int[Tensor, " N"]:
        """The face of each sample."""
        return self._listed[1]

    @property
    def points(self) -> Float[Tensor, "N 2"]:
        """The position (u, v) of each sample in pixels."""
        return self._listed[2]

    @property
    def inner(self) -> Int[Tensor, " S"]:
        """The sample on the inside of each fragment."""
        return self._listed[3]

    @property
    def outer(self) -> Int[Tensor, " S"]:
        """The sample on the outside of each fragment."""
        return self._listed[4]

    def without_fragments(self) -> "Visibility":
        """The same for images that are values at pixel centres."""
        return self if self.fragments is None else Visibility(self.ids, None, self.inverse)


def _list_samples(
    ids: Tensor, fragments: EdgeFragments | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The samples of pixels, and behind them those beside fragments; see `Visibility`."""
    if ids.device.type == "cpu":
        pixels, faces, points = (torch.from_numpy(array) for array in list_pixels(ids.numpy()))
    else:
        pixels, faces, points = list_pixels_reference(ids)
    if fragments is None:
        return pixels, faces, points, pixels[:0], pixels[:0]
    beside = torch.cat([fragments.inner_face, fragments.outer_face])
    shows = beside >= 0
    inner, outer = torch.where(shows, len(pixels) - 1 + torch.cumsum(shows, 0), -1).view(2, -1)
    more = torch.cat([fragments.inner_point, fragments.outer_point])[shows]
    return pixels, torch.cat([faces, beside[shows]]), torch.cat([points, more]), inner, outer


def list_pixels(ids: Int[np.ndarray, "H W"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pixels that show a face, row by row: numbers, faces, centres."""
    counts = np.empty(len(ids), np.int64)
    run_chunks(
        lambda _, begin, end: image_kernels.count_pixels(ids, begin, end, counts),
        len(ids),
        least=64,
    )
    offset = np.concatenate([[0], np.cumsum(counts)])
    pixels = np.empty(offset[-1], np.int64)
    faces = np.empty(offset[-1], np.int64)
    points = np.empty((offset[-1], 2))

    def work(_: int, begin: int, end: int) -> None:
        image_kernels.list_pixels(ids, offset, begin, end, pixels, faces, points)

    run_chunks(work, len(ids), least=64)
    return pixels, faces, points


def list_pixels_reference(
    ids: Int[Tensor, "H W"],
) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"], Float[Tensor, "P 2"]]:
    """Reference of `list_pixels`, on any device: numbers, faces and centres of pixels that show a
    face, row by row.
    """
    shown = (ids.flatten() >= 0).nonzero()[:, 0]
    return shown, ids.flatten()[shown].long(), pixel_centres(shown, ids.shape[1])


def pixel_centres(pixel: Int[Tensor, " K"], width: int) -> Float[Tensor, "K 2"]:
    """The centres (u, v) of pixels given by row * width + column."""
    return torch.stack([pixel % width, pixel // width], -1).double() + 0.5


def share_of_pixel(corners: Float[Tensor, "N 3 2"]) -> Float[Tensor, " N"]:
    """How much of a pixel a triangle on the screen can speak for, 1 but on slivers: twice height by
    length, up to 1.

    A sliver seen at a pixel's centre covers little of the pixel, but its values change without
    bounds as it moves: the fewer the pixels that meet it, the more. Only as much of that counts as
    it covers. Lengths beyond `LONG` are taken as that, so that small triangles are slivers by their
    form, not by their size.
    """
    sides = corners.roll(-1, 1) - corners
    double_area = (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).abs()
    length = sides.norm(dim=-1).amax(1)
    return (2.0 * double_area / (length * length.clamp(max=LONG))).clamp(max=1.0)
