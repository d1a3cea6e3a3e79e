"""What tailors measure along the body: paths of a tape over the skin, heights of its lines, slopes.

The person stands with hanging arms and heels together (`habitus.body.tapes.stand`). A *path* leads
from place to place: landmarks, and places that are found once on the standing template (where the
neck becomes the shoulder, the armpit, the fold under the breast, the level of the waist). Between
two places a plane through both, and through the direction in which the tape lies on the skin, cuts
the template; the points of the cut go with the skin from then on. The tape is taut: it spans
hollows and goes straight where the skin lies behind the line between its ends.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from habitus.body.prepared import PreparedBody
from habitus.body.tapes import SIDES, LaidTape, Ring, cut, hull_perimeter, intersect

_FRONT, _BACK = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
_UP, _OUT = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
_OVER = (0.0, 0.6, -1.0)  # the shoulders, below the seventh neck vertebra
_NAPE_OUT, _THROAT_OUT = (0.5, 1.0, -0.7), (0.5, 0.7, 1.0)  # off the skin at the neck's base
_TURN = (-1.8, -1.0)
"""Into the hollow between neck and shoulder, across and up: the side neck point lies farthest that
way, where the outline is 61 degrees steep."""
_BELOW_CROTCH = 0.005  # metres that the skin of the trunk reaches below the crotch
_NARROW = 1e-9
_DIRECTIONS = 60  # in which a hull's width is taken: right to 2e-4
CROTCH = 1.17
"""A tailor's crotch length over that of the taut tape on the skin, a shallow saddle at the crotch:
ANSUR II's means at the navel are 62.1 and 62.2 cm (women, men), the tape's 52.2 and 53.8 cm."""


@dataclass(frozen=True)
class Leg:
    """A piece of a path: a taut tape between two places, which lies on the skin's side ``out``; the
    straight way where that is None.
    """

    start: str
    end: str
    out: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Path:
    """The pieces of a measurement, of the left side (and in the mean with the right one where a
    place is the left's), so many ``times``; ``down`` is a place from which it goes on to the floor.
    """

    name: str
    legs: tuple[Leg, ...]
    down: str | None = None
    times: float = 1.0


_TO_BUST = Leg("left_side_neck", "left_breast", _FRONT)
_TO_CROTCH = Leg("waist_front_level", "crotch", _FRONT)
_FROM_CROTCH = Leg("crotch", "waist_back_level", _BACK)
_TO_HIP = Leg("left_waist_level", "left_hip_level", _OUT)
_NAPE = Leg("left_side_neck", "c7", _NAPE_OUT)
_THROAT = Leg("left_side_neck", "jugular_notch", _THROAT_OUT)
_ARM = (Leg("left_acromion", "left_elbow_lateral"), Leg("left_elbow_lateral", "left_wrist_ulnar"))
PATHS = (
    Path("back_neck_to_waist_m", (Leg("c7", "waist_back_level", _BACK),)),
    Path("front_neck_to_waist_m", (Leg("jugular_notch", "waist_front_level", _FRONT),)),
    Path("side_neck_to_bust_m", (_TO_BUST,)),
    Path("side_neck_to_waist_front_m", (_TO_BUST, Leg("left_breast", "left_waist_bust", _FRONT))),
    Path("side_neck_to_waist_back_m", (Leg("left_side_neck", "left_waist_scapula", _BACK),)),
    Path("shoulder_length_m", (Leg("left_side_neck", "left_acromion", _UP),)),
    Path("across_shoulder_m", (Leg("left_acromion", "right_acromion", _OVER),)),
    Path("across_back_m", (Leg("left_scye_back", "right_scye_back", _BACK),)),
    Path("across_front_m", (Leg("left_scye_front", "right_scye_front", _FRONT),)),
    Path("neck_back_arc_m", (_NAPE,), times=2.0),
    Path("neck_base_circumference_m", (_NAPE, _THROAT), times=2.0),
    Path("bust_point_distance_m", (Leg("left_breast", "right_breast"),)),
    Path("buttock_point_distance_m", (Leg("left_buttock", "right_buttock"),)),
    Path("bust_to_underbust_m", (Leg("left_breast", "left_underbust", _FRONT),)),
    Path("bust_front_arc_m", (Leg("left_chest_level", "right_chest_level", _FRONT),)),
    Path("bust_back_arc_m", (Leg("left_chest_level", "right_chest_level", _BACK),)),
    Path("waist_back_arc_m", (Leg("left_waist_level", "right_waist_level", _BACK),)),
    Path("hip_back_arc_m", (Leg("left_hip_level", "right_hip_level", _BACK),)),
    Path("arm_length_m", _ARM),
    Path("back_neck_to_wrist_m", (Leg("c7", "left_acromion", (0.0, 1.0, -1.0)), *_ARM)),
    Path("waist_to_hip_m", (_TO_HIP,)),
    Path("outside_leg_m", (_TO_HIP,), "left_hip_level"),
    Path("front_crotch_length_m", (_TO_CROTCH,), times=CROTCH),
    Path("back_crotch_length_m", (_FROM_CROTCH,), times=CROTCH),
    Path("total_crotch_length_m", (_TO_CROTCH, _FROM_CROTCH), times=CROTCH),
)
"""Lengths along the skin, and distances."""
DROPS = {
    "natural_waist_height_m": ("left_waist_level", "", 1.0),
    "armpit_height_m": ("left_armpit", "", 1.0),
    "armscye_depth_m": ("left_acromion", "left_armpit", 1.0),
    "back_neck_to_bust_height_m": ("c7", "left_breast", 1.0),
    "armpit_to_waist_height_m": ("left_armpit", "left_waist_level", 1.0),
    "underbust_to_waist_height_m": ("left_underbust", "left_waist_level", 1.0),
    "waist_to_high_hip_height_m": ("left_waist_level", "left_buttock", 0.5),
    "waist_to_hip_height_m": ("left_waist_level", "left_buttock", 1.0),
    "waist_to_knee_height_m": ("left_waist_level", "left_patella", 1.0),
    "body_rise_m": ("left_waist_level", "crotch", 1.0),
    "hip_to_crotch_height_m": ("left_buttock", "crotch", 1.0),
}
"""Heights of one place above another, or above the sole (""), and the share of them."""
SLOPES = {
    "shoulder_slope_deg": ("left_side_neck", "left_acromion"),
    "hip_inclination_deg": ("left_hip_level", "left_waist_level"),
}
"""Angles of the way between two places, seen from the front: below the level, and against the
plumb line."""
RINGS = ("upper_chest", "underbust", "armscye")


@dataclass(frozen=True, eq=False)
class SewingKit:
    """What a standing person is measured by: ``places`` as points on edges (an edge of one vertex
    twice for a landmark), ``arcs`` of legs and ``rings`` by name, all of ``vertices``, which
    ``prepared`` poses.
    """

    pose: Mapping[str, tuple[float, float, float]]
    vertices: Int[np.ndarray, " N"]
    prepared: PreparedBody
    places: Mapping[str, Ring]
    arcs: Mapping[Leg, Ring]
    rings: Mapping[str, tuple[Ring, ...]]

    def posed(
        self, vertices: Float[np.ndarray, "N V 3"], joints: Float[np.ndarray, "N J 3"]
    ) -> Float[np.ndarray, "N M 3"]:
        """The vertices that are looked at, standing, of people at rest."""
        return self.prepared.carried(vertices[:, self.vertices], joints, self.pose)

    def measure(
        self,
        vertices: Float[np.ndarray, "N V 3"],
        joints: Float[np.ndarray, "N J 3"],
        sole: Float[np.ndarray, " N"],
    ) -> dict[str, Float[np.ndarray, " N"]]:
        """Lengths (m) and slopes (degrees) of rest surfaces whose soles are at ``sole``."""
        posed = self.posed(vertices, joints)
        at = {name: ring.points(posed)[:, 0] for name, ring in self.places.items()}
        legs = {
            leg: taut_length(arc.points(posed), np.array(leg.out)) for leg, arc in self.arcs.items()
        }
        lengths: dict[str, np.ndarray] = {}
        for path in PATHS:
            sides = [_along(path, side, legs, at, sole) for side in SIDES]
            known = [each for each in sides if each is not None]
            if len(known) == len(sides):
                lengths[path.name] = np.mean(known, axis=0)
        for name, (high, low, share) in DROPS.items():
            if {high, low or high} <= at.keys():
                lengths[name] = share * np.mean(
                    [
                        at[_of(high, side)][:, 1] - (at[_of(low, side)][:, 1] if low else sole)
                        for side in SIDES
                    ],
                    axis=0,
                )
        for name, ends in SLOPES.items():
            if set(ends) <= at.keys():
                lengths[name] = np.mean([_slope(name, at, ends, side) for side in SIDES], axis=0)
        for name, rings in self.rings.items():
            lengths[f"{name}_circumference_m"] = np.mean(
                [ring.length(posed) for ring in rings], axis=0
            )
        return lengths


def _along(
    path: Path,
    side: str,
    taut: Mapping[Leg, np.ndarray],
    at: Mapping[str, np.ndarray],
    sole: Float[np.ndarray, " N"],
) -> Float[np.ndarray, " N"] | None:
    """The length of a path on one side; None where a place of it is not known."""
    total = np.zeros(len(sole))
    for leg in (_mirrored(leg, side) for leg in path.legs):
        if leg in taut:
            total += taut[leg]
        elif leg.out is None and {leg.start, leg.end} <= at.keys():
            total += np.linalg.norm(at[leg.start] - at[leg.end], axis=-1)
        else:
            return None
    total *= path.times
    return total if path.down is None else total + at[_of(path.down, side)][:, 1] - sole


def taut_length(points: Float[np.ndarray, "*batch K 3"], out: Float[np.ndarray, " 3"]) -> Any:
    """Of a taut tape from the first to the last of points on a skin that lies on the side ``out``
    of the line between them, (*batch,); the others are in any order. Points behind that line do
    not touch it.
    """
    start = points[..., :1, :]
    way = points[..., -1:, :] - start
    length = np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), _NARROW)
    way = way / length
    across = out - (way @ out)[..., None] * way
    across = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), _NARROW)
    along = np.sum((points - start) * way, axis=-1)
    height = np.sum((points - start) * across, axis=-1)
    end = length[..., 0]
    along = np.where(height > 0.0, along, np.clip(along, 0.0, end))
    flat = np.stack([along, np.maximum(height, 0.0)], axis=-1)
    return np.maximum(hull_perimeter(flat, _DIRECTIONS) - end[..., 0], end[..., 0])


def lay_sewing(
    body: Any,
    marks: Mapping[str, np.ndarray],
    arms: Bool[np.ndarray, " V"],
    tapes: tuple[LaidTape, ...],
    pose: Mapping[str, tuple[float, float, float]],
    midline: Int[np.ndarray, " M"],
) -> SewingKit | None:
    """What measures this body for sewing; None where it has no landmarks.

    marks: joints and landmarks of its template. arms (V,): which vertices are arms. tapes: those at
    rest. pose: in which it stands. midline: the vertices in its plane of symmetry.
    """
    rings = {tape.name: tape.rings[0] for tape in tapes if len(tape.rings) == 1}
    needed = {name for side in SIDES for name in (f"{side}acromion", f"{side}breast")} | {"c7"}
    if not len(midline) or not needed <= marks.keys() or not {"chest", "hip"} <= rings.keys():
        return None
    rest = np.asarray(body.v_template, np.float64)
    joints = np.stack([marks[name] for name in body.joint_names])
    stands = body.prepare(()).carried(rest[None], joints[None], pose)[0]
    crotch = int(midline[rest[midline, 1].argmin()])
    skin = body.faces[(stands[body.faces, 1] > stands[crotch, 1] - _BELOW_CROTCH).all(1)]
    places = {name: _landmark(vertex) for name, vertex in body.landmarks.items()}
    places["crotch"] = _landmark(crotch)
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        places |= _levels(rings, stands, side, sign)
        places |= _corners(body.faces, rest, stands, marks, places, side, sign)
    places |= _on_waist(rings["natural_waist"], stands, places)
    scyes = tuple(_armscye(body.faces, rest, stands, places, side) for side in SIDES)
    for side, scye in zip(SIDES, scyes, strict=True):
        places |= _on_armscye(scye, stands, places, side)
    arcs: dict[Leg, Ring] = {}
    for side in SIDES:
        for path in PATHS:
            for leg in (_mirrored(leg, side) for leg in path.legs):
                if leg.out is not None and {leg.start, leg.end} <= places.keys():
                    arc = _arc(leg, skin, stands, places)
                    if arc is not None:
                        arcs[leg] = arc
    trunk = skin[~arms[skin].any(1)]
    levels = {"upper_chest": "left_armpit", "underbust": "left_underbust"}
    level = {
        name: (cut(stands, trunk, places[at].points(stands)[0], np.array(_UP), whole=True),)
        for name, at in levels.items()
    }
    return _kit(body, pose, places, arcs, level | {"armscye": scyes})


def _kit(
    body: Any,
    pose: Mapping[str, tuple[float, float, float]],
    places: Mapping[str, Ring],
    arcs: Mapping[Leg, Ring],
    rings: Mapping[str, tuple[Ring | None, ...]],
) -> SewingKit:
    """The kit, of the vertices that it needs only."""
    used = [
        leg for path in PATHS for side in SIDES for leg in (_mirrored(g, side) for g in path.legs)
    ]
    names = {name for leg in used for name in (leg.start, leg.end)}
    names |= {_of(n, s) for pair in DROPS.values() for n in pair[:2] for s in SIDES}
    names |= {_of(n, s) for pair in SLOPES.values() for n in pair for s in SIDES}
    kept = {name: ring for name, ring in places.items() if name in names}
    laid = {
        name: tuple(ring for ring in each if ring is not None)
        for name, each in rings.items()
        if not any(ring is None for ring in each)
    }
    every = [*kept.values(), *arcs.values(), *(ring for each in laid.values() for ring in each)]
    vertices = np.unique(np.concatenate([ring.edges.ravel() for ring in every]))

    def local(ring: Ring) -> Ring:
        return Ring(np.searchsorted(vertices, ring.edges), ring.share, ring.axes)

    return SewingKit(
        pose,
        vertices,
        body.prepare((), vertices),
        {name: local(ring) for name, ring in kept.items()},
        {leg: local(ring) for leg, ring in arcs.items()},
        {name: tuple(local(ring) for ring in each) for name, each in laid.items()},
    )


def _of(name: str, side: str) -> str:
    """A place of the left side, on this side."""
    return name.replace("left_", side, 1) if name.startswith("left_") else name


def _mirrored(leg: Leg, side: str) -> Leg:
    """A leg of the left side, on this side; one across the body stays where it is."""
    if side == "left_" or "right_" in (leg.start[:6], leg.end[:6]):
        return leg
    out = None if leg.out is None else (-leg.out[0], leg.out[1], leg.out[2])
    return Leg(_of(leg.start, side), _of(leg.end, side), out)


def _landmark(vertex: int) -> Ring:
    return Ring(np.array([[vertex, vertex]]), np.zeros(1), np.eye(3)[:2])


def _point(ring: Ring, k: int) -> Ring:
    """One point of a ring."""
    return Ring(ring.edges[k : k + 1], ring.share[k : k + 1], ring.axes)


def _levels(
    rings: Mapping[str, Ring], stands: np.ndarray, side: str, sign: float
) -> dict[str, Ring]:
    """Where the tapes of chest, waist and hip are widest."""
    found = {}
    for name, tape in (("chest", "chest"), ("waist", "natural_waist"), ("hip", "hip")):
        ring = rings[tape]
        widest = int((sign * ring.points(stands)[:, 0]).argmax())
        found[f"{side}{name}_level"] = _point(ring, widest)
    return found


def _corners(
    faces: np.ndarray,
    rest: np.ndarray,
    stands: np.ndarray,
    marks: Mapping[str, np.ndarray],
    places: Mapping[str, Ring],
    side: str,
    sign: float,
) -> dict[str, Ring]:
    """The side neck point, the armpit and the fold under the breast: corners of the outline."""

    def at(name: str) -> np.ndarray:
        return places[f"{side}{name}"].points(stands)[0]

    tip, neck, breast, waist = (at(n) for n in ("acromion", "neck_side", "breast", "waist_level"))
    turn = np.array([sign * _TURN[0], _TURN[1], 0.0])

    def on_shoulder(p: np.ndarray) -> np.ndarray:
        return (sign * p[:, 0] > 0.5 * sign * neck[0]) & (p[:, 1] < neck[1]) & (p[:, 1] > tip[1])

    def under_arm(p: np.ndarray) -> np.ndarray:
        out = sign * marks[f"{side}waist_side"][0]
        return (sign * p[:, 0] > out) & (p[:, 1] < marks[f"{side}shoulder"][1])

    def under_breast(p: np.ndarray) -> np.ndarray:
        return (p[:, 2] > waist[2]) & (p[:, 1] < breast[1]) & (p[:, 1] > waist[1])

    shoulder = marks[f"{side}acromion"]
    below = np.array([breast[0], waist[1], breast[2]])
    profile = intersect(stands, faces, breast, np.array(_OUT))
    front = profile[0].points(stands) if profile else stands
    level = np.abs(front[:, 1] - waist[1])
    below[2] = front[(level < 0.02) & (front[:, 2] > waist[2])][:, 2].mean()
    inward = np.cross(breast - below, _OUT)
    return {
        f"{side}side_neck": _extreme(stands, faces, tip, np.array(_FRONT), turn, on_shoulder),
        f"{side}armpit": _extreme(
            rest, faces, shoulder, np.array(_FRONT), np.array([-sign, 1.0, 0.0]), under_arm
        ),
        f"{side}underbust": _extreme(stands, faces, breast, np.array(_OUT), inward, under_breast),
    }


def _extreme(
    vertices: np.ndarray,
    faces: np.ndarray,
    place: np.ndarray,
    normal: np.ndarray,
    way: np.ndarray,
    among: Callable[[np.ndarray], np.ndarray],
) -> Ring:
    """The point of a plane's cut that lies farthest along a way, of some."""
    ring = cut(vertices, faces, place, normal, whole=True)
    assert ring is not None  # the place is on the surface
    points = ring.points(vertices)
    return _point(ring, int(np.where(among(points), points @ way, -np.inf).argmax()))


def _on_waist(ring: Ring, stands: np.ndarray, places: Mapping[str, Ring]) -> dict[str, Ring]:
    """Places of the waist's tape: in front and at the back, in the middle, under the bust points
    and under the side neck points.
    """
    points = ring.points(stands)
    front = points[:, 2] > 0.5 * (points[:, 2].min() + points[:, 2].max())

    def nearest(across: float, where: np.ndarray) -> Ring:
        return _point(ring, int(np.where(where, np.abs(points[:, 0] - across), np.inf).argmin()))

    found = {"waist_front_level": nearest(0.0, front), "waist_back_level": nearest(0.0, ~front)}
    for side in SIDES:
        breast, neck = (places[f"{side}{n}"].points(stands)[0, 0] for n in ("breast", "side_neck"))
        found[f"{side}waist_bust"] = nearest(breast, front)
        found[f"{side}waist_scapula"] = nearest(neck, ~front)
    return found


def _arc(leg: Leg, skin: np.ndarray, stands: np.ndarray, places: Mapping[str, Ring]) -> Ring | None:
    """The points of the skin between the ends of a leg, the ends first and last."""
    ends = [places[leg.start], places[leg.end]]
    start, end = (ring.points(stands)[0] for ring in ends)
    out = np.array(leg.out)
    found = intersect(stands, skin, start, np.cross(end - start, out))
    if found is None:
        return None
    ring, links = found
    points = ring.points(stands)
    tips = [int(np.linalg.norm(points - tip, axis=1).argmin()) for tip in (start, end)]
    kept = np.ones(len(points), bool)
    kept[tips] = False
    graph = (links + links.T).tocsr()
    _, part = connected_components(graph[kept][:, kept], directed=False)
    label = np.full(len(points), -1)
    label[kept] = part
    beside = [set(label[np.flatnonzero(graph[[tip]].toarray()[0])]) - {-1} for tip in tips]
    both = beside[0] & beside[1]
    if not both:
        return Ring(np.concatenate([r.edges for r in ends]), np.zeros(2), np.eye(3)[:2])
    best = max(both, key=lambda k: ((points[label == k] - start) @ out).mean())
    chosen = label == best
    edges = [ends[0].edges, ring.edges[chosen], ends[1].edges]
    share = [ends[0].share, ring.share[chosen], ends[1].share]
    return Ring(np.concatenate(edges), np.concatenate(share), ring.axes)


def _armscye(
    faces: np.ndarray, rest: np.ndarray, stands: np.ndarray, places: Mapping[str, Ring], side: str
) -> Ring | None:
    """A tape through the shoulder's tip and the armpit around the arm, laid with level arms."""
    top, low = (places[f"{side}{name}"] for name in ("acromion", "armpit"))
    way = top.points(rest)[0] - low.points(rest)[0]
    place = low.points(rest)[0] + 0.5 * way
    ring = cut(rest, faces, place, np.cross(way, _FRONT))
    if ring is None:
        return None
    hanging = top.points(stands)[0] - low.points(stands)[0]
    hanging = hanging * [1.0, 1.0, 0.0]
    return Ring(ring.edges, ring.share, np.stack([hanging / np.linalg.norm(hanging), _FRONT]))


def _on_armscye(
    ring: Ring | None, stands: np.ndarray, places: Mapping[str, Ring], side: str
) -> dict[str, Ring]:
    """Where the armscye crosses the level half way from the armpit to the shoulder's tip."""
    if ring is None:
        return {}
    points = ring.points(stands)
    top, low = (places[f"{side}{name}"].points(stands)[0] for name in ("acromion", "armpit"))
    off = np.abs(points[:, 1] - 0.5 * (top + low)[1])
    back = points[:, 2] < 0.5 * (top + low)[2]
    return {
        f"{side}scye_back": _point(ring, int(np.where(back, off, np.inf).argmin())),
        f"{side}scye_front": _point(ring, int(np.where(back, np.inf, off).argmin())),
    }


def _slope(name: str, at: Mapping[str, np.ndarray], ends: tuple[str, str], side: str) -> np.ndarray:
    way = at[_of(ends[0], side)] - at[_of(ends[1], side)]
    across, up = np.abs(way[:, 0]), np.abs(way[:, 1])
    if name == "hip_inclination_deg":
        sign = 1.0 if side == "left_" else -1.0
        return np.rad2deg(np.arctan2(sign * way[:, 0], up))
    return np.rad2deg(np.arctan2(way[:, 1], across))
