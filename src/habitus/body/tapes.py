"""Where tapes, calipers and yardsticks go on a body, as data, and how they are laid on its
template.

Places come from landmarks where a body has them, and from joints otherwise.

A ring is where a plane cuts the template, as fixed places on its edges. On any other rest surface
of the same body it lies at the same places of the same edges, so that a tape's length changes
continuously with the shape: no plane has to find its loop again, and a loop cannot open. The tape
spans hollows: its length is that of the convex hull of the ring as seen along its axis.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

_DIRECTIONS = 180  # in which a hull's width is taken: right to 5e-5


@dataclass(frozen=True, eq=False)
class Ring:
    """Points on edges of a mesh: ``share`` of the way from the first vertex of ``edges`` to the
    second.

    ``axes`` are two directions across the ring's axis, as wide as unit vectors.
    """

    edges: Int[np.ndarray, "K 2"]
    share: Float[np.ndarray, " K"]
    axes: Float[np.ndarray, "2 3"]

    def points(self, vertices: Float[np.ndarray, "*batch V 3"]) -> Float[np.ndarray, "*batch K 3"]:
        """The ring on a surface."""
        start = vertices[..., self.edges[:, 0], :]
        end = vertices[..., self.edges[:, 1], :]
        return start + self.share[:, None] * (end - start)

    def length(self, vertices: Float[np.ndarray, "*batch V 3"]) -> Any:
        """Of a tape around it: the perimeter of its convex hull (Cauchy: its mean width, times
        pi).
        """
        flat = self.points(vertices) @ self.axes.T
        angle = np.arange(_DIRECTIONS) * (np.pi / _DIRECTIONS)
        width = np.ptp(flat @ np.stack([np.cos(angle), np.sin(angle)]), axis=-2)
        return width.mean(axis=-1) * np.pi

    def extent(
        self, vertices: Float[np.ndarray, "*batch V 3"], direction: Float[np.ndarray, " 3"]
    ) -> Any:
        """How far it reaches along a unit direction, (*batch,)."""
        return np.ptp(self.points(vertices) @ direction, axis=-1)

    def middle(self, vertices: Float[np.ndarray, "V 3"], within: float) -> "Ring | None":
        """Those of its points that lie in the body's plane of symmetry on this surface; None for
        fewer than two.
        """
        near = np.abs(self.points(vertices)[:, 0]) < within
        return Ring(self.edges[near], self.share[near], self.axes) if near.sum() > 1 else None

    def tape(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "H 3"]:
        """The places in order at which a tape around it touches the skin, to be drawn."""
        points = self.points(vertices)
        try:
            return points[ConvexHull(points @ self.axes.T).vertices]
        except QhullError:
            return points


def cut(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "T 3"],
    place: Float[np.ndarray, " 3"],
    normal: Float[np.ndarray, " 3"],
    whole: bool = False,
) -> Ring | None:
    """Where a plane through a place cuts a surface: the loop nearest to the place, or all of them
    (``whole``).
    """
    normal = normal / np.linalg.norm(normal)
    height = (vertices - place) @ normal
    above = height >= 0
    crossing = faces[above[faces].any(1) & ~above[faces].all(1)]
    if len(crossing) == 0:
        return None
    sides = np.sort(np.stack([crossing, np.roll(crossing, -1, axis=1)], -1), -1)
    cuts = above[sides[..., 0]] != above[sides[..., 1]]
    edges, which = np.unique(
        sides[cuts], axis=0, return_inverse=True
    )  # two cut sides a triangle, in order of triangles
    near, far = height[edges].T
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    ring = Ring(edges, near / (near - far), np.stack([first, np.cross(normal, first)]))
    if whole:
        return ring
    links = which.reshape(-1, 2)
    graph = coo_array(
        (np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(edges), len(edges))
    )
    count, loop = connected_components(graph, directed=False)
    points = ring.points(vertices)
    nearest = int(
        np.argmin([np.linalg.norm(points[loop == k].mean(0) - place) for k in range(count)])
    )
    return Ring(edges[loop == nearest], ring.share[loop == nearest], ring.axes)


_UP = (0.0, 1.0, 0.0)
_NECK = (0.0, 1.0, 0.45)
ARMS = ("collar", "shoulder", "elbow", "wrist", "hand", "index", "middle", "pinky", "ring", "thumb")
SIDES = ("left_", "right_")
_MIDLINE = 1e-4  # metres


@dataclass(frozen=True)
class Span:
    """An extent of a tape's ring along a direction; ``midline``: of those of its points in the
    plane of symmetry.
    """

    name: str
    direction: tuple[float, float, float]
    midline: bool = False


@dataclass(frozen=True)
class Tape:
    """A plane between two places (landmarks, or joints ``otherwise``) at a share of the way, across
    a direction.

    ``across`` is a direction, two places that it leads between, or None: the way itself. ``spans``
    are what is measured besides on the same ring.
    """

    name: str
    start: str
    end: str
    share: float = 0.5
    across: tuple[float, float, float] | tuple[str, str] | None = None
    otherwise: tuple[str, str, float] | None = None
    spans: tuple[Span, ...] = ()


def _trunk(name: str, midline: bool = False) -> tuple[Span, ...]:
    return Span(f"{name}_breadth_m", (1.0, 0.0, 0.0)), Span(
        f"{name}_depth_m", (0.0, 0.0, 1.0), midline
    )


TRUNK = (
    Tape(
        "chest", "left_breast", "right_breast", 0.5, _UP, ("spine2", "spine3", 0.7), _trunk("chest")
    ),
    Tape(
        "natural_waist", "left_waist_side", "right_waist_side", 0.5, _UP, ("spine1", "spine2", 0.6)
    ),
    Tape(
        "waist",
        "navel",
        "waist_back",
        0.0,
        _UP,
        ("spine1", "spine2", 0.1),
        _trunk("waist", midline=True),
    ),
    Tape(
        "hip",
        "left_buttock",
        "right_buttock",
        0.5,
        _UP,
        ("left_hip", "right_hip", 0.5),
        _trunk("hip"),
    ),
)
HEAD = (
    Tape("neck", "neck", "head", 0.25, _NECK),
    Tape("head", "glabella", "head_back", 0.5, _UP),
)
LIMBS = (
    Tape("thigh", "left_hip", "left_knee", 0.25),
    Tape("knee", "left_patella", "left_knee", 0.0, _UP, ("left_knee", "left_knee", 0.0)),
    Tape("calf", "left_knee", "left_ankle", 0.3, _UP),
    Tape("ankle", "left_knee", "left_ankle", 0.78, _UP),
    Tape("upper_arm", "left_shoulder", "left_elbow", 0.6),
    Tape("forearm", "left_elbow", "left_wrist", 0.22),
    Tape("wrist", "left_elbow", "left_wrist", 0.97),
    Tape(
        "hand", "left_hand_radial", "left_hand_ulnar", 0.5, ("left_wrist", "left_middle_tip"),
        spans=(Span("hand_breadth_m", (0.0, 0.0, 1.0)),),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class LaidTape:
    """A tape on a body's template: one ring, or one a side; ``spans`` with the rings whose extents
    they are.
    """

    name: str
    rings: tuple[Ring, ...]
    spans: tuple[tuple[Span, tuple[Ring, ...]], ...]


def lay_tapes(
    vertices: np.ndarray, faces: np.ndarray, places: Mapping[str, np.ndarray], arms: np.ndarray
) -> tuple[LaidTape, ...]:
    """The tapes that a template (V, 3) has places for; those of the trunk pass by the vertices
    ``arms`` (V,).
    """
    trunk = faces[~arms[faces].any(1)]
    groups = (
        (TRUNK, trunk, True, ("",)),
        (HEAD, faces, False, ("",)),
        (LIMBS, faces, False, SIDES),
    )
    laid = []
    for tapes, skin, whole, sides in groups:
        for tape in tapes:
            planes = [plane for side in sides if (plane := _plane(tape, side, places)) is not None]
            rings = [
                ring for plane in planes if (ring := cut(vertices, skin, *plane, whole)) is not None
            ]
            if rings:
                spans = tuple((span, _spanned(span, rings, vertices)) for span in tape.spans)
                laid.append(LaidTape(tape.name, tuple(rings), spans))
    return tuple(laid)


def _spanned(span: Span, rings: list[Ring], vertices: np.ndarray) -> tuple[Ring, ...]:
    """What of a tape's rings a span is taken of; whole rings where too little of them lies in the
    midline.
    """
    return tuple(
        ring.middle(vertices, _MIDLINE) or ring if span.midline else ring for ring in rings
    )


def _plane(
    tape: Tape, side: str, places: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray] | None:
    """A place and a normal, on one side of the body; None where the body does not have the
    places.
    """
    if tape.otherwise is not None and not {tape.start, tape.end} <= places.keys():
        start, end, share = tape.otherwise
        tape = replace(tape, start=start, end=end, share=share)
    named = [end for end in tape.across or () if isinstance(end, str)]
    wanted = [tape.start, tape.end, *named]
    names = [name.replace("left_", side) if side else name for name in wanted]
    if not set(names) <= places.keys():
        return None
    start, end, *way = (places[name] for name in names)
    place = start + tape.share * (end - start)
    if named:
        return place, way[1] - way[0]
    return place, end - start if tape.across is None else np.array(tape.across)
