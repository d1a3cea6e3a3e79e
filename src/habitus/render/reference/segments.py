"""Reference of the search for edges at which an image jumps, in plain torch, on any device.

An image jumps where a surface ends in front of another: at borders, at silhouettes (all faces of an
edge lie on one side of it) and at seams, whose two sides may differ in value. What each visible
edge fragment cuts off a pixel, as seen from the pixel's centre, tells how the average over the
pixel differs from the value at the centre; see `shadow`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.render.reference import faces as reference_faces
from habitus.render.reference.edges import Edges, jumping_edges
from habitus.render.reference.faces import DrawnFaces, Nearest, box_pixels, drawn_faces, expanded
from habitus.render.triangles import EdgeFragments, Triangles, pixel_centres

BESIDE = 1e-5
"""How far beside an edge the surface there is looked up, in pixels."""
HIDDEN = 1e-6
"""A surface hides an edge from this difference of 1 / depth on, relative to the edge's."""
SHORTEST = 1e-9
"""Parts shorter than this many pixels are left out."""
ENDS = 1e-3
"""How far from a fragment's ends it is tested whether they show, in lengths of the fragment."""
TOUCHING = 1e-9
"""What crosses a way at its beginning, in lengths of the way."""
TURN_STEPS = 14
"""Bisections of half a fragment on the way to the place where it disappears."""


@dataclass(frozen=True, eq=False)
class _Above:
    """Pairs of a drawn face `n` and a number of `count` points that it may cover: no other face
    covers that point.
    """

    drawn: DrawnFaces
    n: Int[Tensor, " K"]
    slot: Int[Tensor, " K"]
    count: int

    def __getitem__(self, chosen: Int[Tensor, " C"]) -> "_Above":
        number = chosen.new_full((self.count,), -1)
        number[chosen] = torch.arange(len(chosen), device=chosen.device)
        slot = number[self.slot]
        return _Above(self.drawn, self.n[slot >= 0], slot[slot >= 0], len(chosen))

    def nearest(self, points: Float[Tensor, "count 2"]) -> Nearest:
        """What is seen at the points."""
        nearest = Nearest(self.drawn, self.count)
        for n, slot in zip(
            self.n.split(reference_faces.AT_ONCE),
            self.slot.split(reference_faces.AT_ONCE),
            strict=True,
        ):
            nearest.add(n, slot, points[slot])
        return nearest


def edge_fragments(
    screen: Float[Tensor, "V 3"], triangles: Triangles, ids: Int[Tensor, "H W"], cull: bool = False
) -> EdgeFragments:
    """The visible fragments, a pixel each, of edges at which an image may jump.

    screen: u, v and depth of vertices. ids: the faces at the pixels' centres, as
    `reference.visible` gives them.

    Parts are cut at the image's and the pixels' borders, and where they disappear behind a surface,
    which is looked for in each half. `reference/edges.py` says which edges count.
    """
    height, width = ids.shape
    drawn = drawn_faces(screen, triangles, cull)
    edges = jumping_edges(drawn, triangles)
    edges, start, end = _pixel_fragments(edges, *_clipped(edges, width, height))
    most = torch.stack([torch.full_like(start, width - 1), torch.full_like(start, height - 1)], -1)
    column, row = edges.at((start + end) / 2).floor().clamp(min=0).minimum(most).long().unbind(-1)
    pixel = row * width + column

    above = _faces_above(drawn, pixel, width, height)
    shown, start, end = _shown(above, edges, start, end)
    shown = shown.nonzero()[:, 0]
    shown = shown[pixel[shown].argsort(stable=True)]
    above = above[shown]
    edges = edges[shown]
    start = start[shown]
    end = end[shown]
    pixel = pixel[shown]

    centre = pixel_centres(pixel, width)
    within = _centre_within(drawn, edges, centre)
    area = shadow(edges.at(start) - centre, edges.at(end) - centre)
    near, far, at_centre = _sample_points(edges, start, end, pixel, centre, within)
    near_face = torch.where(at_centre, ids.flatten()[pixel].long(), above.nearest(near).face())
    far_face = above.nearest(far).face()
    corners = triangles.faces[drawn.face[edges.n]]
    return EdgeFragments(
        pixel=pixel,
        tail=corners.gather(1, edges.corner[:, None])[:, 0],
        head=corners.gather(1, (edges.corner[:, None] + 1) % 3)[:, 0],
        face=drawn.face[edges.n],
        seam=edges.seam,
        start=start,
        end=end,
        outward=drawn.turn[edges.n],
        weight=torch.where(within, area, -area),
        inner_face=torch.where(within, near_face, far_face),
        outer_face=torch.where(within, far_face, near_face),
        inner_point=torch.where(within[:, None], near, far),
        outer_point=torch.where(within[:, None], far, near),
    )


