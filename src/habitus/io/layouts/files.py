"""Reads marker layouts by name or file: TOML, MoSh++ JSON, OpenSim, and lists of labels; and the
prior over placements, TOML with a table a place, a line for the place itself and for each label
there.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, listed, shown
from habitus.files import atomic_write
from habitus.io.layouts.moshpp import parse_moshpp
from habitus.io.layouts.opensim import parse_marker_set
from habitus.io.layouts.toml import layout_text, parse_layout, quoted
from habitus.io.limits import (
    MAX_LABELS,
    MAX_LAYOUT_BYTES,
    MAX_XML_BYTES,
    check_count,
    read_text_file,
    read_toml,
    read_xml,
)
from habitus.io.models.bodies import load_body
from habitus.io.names import inside, plain_name
from habitus.markers.layouts import MarkerLayout
from habitus.markers.matching import (
    MIN_MARKERS,
    LayoutMatch,
    best_match,
    interpreted,
    match_together,
)
from habitus.markers.placements import PlacementPrior, UsualPlace

_TAGS = ("marker", "label", "trajectory")
_MARKUP = re.compile(r"^(!|#|;|//|\[)")  # headings and remarks
_LINKS = re.compile(r"[,=]")  # sticks between markers and segments of them
_UNKNOWN = "no layout that comes along knows this label; say where it sits in a layout of your own"


def labels_in_tree(root: Element) -> tuple[str, ...]:
    """Labels of an XML file: names of its markers, labels or trajectories, as attributes or
    elements, in order.
    """
    labels = []
    for element in root.iter():
        if str(element.tag).rsplit("}", 1)[-1].lower() in _TAGS:
            named = [value for key, value in element.attrib.items() if key.lower() == "name"]
            named += [child.text or "" for child in element if str(child.tag).lower() == "name"]
            labels.append(plain_name(named[0]) if named else "")
    return tuple(dict.fromkeys(label for label in labels if label))


def labels_in_lines(text: str) -> tuple[str, ...]:
    """Labels of a text: the first word of each line, but for headings, remarks, and lines that link
    markers.
    """
    labels = []
    for line in text.lstrip("\ufeff").splitlines():
        words = re.split(r"[\t;]| {2,}", line.strip())
        if words[0] and not _MARKUP.match(words[0]) and not _LINKS.search(words[0]):
            labels.append(plain_name(words[0]))
    return tuple(dict.fromkeys(label for label in labels if label))


def layout_of_labels(
    labels: Sequence[str], name: str, where: str, known: Sequence[MarkerLayout]
) -> MarkerLayout:
    """The labels at the places that known layouts have for them as a set; the others left out, with
    the reason.

    Raises HabitusError where fewer than six are known.
    """
    check_count(len(labels), MAX_LABELS, f"labels in the layout file {where}")
    meaning = interpreted(labels, known)
    if len(meaning.markers) < MIN_MARKERS:
        raise HabitusError(
            f"layout file {where}: {len(meaning.markers)} of its {len(labels)} labels "
            f"({listed(labels) or 'none'}) are "
            f"known to any layout; expected at least {MIN_MARKERS}; let --layout discover find "
            "where they sit"
        )
    markers = tuple(
        replace(marker, label=labels[column], aliases=(), optional=False)
        for column, marker in sorted(meaning.markers.items())
    )
    used = {marker.label for marker in markers}
    left_out = {
        label: meaning.left_out.get(label, _UNKNOWN) for label in labels if label not in used
    }
    title = f"Label list, places as in {meaning.best.layout.name}"
    return MarkerLayout(name, markers, title, left_out=left_out)


XML_FORMS = (".xml", ".osim", ".vsk", ".vst")
LIST_FORMS = (".mkr", ".txt")
PLACEMENTS = "placements.toml"
FORMS = (".toml", ".json", *XML_FORMS, *LIST_FORMS)
"""Endings of layout files."""


def list_layouts() -> tuple[str, ...]:
    """Names of the layouts that come with habitus, in alphabetical order."""
    folder = resources.files("habitus.assets") / "layouts"
    return tuple(
        sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml"))
    )


def shipped_layouts() -> tuple[MarkerLayout, ...]:
    """All layouts that come with habitus."""
    return tuple(_shipped(name) for name in list_layouts())


def load_layout(name_or_path: str | os.PathLike[str]) -> MarkerLayout:
    """A shipped layout by name (``cmu-41``; other spellings of it are fine) or a file, by its
    ending (`FORMS`).

    Raises HabitusError for an unknown name, a missing file or a file that says something
    unexpected.
    """
    text = os.fspath(name_or_path)
    if text.lower().endswith(FORMS) or os.sep in text or "/" in text:
        return _load_file(Path(text), ())
    plain = _plain(text)
    for layout in shipped_layouts():
        if plain in {_plain(name) for name in (layout.name, *layout.also_known_as)}:
            return layout
    raise HabitusError(
        f"no layout {text!r}; expected a file ({', '.join(FORMS)}) or one of: "
        f"{', '.join(list_layouts())}"
    )


def match_layout(
    labels: Iterable[str],
    markers: Float[np.ndarray, "T M 3"] | None = None,
    layouts: Iterable[MarkerLayout] | None = None,
) -> LayoutMatch:
    """The layout that these capture labels belong to, restricted to the labels found, in capture
    order.

    labels: (M,) as the capture spells them. markers: their positions (T, M, 3), metres, NaN
    missing; where given, the places are checked against the geometry (swapped pairs, wands, wrist
    bars) and corrected with a warning. layouts: the candidates, by default all shipped ones; labels
    that the chosen one lacks are looked up in the others.

    Raises HabitusError when fewer than six labels are known or the choice is too unsure.
    """
    return best_match(
        tuple(labels), shipped_layouts() if layouts is None else tuple(layouts), markers
    )


def match_layouts(
    captures: Sequence[tuple[Sequence[str], Float[np.ndarray, "_ _ 3"]]],
    layouts: Iterable[MarkerLayout] | None = None,
) -> tuple[LayoutMatch, ...]:
    """`match_layout` for several captures (labels, markers) of one person in one session, judged
    together.

    All get the same places and distances; what one capture cannot tell (a standing trial bends no
    elbow) another may.
    """
    return match_together(captures, shipped_layouts() if layouts is None else tuple(layouts))


def save_layout(layout: MarkerLayout, path: str | os.PathLike[str]) -> None:
    """Write a layout as a TOML file that ``load_layout`` reads back to the same layout."""
    with atomic_write(path) as temporary:
        temporary.write_text(layout_text(layout), encoding="utf-8")


@cache
def _template() -> BodyModel:
    """The body on which places of other programs' skeletons are looked up."""
    return load_body("default")


