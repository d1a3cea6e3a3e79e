"""The JSON marker layouts of MoSh++ (github.com/nghorbani/moshpp): labels with vertex ids of one
kind of body.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_LABELS, MAX_LAYOUT_BYTES, check_count, read_json
from habitus.io.names import plain_name
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.matching import interpreted

_VERTEX_COUNTS = {
    "smpl": 6890,
    "smplh": 6890,
    "smplx": 10475,
    "mano": 778,
    "flame": 5023,
    "smal": 3889,
}
_LARGEST = 0.5  # metres


def parse_moshpp(text: str, where: str, known: Sequence[MarkerLayout]) -> MarkerLayout:
    """A MoSh++ marker layout: ``markersets``, each with ``indices`` (label -> vertex id) and
    ``distance_from_skin``.

    Its vertex ids belong to the body that ``surface_model_type`` names. Labels that the ``known``
    layouts understand also get a landmark, so that the layout can serve another body. Raises
    HabitusError for anything else.
    """
    try:
        data = read_json(text, MAX_LAYOUT_BYTES)
        entries = [
            (plain_name(label), _vertex(vertex), _distance(one))
            for one in data["markersets"]
            for label, vertex in one["indices"].items()
        ]
    except (
        HabitusError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        ArithmeticError,
    ) as error:
        raise HabitusError(
            f"layout file {where} is no MoSh++ marker layout ({type(error).__name__}: {error}); "
            "expected JSON with markersets, each with indices (label: vertex id)"
        ) from error
    if not entries:
        raise HabitusError(
            f"layout file {where} has no markers; expected markersets with indices (label: vertex "
            "id)"
        )
    body = str(data.get("surface_model_type", "")).lower().replace("-", "").replace("_", "")
    unique = {label: (vertex, distance) for label, vertex, distance in reversed(entries)}
    labels = tuple(dict.fromkeys(label for label, _, _ in entries))
    check_count(len(labels), MAX_LABELS, f"markers in the layout file {where}")
    places = interpreted(labels, known).markers
    markers = []
    for column, label in enumerate(labels):
        place = places.get(column, Marker(label))
        vertex, distance = unique[label]
        markers.append(
            Marker(
                label,
                landmark=place.landmark,
                between=place.between,
                vertex=vertex,
                distance=distance,
            )
        )
    title = f"MoSh++ layout for {shown(body) or 'a body that the file does not name'}"
    return MarkerLayout(
        plain_name(Path(where).stem),
        tuple(markers),
        title=title,
        num_vertices=_VERTEX_COUNTS.get(body),
    )


def _vertex(value: object) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"vertex id {value!r}")
    return value


def _distance(one: dict) -> float:
    distance = float(one.get("distance_from_skin", Marker.distance))
    if not 0.0 <= distance < _LARGEST:
        raise ValueError(f"distance_from_skin {distance}; expected metres")
    return distance
