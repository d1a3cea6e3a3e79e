"""Markers to choose among: those of layouts, or a set's own and landmarks spread over the body."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.selection.problem import Candidates
from habitus.io.layouts.files import load_layout
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.types import PathLike

APART = 0.015
"""Metres below which two places are one."""
_NOT_SKIN = (
    "thumb",
    "index",
    "middle",
    "ring",
    "pinky",
    "eye",
    "ear",
    "nose",
    "tip",
    "glabella",
    "sellion",
)


@dataclass(frozen=True, eq=False)
class Pool:
    """Candidates, the layout that holds them all, and the groups to start from."""

    candidates: Candidates
    layout: MarkerLayout
    start: tuple[int, ...]


def find_layout(start: int | PathLike) -> MarkerLayout:
    """A layout without its optional markers; a number is that of MoSh's sets. Raises
    HabitusError.
    """
    text = str(start)
    found = load_layout(f"mosh-{text}" if text.isdigit() else text)
    return found.restricted_to(
        tuple(marker.label for marker in found.markers if not marker.optional)
    )


def find_pool(
    body: BodyModel, pool: int | str | Sequence[str], start: MarkerLayout, pairs: bool
) -> Pool:
    """The candidates that ``pool`` means (a number, or layouts), those of ``start`` first.

    Raises HabitusError for fewer than the start has.
    """
    text = str(pool) if isinstance(pool, int | str) else ",".join(pool)
    if text.isdigit():
        markers = _spread(body, list(start.markers), int(text))
    else:
        others = [
            marker for name in text.split(",") for marker in load_layout(name.strip()).markers
        ]
        markers = _apart(body, [*start.markers, *others])
    layout = MarkerLayout("candidates", tuple(markers), num_vertices=start.num_vertices)
    vertices = layout.vertices(body)
    groups = _mirrored(body, vertices) if pairs else [(k,) for k in range(len(vertices))]
    first = tuple(
        k
        for k, group in enumerate(groups)
        if any(layout.labels[each] in start.labels for each in group)
    )
    return Pool(Candidates(layout.labels, vertices, tuple(groups)), layout, first)


def _spread(body: BodyModel, markers: list[Marker], count: int) -> list[Marker]:
    """``count`` markers: the given ones, then landmarks, each time the one farthest from all
    others, with its twin.
    """
    if count < len(markers):
        raise HabitusError(
            f"{count} candidates, and a start of {len(markers)} markers; expected more candidates"
        )
    names = [name for name in body.landmarks if not any(part in name for part in _NOT_SKIN)]
    places = {name: body.v_template[body.landmarks[name]] for name in names}
    taken = [
        body.v_template[vertex] for vertex in MarkerLayout("start", tuple(markers)).vertices(body)
    ]
    while len(markers) < count:
        distance = {
            name: np.linalg.norm(np.array(taken) - place, axis=1).min()
            for name, place in places.items()
        }
        name = max(distance, key=lambda each: distance[each], default="")
        if not name or distance[name] < APART:
            raise HabitusError(
                f"{body.name} has landmarks for {len(markers)} candidates, {count} were asked for"
            )
        for one in dict.fromkeys((name, _other_side(name))):
            if one in places and len(markers) < count:
                markers.append(Marker(_label(one), landmark=one))
                taken.append(places.pop(one))
    return markers


def _apart(body: BodyModel, markers: Sequence[Marker]) -> list[Marker]:
    """Those of the markers that lie `APART` of all before them, under labels of their own."""
    numbered = MarkerLayout(
        "all", tuple(replace(marker, label=f"{k}") for k, marker in enumerate(markers))
    )
    kept: dict[str, Marker] = {}
    taken = np.zeros((0, 3))
    for marker, point in zip(markers, body.v_template[numbered.vertices(body)], strict=True):
        if (
            marker.label not in kept
            and np.linalg.norm(taken - point, axis=1).min(initial=np.inf) >= APART
        ):
            kept[marker.label] = marker
            taken = np.vstack([taken, point])
    return list(kept.values())


def _mirrored(body: BodyModel, vertices: np.ndarray) -> list[tuple[int, ...]]:
    """Groups of a marker and its twin on the other side, where there is one."""
    places = body.v_template[vertices]
    groups = []
    free = set(range(len(vertices)))
    for k in range(len(vertices)):
        if k not in free:
            continue
        away = np.linalg.norm(places - places[k] * [-1, 1, 1], axis=1)
        twin = min((j for j in free if j != k), key=lambda j: away[j], default=k)
        group = (
            (k, twin) if twin != k and away[twin] < APART and abs(places[k, 0]) > APART else (k,)
        )
        groups.append(tuple(sorted(group)))
        free -= set(group)
    return groups


def _other_side(name: str) -> str:
    side, _, rest = name.partition("_")
    other = {"left": "right", "right": "left"}.get(side)
    return f"{other}_{rest}" if other else name


def _label(landmark: str) -> str:
    side, _, rest = landmark.partition("_")
    return f"{side[0].upper()}_{rest.upper()}" if side in ("left", "right") else landmark.upper()
