"""The report of a marker fit: one HTML file that opens offline, with the moving body, plots and
numbers. `scene` packs the arrays, `texts` holds the words.
"""

import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus import __version__
from habitus.errors import listed, shown
from habitus.files import write_text
from habitus.fit.markers.suspects import Suspect
from habitus.report.fit import texts
from habitus.report.fit.scene import ANGLE_FRAMES, Scene, add_angles, add_plots, add_scene
from habitus.report.shell import (
    MAX_NAME,
    MAX_NOTE,
    NO_SCRIPT,
    VIEWER,
    Blob,
    Tile,
    asset,
    banner,
    card,
    columns,
    file_links,
    heading,
    measurement_name,
    measurement_text,
    numbers_table,
    player,
    shell,
    solution_card,
    tiles,
)
from habitus.results.save import finite, marker_metrics

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

SCRIPTS = (*VIEWER, "page_markers.js", "page_main.js")
LAYERS = 8
"""Layers of the player that have keys."""
MAX_BRIEF = 3
"""Brief suspicions that are listed; more are folded."""
LONG_SHARE = 0.1
"""A suspect in this share of the frames in which the marker is seen is suspect for long."""


def write_report(
    fit: "MarkerFit",
    path: str | os.PathLike[str],
    numbers: dict[str, Any] | None = None,
    files: Sequence[str] = (),
) -> None:
    """Write the report of a ``MarkerFit`` as one HTML file, atomically.

    ``numbers`` is ``marker_metrics(fit)`` where the caller has it already; ``files`` are names of
    files beside the page that it offers for download. Long captures are thinned for the player and
    the joint angles only; errors, gaps and numbers hold every frame. Raises HabitusError where the
    file cannot be written.
    """
    write_text(path, report_page(fit, numbers, files))


def report_page(
    fit: "MarkerFit", numbers: dict[str, Any] | None = None, files: Sequence[str] = ()
) -> str:
    """The report as text; arguments as those of `write_report`."""
    numbers = _readable(finite(marker_metrics(fit) if numbers is None else numbers))
    blob = Blob()
    scene = add_scene(fit, blob)
    measurements = numbers["body_measurements"]
    data = {
        "name": numbers["capture"],
        "labels": [shown(label, MAX_NAME) for label in fit.labels],
        "frames": numbers["frames"],
        "rate": numbers["rate_hz"],
        "scene": scene.facts,
        "plots": add_plots(fit, blob),
        "angles": add_angles(fit, blob),
        "measured": {key: measurement_text(key, value) for key, value in measurements.items()},
        "suspects": suspicions(fit),
        "arrays": blob.contents,
        "bytes": blob.size,
    }
    sections = (
        columns(_wrong(fit, numbers), _assumed(fit, numbers, scene)),
        _held_out(numbers),
        _body_and_solution(fit, numbers, scene),
        _details(fit),
    )
    content = Template(asset("page.html")).substitute(
        head=_head(fit, numbers),
        player=_player(scene),
        note=_note(fit, scene),
        anglenote=_angle_note(fit),
        bars=texts.POSE_STAGE_BAR if len(scene.facts["stages"]) > 1 else "",
        files=file_links({name: texts.FILES.get(name, "") for name in files}),
        sections="\n".join(sections),
    )
    return shell(
        f"{shown(fit.capture_name, MAX_NAME)} · habitus",
        content,
        data=finite(data),
        arrays={"report-arrays": blob.base64()},
        scripts=SCRIPTS,
        without_script=NO_SCRIPT,
    )


def _readable(numbers: dict[str, Any]) -> dict[str, Any]:
    """The same numbers with names and warnings that a page can show, whatever the capture's file
    holds.
    """
    names = {key: shown(numbers[key], MAX_NAME) for key in ("capture", "body", "layout")}
    return numbers | names | {"warnings": [shown(text, 1000) for text in numbers["warnings"]]}


