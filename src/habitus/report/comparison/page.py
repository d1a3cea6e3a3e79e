"""The page of a comparison: one HTML file with two bodies on one clock, curves of the distances
between them, and tables.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from string import Template
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Float

from habitus.body.joint_angles import joint_angles
from habitus.body.measurement_names import DEFINITIONS
from habitus.body.motion import Moving
from habitus.errors import shown
from habitus.fit.markers.result import MarkerFit
from habitus.report.comparison.differences import Differences
from habitus.report.fit.scene import ANGLE_FRAMES, PLOT_BINS, add_scene, bin_edges, bin_means
from habitus.report.shell import (
    MAX_NAME,
    NO_SCRIPT,
    VIEWER,
    Blob,
    Tile,
    asset,
    card,
    columns,
    measurement_name,
    measurement_text,
    player,
    shell,
    tiles,
)
from habitus.results.save import finite

SCRIPTS = (*VIEWER, "compare_player.js", "compare_main.js")
LAYERS = 9
"""Layers of the player that have keys."""
TEXTS = {
    "player": "Two fitted bodies, A and B, at the same moment, side by side or overlaid.",
    "thinned": (
        "The player shows {a:.3g} frames per second of A and {b:.3g} of B; curves and tables use "
        "all."
    ),
    "curve": "Mean distance between corresponding points of both skins, and between joints.",
    "curve_joints": "Mean distance between joints of one name.",
    "notes": "Notes",
    "moments": "These are different moments: do not compare them.",
    "summary": "The mean distance between the {things} of A and B is {mean:.1f} mm",
    "worst": (
        ", and {worst:.1f} mm at the worst moment, {time:.2f} s into A, where the distance of the "
        "{joint} is {joint_mm:.0f} mm."
    ),
    "results": "Each result's own numbers.",
    "measurements": "Of both bodies at rest.",
    "joints": "Largest mean distance first; the largest distance leads to its moment.",
    "markers": (
        "Distance between the predictions of A and B, and mean error of each fit: the distance "
        "between its predictions and the observations."
    ),
}


def comparison_page(
    result: Differences,
    numbers: Mapping[str, Any],
    names: tuple[str, str],
    links: Sequence[str | None] = (None, None),
) -> str:
    """The page as text; ``numbers`` is the content of compare.json, ``links`` lead to the reports
    of A and B where there are any.
    """
    titles = (shown(names[0], MAX_NAME), shown(names[1], MAX_NAME))
    ours = Blob()
    theirs = Blob()
    data = _side(result.a, ours) | {"other": _side(result.b, theirs)}
    _add_curves(result, ours)
    data |= {
        "end": float(result.pairing.times[-1]),
        "offset": _offset(result),
        "angles": _add_angles(result, ours),
        "name": f"{shown(result.a.capture_name, MAX_NAME)}-compared",
    }
    for side, blob in ((data, ours), (data["other"], theirs)):
        side |= {"arrays": blob.contents, "bytes": blob.size}
    capture = shown(result.a.capture_name, MAX_NAME)
    content = Template(asset("compare.html")).substitute(
        head=_head(result, numbers, titles),
        player=_player(titles),
        note=_note(data),
        curvetext=TEXTS["curve_joints" if result.skin is None else "curve"],
        worst=_worst(numbers),
        sections=_sections(result, numbers),
        files=_links(links),
    )
    arrays = {"arrays-a": ours.base64(), "arrays-b": theirs.base64()}
    return shell(
        f"{capture}: {titles[0]} and {titles[1]} · habitus",
        content,
        data=finite(data),
        arrays=arrays,
        scripts=SCRIPTS,
        styles=["compare.css"],
        without_script=NO_SCRIPT,
    )


def _side(moving: Moving, blob: Blob) -> dict[str, Any]:
    """What the player reads of one result."""
    labels = (
        [shown(label, MAX_NAME) for label in moving.labels] if isinstance(moving, MarkerFit) else []
    )
    scene = add_scene(moving, blob, last_stage=True)
    return {
        "labels": labels,
        "frames": moving.num_frames,
        "rate": float(moving.rate_hz),
        "scene": scene.facts,
    }


def _offset(result: Differences) -> float:
    """Seconds from A's first frame to B's."""
    pairing = result.pairing
    return float(pairing.times[0] - pairing.frames[1][0] / result.b.rate_hz)


def _add_curves(result: Differences, blob: Blob) -> None:
    edges = bin_edges(len(result.pairing.times), PLOT_BINS)
    blob.add("times", result.pairing.times[edges].astype("f4"))
    curves = {
        "distance/joints": result.joints.mean(1),
        "distance/aligned": result.root_aligned.mean(1),
    }
    if result.skin is not None:
        curves |= {"distance/skin": result.skin[:, 0], "distance/worst": result.skin[:, 2]}
    if result.markers is not None:
        nearest = result.pairing.nearest
        for side, fit, rows in zip("ab", (result.a, result.b), nearest, strict=True):
            assert isinstance(fit, MarkerFit)
            curves[f"error/{side}"] = _mean_error(np.asarray(fit.errors_mm)[rows])
    for name, values in curves.items():
        blob.add(name, bin_means(values, edges).astype("f4"))


def _mean_error(errors: Float[np.ndarray, "T M"]) -> Float[np.ndarray, " T"]:
    """Mean over the visible markers of each frame, NaN where there are none."""
    seen = np.isfinite(errors)
    count = seen.sum(1)
    return np.where(count > 0, np.where(seen, errors, 0).sum(1) / np.maximum(count, 1), np.nan)


def _add_angles(result: Differences, blob: Blob) -> list[dict[str, str]]:
    """Joint angles that both bodies have, in tenths of degrees; gives name, side and body of each
    row.
    """
    some = bin_edges(len(result.pairing.times), ANGLE_FRAMES)
    both = [
        joint_angles(m.body, m.betas, np.asarray(m.pose)[rows[some]])
        for m, rows in zip((result.a, result.b), result.pairing.nearest, strict=True)
    ]
    rows = [
        ({"name": name, "side": side, "whose": whose}, angles[name][side])
        for name, sides in both[0].items()
        for side in sides
        for whose, angles in zip("AB", both, strict=True)
        if side in both[0].get(name, {}) and side in both[1].get(name, {})
    ]
    if rows:
        tenths = 10 * np.column_stack([values for _, values in rows])
        blob.add("angles", np.round(np.clip(tenths, -32768, 32767)).astype("i2"), True)
        frames = result.pairing.times[some] * result.a.rate_hz
        blob.add("angleFrames", np.round(frames).astype("u4"))
    return [facts for facts, _ in rows]


def _player(names: tuple[str, str]) -> str:
    tags = "".join(
        f"<span class='side-{letter.lower()}'><i class='letter'>{letter}</i> "
        f"<b>{escape(name)}</b></span>"
        for letter, name in zip("AB", names, strict=True)
    )
    return player(
        TEXTS["player"],
        asset("player_pair.html"),
        LAYERS,
        "<dt>V</dt><dd>side by side, overlay</dd>",
        f"<div class='tags'>{tags}</div>",
    )


def _note(data: Mapping[str, Any]) -> str:
    """How many frames the player shows, where it does not show all."""
    rates = [side["scene"]["rate"] for side in (data, data["other"])]
    if not any(side["scene"]["stride"] > 1 for side in (data, data["other"])):
        return ""
    text = TEXTS["thinned"].format(a=rates[0], b=rates[1])
    return f"<p class='note'>{escape(text)}</p>"


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:,.{digits}f}"


def _name(name: str) -> str:
    return shown(name, MAX_NAME).replace("_", " ")


def _head(result: Differences, numbers: Mapping[str, Any], names: tuple[str, str]) -> str:
    """Title, what is compared, the result in a sentence, tiles, and notes."""
    compared = numbers["compared"]
    facts = (
        f"{compared['moments']:,} frames compared · {compared['rate_hz']:g} Hz · "
        f"{compared['seconds']:,.1f} s"
    )
    listed = numbers["notes"] if result.same_moments else numbers["notes"][1:]
    items = "".join(f"<li class='minor'>{escape(note)}</li>" for note in listed)
    notes = card(TEXTS["notes"], f"<ul class='findings'>{items}</ul>") if items else ""
    both = "".join(
        f"<span class='side-{letter.lower()}'><i class='letter'>{letter}</i> {escape(name)}</span> "
        for letter, name in zip("AB", names, strict=True)
    )
    return (
        f"<h1>{escape(shown(result.a.capture_name, MAX_NAME))}, compared</h1>\n"
        f"<p class='facts'>{both}</p><p class='facts'>{escape(facts)}</p>\n"
        f"{'' if result.same_moments else _warning(numbers['notes'][0])}"
        f"<p class='verdict'>{escape(_summary(numbers))}</p>\n{tiles(_tiles(numbers))}{notes}"
    )


def _warning(note: str) -> str:
    return (
        f"<div class='banner failed' role='alert'><strong>{TEXTS['moments']}</strong>"
        f"<ul><li>{escape(note)}</li></ul></div>"
    )


def _summary(numbers: Mapping[str, Any]) -> str:
    """The comparison in a sentence."""
    skin = numbers["skin_mm"]
    things, mean = ("skins", skin) if skin else ("joints", numbers["joints_mm"])
    text = TEXTS["summary"].format(things=things, mean=mean["mean"])
    if not numbers["worst_moments"]:
        return f"{text}."
    worst = numbers["worst_moments"][0]
    return text + TEXTS["worst"].format(
        worst=worst["mean_mm"],
        time=worst["time_s"],
        joint=_name(worst["worst_joint"]),
        joint_mm=worst["worst_joint_mm"],
    )


def _tiles(numbers: Mapping[str, Any]) -> Iterator[Tile]:
    skin = numbers["skin_mm"]
    joints = numbers["joints_mm"]
    aligned = numbers["joints_root_aligned_mm"]
    rotations = numbers["joint_rotations_degrees"]
    rest = numbers["shape_at_rest_mm"]
    if skin:
        remark = f"largest {_number(skin['max'], 0)} mm"
        yield "Skin distance", _number(skin["mean"]), "mm", remark
    remark = f"95 % below {_number(joints['p95'])} mm"
    yield "Joint distance", _number(joints["mean"]), "mm", remark
    yield "Root-aligned", _number(aligned["mean"]), "mm", "joints, pelvis on pelvis"
    if rotations:
        remark = f"95 % below {_number(rotations['p95'])}°"
        yield "Joint rotation", _number(rotations["mean"]), "°", remark
    if rest:
        yield "Shape at rest", _number(rest["mean"]), "mm", f"largest {_number(rest['max'], 0)} mm"
    if numbers["markers"]:
        distance = numbers["markers"]["distance_mm"]
        yield "Marker distance", _number(distance["mean"]), "mm", "as the bodies predict them"


def _worst(numbers: Mapping[str, Any]) -> str:
    """Buttons to the moments with the largest distances."""
    items = "".join(
        f"<li><button type='button' class='go' data-time='{moment['time_s']:.6f}'>"
        f"<b>{moment['time_s']:.2f} s</b>, {moment['mean_mm']:.1f} mm"
        f"<small>{escape(_name(moment['worst_joint']))} {moment['worst_joint_mm']:.0f} mm; frame "
        f"{moment['frame_a'] + 1:,} of A, {moment['frame_b'] + 1:,} of B</small></button></li>"
        for moment in numbers["worst_moments"]
    )
    if not items:
        return ""
    return f"<h3>Worst moments</h3><ol class='moments' aria-label='Worst moments'>{items}</ol>"


def _sections(result: Differences, numbers: Mapping[str, Any]) -> str:
    """All tables: the two results, measurements, joints, markers."""
    return columns(_results(numbers), _measurements(numbers)) + columns(
        _joints(result, numbers), _markers(result, numbers)
    )


def _table(title: str, lead: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in a card; cells are HTML."""
    body = "".join(
        f"<tr><th scope='row'>{cells[0]}</th>"
        + "".join(f"<td class=number>{cell}</td>" for cell in cells[1:])
        + "</tr>"
        for cells in rows
    )
    if not body:
        return ""
    top = "".join(
        f"<th scope='col'{' class=number' * (k > 0)}>{head}</th>" for k, head in enumerate(heads)
    )
    inside = (
        f"<div class='scroll' tabindex='0' role='group' aria-label='{title}'>"
        f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )
    return card(title, inside, lead)


