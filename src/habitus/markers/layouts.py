"""Marker layouts: which label sits where on a body, and how far off the skin (MoSh paper, sections
4.1 and 7).

A place is a landmark of the body (``body.landmarks``), the surface point nearest to a blend of two
landmarks, or, for one named body only, a vertex id; `place_in_words` gives a vertex one of the
first two. Everything here is data; files are read by ``habitus.io.layouts.files``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError

DEFAULT_DISTANCE = 0.0095
DEFAULT_DISTANCE_SPREAD = 0.001
DEFAULT_PLACE_SPREAD = 0.02
ON_A_FINGER = "finger marker: the fingers of this body move as one part"
"""Why markers on fingers are left out by themselves."""

MIDLINE = 1e-3
"""Metres: places nearer to x = 0 lie on the middle of the body."""


class PlacedBody(Protocol):
    """What a layout needs of a body: its name, its landmarks (name -> vertex) and its template (V,
    3), metres.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def landmarks(self) -> Mapping[str, int]: ...  # noqa: D102
    @property
    def v_template(self) -> Any: ...  # noqa: D102


@dataclass(frozen=True)
class Marker:
    """One marker of a layout.

    label, aliases: how capture files spell it. One place: ``landmark`` (a name in
    ``body.landmarks``), ``between`` (two landmarks and the share of the way from the first to the
    second) or ``vertex`` (an id of one body, see ``MarkerLayout.num_vertices``; a landmark beside
    it is the fallback for other bodies). ``shift``: from there along the skin of the template,
    metres in body space: where people put this marker. ``distance``: marker centre from the skin
    along the vertex normal (or along ``direction`` in body space), metres. ``distance_spread`` and
    ``place_spread``: standard deviations in metres of the distance and of the place on the skin;
    the paper's weights 100/cm² and 0.25/cm² are 1 mm and 2 cm. ``optional`` markers are extras that
    a capture may lack without remark; those ``on_finger`` tell how fingers bend. ``confidence``: of
    a place that was found by fitting, how likely the marker sits within 5 cm of it (0..1).
    """

    label: str
    aliases: tuple[str, ...] = ()
    landmark: str | None = None
    vertex: int | None = None
    between: tuple[str, str, float] | None = None
    shift: tuple[float, float, float] | None = None
    distance: float = DEFAULT_DISTANCE
    distance_spread: float = DEFAULT_DISTANCE_SPREAD
    place_spread: float = DEFAULT_PLACE_SPREAD
    direction: tuple[float, float, float] | None = None
    optional: bool = False
    on_finger: bool = False
    confidence: float | None = None

    @property
    def place(self) -> str:
        """The place in words, e.g. ``left_asis`` or ``left_acromion > left_elbow_lateral 40%``."""
        if self.between is not None:
            first, second, share = self.between
            return f"{first} > {second} {share:.0%}"
        return self.landmark if self.landmark is not None else f"vertex {self.vertex}"

    @property
    def landmarks(self) -> tuple[str, ...]:
        """The landmark names that this marker needs."""
        if self.between is not None:
            return self.between[:2]
        return () if self.landmark is None else (self.landmark,)

    def measured_at(self, **changes: Any) -> Marker:
        """This marker with what the geometry of a capture says of its place, which no ``shift``
        betters.
        """
        return replace(self, shift=None, **changes)

    def moved_to(self, other: Marker) -> Marker:
        """This marker (label, aliases) at the other one's place, distance and spreads."""
        return replace(other, label=self.label, aliases=self.aliases, optional=self.optional)