def _player(scene: Scene) -> str:
    stages = (
        '<div class="segments motion-only" role="group" aria-label="Stage">'
        '<button type="button" data-stage="pose" title="The rigid shape of the pose stage (S)">'
        'Pose</button><button type="button" data-stage="soft_tissue" title="With soft tissue (S)">'
        "Soft tissue</button></div>"
    )
    unobserved = (
        '<button type="button" data-layer="guessed" class="motion-only" '
        'title="Hatched: segments without markers"><i class="swatch guessed"></i>Unobserved'
        "</button>"
    )
    tapes = (
        '<button type="button" data-layer="tapes" class="placement-only" '
        'title="The tapes of the measurements"><i class="swatch tapes"></i>Tapes</button>'
    )
    skin = (
        '<button type="button" data-layer="skin" title="Painted skin of the default body">'
        "Skin</button>"
    )
    facts = scene.facts
    layers = Template(asset("player_fit.html")).substitute(
        stages=stages if len(facts["stages"]) > 1 else "",
        some=unobserved * bool(facts["guessed"])
        + tapes * bool(facts["tapes"])
        + skin * facts["skin"],
    )
    keys = "<dt>V</dt><dd>motion, placement</dd><dt>S</dt><dd>soft tissue</dd>"
    hint = f"<p class='hint placement-only'>{texts.PLACEMENT_HINT}</p>"
    return player(texts.PLAYER, layers, LAYERS, keys, hint)


def _note(fit: "MarkerFit", scene: Scene) -> str:
    sentences = []
    missed = 1e3 * scene.facts["morphResidual"]
    if scene.stride > 1:
        stride = _ordinal(scene.stride)
        sentences.append(
            texts.STRIDE.format(stride=stride, shown=scene.facts["rate"], rate=fit.rate_hz)
        )
    if missed > 0.5:
        sentences.append(texts.MORPHS.format(missed=missed))
    if fit.body.skinning != "lbs":
        sentences.append(texts.SKINNING)
    return f"<p class='note'>{escape(' '.join(sentences))}</p>" if sentences else ""


def _angle_note(fit: "MarkerFit") -> str:
    if len(fit.pose) <= ANGLE_FRAMES:
        return ""
    return texts.ANGLES.format(stride=len(fit.pose) / ANGLE_FRAMES)


def _ordinal(number: int) -> str:
    ending = {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number:,}{'th' if number % 100 in (11, 12, 13) else ending}"


def _number(value: float | None, digits: int = 1) -> str:
    """A number with thousands separators, or a dash."""
    return "–" if value is None else f"{value:,.{digits}f}"


def _count(number: int, thing: str) -> str:
    return f"{number:,} {thing}{'s' * (number != 1)}"


def _head(fit: "MarkerFit", numbers: dict[str, Any]) -> str:
    """Title, facts of the capture, verdict, the result in a sentence, and tiles."""
    facts = [
        f"{numbers['frames']:,} frames",
        f"{numbers['rate_hz']:g} Hz",
        f"{numbers['frames'] / numbers['rate_hz']:,.1f} s",
        f"{numbers['markers']} markers",
        f"layout {numbers['layout']}",
        f"body {numbers['body']}{'' if fit.body.age is None else f', {fit.body.age:g} years'}",
    ]
    summary = f"<p class='verdict'>{escape(_summary(fit, numbers))}</p>\n"
    return (
        heading(numbers["capture"], facts)
        + banner(numbers["verdict"])
        + summary
        + tiles(_tiles(numbers))
    )


