"""The parts of the report that are words and tables. Every text from outside is escaped here."""

import json
import platform
from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus import __version__
from habitus.errors import listed, shown
from habitus.fit.markers.suspects import Suspect
from habitus.report.fit.parts import guessed_parts
from habitus.report.fit.scene import Scene
from habitus.report.fit.suspicion import corrected_suspects, split_suspects
from habitus.report.fit.words import isolated, term_rows
from habitus.report.parts import Tile, banner, card, numbers_table, tiles
from habitus.results.metrics import finite

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

FEW = 3
STAGE_TITLES = {
    "read": "Reading the file",
    "shape": "Shape and marker placement",
    "pose": "Pose",
    "soft_tissue": "Soft tissue",
    "export": "Writing results",
    "total": "Total",
    "startup": "Start-up (imports, compilation; not in the total)",
}


def number(value: float | None, digits: int = 1) -> str:
    """A number with thousands separators, or a dash."""
    return "–" if value is None else f"{value:,.{digits}f}"


def head(fit: "MarkerFit", numbers: dict[str, Any]) -> str:
    """Title, what was captured, the result in a sentence, and tiles."""
    seconds = numbers["frames"] / numbers["rate_hz"]
    facts = [
        f"{numbers['frames']:,} frames",
        f"{numbers['rate_hz']:g} Hz",
        f"{seconds:,.1f} s",
        f"{numbers['markers']} markers",
        f"layout {numbers['layout']}",
        f"body {numbers['body']}{'' if fit.body.age is None else f', {fit.body.age:g} years'}",
    ]
    return (
        f"<h1>{escape(numbers['capture'])}</h1>\n<p class='facts'>{escape(' · '.join(facts))}</p>\n"
        f"{banner(numbers['verdict'])}<p "
        f"class='verdict'>{escape(summary(fit, numbers))}</p>\n{tiles(_tiles(numbers))}"
    )


def summary(fit: "MarkerFit", numbers: dict[str, Any]) -> str:
    """The result in a sentence or three."""
    errors = numbers["marker_error_mm"]
    final = errors["soft_tissue"] or errors["pose"]
    if final["mean"] is None:
        return "No marker was ever seen: there is nothing to judge the body by."
    failed = numbers["verdict"]["level"] == "failed"
    text = "The body is off the markers by" if failed else "The body follows the markers to"
    text += f" {final['mean']:.1f} mm on average"
    if errors["soft_tissue"] and errors["pose"]["mean"] is not None:
        text += f" with soft tissue, {errors['pose']['mean']:.1f} mm without"
    long, brief = (len({suspect.label for suspect in suspects}) for suspects in split_suspects(fit))
    flagged = int(fit.flagged_frames.sum())
    text += (
        f". {_count(long, 'marker') if long else 'No marker'} "
        f"{'look' if long > 1 else 'looks'} wrong for long."
    )
    if brief:
        text += f" {_count(brief, 'marker')} {'were' if brief > 1 else 'was'} distrusted briefly."
    return text + (
        f" {_count(flagged, 'frame')} {'are' if flagged > 1 else 'is'} flagged." if flagged else ""
    )


def _count(number: int, thing: str) -> str:
    return f"{number:,} {thing}{'s' * (number != 1)}"


def _tiles(numbers: dict[str, Any]) -> list[Tile]:
    errors = numbers["marker_error_mm"]
    rates = numbers["frames_per_second"]
    final = errors["soft_tissue"] or errors["pose"]
    body = numbers["body_measurements"]
    found = [
        ("Mean error", number(final["mean"]), "mm", f"median {number(final['median'])} mm"),
        ("95 % are below", number(final["p95"]), "mm", f"largest {number(final['max'], 0)} mm"),
    ]
    if "height_m" in body:
        found.append(("Height", number(100 * body["height_m"], 0), "cm", "of the fitted body"))
    if "mass_kg" in body:
        found.append(("Mass", number(body["mass_kg"], 0), "kg", "volume times density"))
    found.append(
        ("Not seen", number(100 * numbers["missing_fraction"]), "%", "of all marker samples")
    )
    if rates["pose"]:
        soft = f", soft tissue {rates['soft_tissue']:,.0f}" if rates["soft_tissue"] else ""
        found.append(("Speed", f"{rates['pose']:,.0f}", "frames/s", f"pose stage{soft}"))
    return found


