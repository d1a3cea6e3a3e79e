"""Which edges may show a jump of an image, for the reference of the search for them. Plain torch,
on any device.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from habitus.render.reference.faces import DrawnFaces
from habitus.render.triangles import Triangles


@dataclass(frozen=True, eq=False)
class Edges:
    """E edges at which an image may jump: each is edge `corner` of the drawn face `n`, its inside
    face.
    """

    n: Int[Tensor, " E"]
    corner: Int[Tensor, " E"]
    seam: Bool[Tensor, " E"]
    """Whether faces lie on both sides."""
    tail: Float[Tensor, "E 2"]
    head: Float[Tensor, "E 2"]
    inverse: Float[Tensor, "E 2"]
    """1 / depth at tail and head."""
    outward: Float[Tensor, "E 2"]
    """Unit normals."""

    def __getitem__(self, chosen: Tensor) -> "Edges":
        return Edges(*(field[chosen] for field in vars(self).values()))

    def at(self, t: Float[Tensor, " E"]) -> Float[Tensor, "E 2"]:
        """A point of each; both ends exactly, so that edges with a common end agree on it."""
        return torch.where(
            t[:, None] == 1, self.head, self.tail + t[:, None] * (self.head - self.tail)
        )


def jumping_edges(drawn: DrawnFaces, triangles: Triangles) -> Edges:
    """The edges that count, with their inside faces.

    An edge counts whose drawn faces all lie on one side of its line (a border, a silhouette), or
    that is a seam. Its inside face is the one nearest to the eye just beside the edge: 1 / depth
    grows fastest inwards; of equal ones the first. A seam with faces on both sides takes the side
    where the edge function is positive.
    """
    number = drawn.face.new_full((len(triangles.faces),), -1)
    number[drawn.face] = torch.arange(len(drawn.face), device=number.device)
    count = len(triangles.edge_start) - 1
    edge = torch.arange(count, device=number.device).repeat_interleave(triangles.edge_start.diff())
    n = number[triangles.edge_face]
    corner = triangles.edge_corner
    edge, n, corner = edge[n >= 0], n[n >= 0], corner[n >= 0]

    after = (corner + 1) % 3
    tail = drawn.corners[n, corner]
    head = drawn.corners[n, after]
    step = head - tail
    outward = (
        drawn.turn[n, None]
        * torch.stack([step[:, 1], -step[:, 0]], -1)
        / step.norm(dim=-1, keepdim=True)
    )
    inverse = torch.stack([drawn.inverse[n, corner], drawn.inverse[n, after]], -1)

    side = drawn.turn[n] * _line_directions(drawn, edge, n, corner, step, count)
    low, high = (
        side.new_zeros(count).scatter_reduce_(0, edge, side, how) for how in ("amin", "amax")
    )
    two_sided = low * high < 0
    growth = -(drawn.slope[n] * outward).sum(-1).nan_to_num()
    growth = growth.where(side == torch.where(high > 0, high, low)[edge], -torch.inf)
    most = growth.new_full((count,), -torch.inf).scatter_reduce_(0, edge, growth, "amax")
    first = _first(edge, growth == most[edge], count)
    chosen = first[(~two_sided | triangles.edge_seam) & (first < len(n))]
    return Edges(n, corner, two_sided[edge], tail, head, inverse, outward)[chosen]


def _line_directions(
    drawn: DrawnFaces, edge: Tensor, n: Tensor, corner: Tensor, step: Tensor, count: int
) -> Tensor:
    """For each face around an edge: 1 where it runs along the edge's line, its upper (else left)
    end first, or -1.

    Faces around a seam may name different copies of its vertices, whose places can differ by
    rounding. So the line is that of the first face, and the others are told from it by their
    directions.
    """
    first = _first(edge, torch.ones_like(edge, dtype=torch.bool), count)[edge]
    alike = 1 - 2 * ((step * step[first]).sum(-1) < 0).double()
    return alike * drawn.along[n, corner][first]


def _first(edge: Tensor, real: Tensor, count: int) -> Tensor:
    """For each of `count` edges its first entry that is `real`; len(edge) where it has none."""
    entry = torch.arange(len(edge), device=edge.device)
    return edge.new_full((count,), len(edge)).scatter_reduce_(0, edge[real], entry[real], "amin")
