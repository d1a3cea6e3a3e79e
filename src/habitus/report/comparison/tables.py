"""The words and tables of a comparison's page. Every text from outside is escaped here."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from habitus.body.measurement_names import DEFINITIONS
from habitus.errors import shown
from habitus.report.comparison.differences import Differences
from habitus.report.facts import LONGEST_NAME
from habitus.report.parts import Tile, tiles


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:,.{digits}f}"


def _signed(value: float) -> str:
    rounded = round(value, 1)
    return f"{rounded:+.1f}" if rounded else "0.0"


def _words(name: str) -> str:
    return shown(name, LONGEST_NAME).replace("_", " ")


def head(found: Differences, numbers: Mapping[str, Any], names: tuple[str, str]) -> str:
    """Title, what is compared, the result in a sentence, tiles, and what must be known."""
    compared = numbers["compared"]
    facts = (
        f"{compared['moments']:,} moments · {compared['rate_hz']:g} Hz · "
        f"{compared['seconds']:,.1f} s"
    )
    listed = numbers["notes"] if found.same_moments else numbers["notes"][1:]
    items = "".join(f"<li class='minor'>{escape(note)}</li>" for note in listed)
    notes = (
        f"<section class='card'><h2>To be known</h2><ul class='findings'>{items}</ul></section>"
        if items
        else ""
    )
    title = shown(found.a.capture_name, LONGEST_NAME)
    both = "".join(
        f"<span class='side-{letter.lower()}'><i class='letter'>{letter}</i> {escape(name)}</span> "
        for letter, name in zip("AB", names, strict=True)
    )
    return (
        f"<h1>{escape(title)}, compared</h1>\n<p class='facts'>{both}</p><p "
        f"class='facts'>{escape(facts)}</p>\n"
        f"{'' if found.same_moments else _warning(numbers['notes'][0])}"
        f"<p class='verdict'>{escape(summary(numbers))}</p>\n{tiles(_tiles(numbers))}{notes}"
    )


def _warning(note: str) -> str:
    lead = "These are different moments: do not compare them."
    return (
        "<div class='banner failed' "
        f"role='alert'><strong>{lead}</strong><ul><li>{escape(note)}</li></ul></div>"
    )


def summary(numbers: Mapping[str, Any]) -> str:
    """The comparison in a sentence or two."""
    skin = numbers["skin_mm"]
    joints = numbers["joints_mm"]
    worst = numbers["worst_moments"]
    lead = (
        f"The skins of A and B are {skin['mean']:.1f} mm apart on average"
        if skin
        else f"Joints of A and B are {joints['mean']:.1f} mm apart on average"
    )
    if not worst:
        return f"{lead}."
    first = worst[0]
    return (
        f"{lead}, {first['mean_mm']:.1f} mm at worst, {first['time_s']:.2f} s into A, where the "
        f"{_words(first['worst_joint'])} is {first['worst_joint_mm']:.0f} mm off."
    )


def _tiles(numbers: Mapping[str, Any]) -> Iterable[Tile]:
    skin = numbers["skin_mm"]
    joints = numbers["joints_mm"]
    rest = numbers["shape_at_rest_mm"]
    centred, turned, markers = (
        numbers[k] for k in ("joints_root_aligned_mm", "joint_rotations_degrees", "markers")
    )
    if skin:
        yield (
            "Skin apart",
            _number(skin["mean"]),
            "mm",
            f"furthest point {_number(skin['max'], 0)} mm",
        )
    yield "Joints apart", _number(joints["mean"]), "mm", f"95 % below {_number(joints['p95'])} mm"
    yield "Pelvis on pelvis", _number(centred["mean"]), "mm", "joints, the same way"
    if turned:
        yield "Joints turned", _number(turned["mean"]), "°", f"95 % below {_number(turned['p95'])}°"
    if rest:
        yield "Shape at rest", _number(rest["mean"]), "mm", f"at most {_number(rest['max'], 0)} mm"
    if markers:
        apart = markers["apart_mm"]
        yield "Markers apart", _number(apart["mean"]), "mm", "as the bodies carry them"


def apart_text(found: Differences) -> str:
    """What the first curve shows."""
    if found.skin is None:
        return "Mean distance between joints of one name."
    return "Mean distance between the same points of both skins, and between joints of one name."


def worst(numbers: Mapping[str, Any]) -> str:
    """Buttons to the moments at which the two are furthest apart."""
    items = "".join(
        "<li><button type='button' class='go' "
        f"data-time='{moment['time_s']:.6f}'><b>{moment['time_s']:.2f} s</b>, "
        f"{moment['mean_mm']:.1f} mm apart<small>{escape(_words(moment['worst_joint']))} "
        f"{moment['worst_joint_mm']:.0f} mm; frame {moment['frame_a'] + 1:,} of A, "
        f"{moment['frame_b'] + 1:,} of B"
        "</small></button></li>"
        for moment in numbers["worst_moments"]
    )
    return (
        f"<h3>The worst moments</h3><ol class='moments' aria-label='Worst moments'>{items}</ol>"
        if items
        else ""
    )


def sections(found: Differences, numbers: Mapping[str, Any]) -> str:
    """All tables: the two results, joints, markers, measurements."""
    cards = [_results(numbers), _measured(numbers)]
    return (
        f"<div class='columns'>{''.join(cards)}</div>"
        f"<div class='columns'>{_joints(found, numbers)}{_markers(found, numbers)}</div>"
    )


def _card(title: str, lead: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in a card; cells are HTML already."""
    body = "".join(
        f"<tr><th scope='row'>{cells[0]}</th>{''.join(f'<td class=number>{cell}</td>' for cell in cells[1:])}</tr>"  # noqa: E501
        for cells in rows
    )
    if not body:
        return ""
    top = "".join(
        f"<th scope='col'{' class=number' * (k > 0)}>{one}</th>" for k, one in enumerate(heads)
    )
    return (
        f"<section class='card'><h2>{title}</h2><p class='lead'>{lead}</p>"
        "<div class='scroll' tabindex='0' role='group' "
        f"aria-label='{title}'><table><thead><tr>{top}</tr></thead>"
        f"<tbody>{body}</tbody></table></div></section>"
    )


