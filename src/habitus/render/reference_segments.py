"""The slow, clear twin of the search for edges at which an image jumps. Plain torch, on any device.

An image jumps where a surface ends in front of another: at borders, at silhouettes (all faces of an edge lie on one
side of it) and at seams, whose two sides may differ in value. What each visible part of an edge cuts off a pixel, as
seen from the pixel's centre, tells how the average over the pixel differs from the value at the centre; see `shadow`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.render.reference import DrawnFaces, Nearest, box_pixels, drawn_faces, expanded, pixel_centres
from habitus.render.segments import Segments
from habitus.render.triangles import Triangles

BESIDE = 1e-5
"""How far outside an edge the surface behind it is looked up, in pixels."""
HIDDEN = 1e-6
"""A surface hides an edge from this difference of 1 / depth on, relative to the edge's."""
SHORTEST = 1e-9
"""Parts shorter than this many pixels are left out."""


@dataclass(frozen=True, eq=False)
class _Edges:
    """E edges at which an image may jump: each is edge `corner` of the drawn face `n`, its inside face."""

    n: Int[Tensor, " E"]
    corner: Int[Tensor, " E"]
    tail: Float[Tensor, "E 2"]
    head: Float[Tensor, "E 2"]
    outward: Float[Tensor, "E 2"]
    """Unit normals."""

    def __getitem__(self, chosen: Tensor) -> "_Edges":
        return _Edges(*(field[chosen] for field in vars(self).values()))

    def at(self, t: Float[Tensor, " E"]) -> Float[Tensor, "E 2"]:
        """A point of each; both ends exactly, so that edges with a common end agree on it."""
        return torch.where(t[:, None] == 1, self.head, self.tail + t[:, None] * (self.head - self.tail))


def segments(
    screen: Float[Tensor, "V 3"], triangles: Triangles, width: int, height: int, cull: bool = False
) -> Segments:
    """The visible parts, a pixel each, of edges at which an image may jump; `screen` holds u, v and depth.

    An edge counts whose drawn faces all lie on one side of its line (a border, a silhouette), or that is a seam. Its
    inside face is the one nearest to the eye just beside the edge: 1 / depth grows fastest inwards; of equal ones the
    first. A seam with faces on both sides takes the side where the edge function is positive. Parts are cut at the
    image's and the pixels' borders. What lies outside is the nearest face 1e-5 pixels from the part's middle; one that
    is nearer than the edge hides the part.
    """
    drawn = drawn_faces(screen, triangles, cull)
    edges = _jumping_edges(drawn, triangles)
    edges, start, end = _pixel_parts(edges, *_clipped(edges, width, height))
    corners = triangles.faces[drawn.face[edges.n]]
    tail, head = (corners.gather(1, corner[:, None])[:, 0] for corner in (edges.corner, (edges.corner + 1) % 3))
    middle = (start + end) / 2
    point = edges.at(middle)
    column, row = (
        at.floor().clamp(0, size - 1).long() for at, size in zip(point.unbind(-1), (width, height), strict=True)
    )
    pixel = row * width + column

    outside, inverse = _nearest_at(drawn, point + BESIDE * edges.outward, pixel, width, height)
    depth = screen.detach().double()[:, 2]
    shown = inverse <= (1 + HIDDEN) * ((1 - middle) / depth[tail] + middle / depth[head])
    weight = _weight(drawn, edges, start, end, pixel_centres(pixel, width))
    fields = (pixel, tail, head, drawn.face[edges.n], outside, start, end, drawn.turn[edges.n], weight, point)
    return Segments(*(field[shown] for field in fields))