def shadow(a: Float[Tensor, "S 2"], b: Float[Tensor, "S 2"]) -> Float[Tensor, " S"]:
    """The area of the unit square around 0 that lies behind the fragment from a to b, as seen from
    0.

    Colours are constant between edges, so the colour at a point of the square is that at its centre
    plus the jumps met on the straight way there; each jump counts for the area of all points whose
    way meets it. A wedge at the centre has a quarter of the way that it spans along the square's
    border, 4 long, as its area, for the border is 1/2 away everywhere; the triangle between the
    centre and the fragment does not belong. A fragment through the centre spans half the border,
    whichever way round.
    """
    way = (_along_border(a) - _along_border(b)).abs()
    return torch.minimum(way, 4 - way) / 4 - (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs() / 2


def _along_border(direction: Tensor) -> Tensor:
    """Where rays from the centre meet the unit square's border: the way along it, from 0 up to 4.

    A fragment that ends at the centre itself is seen from where the top-left rule takes the centre
    to be, a little to the right of it: its end lies to the left.
    """
    x, y = direction.unbind(-1)
    x = x.masked_fill((x == 0) & (y == 0), -1.0)
    flat = x.abs() >= y.abs()
    across = torch.where(x > 0, 0.5, 2.5) + y / (2 * x.where(flat, 1.0))
    upright = torch.where(y > 0, 1.5, 3.5) - x / (2 * y.where(~flat, 1.0))
    return torch.where(flat, across, upright)


def _centre_within(drawn: DrawnFaces, edges: Edges, centre: Tensor) -> Tensor:
    """Whether a centre lies on the inside of an edge's line, by the rasteriser's rule."""
    corner = edges.corner[:, None]
    side = drawn.sides(edges.n, centre).gather(1, corner)[:, 0]
    return (side > 0) | (side == 0) & drawn.owns[edges.n].gather(1, corner)[:, 0]


def _clipped(edges: Edges, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The parameters from and to which each edge lies in the image (Liang and Barsky 1984); start
    >= end: nowhere.
    """
    step = edges.head - edges.tail
    one = -edges.tail / step
    other = (step.new_tensor([width, height]) - edges.tail) / step
    one = one.where(~one.isnan(), -torch.inf)
    other = other.where(~other.isnan(), torch.inf)  # along the image's border
    near = torch.minimum(one, other)
    far = torch.maximum(one, other)
    return near.amax(-1).clamp(min=0), far.amin(-1).clamp(max=1)


def _pixel_fragments(edges: Edges, start: Tensor, end: Tensor) -> tuple[Edges, Tensor, Tensor]:
    """Edges from `start` to `end`, cut at the pixels' borders: for each fragment its edge, start
    and end.
    """
    met = start < end
    edges = edges[met]
    start = start[met]
    end = end[met]
    owner = torch.arange(len(start), device=start.device)
    cuts = [(owner, start), (owner, end)]
    for axis in (0, 1):
        ends = torch.stack([edges.at(start)[:, axis], edges.at(end)[:, axis]])
        first = ends.amin(0).floor() + 1
        last = ends.amax(0).ceil() - 1
        for e, k in expanded((last - first + 1).clamp(min=0).long()):
            t = (first[e] + k - edges.tail[e, axis]) / (edges.head - edges.tail)[e, axis]
            cuts.append((e, t.clamp(start[e], end[e])))
    owner, t = (torch.cat(values) for values in zip(*cuts, strict=True))
    order = t.argsort()
    order = order[owner[order].argsort(stable=True)]
    owner = owner[order]
    t = t[order]
    length = (t[1:] - t[:-1]) * (edges.head - edges.tail).norm(dim=-1)[owner[:-1]]
    real = (owner[1:] == owner[:-1]) & (length > SHORTEST)
    return edges[owner[:-1][real]], t[:-1][real], t[1:][real]


def _faces_above(drawn: DrawnFaces, pixel: Tensor, width: int, height: int) -> _Above:
    """For points in the given pixels, or up to 1e-5 beside, the faces whose boxes meet the
    pixel.
    """
    listed = pixel.argsort()
    count = pixel.bincount(minlength=width * height)
    first = count.cumsum(0) - count
    pairs = [(pixel[:0], pixel[:0])]
    for n, touched in box_pixels(drawn, width, height, 0.5 + 2 * BESIDE):
        for pair, k in expanded(count[touched]):
            pairs.append((n[pair], listed[first[touched[pair]] + k]))
    n, slot = (torch.cat(values) for values in zip(*pairs, strict=True))
    return _Above(drawn, n, slot, len(pixel))


def _shown(
    above: _Above, edges: Edges, start: Tensor, end: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Whether anything of each fragment shows, and from where to where: all, an end, the middle."""
    middle = (start + end) / 2
    ends = ENDS * (end - start)
    first, centre, last = (_shows(above, edges, t) for t in (start + ends, middle, end - ends))
    low = start.clone()
    high = end.clone()
    first_half = first != centre
    second_half = (centre != last) & ~(first & ~centre)
    for begin, stop, before, turns in (
        (start, middle, first, first_half),
        (middle, end, centre, second_half),
    ):
        k = turns.nonzero()[:, 0]
        turn = _turn(above[k], edges[k], begin[k], stop[k], before[k])
        low[k], high[k] = (
            torch.where(before[k], low[k], turn),
            torch.where(before[k], turn, high[k]),
        )
    return first | centre | last, low, high


def _shows(above: _Above, edges: Edges, t: Tensor) -> Tensor:
    """Whether nothing is in front of edges at their parameters t, looked up just outside them."""
    inverse = (1 - t) * edges.inverse[:, 0] + t * edges.inverse[:, 1]
    return (
        above.nearest(edges.at(t) + BESIDE * edges.outward).inverse_depth <= (1 + HIDDEN) * inverse
    )


def _turn(above: _Above, edges: Edges, low: Tensor, high: Tensor, before: Tensor) -> Tensor:
    """The parameter between two where an edge changes from `before` (visible or not) to the
    opposite.
    """
    for _ in range(TURN_STEPS):
        middle = (low + high) / 2
        same = _shows(above, edges, middle) == before
        low = torch.where(same, middle, low)
        high = torch.where(same, high, middle)
    return (low + high) / 2


def _sample_points(
    edges: Edges, start: Tensor, end: Tensor, pixel: Tensor, centre: Tensor, within: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Where the image is looked up on the centre's side of fragments and beyond, and whether the
    former is the centre.

    The line from the centre through the fragment's middle ends at the pixel's border, and other
    fragments may cross it. The far point lies halfway to what comes first beyond the fragment; the
    near one at the centre, or where a fragment lies between, halfway to that. So slanted is a
    surface at its silhouette that its value at the border itself says little about the pixel. Both
    keep 1e-5 pixels away from the fragment; where its line runs through the centre, they lie there
    beside its middle.
    """
    middle = edges.at((start + end) / 2)
    ray = middle - centre
    reach = ray.abs().amax(-1)
    before = torch.zeros_like(reach)
    after = torch.where(reach > 0, 0.5 / reach, 1.0)
    _, group, size = pixel.unique_consecutive(return_inverse=True, return_counts=True)
    first = size.cumsum(0) - size
    for fragment, k in expanded(size[group]):
        other = first[group[fragment]] + k
        fragment, other = fragment[fragment != other], other[fragment != other]
        tail = edges.tail[other] - centre[fragment]
        step = (edges.head - edges.tail)[other]
        across = _cross(ray[fragment], step)
        on_other = _cross(tail, ray[fragment]) / across
        at = _cross(tail, step) / across
        met = (across != 0) & (on_other >= start[other]) & (on_other <= end[other])
        between = met & (at >= -TOUCHING) & (at < 1)
        beyond = met & (at > 1)
        before.scatter_reduce_(0, fragment[between], at[between].clamp(min=TOUCHING), "amax")
        after.scatter_reduce_(0, fragment[beyond], at[beyond], "amin")
    beside = BESIDE * torch.where(within, 1, -1)[:, None] * edges.outward
    height = (ray * beside).sum(-1) / BESIDE
    at_centre = before == 0
    through = height < BESIDE
    near = torch.where(at_centre, 0.0, (1 + before) / 2)
    far = (1 + after) / 2
    back = ~at_centre & ((1 - near) * height < BESIDE)
    on = (far - 1) * height < BESIDE
    near_point = centre + near[:, None] * ray - torch.where(back[:, None], beside, 0.0)
    far_point = centre + far[:, None] * ray + torch.where(on[:, None], beside, 0.0)
    near_point = torch.where(through[:, None], middle - beside, near_point)
    far_point = torch.where(through[:, None], middle + beside, far_point)
    return near_point, far_point, at_centre & ~through


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
