"""Marker layouts as TOML text: one readable line a marker, left and right written once."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_LABELS, MAX_LAYOUT_BYTES, check_count, read_toml
from habitus.io.names import plain_name
from habitus.markers.layouts import ON_A_FINGER, Marker, MarkerLayout

_SIDES = re.compile(r"\[(?:([^\[\]|]+)\|([^\[\]|]+)|(L)(R))\]")
_PLACE_KEYS = ("place", "between", "vertex")
_OTHER_KEYS = (
    "aliases",
    "shift",
    "distance",
    "distance_spread",
    "place_spread",
    "direction",
    "optional",
    "confidence",
)
_FILE_KEYS = {
    "name",
    "title",
    "description",
    "sources",
    "also_known_as",
    "fingerprint",
    "extends",
    "without",
    "defaults",
    "num_vertices",
    "markers",
    "fingers",
    "left_out",
}


def parse_layout(text: str, where: str, base_of: Callable[[str], MarkerLayout]) -> MarkerLayout:
    """A layout from the text of a TOML file.

    ``where`` names the file in errors; ``base_of`` gives the layout that ``extends`` names. Raises
    HabitusError for text that is not TOML, unknown keys, no markers, or a marker without exactly
    one place.
    """
    try:
        data = read_toml(text, MAX_LAYOUT_BYTES)
    except HabitusError as error:
        raise HabitusError(f"layout file {where} is not TOML: {error}") from error
    _only_keys(data, _FILE_KEYS, where)
    if not isinstance(data.get("name"), str):
        raise HabitusError(f'layout file {where}: no name; expected a line such as name = "my-set"')
    for key in ("markers", "fingers", "defaults", "left_out"):
        if not isinstance(data.get(key, {}), dict):
            raise HabitusError(
                f"layout file {where}: {key} = {shown(data[key])}; expected a table [{key}]"
            )
        check_count(
            len(data.get(key, {})), MAX_LABELS, f"entries of {key} in the layout file {where}"
        )
    base = base_of(data["extends"]) if "extends" in data else None
    markers = _all_markers(data, base, where)
    fingers = _fingers(data, base, where)
    left_out = dict(base.left_out) if base else {}
    left_out |= dict.fromkeys((label for label in fingers if label not in markers), ON_A_FINGER)
    left_out |= {
        one: plain_name(why)
        for label, why in data.get("left_out", {}).items()
        for one in sides(label)
    }
    return MarkerLayout(
        name=plain_name(data["name"]),
        markers=tuple(markers.values()),
        title=plain_name(data.get("title", "")),
        description="\n".join(
            shown(line, 500) for line in str(data.get("description", "")).strip().splitlines()
        ),
        sources=_strings(data, "sources", where),
        also_known_as=_strings(data, "also_known_as", where),
        fingerprint=tuple(
            one for entry in _strings(data, "fingerprint", where) for one in sides(entry)
        ),
        left_out={label: why for label, why in left_out.items() if label not in markers},
        num_vertices=_count(data, where),
        fingers=tuple(marker for label, marker in fingers.items() if label not in markers),
    )


def layout_text(layout: MarkerLayout) -> str:
    """A layout as the text of a TOML file, one line a marker."""
    lines = [f"name = {quoted(layout.name)}"]
    for key in ("title", "description"):
        if getattr(layout, key):
            lines.append(f"{key} = {quoted(getattr(layout, key))}")
    for key in ("sources", "also_known_as", "fingerprint"):
        if getattr(layout, key):
            lines.append(f"{key} = {_value(list(getattr(layout, key)))}")
    if layout.num_vertices is not None:
        lines.append(f"num_vertices = {layout.num_vertices}")
    lines += ["", "[markers]", *(marker_line(marker) for marker in layout.markers)]
    if layout.fingers:
        plain = (replace(marker, optional=False, on_finger=False) for marker in layout.fingers)
        lines += ["", "[fingers]", *(marker_line(marker) for marker in plain)]
    own = {marker.label for marker in layout.fingers}
    left_out = {label: why for label, why in layout.left_out.items() if label not in own}
    if left_out:
        lines += [
            "",
            "[left_out]",
            *(f"{key_text(label)} = {quoted(why)}" for label, why in left_out.items()),
        ]
    return "\n".join(lines) + "\n"


def marker_line(marker: Marker) -> str:
    """One marker as a line of a layout file."""
    blank = Marker(marker.label)
    entry: dict[str, Any] = {}
    if marker.landmark is not None:
        entry["place"] = marker.landmark
    for key in ("between", "vertex", *_OTHER_KEYS):
        value = getattr(marker, key)
        if value != getattr(blank, key):
            entry[key] = list(value) if isinstance(value, tuple) else value
    if set(entry) == {"place"}:
        return f"{key_text(marker.label)} = {quoted(entry['place'])}"
    return (
        f"{key_text(marker.label)} = {{ "
        f"{', '.join(f'{key} = {_value(value)}' for key, value in entry.items())} }}"
    )


def _all_markers(
    data: Mapping[str, Any], base: MarkerLayout | None, where: str
) -> dict[str, Marker]:
    """The extended layout's markers, less ``without``, with this file's markers added or put in
    their place.
    """
    markers = {marker.label: marker for marker in (base.markers if base else ())}
    for label in (one for entry in _strings(data, "without", where) for one in sides(entry)):
        if markers.pop(label, None) is None:
            raise HabitusError(
                f"layout file {where}: without names {label!r}, which the extended layout does "
                "not have"
            )
    for label, entry in data.get("markers", {}).items():
        for marker in _markers(label, entry, data.get("defaults", {}), where):
            markers[marker.label] = marker
    if not markers:
        raise HabitusError(
            f"layout file {where} has no markers; expected a [markers] table with a line for each"
        )
    return markers


def _fingers(data: Mapping[str, Any], base: MarkerLayout | None, where: str) -> dict[str, Marker]:
    """Markers on fingers, this file's added to those of the extended layout or put in their
    place.
    """
    fingers = {marker.label: marker for marker in (base.fingers if base else ())}
    for label, entry in data.get("fingers", {}).items():
        for marker in _markers(label, entry, data.get("defaults", {}), where):
            fingers[marker.label] = replace(marker, optional=True, on_finger=True)
    return fingers


def sides(text: str) -> tuple[str, ...]:
    """``[LR]FHD`` or ``[left|right]_asis`` as its left and its right spelling; other text alone."""
    text = plain_name(text)
    if not _SIDES.search(text):
        return (text,)
    left = _SIDES.sub(lambda found: found[1] or found[3], text)
    return left, _SIDES.sub(lambda found: found[2] or found[4], text)


def _count(data: Mapping[str, Any], where: str) -> int | None:
    count = data.get("num_vertices")
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise HabitusError(
            f"layout file {where}: num_vertices = {shown(count)}; expected the body's number of "
            "vertices"
        )
    return count


def _markers(label: str, entry: Any, defaults: Mapping[str, Any], where: str) -> list[Marker]:
    entry = {"place": entry} if isinstance(entry, str) else entry
    if not isinstance(entry, dict):
        raise HabitusError(
            f"layout file {where}: {shown(label)} = {shown(entry)}; expected a landmark name or "
            f"{{ place = … }}"
        )
    entry = {**defaults, **entry}
    _only_keys(entry, {*_PLACE_KEYS, *_OTHER_KEYS}, f"{where}, marker {label}")
    labels = sides(label)
    markers = []
    for index, one in enumerate(labels):
        try:
            markers.append(_marker(one, entry, index, len(labels)))
        except (TypeError, ValueError, KeyError, IndexError, OverflowError) as error:
            raise HabitusError(f"layout file {where}, marker {label}: {error}") from error
    return markers


def _marker(label: str, entry: Mapping[str, Any], side: int, count: int) -> Marker:
    """One side of an entry; raises ValueError or TypeError with what is wrong."""

    def sided(text: Any) -> str:
        if not isinstance(text, str):
            raise TypeError(f"{text!r}; expected a text")
        if not text.strip():
            raise ValueError("an empty text; expected a landmark's name")
        both = sides(text)
        if len(both) > count:
            raise ValueError(
                f"{text!r} has two sides but the label has one; write [LR] in the label"
            )
        return both[side if len(both) > 1 else 0]

    if ("place" in entry) == ("between" in entry) and ("place" in entry or "vertex" not in entry):
        raise ValueError("expected one place: place, between or vertex")
    if not isinstance(entry.get("optional", False), bool) or not isinstance(
        entry.get("aliases", []), list
    ):
        raise TypeError('expected optional = true or false, and aliases = ["…"]')
    if "vertex" in entry and (type(entry["vertex"]) is not int or entry["vertex"] < 0 or count > 1):
        raise ValueError("expected one vertex id, on a label of one side")
    between = entry.get("between")
    return Marker(
        label=label,
        aliases=tuple(sided(alias) for alias in entry.get("aliases", ())),
        landmark=sided(entry["place"]) if "place" in entry else None,
        vertex=entry.get("vertex"),
        between=None if between is None else _between(between, sided),
        shift=_shift(entry["shift"], side) if "shift" in entry else None,
        direction=_direction(entry["direction"], side) if "direction" in entry else None,
        optional=entry.get("optional", False),
        confidence=_confidence(entry["confidence"]) if "confidence" in entry else None,
        **_lengths(entry),
    )


def _between(value: Any, sided: Callable[[Any], str]) -> tuple[str, str, float]:
    if not isinstance(value, list) or len(value) != 3 or not 0.0 <= float(value[2]) <= 1.0:
        raise ValueError(
            f"between = {shown(value)}; expected [landmark, landmark, share from 0 to 1]"
        )
    return sided(value[0]), sided(value[1]), float(value[2])


def _shift(value: Any, side: int) -> tuple[float, float, float]:
    x, y, z = (float(one) for one in value)
    if not x * x + y * y + z * z < 0.25:
        raise ValueError(
            f"shift = {shown(value)}; expected three numbers in metres, together below 0.5"
        )
    return (-x if side else x, y, z)


def _direction(value: Any, side: int) -> tuple[float, float, float]:
    x, y, z = (float(one) for one in value)
    if not 0.0 < x * x + y * y + z * z < math.inf:
        raise ValueError(f"direction = {shown(value)}; expected three numbers, not all zero")
    return (-x if side else x, y, z)


def _confidence(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= 1.0:
        raise ValueError(f"confidence = {shown(value)}; expected a number from 0 to 1")
    return float(value)


def _lengths(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The marker's lengths in metres; 9.5 is meant in millimetres and refused."""
    lengths = {
        key: float(entry[key])
        for key in ("distance", "distance_spread", "place_spread")
        if key in entry
    }
    for key, value in lengths.items():
        if not 0.0 <= value < 0.5 or (value == 0.0 and key != "distance"):
            raise ValueError(f"{key} = {value:g}; expected metres between 0 and 0.5")
    return lengths


def _only_keys(data: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(data) - known)
    if unknown:
        expected = ", ".join(sorted(known))
        raise HabitusError(
            f"layout file {where}: unknown key {', '.join(unknown)}; expected {expected}"
        )


def _strings(data: Mapping[str, Any], key: str, where: str) -> tuple[str, ...]:
    value = data.get(key, [])
    if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
        raise HabitusError(f"layout file {where}: {key} = {shown(value)}; expected a list of texts")
    return tuple(map(plain_name, value))


def quoted(text: str) -> str:
    """A text as a TOML string; halves of characters, which TOML cannot hold, as they are shown."""
    whole = "".join(shown(letter) if "\ud800" <= letter <= "\udfff" else letter for letter in text)
    return json.dumps(whole, ensure_ascii=False).replace("\x7f", "\\u007f")


def key_text(label: str) -> str:
    """A label as a TOML key."""
    return label if re.fullmatch(r"[A-Za-z0-9_-]+", label) else quoted(label)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "[" + ", ".join(_value(one) for one in value) + "]"
    return quoted(value) if isinstance(value, str) else repr(value)
