"""The prior over placements as TOML text: a table a place, a line for the place itself and for each
label there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from habitus.errors import HabitusError, shown
from habitus.io.layouts.toml import quoted
from habitus.io.limits import MAX_LAYOUT_BYTES
from habitus.io.structured_text import read_toml
from habitus.markers.placements import PlacementPrior, UsualPlace

ALIKE = "alike"
_PAIRS = ("on_landmarks", "placed_freely")
ANYWHERE = "*"
"""Stands for every label at a place."""
_KEYS = {"shift", "off", "spread", "people"}


def parse_placements(text: str, where: str) -> PlacementPrior:
    """A prior over placements from its text; ``where`` names the file in errors. Raises
    HabitusError for others.
    """
    try:
        data = read_toml(text, MAX_LAYOUT_BYTES)
    except HabitusError as error:
        raise HabitusError(f"placements {where} are not TOML: {error}") from error
    places: dict[str, UsualPlace] = {}
    labels: dict[tuple[str, str], UsualPlace] = {}
    alike = _alike(data.pop(ALIKE, {}), where)
    for place, entries in data.items():
        if not isinstance(entries, dict):
            raise HabitusError(
                f"placements {where}: {shown(place)} = {shown(entries)}; expected a table of labels"
            )
        for label, entry in entries.items():
            try:
                usual = _usual(entry)
            except (TypeError, ValueError, KeyError) as error:
                raise HabitusError(
                    f"placements {where}: {shown(place)}, {shown(label)}: {error}"
                ) from error
            if label == ANYWHERE:
                places[place] = usual
            else:
                labels[place, label] = usual
    return PlacementPrior(places, labels, alike)


def placements_text(prior: PlacementPrior, head: str = "") -> str:
    """The text of a prior, tenths of millimetres; ``head`` (lines of comments) in front of it."""
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    lines += [
        "",
        f"[{ALIKE}]",
        *(f"{name} = {share:.3f}" for name, share in zip(_PAIRS, prior.alike, strict=True)),
    ]
    for place in sorted({*prior.places, *(place for place, _ in prior.labels)}):
        lines += ["", f"[{quoted(place)}]"]
        entries = {ANYWHERE: prior.places[place]} if place in prior.places else {}
        entries |= {
            label: usual for (at, label), usual in sorted(prior.labels.items()) if at == place
        }
        lines += [f"{quoted(label)} = {_line(usual)}" for label, usual in entries.items()]
    return "\n".join(lines) + "\n"


def _alike(entry: Any, where: str) -> tuple[float, float]:
    known = isinstance(entry, Mapping) and set(entry) <= set(_PAIRS)
    one, other = (float(entry.get(name, 0.0)) if known else math.nan for name in _PAIRS)
    if not (0.0 <= one <= 1.0 and 0.0 <= other <= 1.0):
        raise HabitusError(
            f"placements {where}: {ALIKE} = {shown(entry)}; expected {' and '.join(_PAIRS)}, 0 to 1"
        )
    return one, other


def _line(usual: UsualPlace) -> str:
    shift = ", ".join(_metres(x) for x in usual.shift)
    told = f"off = {_metres(usual.off)}, spread = {_metres(usual.spread)}, people = {usual.people}"
    return f"{{ shift = [{shift}], {told} }}"


def _metres(length: float) -> str:
    return f"{round(length, 4) + 0.0:.4f}"


def _usual(entry: Any) -> UsualPlace:
    if not isinstance(entry, Mapping) or set(entry) != _KEYS:
        raise ValueError(f"{shown(entry)}; expected {', '.join(sorted(_KEYS))}")
    x, y, z = (float(one) for one in entry["shift"])
    spread = float(entry["spread"])
    off = float(entry["off"])
    if (
        not all(math.isfinite(one) and abs(one) < 0.5 for one in (x, y, z, off, spread))
        or spread <= 0.0
    ):
        raise ValueError(f"{shown(entry)}; expected metres below 0.5, and a spread above 0")
    return UsualPlace((x, y, z), off, spread, int(entry["people"]))
