"""Tape, scales and yardstick: what a tailor or a doctor would read off a person.

The person is upright at rest, arms level to the sides (T-pose), feet a little apart; shoulders,
chest and hips are measured with hanging arms and heels together (`habitus.body.tapes`). A
circumference is a tape's length around a material ring (`habitus.body.tapes`), heights are along y
from the lowest point of the sole, limbs are measured on both sides and averaged. Everything is laid
out once on the body's template and then goes along with its vertices, so that measurements change
continuously with the shape. Also where the soles of the feet are.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.arrays import to_numpy
from habitus.body.body_arrays import BodyArrays
from habitus.body.seated import SeatedKit, lay_seated
from habitus.body.sewing import SewingKit, lay_sewing
from habitus.body.state import BodySurface
from habitus.body.tapes import (
    ARMS,
    SIDES,
    STANDING_TAPES,
    LaidTape,
    Standing,
    cut,
    lay_tapes,
    stand,
)
from habitus.errors import HabitusError
from habitus.types import Array, ArrayLike

DENSITY = 1000.0
"""kg/m^3, lungs half full: a person's of whom no waist is known, and that with which bodies of
known ages were fitted to published weights."""
LEAN_DENSITY, DENSITY_SLOPE = 1090.0, -141.0
"""kg/m^3 of an adult, lungs half full: ``LEAN_DENSITY + DENSITY_SLOPE * waist / height``.
Fitted to scales and volumes of 220 adults of ANSUR II (bodies from 13 lengths and girths, without
the weight). Fitted to one half of them, masses of the other have a bias of .1 and .2 kg and an
error of 2.2 and 2.1 % (women, men; RMS); with 1,000 kg/m^3 of -.9 and -1.1 kg, 2.7 and 2.6 %."""
WAISTS = (0.40, 0.72)
"""Waist over height of those adults."""
SEAT = 1.0105  # sitting height as a share of stature less crotch height: the mean of ANSUR II
# acromion to the radius' head, as a share of the way between the centres of shoulder and elbow
ACROMION = 1.22
POSTURES = ("standing", "seated")
_Z = np.eye(3)[2]
_HEIGHTS = {
    "cervical_height_m": "c7",
    "chest_height_m": "left_breast",
    "waist_height_m": "navel",
    "hip_height_m": "left_buttock",
    "trochanter_height_m": "left_trochanter",
    "knee_height_m": "left_patella",
    "ankle_height_m": "left_ankle_lateral",
}
_DISTANCES = {
    "forearm_length_m": ("left_elbow_lateral", "left_wrist_radial"),
    "hand_length_m": ("left_wrist", "left_middle_tip"),
    "head_length_m": ("glabella", "head_back"),
    "head_breadth_m": ("left_head_side", "right_head_side"),
}


@runtime_checkable
class MeasurableBody(Protocol):
    """What of a body (`habitus.body.model.BodyModel`) is needed to measure it."""

    @property
    def v_template(self) -> Float[np.ndarray, "V 3"]:
        """The mean person at rest."""
        ...

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

    @property
    def age(self) -> float | None:
        """That the body was brought to (years)."""
        ...

    @property
    def prepare(self) -> Any:
        """The body function with a fixed shape, of some vertices."""
        ...


@dataclass(frozen=True, eq=False)
class MeasuringKit:
    """Tapes, yardsticks and calipers laid on a body's template: which vertices each of them looks
    at.

    ``feet`` are a foot's vertices, which of them are the ball, and its long axis, one a side;
    ``standing`` and ``sewing`` are what is measured in another posture.
    """

    tapes: tuple[LaidTape, ...]
    closed: bool
    midline: Int[np.ndarray, " M"]
    feet: tuple[tuple[Int[np.ndarray, " N"], Bool[np.ndarray, " N"], Float[np.ndarray, " 3"]], ...]
    standing: Standing | None
    sewing: SewingKit | None


def lay_out(body: MeasurableBody) -> MeasuringKit | None:
    """What measures this body; None for hands and animals."""
    if not {"pelvis", "left_hip", "left_knee", "head"} <= set(body.joint_names):
        return None
    template = body.v_template
    places = _places(body, template)
    names = [
        n
        for n in body.joint_names
        if n.removeprefix("left_").removeprefix("right_").startswith(ARMS)
    ]
    arms = _carried(body, names)
    tapes = lay_tapes(template, body.faces, places, arms)
    used = np.unique(body.faces)
    middle = () if body.mirror is None else used[body.mirror[used] == used]
    posed = {tape.name: tape.rings[0] for tape in tapes if tape.name in STANDING_TAPES}
    upper_arms = _carried(body, ["left_shoulder", "right_shoulder"])
    standing = stand(body, places, arms, upper_arms, posed)
    feet = tuple(_foot(body, side, places) for side in SIDES)
    midline = np.array(middle, int)
    sewing = (
        None if standing is None else lay_sewing(body, places, arms, tapes, standing.pose, midline)
    )
    return MeasuringKit(tapes, is_closed(body.faces), midline, feet, standing, sewing)


def measure(
    body: MeasurableBody, rest_vertices: Float[Array, "V 3"], kit: MeasuringKit | None = None
) -> dict[str, float]:
    """Measurements of a person at rest (T-pose), in metres and kilograms; none for hands and
    animals.

    `habitus.body.measurement_names` says what each is. ``mass_kg`` is there where the skin is
    closed, ``inseam_m`` where the body knows its mirror image, heights and lengths between
    landmarks where it has these. ``kit`` is `lay_out(body)`, where the caller keeps it.
    """
    measured = measure_many(body, to_numpy(rest_vertices, np.float64)[None], kit)
    return {name: float(values[0]) for name, values in measured.items()}


def measure_many(
    body: MeasurableBody,
    rest_vertices: Float[np.ndarray, "N V 3"],
    kit: MeasuringKit | None = None,
    sewing: bool = True,
) -> dict[str, Float[np.ndarray, " N"]]:
    """`measure` of several people. sewing: with the tapes of `habitus.body.sewing`, which come last
    and take nine tenths of the time.
    """
    kit = kit or lay_out(body)
    if kit is None:
        return {}
    vertices = rest_vertices
    places = _places(body, rest_vertices)
    height = vertices[..., 1]
    sole = height.min(axis=-1)
    measured = {"height_m": np.ptp(height, axis=-1)}
    if len(kit.midline):
        measured["inseam_m"] = height[:, kit.midline].min(axis=-1) - sole
        measured["sitting_height_m"] = SEAT * (measured["height_m"] - measured["inseam_m"])
    measured |= {
        n: _sides(lambda p: places[p][:, 1] - sole, places, mark) for n, mark in _HEIGHTS.items()
    }
    measured["arm_span_m"] = np.ptp(vertices[..., 0], axis=-1)
    measured |= {
        n: _sides(lambda a, b: _apart(places, a, b), places, *ends)
        for n, ends in _DISTANCES.items()
    }
    arms = _sides(lambda a, b: _apart(places, a, b), places, "left_shoulder", "left_elbow")
    measured["upper_arm_length_m"] = None if arms is None else ACROMION * arms
    measured |= _of_feet(kit, vertices) | _around(kit, vertices)
    measured["surface_area_m2"] = surface_area(vertices, body.faces)
    if kit.closed:
        waist = None if body.age is not None else measured.get("waist_circumference_m")
        density = DENSITY if waist is None else density_of(waist / measured["height_m"])
        measured["volume_m3"] = volume(vertices, body.faces)
        measured["mass_kg"] = density * measured["volume_m3"]
    if kit.standing is not None:
        joints = np.stack([places[name] for name in body.joint_names], axis=1)
        measured |= kit.standing.measure(vertices, joints, sole)
        if kit.sewing is not None and sewing:
            measured |= kit.sewing.measure(vertices, joints, sole)
            measured["back_neck_to_crown_m"] = measured["height_m"] - measured["cervical_height_m"]
    return {name: values for name, values in measured.items() if values is not None}


def density_of(waist_over_height: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """kg/m^3 of adults, lungs half full."""
    return LEAN_DENSITY + DENSITY_SLOPE * np.clip(waist_over_height, *WAISTS)


def volume(
    vertices: Float[np.ndarray, "*batch V 3"], faces: Int[np.ndarray, "T 3"]
) -> float | Float[np.ndarray, "*batch"]:
    """The volume (m^3) inside a closed surface whose triangles run counter-clockwise seen from
    outside.
    """
    x, y, z = np.moveaxis(vertices - vertices.mean(-2, keepdims=True), -1, 0)
    a, b, c = faces.T
    ya = y[..., a]
    za = z[..., a]
    area = (y[..., b] - ya) * (z[..., c] - za) - (z[..., b] - za) * (
        y[..., c] - ya
    )  # twice the shadow along x
    return np.einsum("...t,...t->...", x[..., a] + x[..., b] + x[..., c], area) / 6


def surface_area(
    vertices: Float[np.ndarray, "*batch V 3"], faces: Int[np.ndarray, "T 3"]
) -> float | Float[np.ndarray, "*batch"]:
    """The area (m^2) of a surface."""
    a, b, c = faces.T
    axes = [np.ascontiguousarray(vertices[..., k]) for k in range(3)]
    (ux, vx), (uy, vy), (uz, vz) = ((p[..., b] - p[..., a], p[..., c] - p[..., a]) for p in axes)
    squared = (uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2
    return 0.5 * np.sqrt(squared).sum(-1)


def circumference(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "T 3"],
    place: Float[np.ndarray, " 3"],
    normal: Float[np.ndarray, " 3"],
) -> float:
    """Length (m) of a tape around the loop that a plane cuts from a surface nearest to a place in
    it; 0 without any.
    """
    ring = cut(vertices, faces, place, normal)
    return 0.0 if ring is None else float(ring.length(vertices))


def _places(body: MeasurableBody, vertices: np.ndarray) -> dict[str, np.ndarray]:
    """Joints and landmarks (*batch, 3) by name; a landmark goes before a joint of its name."""
    joints = body.joint_regressor @ vertices
    places = {name: joints[..., k, :] for k, name in enumerate(body.joint_names)}
    return places | {name: vertices[..., vertex, :] for name, vertex in body.landmarks.items()}


def _sides(length: Any, places: Mapping[str, np.ndarray], *names: str) -> np.ndarray | None:
    """A length at places of the left side, averaged with that on the right; from left to right
    there is but one.

    None where the body lacks the places.
    """
    across = any(name.startswith("right_") for name in names)
    both = [tuple(n if across else n.replace("left_", side, 1) for n in names) for side in SIDES]
    known = [each for each in dict.fromkeys(both) if set(each) <= places.keys()]
    return np.mean([length(*each) for each in known], axis=0) if known else None


def _apart(places: Mapping[str, np.ndarray], a: str, b: str) -> np.ndarray:
    return np.linalg.norm(places[a] - places[b], axis=-1)


def _around(kit: MeasuringKit, vertices: np.ndarray) -> dict[str, np.ndarray]:
    """Circumferences, and the breadths and depths of the same rings."""
    girths = {}
    spans = {}
    for tape in kit.tapes:
        girths[f"{tape.name}_circumference_m"] = np.mean(
            [ring.length(vertices) for ring in tape.rings], axis=0
        )
        for span, rings in tape.spans:
            spans[span.name] = np.mean(
                [ring.extent(vertices, np.array(span.direction)) for ring in rings], axis=0
            )
    return spans | girths


def _of_feet(kit: MeasuringKit, vertices: np.ndarray) -> dict[str, np.ndarray]:
    """Extents along and across each foot's long axis, which is level."""
    sizes: dict[str, list[np.ndarray]] = {"foot_length_m": [], "foot_breadth_m": []}
    for foot, ball, axis in kit.feet:
        if len(foot) and ball.any():
            sizes["foot_length_m"].append(np.ptp(vertices[:, foot] @ axis, axis=-1))
            across = np.cross(np.array([0.0, 1.0, 0.0]), axis)
            sizes["foot_breadth_m"].append(np.ptp(vertices[:, foot[ball]] @ across, axis=-1))
    return {name: np.mean(sides, axis=0) for name, sides in sizes.items() if sides}