def segment_weights(screen: Float[Tensor, "V 3"], segments: Segments) -> Float[Tensor, " S"]:
    """The parts' weights, which change with the screen as the true areas do. Differentiable.

    A part that moves by d sweeps the area of its normal's velocity, integrated along it; an area's derivative needs no
    more (Reynolds' transport theorem). With n = outward (dv, -du), as long as the edge, and m the part's middle, that
    is (end - start) n . ((1 - m) d_tail + m d_head). The weight falls by it where the inside grows.
    """
    tail, head = (screen.index_select(0, vertex)[:, :2] for vertex in (segments.tail, segments.head))
    du, dv = (head - tail).detach().unbind(-1)
    normal = segments.outward[:, None].to(screen.dtype) * torch.stack([dv, -du], -1)
    middle = ((segments.start + segments.end) / 2)[:, None].to(screen.dtype)
    moved = (1 - middle) * (tail - tail.detach()) + middle * (head - head.detach())
    swept = (segments.end - segments.start).to(screen.dtype) * (normal * moved).sum(-1)
    return segments.weight.to(screen.dtype) - swept


def shadow(a: Float[Tensor, "S 2"], b: Float[Tensor, "S 2"]) -> Float[Tensor, " S"]:
    """The area of the unit square around 0 that lies behind the part from a to b, as seen from 0.

    Colours are constant between edges, so the colour at a point of the square is that at its centre plus the jumps met
    on the straight way there; each jump counts for the area of all points whose way meets it. A wedge at the centre has
    a quarter of the way that it spans along the square's border, 4 long, as its area, for the border is 1/2 away
    everywhere; the triangle between the centre and the part does not belong. A part through the centre spans half the
    border, whichever way round.
    """
    way = (_along_border(a) - _along_border(b)).abs()
    return torch.minimum(way, 4 - way) / 4 - (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs() / 2


def _along_border(direction: Tensor) -> Tensor:
    """Where rays from the centre meet the unit square's border: the way along it, from 0 up to 4.

    A part that ends at the centre itself is seen from where the top-left rule takes the centre to be, a little to the
    right of it: its end lies to the left.
    """
    x, y = direction.unbind(-1)
    x = x.masked_fill((x == 0) & (y == 0), -1.0)
    flat = x.abs() >= y.abs()
    across = torch.where(x > 0, 0.5, 2.5) + y / (2 * x.where(flat, 1.0))
    upright = torch.where(y > 0, 1.5, 3.5) - x / (2 * y.where(~flat, 1.0))
    return torch.where(flat, across, upright)


def _weight(drawn: DrawnFaces, edges: _Edges, start: Tensor, end: Tensor, centre: Tensor) -> Tensor:
    """The shadows of parts in their pixels: positive where the centre lies on the inside, by the rasteriser's rule."""
    corner = edges.corner[:, None]
    side = drawn.sides(edges.n, centre).gather(1, corner)[:, 0]
    within = (side > 0) | (side == 0) & drawn.owns[edges.n].gather(1, corner)[:, 0]
    area = shadow(edges.at(start) - centre, edges.at(end) - centre)
    return torch.where(within, area, -area)


def _jumping_edges(drawn: DrawnFaces, triangles: Triangles) -> _Edges:
    """The edges that count, with their inside faces."""
    number = drawn.face.new_full((len(triangles.faces),), -1)
    number[drawn.face] = torch.arange(len(drawn.face), device=number.device)
    count = len(triangles.edge_start) - 1
    edge = torch.arange(count, device=number.device).repeat_interleave(triangles.edge_start.diff())
    n, corner = number[triangles.edge_face], triangles.edge_corner
    edge, n, corner = edge[n >= 0], n[n >= 0], corner[n >= 0]

    tail, head = drawn.corners[n, corner], drawn.corners[n, (corner + 1) % 3]
    step = head - tail
    outward = drawn.turn[n, None] * torch.stack([step[:, 1], -step[:, 0]], -1) / step.norm(dim=-1, keepdim=True)
    around = _Edges(n, corner, tail, head, outward)

    side = _line_sides(drawn, around, edge, count)
    low, high = (side.new_zeros(count).scatter_reduce_(0, edge, side, how) for how in ("amin", "amax"))
    jumps = (low * high == 0) | triangles.edge_seam
    growth = -(drawn.slope[n] * outward).sum(-1).nan_to_num()
    growth = growth.where(side == torch.where(high > 0, high, low)[edge], -torch.inf)
    most = growth.new_full((count,), -torch.inf).scatter_reduce_(0, edge, growth, "amax")
    first = _first(edge, growth == most[edge], count)
    return around[first[jumps & (first < len(n))]]


def _line_sides(drawn: DrawnFaces, around: _Edges, edge: Tensor, count: int) -> Tensor:
    """The sign of the edge function of each edge's line where its faces are: one number for each face around it.

    Faces around a seam may name different copies of its vertices, whose places can differ by rounding. So the line is
    that of the first face, and the others run along it or against it by their directions.
    """
    step = around.head - around.tail
    first = _first(edge, torch.ones_like(edge, dtype=torch.bool), count)[edge]
    alike = 1 - 2 * ((step * step[first]).sum(-1) < 0).double()
    return drawn.turn[around.n] * alike * drawn.along[around.n, around.corner][first]


def _first(edge: Tensor, real: Tensor, count: int) -> Tensor:
    """For each of `count` edges its first entry that is `real`; len(edge) where it has none."""
    entry = torch.arange(len(edge), device=edge.device)
    return edge.new_full((count,), len(edge)).scatter_reduce_(0, edge[real], entry[real], "amin")


def _clipped(edges: _Edges, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The parameters from and to which each edge lies in the image (Liang and Barsky 1984); start >= end: nowhere."""
    step = edges.head - edges.tail
    one, other = -edges.tail / step, (step.new_tensor([width, height]) - edges.tail) / step
    one, other = one.where(~one.isnan(), -torch.inf), other.where(~other.isnan(), torch.inf)  # along the image's border
    near, far = torch.minimum(one, other), torch.maximum(one, other)
    return near.amax(-1).clamp(min=0), far.amin(-1).clamp(max=1)


def _pixel_parts(edges: _Edges, start: Tensor, end: Tensor) -> tuple[_Edges, Tensor, Tensor]:
    """Edges from `start` to `end`, cut at the pixels' borders: for each part its edge, start and end."""
    met = start < end
    edges, start, end = edges[met], start[met], end[met]
    owner = torch.arange(len(start), device=start.device)
    cuts = [(owner, start), (owner, end)]
    for axis in (0, 1):
        ends = torch.stack([edges.at(start)[:, axis], edges.at(end)[:, axis]])
        first, last = ends.amin(0).floor() + 1, ends.amax(0).ceil() - 1
        for e, k in expanded((last - first + 1).clamp(min=0).long()):
            t = (first[e] + k - edges.tail[e, axis]) / (edges.head - edges.tail)[e, axis]
            cuts.append((e, t.clamp(start[e], end[e])))
    owner, t = (torch.cat(values) for values in zip(*cuts, strict=True))
    order = t.argsort()
    order = order[owner[order].argsort(stable=True)]
    owner, t = owner[order], t[order]
    length = (t[1:] - t[:-1]) * (edges.head - edges.tail).norm(dim=-1)[owner[:-1]]
    real = (owner[1:] == owner[:-1]) & (length > SHORTEST)
    return edges[owner[:-1][real]], t[:-1][real], t[1:][real]


def _nearest_at(drawn: DrawnFaces, points: Tensor, pixel: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The nearest face (-1: none) and its 1 / depth (-inf) at points in, or up to 1e-5 beside, given pixels."""
    nearest = Nearest(drawn, len(points))
    listed = pixel.argsort()
    count = pixel.bincount(minlength=width * height)
    first = count.cumsum(0) - count
    for n, touched in box_pixels(drawn, width, height, 0.5 + 2 * BESIDE):
        for pair, k in expanded(count[touched]):
            slot = listed[first[touched[pair]] + k]
            nearest.add(n[pair], slot, points[slot])
    return nearest.face(), nearest.inverse_depth