def _summary(fit: "MarkerFit", numbers: dict[str, Any]) -> str:
    """The result in a sentence or three."""
    errors = numbers["marker_error_mm"]
    final = errors["soft_tissue"] or errors["pose"]
    if final["mean"] is None:
        return texts.NO_MARKERS
    text = texts.ERROR.format(mean=final["mean"])
    if errors["soft_tissue"] and errors["pose"]["mean"] is not None:
        text += texts.ERROR_BOTH.format(pose=errors["pose"]["mean"])
    long, brief = (len({suspect.label for suspect in suspects}) for suspects in split_suspects(fit))
    text += f". {texts.SUSPECTS.get(long, texts.SUSPECTS_MANY).format(count=long)}."
    if brief:
        were = "were" if brief > 1 else "was"
        text += texts.BRIEF.format(count=_count(brief, "marker"), were=were)
    flagged = int(fit.flagged_frames.sum())
    if flagged:
        are = "are" if flagged > 1 else "is"
        text += texts.FLAGGED.format(count=_count(flagged, "frame"), are=are)
    return text


def _tiles(numbers: dict[str, Any]) -> list[Tile]:
    errors = numbers["marker_error_mm"]
    rates = numbers["frames_per_second"]
    final = errors["soft_tissue"] or errors["pose"]
    body = numbers["body_measurements"]
    names = texts.TILES
    notes = texts.TILE_NOTES
    rows = [
        (names["mean"], _number(final["mean"]), "mm", f"median {_number(final['median'])} mm"),
        (names["p95"], _number(final["p95"]), "mm", f"largest {_number(final['max'], 0)} mm"),
    ]
    if "height_m" in body:
        rows.append((names["height"], _number(100 * body["height_m"], 0), "cm", notes["height"]))
    if "mass_kg" in body:
        rows.append((names["mass"], _number(body["mass_kg"], 0), "kg", notes["mass"]))
    missing = _number(100 * numbers["missing_fraction"])
    rows.append((names["missing"], missing, "%", notes["missing"]))
    if rates["pose"]:
        soft = f", soft tissue {rates['soft_tissue']:,.0f}" if rates["soft_tissue"] else ""
        rows.append((names["speed"], f"{rates['pose']:,.0f}", "frames/s", f"pose stage{soft}"))
    return rows


def split_suspects(fit: "MarkerFit") -> tuple[list[Suspect], list[Suspect]]:
    """Suspects that were not corrected, most frames first: those for at least LONG_SHARE of the
    frames in which the marker is seen, and those for fewer.
    """
    seen = dict(zip(fit.labels, fit.visible.sum(axis=0).tolist(), strict=True))
    ordered = sorted((s for s in fit.suspects if not s.corrected), key=lambda s: -s.frames)
    long = [s for s in ordered if s.frames >= LONG_SHARE * seen.get(s.label, 0)]
    return long, [suspect for suspect in ordered if suspect not in long]


def corrected_suspects(fit: "MarkerFit") -> list[Suspect]:
    """Suspects that the fit corrected, most frames first."""
    return sorted((s for s in fit.suspects if s.corrected), key=lambda suspect: -suspect.frames)


def suspicions(fit: "MarkerFit") -> list[dict | None]:
    """For each label, in order: None, or its reasons and the worst kind: "wrong" (for long),
    "doubted", "corrected".
    """
    long, brief = split_suspects(fit)
    kinds = {"wrong": long, "doubted": brief, "corrected": corrected_suspects(fit)}
    by_label: dict[str, dict] = {}
    for kind, suspects in kinds.items():
        for suspect in suspects:
            entry = by_label.setdefault(suspect.label, {"reasons": [], "kind": kind})
            entry["reasons"].append(shown(suspect.reason, MAX_NOTE))
    return [by_label.get(label) for label in fit.labels]


