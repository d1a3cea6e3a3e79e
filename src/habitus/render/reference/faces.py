"""Faces on the screen and the nearest at given points, for the renderer's reference. Plain torch,
on any device.

All works on the screen: u to the right, v down, in pixels; 1 / depth is linear there. Decisions are
made in float64, whatever the screen's type.

The edge function of a line p -> q at a point s is ``(q - p) x (s - p)``, with the upper end first,
of two equally high ones the left. Two faces that share an edge, even through copies of its
vertices, so get exactly opposite numbers.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from habitus.render.triangles import Triangles

AT_ONCE = 1 << 20
"""How many pairs of a face and a point are looked at together: it bounds the memory."""


@dataclass(frozen=True, eq=False)
class DrawnFaces:
    """The N faces that are drawn, ready to be asked about points. Edge c runs from corner c to
    corner c + 1.
    """

    face: Int[Tensor, " N"]
    """Their numbers among all, ascending."""
    corners: Float[Tensor, "N 3 2"]
    turn: Float[Tensor, " N"]
    """-1 where the front shows (counter-clockwise as one sees it, v pointing down), 1 where the
    back does.
    """
    along: Float[Tensor, "N 3"]
    """1 where an edge has its upper (else left) end first, else -1."""
    start: Float[Tensor, "N 3 2"]
    """That end of each edge."""
    step: Float[Tensor, "N 3 2"]
    """From there to the other end, with the sign that makes the edge function positive inside."""
    owns: Bool[Tensor, "N 3"]
    """Whether a point exactly on an edge belongs to the face: it does on its left edges and
    horizontal top edges.
    """
    inverse: Float[Tensor, "N 3"]
    """1 / depth at the corners."""
    slope: Float[Tensor, "N 2"]
    """How 1 / depth grows along u and v."""

    def sides(self, n: Int[Tensor, " K"], points: Float[Tensor, "K 2"]) -> Float[Tensor, "K 3"]:
        """The edge functions of drawn faces `n` at points: positive inside."""
        away = points[:, None] - self.start[n]
        step = self.step[n]
        return step[..., 0] * away[..., 1] - step[..., 1] * away[..., 0]

    def inverse_depth(
        self, n: Int[Tensor, " K"], points: Float[Tensor, "K 2"]
    ) -> Float[Tensor, " K"]:
        """1 / depth of the planes of drawn faces `n` at points; exact where all corners are equally
        far.
        """
        away = points - self.corners[n, 0]
        return self.inverse[n, 0] + self.slope[n, 0] * away[:, 0] + self.slope[n, 1] * away[:, 1]


def drawn_faces(
    screen: Float[Tensor, "V 3"], triangles: Triangles, cull: bool = False
) -> DrawnFaces:
    """The faces that can show. Left out: corners that are not finite or not in front, no area, and
    backs if `cull`.

    A face's front is where its corners run counter-clockwise. A camera that looks along +z with y
    down sees that order as it is, so its doubled area on the screen, ``(b - a) x (c - a)`` with v
    pointing down, is negative.
    """
    at = screen.detach().double()[triangles.faces]
    corners = at[..., :2]
    inverse = 1 / at[..., 2]
    p = corners
    q = corners.roll(-1, 1)
    swap = (p[..., 1] > q[..., 1]) | (p[..., 1] == q[..., 1]) & (p[..., 0] > q[..., 0])
    along = 1 - 2 * swap.double()
    start = torch.where(swap[..., None], q, p)
    step = torch.where(swap[..., None], p - q, q - p)
    ab = step[:, 0]
    opposite = corners[:, 2] - start[:, 0]
    area = along[:, 0] * (ab[:, 0] * opposite[:, 1] - ab[:, 1] * opposite[:, 0])
    slope = _slope(corners, inverse, area)
    drawn = (
        at.isfinite().all(-1).all(-1)
        & (at[..., 2] > 0).all(-1)
        & area.isfinite()
        & slope.isfinite().all(-1)
    )
    drawn &= (area < 0) if cull else (area != 0)
    turn = area.sign()
    step = step * (turn[:, None] * along)[..., None]
    owns = (step[..., 1] < 0) | (step[..., 1] == 0) & (step[..., 0] > 0)
    fields = (corners, turn, along, start, step, owns, inverse, slope)
    return DrawnFaces(drawn.nonzero()[:, 0], *(field[drawn] for field in fields))


def _slope(corners: Tensor, inverse: Tensor, area: Tensor) -> Tensor:
    """The gradient over the screen of what is `inverse` (N, 3) at the corners."""
    (x1, y1), (x2, y2) = ((corners[:, k] - corners[:, 0]).unbind(-1) for k in (1, 2))
    d1 = inverse[:, 1] - inverse[:, 0]
    d2 = inverse[:, 2] - inverse[:, 0]
    return torch.stack([(d1 * y2 - d2 * y1) / area, (d2 * x1 - d1 * x2) / area], -1)


class Nearest:
    """Keeps the nearest of the drawn faces that lie over each of some points."""

    def __init__(self, drawn: DrawnFaces, points: int):
        self._drawn = drawn
        self._none = len(drawn.face)
        self.inverse_depth = drawn.slope.new_full((points,), -torch.inf)
        """(points,) that of the nearest face; -inf where there is none."""
        self._best = drawn.face.new_full((points,), self._none)

    def add(
        self, n: Int[Tensor, " K"], slot: Int[Tensor, " K"], points: Float[Tensor, "K 2"]
    ) -> None:
        """Try drawn faces `n` at points, each the point number `slot`."""
        sides = self._drawn.sides(n, points)
        inside = ((sides > 0) | (sides == 0) & self._drawn.owns[n]).all(-1)
        n = n[inside]
        slot = slot[inside]
        inverse = self._drawn.inverse_depth(n, points[inside])
        before = self.inverse_depth.clone()
        self.inverse_depth.scatter_reduce_(0, slot, inverse, "amax")
        self._best[self.inverse_depth > before] = self._none
        equal = inverse == self.inverse_depth[slot]
        self._best.scatter_reduce_(0, slot[equal], n[equal], "amin")

    def face(self) -> Int[Tensor, " points"]:
        """The nearest face's number among all at each point, -1 where there is none."""
        return torch.cat([self._drawn.face, self._drawn.face.new_tensor([-1])])[self._best]