def _foot(
    body: MeasurableBody, side: str, places: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A foot's vertices, which are not of its toes, and its long axis, from heel to the second
    toe's head, level.

    Straight ahead and all of it where the body has no such landmarks.
    """
    foot = np.flatnonzero(_carried(body, [f"{side}ankle", f"{side}foot"]))
    if not {f"{side}heel", f"{side}mt1_head", f"{side}mt2_head"} <= places.keys():
        return foot, np.ones(len(foot), bool), _Z
    way = (places[f"{side}mt2_head"] - places[f"{side}heel"]) * [1, 0, 1]
    ball = body.v_template[foot, 2] < places[f"{side}mt1_head"][2] + 0.015
    return foot, ball, way / np.linalg.norm(way)


def _carried(body: MeasurableBody, names: list[str]) -> np.ndarray:
    """Which vertices are carried mostly by joints of these names."""
    chosen = [k for k, name in enumerate(body.joint_names) if name in names]
    return body.skinning_weights[:, chosen].sum(1) > 0.5


def is_closed(faces: Int[np.ndarray, "T 3"]) -> bool:
    """Whether every side of a triangle is the side of one other, run through the other way."""
    sides = np.concatenate([faces, np.roll(faces, -1, axis=1)], 0).reshape(2, -1)
    size = int(faces.max()) + 1
    return np.array_equal(np.sort(sides[0] * size + sides[1]), np.sort(sides[1] * size + sides[0]))


_BLOCK = 64  # people at once: as many as the cache holds


class Measured:
    """Of a `habitus.body.model.BodyModel`: how tall, how heavy, how wide."""

    @cached_property
    def measuring_kit(self) -> MeasuringKit | None:
        """Tapes and yardsticks laid on the template; None for hands and animals."""
        return lay_out(self)  # type: ignore[arg-type]

    @cached_property
    def seated_kit(self) -> SeatedKit | None:
        """The kit of seated dimensions; None for hands, animals and bodies without arms."""
        return lay_seated(self)

    def measure(
        self, surface: BodySurface | ArrayLike | None = None, posture: str = "standing"
    ) -> dict[str, float]:
        """Measurements of a person at rest (`habitus.body.measurements`), in metres and kilograms,
        or "seated" (`habitus.body.seated`).

        Of the template, of shape coefficients (B,), or of the person whose surface is given,
        whatever its pose: a surface knows its betas. Raises HabitusError for several people and
        other postures.
        """
        betas = () if surface is None else getattr(surface, "betas", surface)
        rest = self.rest_vertices(to_numpy(betas, np.float64))  # type: ignore[attr-defined]
        if rest.ndim != 2:
            raise HabitusError(f"{rest.shape[:-2]} people to measure; give the betas of one, (B,)")
        return self.measure_rest(rest, posture)

    def measure_rest(
        self, rest_vertices: np.ndarray, posture: str = "standing"
    ) -> dict[str, float]:
        """Measurements of a person whose surface at rest (V, 3) is given, whatever shape it has."""
        if posture not in POSTURES:
            raise HabitusError(f"posture {posture!r}; expected one of {', '.join(POSTURES)}")
        if posture == "standing":
            return measure(self, rest_vertices, self.measuring_kit)  # type: ignore[arg-type]
        kit, rest = self.seated_kit, to_numpy(rest_vertices, np.float64)
        if kit is None:
            return {}
        return kit.measure(rest, self.joint_regressor @ rest)  # type: ignore[attr-defined]

    def measure_people(self, betas: ArrayLike, sewing: bool = True) -> dict[str, np.ndarray]:
        """Measurements (N,) of N people at once, of betas (N, B). sewing: as for `measure_many`."""
        people = to_numpy(betas, np.float64)
        parts = []
        for first in range(0, max(len(people), 1), _BLOCK):
            rest = self.rest_vertices(people[first : first + _BLOCK])  # type: ignore[attr-defined]
            parts.append(measure_many(self, rest, self.measuring_kit, sewing))  # type: ignore[arg-type]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@dataclass(frozen=True)
class SoleSettings:
    """Where the soles of a body's feet are."""

    sole_height: float = 0.015
    """Metres from a foot's lowest vertex up to which the sole reaches."""
    sole_parts: tuple[tuple[float, float], ...] = ((0.0, 0.2), (0.6, 0.75), (0.85, 1.0))
    """Heel, ball and toes, in shares of the sole's length from the heel."""


SOLES = SoleSettings()


@dataclass(frozen=True)
class Soles:
    """Points of both feet: each the mean of some vertices. ``points`` (2, 3) holds ids: side; heel,
    ball, toes.
    """

    points: tuple[tuple[Int[np.ndarray, " _"], ...], ...]

    @property
    def used(self) -> Int[np.ndarray, " N"]:
        """All these vertices."""
        return np.unique(np.concatenate([ids for side in self.points for ids in side]))

    def means(self, vertices: Float[np.ndarray, "T N 3"]) -> Float[np.ndarray, "T 2 3 3"]:
        """The points, of the places of the ``used`` vertices: side, point, coordinate."""
        used = self.used
        rows = [[np.searchsorted(used, ids) for ids in side] for side in self.points]
        return np.stack(
            [np.stack([vertices[:, row].mean(axis=1) for row in side], 1) for side in rows], 1
        )

    def lowest(self, vertices: Float[np.ndarray, "T N 3"]) -> tuple[Float[np.ndarray, " T"], ...]:
        """The height (y) of each sole's lowest vertex, of the places of the ``used`` ones."""
        sides = (np.searchsorted(self.used, np.concatenate(side)) for side in self.points)
        return tuple(vertices[:, rows, 1].min(axis=1) for rows in sides)


def find_soles(body: BodyArrays, settings: SoleSettings = SOLES) -> Soles:
    """The soles of a body, by its skinning and its template (y up, facing +z). Raises HabitusError
    without feet.
    """
    strongest = body.skinning_index[np.arange(body.num_vertices), body.skinning_value.argmax(1)]
    return Soles(tuple(_sole(body, strongest, side, settings) for side in ("left", "right")))


def _sole(
    body: BodyArrays, strongest: np.ndarray, side: str, settings: SoleSettings
) -> tuple[np.ndarray, ...]:
    joints = [
        k for k, name in enumerate(body.joint_names) if name in (f"{side}_ankle", f"{side}_foot")
    ]
    ids = np.flatnonzero(np.isin(strongest, joints))
    if not len(ids):
        raise HabitusError(
            f"the body {body.name} has no {side} foot (joints {side}_ankle, {side}_foot)"
        )
    points = body.v_template[ids]
    low = points[:, 1] < points[:, 1].min() + settings.sole_height
    along = (points[:, 2] - points[low, 2].min()) / max(float(np.ptp(points[low, 2])), 1e-9)
    parts = (ids[low & (along >= a) & (along <= b)] for a, b in settings.sole_parts)
    return tuple(part if len(part) else ids[low] for part in parts)