def _wrong(fit: "MarkerFit", numbers: dict[str, Any]) -> str:
    """What looked wrong: suspects, warnings, flagged frames, unobserved segments."""
    long, brief = split_suspects(fit)
    items = [_item(_suspicion(suspect), "bad") for suspect in long]
    warnings = [text for text in numbers["warnings"] if not _is_match(text, numbers)]
    items += [_item(text, "minor") for text in warnings]
    items += [_item(_suspicion(suspect), "good") for suspect in corrected_suspects(fit)]
    flagged = int(fit.flagged_frames.sum())
    if flagged:
        share = f"{flagged:,} of {numbers['frames']:,}"
        items.append(_item(texts.FRAMES_FLAGGED.format(share=share), "bad"))
    items += [_item(text, "minor") for text in _unobserved(fit)]
    if len(brief) > MAX_BRIEF:
        inside = _list(_item(_suspicion(suspect), "") for suspect in brief)
        title = escape(texts.BRIEF_TITLE.format(count=len(brief)))
        items.append(
            f"<li class='minor'><details><summary>{title}</summary>{inside}</details></li>"
        )
    else:
        items += [_item(_suspicion(suspect), "minor") for suspect in brief]
    return card(texts.WRONG_TITLE, _list(items or [_item(texts.WRONG_NOTHING, "good")]))


def _unobserved(fit: "MarkerFit") -> list[str]:
    """Segments without markers in half of the capture or more, and their accuracy."""
    joints = np.flatnonzero(fit.guessed.joints())
    if not len(joints):
        return []
    spread = np.median(fit.guessed.spread, axis=0)[joints]
    known = sorted(round(100 * float(value)) for value in spread if np.isfinite(value))
    accuracy = texts.UNOBSERVED_ACCURACY.format(low=known[0], high=known[-1]) if known else ""
    names = listed((texts.segment(fit.body.joint_names[k]) for k in joints), 12)
    return [texts.UNOBSERVED.format(names=names, accuracy=accuracy)]


def _is_match(warning: str, numbers: dict[str, Any]) -> bool:
    """Whether a warning only says which layout was matched: an assumption, not a fault."""
    return warning.startswith(f"layout {numbers['layout']}: ") and "labels matched" in warning


def _suspicion(suspect: Suspect) -> str:
    return texts.SUSPICION.format(
        label=_isolated(suspect.label),
        reason=shown(suspect.reason, MAX_NOTE),
        frames=_count(suspect.frames, "frame"),
        corrected=texts.CORRECTED if suspect.corrected else "",
    )


def _isolated(name: object) -> str:
    """A name out of a file inside a sentence; its direction of writing does not spread."""
    return f"\u2068{shown(name, MAX_NAME)}\u2069"


def _item(text: str, kind: str) -> str:
    return f"<li class='{kind}'>{escape(text)}</li>"


def _list(items: Iterable[str]) -> str:
    return f"<ul class='findings'>{''.join(items)}</ul>"


def _assumed(fit: "MarkerFit", numbers: dict[str, Any], scene: Scene) -> str:
    """What was assumed: layout, axes, rate, floor, sex."""
    floor = scene.facts["floor"]
    matches = [text for text in numbers["warnings"] if _is_match(text, numbers)]
    sentences = [text[:1].upper() + text[1:] for text in matches]
    sentences += [
        texts.LAYOUT.format(layout=numbers["layout"]),
        texts.UP.format(up=fit.up_axis),
        texts.RATE.format(rate=numbers["rate_hz"]),
        texts.FLOOR_ZERO if floor == 0 else texts.FLOOR.format(height=floor),
    ]
    if fit.recorded:
        values = ", ".join(
            f"{measurement_name(key).lower()} {measurement_text(key, value)}"
            for key, value in fit.recorded.items()
        )
        sentences.append(texts.RECORDED.format(values=shown(values, 500)))
    sentences += _gender(numbers["gender"])
    return card(texts.ASSUMED_TITLE, _list(_item(text, "") for text in sentences))


