"""Marker layout files: TOML of this project, and the JSON layouts of MoSh++ (labels with vertex ids of one body)."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable
from functools import cache, partial
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.io.files import atomic_write
from habitus.io.layout_toml import layout_text, parse_layout
from habitus.observe.labels import normalised
from habitus.observe.layout_match import LayoutMatch, best_match
from habitus.observe.layouts import Marker, MarkerLayout

_VERTEX_COUNTS = {"smpl": 6890, "smplh": 6890, "smplx": 10475, "mano": 778, "flame": 5023, "smal": 3889}


def list_layouts() -> tuple[str, ...]:
    """Names of the layouts that come with habitus, in alphabetical order."""
    folder = resources.files("habitus.assets") / "layouts"
    return tuple(sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml")))


def shipped_layouts() -> tuple[MarkerLayout, ...]:
    """All layouts that come with habitus."""
    return tuple(_shipped(name) for name in list_layouts())


def load_layout(name_or_path: str | os.PathLike[str]) -> MarkerLayout:
    """A shipped layout by name (``cmu-41``; other spellings and names of it are fine) or a ``.toml`` or ``.json`` file.

    Raises HabitusError for an unknown name, a missing file or a file that says something unexpected.
    """
    text = os.fspath(name_or_path)
    if text.lower().endswith((".toml", ".json")) or os.sep in text:
        return _load_file(Path(text))
    wanted = _plain(text)
    for layout in shipped_layouts():
        if wanted in {_plain(name) for name in (layout.name, *layout.also_known_as)}:
            return layout
    raise HabitusError(f"no layout {text!r}; expected a .toml or .json file or one of: {', '.join(list_layouts())}")


def match_layout(
    labels: Iterable[str],
    markers: Float[np.ndarray, "T M 3"] | None = None,
    layouts: Iterable[MarkerLayout] | None = None,
) -> LayoutMatch:
    """The layout that these capture labels belong to, restricted to the labels found, in capture order.

    labels: (M,) as the capture spells them. markers: their positions (T, M, 3), metres, NaN missing; where given, the
    places are checked against the geometry (swapped pairs, wands, wrist bars) and corrected with a warning. layouts:
    the candidates, by default all shipped ones; labels that the chosen one lacks are looked up in the others.

    Raises HabitusError when fewer than six labels are known or the choice is too unsure.
    """
    return best_match(tuple(labels), shipped_layouts() if layouts is None else tuple(layouts), markers)


def save_layout(layout: MarkerLayout, path: str | os.PathLike[str]) -> None:
    """Write a layout as a TOML file that ``load_layout`` reads back to the same layout."""
    with atomic_write(path) as temporary:
        temporary.write_text(layout_text(layout), encoding="utf-8")


@cache
def _shipped(name: str) -> MarkerLayout:
    text = (resources.files("habitus.assets") / "layouts" / f"{name}.toml").read_text(encoding="utf-8")
    return parse_layout(text, f"{name}.toml", partial(_base, Path()))


def _load_file(path: Path) -> MarkerLayout:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise HabitusError(f"no layout file {path}; expected a .toml or .json file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise HabitusError(f"cannot read layout file {path}: {error}; expected a text file") from error
    if path.suffix.lower() == ".json":
        return parse_moshpp(text, str(path))
    return parse_layout(text, str(path), partial(_base, path.parent))


def _base(folder: Path, extends: object) -> MarkerLayout:
    if isinstance(extends, str) and extends.endswith(".toml"):
        return _load_file(folder / extends)
    if isinstance(extends, str) and extends in list_layouts():
        return _shipped(extends)
    known = ", ".join(list_layouts())
    raise HabitusError(f"layout: extends = {extends!r}; expected a .toml file or one of: {known}")


def parse_moshpp(text: str, where: str) -> MarkerLayout:
    """A MoSh++ marker layout (JSON): vertex ids of the body type that it names.

    Labels that all shipped layouts place alike also get that landmark, so that the layout can serve another body.
    """
    try:
        data = json.loads(text)
        sets = data["markersets"]
        entries = [(str(label), int(vertex), one) for one in sets for label, vertex in one["indices"].items()]
        distances = [float(one.get("distance_from_skin", Marker.distance)) for _, _, one in entries]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise HabitusError(
            f"layout file {where} is no MoSh++ marker layout ({type(error).__name__}: {error}); "
            "expected JSON with markersets, each with indices (label: vertex id)"
        ) from error
    body_type = str(data.get("surface_model_type", "")).lower().replace("-", "")
    places = common_places(shipped_layouts())
    markers: dict[str, Marker] = {}
    for (label, vertex, _), distance in zip(entries, distances, strict=True):
        known = places.get(normalised(label), Marker(label))
        markers.setdefault(
            label, Marker(label, landmark=known.landmark, between=known.between, vertex=vertex, distance=distance)
        )
    title = f"MoSh++ layout for {body_type or 'a body that the file does not name'}"
    count = _VERTEX_COUNTS.get(body_type)
    return MarkerLayout(Path(where).stem, tuple(markers.values()), title=title, num_vertices=count)


def common_places(layouts: Iterable[MarkerLayout]) -> dict[str, Marker]:
    """Normalised label -> marker, for the labels that all these layouts place alike."""
    found: dict[str, Marker] = {}
    clashing: set[str] = set()
    for layout in layouts:
        for marker in layout.markers:
            for name in map(normalised, (marker.label, *marker.aliases)):
                if found.setdefault(name, marker).place != marker.place:
                    clashing.add(name)
    return {name: marker for name, marker in found.items() if name not in clashing}


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