def findings(fit: "MarkerFit", numbers: dict[str, Any], scene: Scene) -> str:
    """Two cards: what looked wrong, and what was assumed."""
    long, brief = split_suspects(fit)
    wrong = [_item(_suspicion(suspect), "bad") for suspect in long]
    wrong += [
        _item(warning, "minor")
        for warning in numbers["warnings"]
        if not _is_match(warning, numbers)
    ]
    wrong += [_item(_suspicion(suspect), "good") for suspect in corrected_suspects(fit)]
    flagged = int(fit.flagged_frames.sum())
    if flagged:
        share = f"{flagged:,} of {numbers['frames']:,}"
        wrong.append(
            _item(f"{share} frames are flagged: too little was seen to trust them.", "bad")
        )
    wrong += [_item(text, "minor") for text in _guessed(fit)]
    if len(brief) > FEW:
        inside = _list(_item(_suspicion(suspect), "") for suspect in brief)
        title = (
            f"{len(brief)} brief doubts: samples far from the body, down-weighted where they were"
        )
        wrong.append(
            f"<li class='minor'><details><summary>{escape(title)}</summary>{inside}</details></li>"
        )
    else:
        wrong += [_item(_suspicion(suspect), "minor") for suspect in brief]
    wrong = wrong or [_item("Nothing: no suspect marker, no warning, no flagged frame.", "good")]
    assumed = _list(_item(text, "") for text in _assumptions(fit, numbers, scene))
    return f"<div class='columns'>{card('What looked wrong', _list(wrong))}{card('What was assumed', assumed)}</div>"  # noqa: E501


def _guessed(fit: "MarkerFit") -> list[str]:
    parts = guessed_parts(fit)
    if not parts:
        return []
    known = sorted(round(100 * spread) for _, spread in parts if np.isfinite(spread))
    off = f", to within {known[0]} to {known[-1]} cm" if known else ""
    names = listed((name for name, _ in parts), 12)
    return [
        f"Guessed, as no marker tells: {names}. Where they are is what people usually do{off}; "
        "they are striped."
    ]


def _is_match(warning: str, numbers: dict[str, Any]) -> bool:
    """Whether it only tells which layout was matched: an assumption, no fault."""
    return warning.startswith(f"layout {numbers['layout']}: ") and "labels matched" in warning


def _suspicion(suspect: Suspect) -> str:
    put_right = "; put right" if suspect.corrected else ""
    return (
        f"{isolated(suspect.label)}: {shown(suspect.reason, 400)} "
        f"({_count(suspect.frames, 'frame')}{put_right})"
    )


def _item(text: str, kind: str) -> str:
    return f"<li class='{kind}'>{escape(text)}</li>"


def _list(items: Iterable[str]) -> str:
    return f"<ul class='findings'>{''.join(items)}</ul>"


def _assumptions(fit: "MarkerFit", numbers: dict[str, Any], scene: Scene) -> list[str]:
    floor = scene.facts["floor"]
    texts = [
        text[:1].upper() + text[1:] for text in numbers["warnings"] if _is_match(text, numbers)
    ]
    texts += [
        f"Markers sit where the layout “{numbers['layout']}” puts them, give or take its "
        "tolerances.",
        f"{fit.up_axis} is up in the capture; lengths are metres.",
        f"Frames are {numbers['rate_hz']:g} a second and evenly spaced.",
        "The floor in the player is the capture's zero height."
        if floor == 0
        else "The capture's zero height is no floor: the player's floor is where the body "
        f"stands, {floor:.2f} m.",
    ]
    if fit.recorded:
        said = ", ".join(
            f"{_measure_name(k).lower()} {_measure(k, v)}" for k, v in fit.recorded.items()
        )
        said = shown(said, 500)
        texts.append(f"The file itself says of the subject: {said}.")
    texts += _of_gender(numbers["gender"])
    return texts


def _of_gender(gender: dict[str, Any] | None) -> list[str]:
    """What the shape says of the sex, and which model was fitted."""
    if not gender:
        return []
    female = gender["female_probability"]
    model = gender["model"]
    lead = (
        "The shape space is one for everybody"
        if model == "neutral"
        else f"The body is the {model} model"
    )
    if female is None:
        return [f"{lead}."]
    reads = {
        "female": f"reads as female ({female:.0%})",
        "male": f"reads as male ({1 - female:.0%})",
    }
    whose = "this shape" if model == "neutral" else "the neutral shape"
    said = reads.get(gender["says"], f"does not tell the sex (female {female:.0%})")
    return [f"{lead}; {whose} {said}."]