@cache
def _shipped(name: str) -> MarkerLayout:
    return load_placements().applied(plain_layout(name))


@cache
def plain_layout(name: str) -> MarkerLayout:
    """A shipped layout as its file has it: each marker at its landmark, not where people put it."""
    text = (resources.files("habitus.assets") / "layouts" / f"{name}.toml").read_text(
        encoding="utf-8"
    )
    return parse_layout(text, f"{name}.toml", plain_layout)


@cache
def load_placements() -> PlacementPrior:
    """Where people put markers, beside the layouts' landmarks: the prior that comes with
    habitus.
    """
    file = resources.files("habitus.assets") / PLACEMENTS
    return parse_placements(file.read_text(encoding="utf-8"), PLACEMENTS)


def _load_file(path: Path, extending: tuple[Path, ...]) -> MarkerLayout:
    """A layout file; ``extending`` are the files that led here, none of which it may extend
    again.
    """
    ending = path.suffix.lower()
    place = Path(os.path.realpath(path))  # Path.resolve fails on links in a loop
    if place in extending:
        raise HabitusError(f"layout file {path} extends itself; expected another layout")
    try:
        text = read_text_file(path, MAX_XML_BYTES if ending in XML_FORMS else MAX_LAYOUT_BYTES)
    except FileNotFoundError:
        raise HabitusError(f"no layout file {path}; expected a {', '.join(FORMS)} file") from None
    except HabitusError as error:
        raise HabitusError(f"layout file {path}: {error}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise HabitusError(
            f"cannot read layout file {path}: {error}; expected a text file"
        ) from error
    if ending == ".json":
        return parse_moshpp(text, str(path), shipped_layouts())
    if ending in XML_FORMS:
        return _of_tree(text, path)
    if ending in LIST_FORMS:
        return layout_of_labels(
            labels_in_lines(text), plain_name(path.stem), str(path), shipped_layouts()
        )
    return parse_layout(text, str(path), partial(_base, path.parent, (*extending, place)))


def _of_tree(text: str, path: Path) -> MarkerLayout:
    """An XML file: OpenSim's where markers name a bone, else a list of labels."""
    try:
        root = read_xml(text)
    except HabitusError as error:
        raise HabitusError(f"layout file {path} is not XML: {error}") from error
    name = plain_name(path.stem)
    if any(element.find("location") is not None for element in root.iter("Marker")):
        return parse_marker_set(root, name, str(path), _template())
    return layout_of_labels(labels_in_tree(root), name, str(path), shipped_layouts())


def _base(folder: Path, extending: tuple[Path, ...], extends: object) -> MarkerLayout:
    if isinstance(extends, str) and extends.endswith(".toml"):
        return _load_file(folder / inside(extends), extending)
    if isinstance(extends, str) and extends in list_layouts():
        return _shipped(extends)
    known = ", ".join(list_layouts())
    raise HabitusError(f"layout: extends = {extends!r}; expected a .toml file or one of: {known}")


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


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
    numbers = (
        f"off = {_metres(usual.off)}, spread = {_metres(usual.spread)}, people = {usual.people}"
    )
    return f"{{ shift = [{shift}], {numbers} }}"


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