@dataclass(frozen=True)
class MarkerLayout:
    """A named set of markers. Labels are unique.

    ``fingerprint``: labels that tell this set from others. ``left_out``: known labels that are no
    markers on the skin, with the reason. ``fingers``: markers on fingers, left out but of a layout
    `with_fingers`. ``num_vertices``: the vertex count of the body that vertex ids belong to, None
    where none are used. ``also_known_as``: other names of the same layout.
    """

    name: str
    markers: tuple[Marker, ...]
    title: str = ""
    description: str = ""
    sources: tuple[str, ...] = ()
    also_known_as: tuple[str, ...] = ()
    fingerprint: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    num_vertices: int | None = None
    fingers: tuple[Marker, ...] = ()

    def __post_init__(self) -> None:
        seen: set[str] = set()
        for marker in self.markers:
            if marker.label in seen:
                raise HabitusError(
                    f"layout {self.name}: label {marker.label!r} occurs twice; expected unique "
                    "labels"
                )
            seen.add(marker.label)

    @property
    def labels(self) -> tuple[str, ...]:
        """(M,) the labels, in order."""
        return tuple(marker.label for marker in self.markers)

    def __len__(self) -> int:
        return len(self.markers)

    def __getitem__(self, label: str) -> Marker:
        for marker in self.markers:
            if marker.label == label:
                return marker
        raise KeyError(label)

    def vertices(self, body: PlacedBody) -> Int[np.ndarray, " M"]:
        """(M,) vertex id of each marker's place on this body.

        Raises HabitusError naming the landmarks that the body lacks, or when vertex ids belong to
        another body.
        """
        missing = sorted(
            {
                name
                for marker in self.markers
                for name in marker.landmarks
                if name not in body.landmarks
            }
        )
        count = len(body.v_template)
        own_ids = count == self.num_vertices
        foreign = [
            m.label
            for m in self.markers
            if m.vertex is not None and not m.landmarks and not own_ids
        ]
        if foreign:
            raise HabitusError(
                f"layout {self.name} places {_some(foreign)} by vertex ids of a body with "
                f"{self.num_vertices or 'an unnamed number of'} vertices, but body {body.name} "
                f"has {count}; "
                "use that body (num_vertices in the layout file says which), or give landmark "
                "names instead"
            )
        if missing and not (own_ids and all(marker.vertex is not None for marker in self.markers)):
            raise HabitusError(
                f"layout {self.name}: body {body.name} has no landmark {_some(missing)}; "
                f"it knows {len(body.landmarks)} landmarks; correct the layout or place these "
                "markers elsewhere"
            )
        return np.array(
            [_shifted(marker, _vertex(marker, body, own_ids), body) for marker in self.markers],
            np.int64,
        )

    def distances(self) -> np.ndarray:
        """(M,) distance of each marker centre from the skin, metres."""
        return np.array([marker.distance for marker in self.markers])

    def distance_spreads(self) -> np.ndarray:
        """(M,) standard deviation of each distance from the skin, metres."""
        return np.array([marker.distance_spread for marker in self.markers])

    def place_spreads(self) -> np.ndarray:
        """(M,) standard deviation of each place on the skin, metres."""
        return np.array([marker.place_spread for marker in self.markers])

    def with_fingers(self) -> MarkerLayout:
        """The same layout with its markers on fingers among the others, for a body that has finger
        joints.
        """
        own = {marker.label for marker in self.fingers}
        left_out = {label: why for label, why in self.left_out.items() if label not in own}
        return replace(self, markers=(*self.markers, *self.fingers), left_out=left_out, fingers=())

    def restricted_to(self, labels: tuple[str, ...]) -> MarkerLayout:
        """The same layout with only these labels, in this order."""
        return replace(self, markers=tuple(self[label] for label in labels))


def _shifted(marker: Marker, vertex: int, body: PlacedBody) -> int:
    """The vertex nearest to a marker's shifted place; what lies on the middle of the body stays
    there.
    """
    if marker.shift is None:
        return vertex
    template = np.asarray(body.v_template)
    squared_distances = np.sum((template - (template[vertex] + marker.shift)) ** 2, axis=1)
    if abs(template[vertex, 0]) < MIDLINE and abs(marker.shift[0]) < MIDLINE:
        squared_distances[np.abs(template[:, 0]) > MIDLINE] = np.inf
    return int(np.argmin(squared_distances))