def box_pixels(
    drawn: DrawnFaces, width: int, height: int, reach: float
) -> Iterator[tuple[Tensor, Tensor]]:
    """All pairs of a drawn face and a pixel whose centre's square of half side `reach` meets the
    face's box.
    """
    most = drawn.corners.new_tensor([width, height])
    low = (drawn.corners.amin(1) - (0.5 + reach)).ceil().clamp(min=0).minimum(most).long()
    high = (drawn.corners.amax(1) - (0.5 - reach)).floor().clamp(min=-1).minimum(most - 1).long()
    size = (high - low + 1).clamp(min=0)
    for n, k in expanded(size.prod(-1)):
        column = low[n, 0] + k % size[n, 0]
        row = low[n, 1] + k // size[n, 0]
        yield n, row * width + column


def expanded(
    counts: Int[Tensor, " N"], at_once: int | None = None
) -> Iterator[tuple[Tensor, Tensor]]:
    """(n, k) with k from 0 to counts[n] - 1, for one n after the other; `at_once` pairs at a
    time.
    """
    ends = counts.cumsum(0)
    total = int(counts.sum())
    at_once = AT_ONCE if at_once is None else at_once
    for first in range(0, total, at_once):
        pair = torch.arange(first, min(first + at_once, total), device=counts.device)
        n = torch.searchsorted(ends, pair, right=True)
        yield n, pair - (ends - counts)[n]
