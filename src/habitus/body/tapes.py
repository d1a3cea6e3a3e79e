"""Where tapes, calipers and yardsticks go on a body, as data, how they are laid on its template,
and what is measured standing, with hanging arms and heels together, as surveys take it.

Places come from landmarks where a body has them, and from joints otherwise.

A ring is where a plane cuts the template, as fixed places on its edges. On any other rest surface
of the same body it lies at the same places of the same edges, so that a tape's length changes
continuously with the shape: no plane has to find its loop again, and a loop cannot open. The tape
spans hollows: its length is that of the convex hull of the ring as seen along its axis.

To stand, the body's own function brings it there from rest: collar bones and arms are lowered, legs
are drawn together.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from habitus.body.prepared import PreparedBody

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
        return hull_perimeter(self.points(vertices) @ self.axes.T)

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


def hull_perimeter(points: Float[np.ndarray, "*batch K 2"], directions: int = _DIRECTIONS) -> Any:
    """Of the convex hull of points in a plane (Cauchy: its mean width, times pi), (*batch,)."""
    angle = np.arange(directions) * (np.pi / directions)
    width = np.ptp(points @ np.stack([np.cos(angle), np.sin(angle)]), axis=-2)
    return width.mean(axis=-1) * np.pi


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
    found = intersect(vertices, faces, place, normal)
    if found is None or whole:
        return None if found is None else found[0]
    ring, links = found
    count, loop = connected_components(links, directed=False)
    points = ring.points(vertices)
    nearest = int(
        np.argmin([np.linalg.norm(points[loop == k].mean(0) - place) for k in range(count)])
    )
    return Ring(ring.edges[loop == nearest], ring.share[loop == nearest], ring.axes)


def intersect(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "T 3"],
    place: Float[np.ndarray, " 3"],
    normal: Float[np.ndarray, " 3"],
) -> tuple[Ring, coo_array] | None:
    """Where a plane through a place cuts a surface, and which of these K points are neighbours, as
    a graph (K, K); None where it does not cut.
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
    links = which.reshape(-1, 2)
    graph = coo_array(
        (np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(edges), len(edges))
    )
    return ring, graph


_UP = (0.0, 1.0, 0.0)
_NECK = (0.0, 1.0, 0.45)
_HEEL = (0.0, 0.707, -0.707)  # from under the heel to where the foot joins the leg
_RIBS = 0.195
"""Half way from the top of the hip bone to the tenth rib, as ANSUR II has them (iliocristale and
tenth rib height: 99.6 and 105.6 cm of women, 106.2 and 112.1 cm of men), as a share of the way
between these landmarks: that of the ribs lies above the tenth."""
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
        "natural_waist", "left_iliac_crest", "left_rib_side", _RIBS, _UP, ("spine1", "spine2", 0.2)
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
    Tape("high_hip", "left_waist_side", "left_buttock", 0.5, _UP),
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
    Tape("mid_thigh", "left_hip", "left_knee", 0.6, _UP),
    Tape("knee", "left_patella", "left_knee", 0.0, _UP, ("left_knee", "left_knee", 0.0)),
    Tape("calf", "left_knee", "left_ankle", 0.3, _UP),
    Tape("ankle", "left_knee", "left_ankle", 0.78, _UP),
    Tape("heel_ankle", "left_heel", "left_heel", 0.0, _HEEL),
    Tape("upper_arm", "left_shoulder", "left_elbow", 0.6),
    Tape("elbow", "left_olecranon", "left_olecranon", 0.0, ("left_shoulder", "left_wrist")),
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
    landmarks = [tape.start, tape.end, *named]
    names = [name.replace("left_", side) if side else name for name in landmarks]
    if not set(names) <= places.keys():
        return None
    start, end, *way = (places[name] for name in names)
    place = start + tape.share * (end - start)
    if named:
        return place, way[1] - way[0]
    return place, end - start if tape.across is None else np.array(tape.across)


HANGING = np.deg2rad(83.0)
"""Of the arms below the level."""
COLLAR = 0.15
"""Of the arms' way that the collar bones go along."""
HEEL = 0.052
"""Metres from the midline to an ankle's centre where heels touch, of a body 1.75 m tall."""
STANDING_TAPES = ("chest", "hip")
_SHOULDER = 0.14  # metres around a shoulder's centre within which it is broadest
_MARKS = ("left_acromion", "right_acromion")