def _results(numbers: Mapping[str, Any]) -> str:
    sides = [numbers[side] for side in "ab"]
    errors = [side["marker_error_mm"] or {} for side in sides]
    rows = [
        ["Verdict", *(_level(side["verdict"]) for side in sides)],
        ["Marker error, mean", *(f"{_number(error.get('mean'))} mm" for error in errors)],
        ["95 % are below", *(f"{_number(error.get('p95'))} mm" for error in errors)],
        ["Markers", *(_count(side["markers"]) for side in sides)],
        ["Suspect markers", *(_count(side["suspects"]) for side in sides)],
        ["Frames", *(f"{side['frames']:,} at {side['rate_hz']:g} Hz" for side in sides)],
        ["Body", *(escape(shown(side["body"], MAX_NAME)) for side in sides)],
        ["Layout", *(escape(shown(side["layout"] or "–", MAX_NAME)) for side in sides)],
    ]
    return _table("The two results", TEXTS["results"], ["", "A", "B"], rows)


def _level(verdict: Mapping[str, Any] | None) -> str:
    if verdict is None:
        return "–"
    return f"<span title='{escape(' '.join(verdict['reasons']))}'>{escape(verdict['level'])}</span>"


def _count(value: int | None) -> str:
    return "–" if value is None else f"{value:,}"