def _vertex(marker: Marker, body: PlacedBody, own_ids: bool) -> int:
    if marker.vertex is not None and (own_ids or not marker.landmarks):
        return _checked_id(marker, body)
    if marker.between is not None:
        first, second, share = marker.between
        template = np.asarray(body.v_template)
        a = template[int(body.landmarks[first])]
        b = template[int(body.landmarks[second])]
        squared_distances = np.sum((template - ((1.0 - share) * a + share * b)) ** 2, axis=1)
        if max(abs(a[0]), abs(b[0])) < MIDLINE:  # what lies between them lies on it too
            squared_distances[np.abs(template[:, 0]) > MIDLINE] = np.inf
        return int(np.argmin(squared_distances))
    assert marker.landmark is not None
    return int(body.landmarks[marker.landmark])


def _checked_id(marker: Marker, body: PlacedBody) -> int:
    assert marker.vertex is not None
    if not 0 <= marker.vertex < len(body.v_template):
        count = len(body.v_template)
        raise HabitusError(
            f"marker {marker.label} names vertex {marker.vertex}; body {body.name} has {count} "
            "vertices"
        )
    return marker.vertex


def _some(names: list[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


AT = 0.012
"""Metres: a vertex this near to a landmark is the landmark."""
_SHARES = np.round(np.linspace(0.05, 0.95, 19), 2)
_MIDDLE = 0.03  # metres: nearer to x = 0 than this, landmarks of both sides may be meant
_LONGEST = 0.45
_TRIED = 24  # metres between two landmarks; pairs looked at
_LENGTH = 0.04  # so much nearer must a point be for each metre that its landmarks are further apart


def place_in_words(body: PlacedBody, vertex: int) -> Marker:
    """A marker without a label at a vertex, said by landmarks, so that people can read and correct
    it; by the vertex where the body has no landmarks.
    """
    template = np.asarray(body.v_template, dtype=float)
    names = [name for name in body.landmarks if _sided_as(name, template[vertex])]
    if len(names) < 2:
        return Marker("", vertex=int(vertex))
    points = template[[int(body.landmarks[name]) for name in names]]
    distances = np.linalg.norm(points - template[vertex], axis=1)
    nearest = int(np.argmin(distances))
    if distances[nearest] <= AT:
        return Marker("", landmark=names[nearest])
    nearest_words = [
        Marker("", landmark=names[nearest]),
        *_between(names, points, template[vertex]),
    ]
    unique = MarkerLayout(
        "", tuple(Marker(str(k), **_place(one)) for k, one in enumerate(nearest_words))
    )
    off = np.linalg.norm(template[unique.vertices(body)] - template[vertex], axis=1)
    far = np.array([0.0, *(_apart(one, body) for one in nearest_words[1:])])
    return nearest_words[int(np.argmin(off + _LENGTH * far))]


def _between(
    names: Sequence[str], points: Float[np.ndarray, "L 3"], target: Float[np.ndarray, " 3"]
) -> list[Marker]:
    """Points between two landmarks that are near to a target, the nearest first."""
    first, second = (np.asarray(rows) for rows in np.triu_indices(len(names), 1))
    near = np.linalg.norm(points[first] - points[second], axis=1) < _LONGEST
    first = first[near]
    second = second[near]
    way = points[second] - points[first]
    at = points[first][:, None] + _SHARES[None, :, None] * way[:, None]
    off = np.linalg.norm(at - target, axis=2) + _LENGTH * np.linalg.norm(way, axis=1)[:, None]
    best = np.argmin(off, axis=1)
    order = np.argsort(off[np.arange(len(best)), best], kind="stable")[:_TRIED]
    return [
        Marker("", between=(names[int(first[k])], names[int(second[k])], float(_SHARES[best[k]])))
        for k in order
    ]


def _apart(marker: Marker, body: PlacedBody) -> float:
    ends = np.asarray(body.v_template)[[int(body.landmarks[name]) for name in marker.landmarks]]
    return float(np.linalg.norm(ends[0] - ends[1]))


def _place(marker: Marker) -> dict:
    return {"landmark": marker.landmark, "between": marker.between}


def _sided_as(name: str, point: Float[np.ndarray, " 3"]) -> bool:
    """Whether a landmark is not on the other side of the body than a point."""
    other = "right_" if point[0] > _MIDDLE else "left_" if point[0] < -_MIDDLE else None
    return other is None or not name.startswith(other)