@dataclass(frozen=True, eq=False)
class Standing:
    """Which vertices are posed, and what is read off them: marks by name, shoulders, hips, tapes of
    chest and hip.

    All but ``vertices`` count in these. ``prepared`` is the body function of these vertices.
    """

    pose: Mapping[str, tuple[float, float, float]]
    vertices: Int[np.ndarray, " N"]
    prepared: PreparedBody
    marks: Mapping[str, int]
    shoulders: slice
    hips: slice
    tapes: Mapping[str, Ring]

    def measure(
        self,
        vertices: Float[np.ndarray, "N V 3"],
        joints: Float[np.ndarray, "N J 3"],
        sole: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Shoulders, chest and hips (m) of rest surfaces whose soles are at ``sole`` (N,)."""
        posed = self.prepared.carried(vertices[:, self.vertices], joints, self.pose)
        at = {name: posed[:, k] for name, k in self.marks.items()}
        lengths = {}
        if len(at) == len(_MARKS):
            lengths["shoulder_height_m"] = (
                0.5 * (at["left_acromion"] + at["right_acromion"])[:, 1] - sole
            )
            lengths["biacromial_breadth_m"] = np.linalg.norm(
                at["left_acromion"] - at["right_acromion"], axis=-1
            )
        for name, ring in self.tapes.items():
            lengths[f"{name}_circumference_m"] = ring.length(posed)
            lengths[f"{name}_breadth_m"] = ring.extent(posed, np.array([1.0, 0.0, 0.0]))
            lengths[f"{name}_depth_m"] = ring.extent(posed, np.array([0.0, 0.0, 1.0]))
        for name, part in (("shoulder_breadth_m", self.shoulders), ("hip_breadth_m", self.hips)):
            if part.stop > part.start:
                lengths[name] = np.ptp(posed[:, part, 0], axis=-1)
        return lengths


def stand(
    body: Any,
    places: Mapping[str, np.ndarray],
    arms: np.ndarray,
    upper_arms: np.ndarray,
    tapes: Mapping[str, Ring],
) -> Standing | None:
    """How this body stands; None where it lacks the joints.

    places: joints and landmarks of the template. arms (V,): which vertices are arms; upper_arms
    (V,): which are carried by the shoulders. tapes: those at rest that are read standing.
    """
    names = {
        f"{side}{joint}"
        for side in ("left_", "right_")
        for joint in ("collar", "shoulder", "elbow", "hip")
    }
    if not names | {"left_ankle", "right_ankle"} <= set(body.joint_names):
        return None
    marks = {name: body.landmarks[name] for name in _MARKS if name in body.landmarks}
    shoulders = _shoulders(body.v_template, places, upper_arms)
    hips = _hips(body.v_template, places, arms)
    parts = [
        np.array([*marks.values()], int),
        shoulders,
        hips,
        *(ring.edges.ravel() for ring in tapes.values()),
    ]
    ends = np.cumsum([len(part) for part in parts])
    moved = {
        name: Ring(start + np.arange(ring.edges.size).reshape(-1, 2), ring.share, ring.axes)
        for (name, ring), start in zip(tapes.items(), ends[2:], strict=False)
    }
    pose = _arms_down(places) | _heels_together(places, float(np.ptp(body.v_template[:, 1])))
    local = dict(zip(marks, range(len(marks)), strict=True))
    vertices = np.concatenate(parts)
    return Standing(
        pose,
        vertices,
        body.prepare((), vertices),
        local,
        slice(*ends[:2]),
        slice(*ends[1:3]),
        moved,
    )


def _arms_down(places: Mapping[str, np.ndarray]) -> dict[str, tuple[float, float, float]]:
    """Turns about z that let the arms of the template hang."""
    pose = {}
    for side, sign in (("left_", -1.0), ("right_", 1.0)):
        way = places[f"{side}elbow"] - places[f"{side}shoulder"]
        turn = HANGING + float(np.arctan2(way[1], abs(way[0])))
        pose |= {f"{side}collar": (0.0, 0.0, sign * COLLAR * turn)}
        pose |= {f"{side}shoulder": (0.0, 0.0, sign * (1 - COLLAR) * turn)}
    return pose


def _heels_together(
    places: Mapping[str, np.ndarray], height: float
) -> dict[str, tuple[float, float, float]]:
    """Turns about z that bring the ankles to each other, and the soles back to the floor."""
    pose = {}
    for side, sign in (("left_", 1.0), ("right_", -1.0)):
        hip = places[f"{side}hip"]
        ankle = places[f"{side}ankle"]
        down = hip[1] - ankle[1]
        now = sign * (ankle[0] - hip[0])
        aim = HEEL * height / 1.75 - sign * hip[0]
        turn = sign * float(np.arctan2(aim, down) - np.arctan2(now, down))
        pose |= {f"{side}hip": (0.0, 0.0, turn), f"{side}ankle": (0.0, 0.0, -turn)}
    return pose


def _shoulders(
    template: np.ndarray, places: Mapping[str, np.ndarray], upper_arms: np.ndarray
) -> np.ndarray:
    """Vertices of both deltoids."""
    on_shoulders = np.zeros(len(template), bool)
    for side in ("left_", "right_"):
        start = places[f"{side}shoulder"]
        end = places[f"{side}elbow"]
        beyond = (template - start) @ (end - start) > 0
        on_shoulders |= upper_arms & beyond & (np.linalg.norm(template - start, axis=1) < _SHOULDER)
    return np.flatnonzero(on_shoulders)


def _hips(template: np.ndarray, places: Mapping[str, np.ndarray], arms: np.ndarray) -> np.ndarray:
    """Vertices of the flanks between the navel's height and a third of the way down the thighs."""
    hip = places["left_hip"]
    knee = places["left_knee"]
    thigh = hip[1] - knee[1]
    level = (template[:, 1] < hip[1] + 0.3 * thigh) & (template[:, 1] > hip[1] - 0.4 * thigh)
    return np.flatnonzero(level & ~arms & (np.abs(template[:, 0]) > abs(hip[0])))