def _measurements(numbers: Mapping[str, Any]) -> str:
    rows = []
    for name, values in numbers["measurements"].items():
        definition = escape(DEFINITIONS[name].says) if name in DEFINITIONS else ""
        difference = measurement_text(name, values["difference"])
        rows.append(
            [
                f"<span title='{definition}'>{escape(measurement_name(shown(name)))}</span>",
                *(measurement_text(name, values[side]) for side in "ab"),
                difference if difference.startswith("-") else f"+{difference}",
            ]
        )
    return _table("Measurements", TEXTS["measurements"], ["", "A", "B", "B − A"], rows)


def _go(time: float, text: str, label: str, marker: str = "") -> str:
    """A button that moves the player to a moment, with its label for screen readers; ``marker`` is
    escaped already.
    """
    chosen = f" data-marker='{marker}'" if marker else ""
    label = escape(f"{label}: go to {time:.2f} s")
    return (
        f"<button type='button' class='go' data-time='{time:.6f}'{chosen} "
        f"aria-label='{label}'>{text}</button>"
    )


def _joints(result: Differences, numbers: Mapping[str, Any]) -> str:
    per_joint = numbers["joints_mm"]["per_joint"]
    rotations = numbers["joint_rotations_degrees"]
    times = result.pairing.times[result.joints.argmax(0)]
    by_name = dict(zip(result.joint_names, times, strict=True))
    rows = []
    for name in sorted(by_name, key=lambda name: -per_joint[name]["mean"]):
        distance = per_joint[name]
        largest = _number(distance["max"])
        link = _go(by_name[name], largest, f"{_name(name)}, {largest} mm")
        row = [escape(_name(name)), _number(distance["mean"]), _number(distance["p95"]), link]
        rows.append(row + ([_number(rotations["per_joint"][name]["mean"])] if rotations else []))
    heads = ["", "mean mm", "95 % below", "largest mm", *(["rotation °"] if rotations else [])]
    return _table("Joints", TEXTS["joints"], heads, rows)


