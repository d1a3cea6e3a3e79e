"""Tape, scales and yardstick: what a tailor or a doctor would read off a body at rest.

A circumference is the length of a tape, the convex hull of the loop in which a plane cuts the skin; of the loops, the
one around a given place counts. Heights are along y, from the lowest point of the sole. Limbs are measured on both
sides and averaged. Places come from landmarks where a body has them, and from joints otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from habitus.arrays import to_numpy
from habitus.types import Array

DENSITY = (
    1000.0  # kg/m^3, lungs half full: what the shapes of the default body were fitted to the scales of a survey with
)
_UP, _NECK = (0.0, 1.0, 0.0), (0.0, 1.0, 0.45)


@runtime_checkable
class MeasurableBody(Protocol):
    """What of a body (`habitus.body.model.BodyModel`) is needed to measure it."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """(J,)"""
        ...

    @property
    def joint_regressor(self) -> Float[np.ndarray, "J V"]:
        """From rest vertices to joints."""
        ...

    @property
    def skinning_weights(self) -> Float[np.ndarray, "V J"]:
        """How much of a vertex moves with a joint."""
        ...

    @property
    def faces(self) -> Int[np.ndarray, "T 3"]:
        """Triangles."""
        ...

    @property
    def landmarks(self) -> Mapping[str, int]:
        """Vertices by name."""
        ...

    @property
    def mirror(self) -> Int[np.ndarray, " V"] | None:
        """Each vertex' partner across the body."""
        ...


@dataclass(frozen=True)
class _Tape:
    """A plane between two places (landmarks, or joints as a fallback) at a share of the way, across a direction."""

    name: str
    start: str
    end: str
    share: float = 0.5
    across: tuple[float, float, float] | None = None  # None: the way itself
    otherwise: tuple[str, str, float] | None = None


_TAPES = (
    _Tape("chest", "left_breast", "right_breast", across=_UP, otherwise=("spine3", "spine3", 0.0)),
    _Tape("waist", "navel", "waist_back", 0.0, across=_UP, otherwise=("spine1", "spine2", 0.1)),  # at the navel
    _Tape("hip", "left_buttock", "right_buttock", across=_UP, otherwise=("left_hip", "right_hip", 0.5)),
    _Tape("neck", "neck", "head", 0.25, across=_NECK),
    _Tape("head", "glabella", "head_back", across=_UP),
)
_LIMBS = (
    _Tape("thigh", "left_hip", "left_knee", 0.27, across=_UP),
    _Tape("calf", "left_knee", "left_ankle", 0.3, across=_UP),
    _Tape("ankle", "left_knee", "left_ankle", 0.78, across=_UP),
    _Tape("upper_arm", "left_shoulder", "left_elbow", 0.6),
    _Tape("forearm", "left_elbow", "left_wrist", 0.22),
    _Tape("wrist", "left_elbow", "left_wrist", 0.97),
)
_ARMS = ("collar", "shoulder", "elbow", "wrist", "hand", "index", "middle", "pinky", "ring", "thumb")


def measure(body: MeasurableBody, rest_vertices: Float[Array, "V 3"]) -> dict[str, float]:
    """Measurements of a person at rest (T-pose), in metres and kilograms; none for hands and animals.

    ``height_m`` from sole to crown; ``mass_kg`` at 1,000 kg/m^3 where the skin is closed; ``arm_span_m`` between
    fingertips; ``inseam_m`` from sole to crotch where the body knows its mirror image; ``foot_length_m``;
    circumferences ``chest`` (nipples), ``waist`` (navel), ``hip`` (fullest buttocks), ``neck``, ``head``, ``thigh`` (27
    % of the way to the knee), ``calf`` (30 % of the way to the ankle), ``ankle``, ``upper_arm`` (60 % of the way to the
    elbow), ``forearm`` (22 % of the way to the wrist) and ``wrist``, each named ``…_circumference_m``.
    """
    if not {"pelvis", "left_hip", "left_knee", "head"} <= set(body.joint_names):
        return {}
    vertices, faces = to_numpy(rest_vertices, np.float64), body.faces
    joints = body.joint_regressor @ vertices
    places = dict(zip(body.joint_names, joints, strict=True))
    places |= {name: vertices[vertex] for name, vertex in body.landmarks.items()}
    found = {"height_m": float(np.ptp(vertices[:, 1]))}
    if _closed(faces):
        found["mass_kg"] = DENSITY * volume(vertices, faces)
    return found | _lengths(body, vertices) | _circumferences(body, vertices, faces, places)