def body_and_timing(fit: "MarkerFit", numbers: dict[str, Any], scene: Scene) -> str:
    """Measurements of the body beside the seconds each stage took."""
    cards = []
    body = numbers["body_measurements"]
    seconds = numbers["stage_seconds"]
    if body:
        said = {key: _measure(key, value) for key, value in fit.recorded.items() if key in body}
        heads = ["", "Fitted", "The file says"] if said else ()
        rows = (
            (_measure_name(key), _measure(key, value), said.get(key, ""))
            for key, value in body.items()
        )
        table = numbers_table((row if said else row[:2] for row in rows), heads)
        tapes = {tape["name"] for tape in scene.facts["tapes"]}
        for key in tapes & body.keys():
            name = escape(_measure_name(key))
            button = f"<button type='button' class='tape' data-tape='{escape(key)}'>{name}</button>"
            table = table.replace(f"<th scope='row'>{name}</th>", f"<th scope='row'>{button}</th>")
        lead = "Measured on the fitted body at rest." + " Click a girth to see its tape." * bool(
            tapes
        )
        cards.append(card("Body", f"<p class='lead'>{lead}</p>{table}"))
    known = {key: seconds[key] for key in STAGE_TITLES if seconds.get(key)}
    timing = numbers_table((STAGE_TITLES[key], f"{value:,.2f} s") for key, value in known.items())
    if known:
        cards.append(card("Timing", timing))
    return f"<div class='columns'>{''.join(cards)}</div>"


def lengths(measurements: Mapping[str, float]) -> dict[str, str]:
    """Measurements as they are shown."""
    return {name: _measure(name, value) for name, value in measurements.items()}


def held_out(numbers: dict[str, Any]) -> str:
    """Errors of markers that the fit never saw; nothing where none were held out."""
    held = numbers["held_out_error_mm"]
    if held is None:
        return ""
    told = numbers.get("held_out_known_placement_mm")
    names = {"pose": "Pose stage", "soft_tissue": "Soft-tissue stage"}
    columns = [(names[stage], held[stage]) for stage in names if held[stage]]
    columns += [
        (f"{names[stage]}, places told", told[stage]) for stage in names if told and told[stage]
    ]
    heads = [head for head, _ in columns]
    rows = [("Mean", "mean"), ("Median", "median"), ("95 % are below", "p95"), ("Largest", "max")]
    whole = numbers_table(
        [(title, *(f"{number(one[key])} mm" for _, one in columns)) for title, key in rows],
        ["", *heads],
    )
    each = [
        (m, *(f"{number(one['per_marker'][m])} mm" for _, one in columns))
        for m in held["pose"]["per_marker"]
    ]
    lead = (
        "These markers were left out of everything and then predicted where people put such "
        "markers: "
    )
    lead += (
        "what the body says where nothing pulls on it, and how far markers were put from "
        "these places."
    )
    if told:
        lead += " Places told: the same, where another capture of this person told the places."
    return card(
        "Held-out markers",
        f"<p class='lead'>{lead}</p>{whole}"
        "<details><summary>Marker by "
        f"marker</summary>{numbers_table(each, ['Marker', *heads])}</details>",
    )


def details(fit: "MarkerFit") -> str:
    """Settings and versions, folded."""
    settings = escape(
        json.dumps(finite(dict(fit.settings)), indent=2, ensure_ascii=False, default=str)
    )
    versions = [("habitus", __version__), ("Python", platform.python_version())]
    table = numbers_table([("Status", str(fit.status)), ("Seed", str(fit.seed)), *versions])
    left = ""
    if fit.costs:
        text = (
            "The solver balances these terms against each other; this is half of each one's "
            "weighted sum of squares "
            "where it stopped. They have no unit and say nothing alone: compare them between fits "
            "of one capture."
        )
        left = (
            "<h3>What the energy's terms came to</h3><p "
            f"class='lead'>{text}</p>{numbers_table(term_rows(fit.costs))}"
        )
    inside = (
        "<details><summary>Settings and "
        f"versions</summary>{table}{left}<pre>{settings}</pre></details>"
    )
    return f"<section class='card'>{inside}</section>"


def _measure_name(key: str) -> str:
    for unit in ("_m", "_kg", "_l", "_years"):
        key = key.removesuffix(unit)
    return key.replace("_", " ").capitalize()


def _measure(key: str, value: Any) -> str:
    if not isinstance(value, (int, float)):
        return str(value)
    if key.endswith("_m"):
        return f"{100 * value:.1f} cm"
    if key.endswith("_years"):
        return f"{value:g} years"
    return f"{value:.1f} kg" if key.endswith("_kg") else f"{value:.3g}"