def _markers(result: Differences, numbers: Mapping[str, Any]) -> str:
    markers = result.markers
    if markers is None or numbers["markers"] is None:
        return ""
    errors = numbers["markers"]["errors_mm"]
    distance = np.where(np.isfinite(markers.predicted), markers.predicted, -1.0)
    times = dict(zip(markers.labels, result.pairing.times[distance.argmax(0)], strict=True))
    rows = []
    for label in sorted(times, key=lambda label: -(errors[label]["distance"] or 0.0)):
        error = errors[label]
        name = escape(shown(label, MAX_NAME))
        spoken = f"{shown(label, MAX_NAME)}, largest distance"
        link = _go(times[label], _number(error["distance"]), spoken, name)
        rows.append([name, link, _number(error["a"]), _number(error["b"])])
    heads = ["", "distance mm", "error of A", "error of B"]
    return _table("Markers", TEXTS["markers"], heads, rows)


def _links(links: Sequence[str | None]) -> str:
    """Links to the pages of the two results, and to the numbers."""
    items = [
        f"<li><a href='{escape(quote(os.fsencode(link)))}'>Report of {letter}</a></li>"
        for letter, link in zip("AB", links, strict=True)
        if link
    ]
    items.append(
        "<li><a href='compare.json' download>compare.json</a> "
        "<span>the numbers of this page, for programs</span></li>"
    )
    return f"<ul class='files' aria-label='Files beside this page'>{''.join(items)}</ul>"