def volume(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "T 3"]) -> float:
    """The volume (m^3) inside a closed surface whose triangles run counter-clockwise seen from outside."""
    a, b, c = (vertices - vertices.mean(0))[faces].swapaxes(0, 1)
    return float(np.einsum("tc,tc->", a, np.cross(b, c)) / 6)


def circumference(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "T 3"],
    place: Float[np.ndarray, " 3"],
    normal: Float[np.ndarray, " 3"],
) -> float:
    """Length (m) of a tape around the loop that a plane cuts from a surface nearest to a place in it; 0 without any."""
    normal = normal / np.linalg.norm(normal)
    height = (vertices - place) @ normal
    above = height >= 0
    crossing = faces[above[faces].any(1) & ~above[faces].all(1)]
    if len(crossing) == 0:
        return 0.0
    sides = np.sort(np.stack([crossing, np.roll(crossing, -1, axis=1)], -1), -1)
    cut = above[sides[..., 0]] != above[sides[..., 1]]
    edges, which = np.unique(sides[cut], axis=0, return_inverse=True)  # two cut sides a triangle, in order of triangles
    links = which.reshape(-1, 2)
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(edges), len(edges)))
    count, loop = connected_components(graph, directed=False)
    near, far = height[edges].T
    points = vertices[edges[:, 0]] + (near / (near - far))[:, None] * (vertices[edges[:, 1]] - vertices[edges[:, 0]])
    middles = [np.linalg.norm(points[loop == k].mean(0) - place) for k in range(count)]
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    flat = points[loop == int(np.argmin(middles))] @ np.stack([first, np.cross(normal, first)], 1)
    try:
        return float(ConvexHull(flat).area) if len(flat) > 2 else 0.0  # the "area" of a flat hull is its perimeter
    except QhullError:  # a loop without width: its tape goes there and back
        return 2.0 * float(np.ptp(flat, axis=0).max())


def _closed(faces: Int[np.ndarray, "T 3"]) -> bool:
    """Whether every side of a triangle is the side of one other, run through the other way."""
    sides = np.concatenate([faces, np.roll(faces, -1, axis=1)], 0).reshape(2, -1)
    size = int(faces.max()) + 1
    return np.array_equal(np.sort(sides[0] * size + sides[1]), np.sort(sides[1] * size + sides[0]))


def _lengths(body: MeasurableBody, vertices: np.ndarray) -> dict[str, float]:
    found = {"arm_span_m": float(np.ptp(vertices[:, 0]))}
    if body.mirror is not None:
        middle = body.mirror == np.arange(len(vertices))
        found["inseam_m"] = float(vertices[middle, 1].min() - vertices[:, 1].min())
    feet = [vertices[_carried(body, (f"{side}_ankle", f"{side}_foot"))] for side in ("left", "right")]
    if all(len(foot) for foot in feet):
        found["foot_length_m"] = float(np.mean([np.ptp(foot[:, 2]) for foot in feet]))
    return found


def _carried(body: MeasurableBody, names: tuple[str, ...]) -> np.ndarray:
    """Which vertices are carried mostly by joints of these names."""
    wanted = [k for k, name in enumerate(body.joint_names) if name in names]
    return body.skinning_weights[:, wanted].sum(1) > 0.5


def _circumferences(
    body: MeasurableBody, vertices: np.ndarray, faces: np.ndarray, places: Mapping[str, np.ndarray]
) -> dict[str, float]:
    arms = tuple(
        name for name in body.joint_names if name.removeprefix("left_").removeprefix("right_").startswith(_ARMS)
    )
    trunk = faces[~_carried(body, arms)[faces].any(1)]
    found = {}
    for tape in _TAPES:
        if (plane := _plane(tape, places)) is not None:
            found[f"{tape.name}_circumference_m"] = circumference(vertices, trunk, *plane)
    for tape in _LIMBS:
        sides = [_plane(_on_side(tape, side), places) for side in ("left_", "right_")]
        lengths = [circumference(vertices, faces, *plane) for plane in sides if plane is not None]
        if lengths:
            found[f"{tape.name}_circumference_m"] = float(np.mean(lengths))
    return found


def _on_side(tape: _Tape, side: str) -> _Tape:
    return _Tape(tape.name, tape.start.replace("left_", side), tape.end.replace("left_", side), tape.share, tape.across)


def _plane(tape: _Tape, places: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    start, end, share = tape.start, tape.end, tape.share
    if (start not in places or end not in places) and tape.otherwise is not None:
        start, end, share = tape.otherwise
    if start not in places or end not in places:
        return None
    way = places[end] - places[start]
    return places[start] + share * way, way if tape.across is None else np.array(tape.across)