def _gender(gender: dict[str, Any] | None) -> list[str]:
    """What the shape says of the sex, and which model was fitted."""
    if not gender:
        return []
    female = gender["female_probability"]
    model = gender["model"]
    neutral = model == "neutral"
    lead = texts.GENDER_NEUTRAL if neutral else texts.GENDER_MODEL.format(model=model)
    if female is None:
        return [f"{lead}."]
    sentence = texts.GENDER_SAYS.get(gender["decision"], texts.GENDER_SAYS[""])
    shape = texts.GENDER_SHAPE["neutral" if neutral else ""]
    return [f"{lead}; {sentence.format(shape=shape, female=female, male=1 - female)}."]


def _body_and_solution(fit: "MarkerFit", numbers: dict[str, Any], scene: Scene) -> str:
    """Measurements of the body beside status, costs and the seconds of each stage."""
    body = numbers["body_measurements"]
    seconds = {key: numbers["stage_seconds"].get(key) for key in texts.SECONDS}
    rows = [(texts.SECONDS[key], f"{value:,.2f} s") for key, value in seconds.items() if value]
    seed = [("Seed", str(fit.seed))]
    right = solution_card(fit.status, fit.costs, texts.TERMS, texts.TERM_STAGES, seed)
    if rows:
        right += card(texts.TIMING_TITLE, numbers_table(rows))
    left = _body(body, fit.recorded, scene) if body else ""
    return columns(left, f"<div>{right}</div>")


def _body(body: Mapping[str, float], recorded: Mapping[str, Any], scene: Scene) -> str:
    stated = {key: measurement_text(key, recorded[key]) for key in recorded if key in body}
    width = 3 if stated else 2
    rows = (
        (measurement_name(key), measurement_text(key, value), stated.get(key, ""))[:width]
        for key, value in body.items()
    )
    table = numbers_table(rows, texts.BODY_HEADS if stated else ())
    tapes = {tape["name"] for tape in scene.facts["tapes"]}
    for key in tapes & body.keys():
        name = escape(measurement_name(key))
        button = f"<button type='button' class='tape' data-tape='{escape(key)}'>{name}</button>"
        table = table.replace(f"<th scope='row'>{name}</th>", f"<th scope='row'>{button}</th>")
    lead = texts.BODY_LEAD + texts.BODY_TAPES * bool(tapes)
    return card(texts.BODY_TITLE, table, lead)


def _held_out(numbers: dict[str, Any]) -> str:
    """Errors of held-out markers; empty where none were held out."""
    held = numbers["held_out_error_mm"]
    if held is None:
        return ""
    known = numbers.get("held_out_known_placement_mm")
    stages = [stage for stage in texts.STAGES if held[stage]]
    errors = [(texts.STAGES[stage], held[stage]) for stage in stages]
    if known:
        errors += [
            (texts.HELD_OUT_KNOWN_HEAD.format(stage=name), known[stage])
            for stage, name in texts.STAGES.items()
            if known[stage]
        ]
    heads = [head for head, _ in errors]
    rows = (
        (title, *(f"{_number(error[key])} mm" for _, error in errors))
        for key, title in texts.HELD_OUT_ROWS.items()
    )
    each = (
        (label, *(f"{_number(error['per_marker'][label])} mm" for _, error in errors))
        for label in held["pose"]["per_marker"]
    )
    inside = (
        f"{numbers_table(rows, ['', *heads])}<details><summary>{texts.HELD_OUT_EACH}</summary>"
        f"{numbers_table(each, ['Marker', *heads])}</details>"
    )
    lead = texts.HELD_OUT_LEAD + (texts.HELD_OUT_KNOWN if known else "")
    return card(texts.HELD_OUT_TITLE, inside, lead)


def _details(fit: "MarkerFit") -> str:
    """Versions and settings, folded."""
    settings = json.dumps(finite(dict(fit.settings)), indent=2, ensure_ascii=False, default=str)
    rows = [("habitus", __version__), ("Python", platform.python_version())]
    return (
        f"<section class='card'><details><summary>{texts.DETAILS_TITLE}</summary>"
        f"{numbers_table(rows)}<pre>{escape(settings)}</pre></details></section>"
    )