def _results(numbers: Mapping[str, Any]) -> str:
    sides = [numbers[side] for side in "ab"]
    errors = [side["marker_error_mm"] or {} for side in sides]
    rows = [
        ["Verdict", *(_level(side["verdict"]) for side in sides)],
        ["Marker error, mean", *(f"{_number(one.get('mean'))} mm" for one in errors)],
        ["95 % are below", *(f"{_number(one.get('p95'))} mm" for one in errors)],
        ["Markers", *(_count(side["markers"]) for side in sides)],
        ["Suspect markers", *(_count(side["suspects"]) for side in sides)],
        ["Frames", *(f"{side['frames']:,} at {side['rate_hz']:g} Hz" for side in sides)],
        ["Body", *(escape(shown(side["body"], LONGEST_NAME)) for side in sides)],
        ["Layout", *(escape(shown(side["layout"] or "–", LONGEST_NAME)) for side in sides)],
    ]
    return _card("The two results", "What each says of itself.", ["", "A", "B"], rows)


def _level(verdict: Mapping[str, Any] | None) -> str:
    if verdict is None:
        return "–"
    return f"<span title='{escape(' '.join(verdict['reasons']))}'>{escape(verdict['level'])}</span>"


def _count(value: int | None) -> str:
    return "–" if value is None else f"{value:,}"


def _measured(numbers: Mapping[str, Any]) -> str:
    rows = []
    for name, both in numbers["measurements"].items():
        unit, factor = ("kg", 1.0) if name.endswith("_kg") else ("cm", 100.0)
        label = escape(_words(name.removesuffix("_m").removesuffix("_kg")).capitalize())
        says = escape(DEFINITIONS[name].says) if name in DEFINITIONS else ""
        ours, theirs = (f"{_number(factor * both[k])} {unit}" for k in "ab")
        rows.append(
            [
                f"<span title='{says}'>{label}</span>",
                ours,
                theirs,
                f"{factor * both['difference']:+.1f} {unit}",
            ]
        )
    return _card("Measurements", "Of both bodies at rest.", ["", "A", "B", "B − A"], rows)


def _go(time: float, text: str, what: str, marker: str = "") -> str:
    """A button that leads the player to a moment; ``what`` is said of it aloud, ``marker`` escaped
    already.
    """
    chosen = f" data-marker='{marker}'" if marker else ""
    label = escape(f"{what}: go to {time:.2f} s")
    return (
        f"<button type='button' class='go' data-time='{time:.6f}'{chosen} "
        f"aria-label='{label}'>{text}</button>"
    )


def _joints(found: Differences, numbers: Mapping[str, Any]) -> str:
    per = numbers["joints_mm"]["per_joint"]
    turned = numbers["joint_rotations_degrees"]
    worst_at = found.pairing.times[found.joints.argmax(0)]
    rows = []
    for name, time in sorted(
        zip(found.joint_names, worst_at, strict=True), key=lambda one: -per[one[0]]["mean"]
    ):
        link = _go(
            time, _number(per[name]["max"]), f"{_words(name)}, {_number(per[name]['max'])} mm"
        )
        row = [escape(_words(name)), _number(per[name]["mean"]), _number(per[name]["p95"]), link]
        rows.append(row + ([_number(turned["per_joint"][name]["mean"])] if turned else []))
    heads = ["", "mean mm", "95 % below", "most mm", *(["turned °"] if turned else [])]
    return _card(
        "Joint by joint",
        "Furthest apart first; the largest distance leads to its moment.",
        heads,
        rows,
    )


def _markers(found: Differences, numbers: Mapping[str, Any]) -> str:
    markers = found.markers
    told = numbers["markers"]
    if markers is None or told is None:
        return ""
    rows = []
    apart = np.where(np.isfinite(markers.apart), markers.apart, -1.0)
    for k, label in sorted(
        enumerate(markers.labels), key=lambda one: -(told["errors_mm"][one[1]]["apart"] or 0.0)
    ):
        each = told["errors_mm"][label]
        time = found.pairing.times[apart[:, k].argmax()]
        name = escape(shown(label, LONGEST_NAME))
        link = _go(
            time,
            _number(each["apart"]),
            f"{shown(label, LONGEST_NAME)}, where it is furthest",
            name,
        )
        rows.append([name, link, _number(each["a"]), _number(each["b"])])
    lead = (
        "How far apart the bodies carry each marker, and how far each of them has it from "
        "where it was seen."
    )
    return _card("Marker by marker", lead, ["", "apart mm", "error of A", "error of B"], rows)


def reports(links: Sequence[str | None]) -> str:
    """Links to the pages of the two results, and to the numbers."""
    items = [
        f"<li><a href='{escape(link)}'>Report of {letter}</a></li>"
        for letter, link in zip("AB", links, strict=True)
        if link
    ]
    items.append(
        "<li><a href='compare.json' download>compare.json</a> <span>the numbers of this page, for "
        "programs</span></li>"
    )
    return f"<ul class='files' aria-label='Files beside this page'>{''.join(items)}</ul>"
