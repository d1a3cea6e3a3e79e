"""The report of an evaluation: one HTML file that opens offline, with a table of all models,
figures (S Figs. 9, 11, 12, 14) and pictures.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import Any

from habitus.report.drawing import CHANGE_RAMP, ERROR_RAMP
from habitus.report.evaluation.figures import SERIES, inline, model_looks
from habitus.report.shell import OFFLINE, card, columns, figure, heading, shell

Number = float | None
MEASURES = {
    "model_generalisation": "Model generalisation",
    "pose_generalisation": "Pose generalisation",
}
MAPS = {"model error map": "Model generalisation", "pose error map": "Pose generalisation"}
FIGURES = {
    "model_generalisation": (
        "Model generalisation",
        "Shape and pose are fitted to each registration: how well the model represents people "
        "whom it has not seen.",
    ),
    "pose_generalisation": (
        "Pose generalisation",
        "The shape is fitted to a person's first registration, only the pose to the others: how "
        "well shape and pose are separated, and how well pose blend shapes predict deformation.",
    ),
    "cumulative_variance": (
        "Cumulative variance",
        "Share of the variance of shape that the first coefficients explain ({kinds}).",
    ),
    "run_time": (
        "Run time",
        "Of one surface from new shape and pose; with 0 coefficients the shape was prepared "
        "before. Medians, one surface at a time, on the machine that wrote this page.",
    ),
}
TEXTS = {
    "table": (
        "Mean distance of the fits from the meshes, over vertices and meshes, by the number of "
        "shape coefficients. The best of each column is in bold."
    ),
    "maps": "Mean distance of each vertex from {target}{count}, on the mean person.",
    "neck": (
        "The head turned to the right, not turned, and to the left. Linear blend skinning thins "
        "the neck at both sides. Pose blend shapes that are linear in angles can correct one side "
        "only at the cost of the other; those linear in entries of rotation matrices can correct "
        "both. Girth is the mean distance of the neck's vertices from the axis."
    ),
    "worst": (
        "The registrations with the largest errors of each model in {measure} generalisation"
        "{count}: the registration in grey, and the fit coloured by its distance from it."
    ),
    "removed": (
        "of the error in pose generalisation without them, against noise-free meshes where there "
        "are any"
    ),
    "foot": "evaluation.json beside it has every number, the folder figures every figure.",
}


@dataclass(frozen=True, eq=False)
class Picture:
    """A PNG of a model: its ``kind`` ("model error map", "pose error map", "neck" or "worst fits")
    gives the section.

    ``scale`` are the values at the ends of its colours: mm, or % of change of girth.
    """

    kind: str
    model: str
    file: str
    caption: str
    content: bytes
    scale: tuple[float, float]


def training_page(
    numbers: Mapping[str, Any], plots: Mapping[str, str], pictures: Sequence[Picture]
) -> str:
    """The report as text. ``numbers`` are the content of evaluation.json, ``plots`` whole SVG files
    by name.
    """
    models = numbers["models"]
    table = measures_table(numbers, model_looks(models))
    sections = [
        card("All models", f"<div class='scroll'>{table}</div>", TEXTS["table"]),
        _figure(plots, "model_generalisation"),
        _figure(plots, "pose_generalisation"),
        columns(
            _figure(plots, "cumulative_variance", kinds=_variance_of(models)),
            _figure(plots, "run_time"),
        ),
        _error_maps(numbers, pictures),
        _necks(numbers, plots, pictures),
        _worst(numbers, pictures),
    ]
    return shell(
        f"{len(models)} body model{'s' * (len(models) > 1)} evaluated · habitus",
        "\n".join([_head(numbers), *sections]),
        styles=["evaluation.css"],
        foot=f"{OFFLINE} {TEXTS['foot']}",
    )


def _head(numbers: Mapping[str, Any]) -> str:
    data = numbers["dataset"]
    models = numbers["models"]
    people = len(set(data["subjects"]))
    facts = [
        _counted(len(models), "model", "models"),
        f"{_counted(len(data['registrations']), 'registration', 'registrations')} of "
        f"{_counted(people, 'person', 'people')}",
        _counted(data["vertices"], "vertex", "vertices"),
        "with noise-free meshes" if data["noise_free"] else "",
        re.split(r"[/\\]", data["path"].rstrip("/\\"))[-1],
    ]
    summary = f"<p class='verdict'>{escape(verdict(numbers))}</p>"
    return heading("Evaluation of body models", filter(None, facts)) + summary


def _counted(count: int, singular: str, plural: str) -> str:
    return f"{count:,} {singular if count == 1 else plural}"


def verdict(numbers: Mapping[str, Any]) -> str:
    """The result in a sentence or three."""
    models = numbers["models"]
    shown = numbers["shown"]
    sentences = []
    for key, objects in zip(MEASURES, ("new people", "new poses of known people"), strict=True):
        known = [(at_count(model[key], shown), model["name"]) for model in models if model[key]]
        if known:
            errors, name = min(known, key=lambda entry: entry[0][0])
            sentences.append(
                f"{name} has the smallest error on {objects}{_with(numbers)}: {_distance(*errors)}."
            )
    gains = [
        (_gain(model, shown), model["name"]) for model in models if model["removed_by_pose_shapes"]
    ]
    if gains:
        gain, name = max(gains)
        verb = "remove" if gain >= 0 else "add"
        text = (
            f"The pose blend shapes of {name} {verb} {abs(gain):.0f} % of the error in new poses."
        )
        sentences.append(text)
    return " ".join(sentences)


def at_count(curve: Mapping[str, Any], count: int | None) -> tuple[float, Number]:
    """A curve's mean errors (mm) at a number of coefficients: to the registrations, and to the
    noise-free meshes.
    """
    k = -1 if count is None else curve["counts"].index(count)
    return curve["mean_mm"][k], curve["clean_mean_mm"][k] if curve["clean_mean_mm"] else None


def _distance(mean: float, clean: Number) -> str:
    return (
        f"{mean:.2f} mm"
        if clean is None
        else f"{mean:.2f} mm ({clean:.2f} mm from the noise-free meshes)"
    )


def _gain(model: Mapping[str, Any], count: int | None) -> float:
    gains = model["removed_by_pose_shapes"]
    return gains["percent"][-1 if count is None else gains["counts"].index(count)]


def _variance_of(models: Sequence[Mapping[str, Any]]) -> str:
    kinds = dict.fromkeys(model["cumulative_variance"]["of"] for model in models)
    return "; ".join(f"of {kind}" for kind in kinds)


def _figure(plots: Mapping[str, str], name: str, **values: str) -> str:
    if name not in plots:
        return ""
    title, lead = FIGURES[name]
    return card(title, _plot(plots, name), lead.format(**values))


def _plot(plots: Mapping[str, str], name: str) -> str:
    return f"<figure class='plot-figure' id='figure-{name}'>{inline(plots[name], name)}</figure>"


def _error_maps(numbers: Mapping[str, Any], pictures: Sequence[Picture]) -> str:
    chosen = {kind: [picture for picture in pictures if picture.kind == kind] for kind in MAPS}
    maps = [picture for group in chosen.values() for picture in group]
    if not maps:
        return ""
    inside = "".join(
        f"<h3>{MAPS[kind]}</h3><div class='pictures maps'>{''.join(map(_picture, group))}</div>"
        for kind, group in chosen.items()
        if group
    )
    noise_free = numbers["dataset"]["noise_free"]
    target = "the noise-free meshes" if noise_free else "the registrations"
    lead = TEXTS["maps"].format(target=target, count=_with(numbers))
    return card("Where the error is", _scale(maps, ERROR_RAMP, "mm") + inside, lead)


def _necks(
    numbers: Mapping[str, Any], plots: Mapping[str, str], pictures: Sequence[Picture]
) -> str:
    necks = [picture for picture in pictures if picture.kind == "neck"]
    if not necks:
        return ""
    twists = {
        model["name"]: model["neck_twist"] for model in numbers["models"] if model["neck_twist"]
    }
    heads = ("Model", "Features", "Loss of girth at the largest turns", "Asymmetry")
    features = {model["name"]: model["pose_features"] or "–" for model in numbers["models"]}
    rows = [
        (
            name,
            features[name],
            f"{100 * twist['shrink']:.1f} %",
            f"{100 * twist['asymmetry']:.2f} %",
        )
        for name, twist in twists.items()
    ]
    pictured = "".join(map(_picture, necks))
    inside = (
        f"{_scale(necks, CHANGE_RAMP, '% change of the distance from the axis')}"
        f"<div class='pictures wide'>{pictured}</div><div class='columns beside'>"
        f"{_plot(plots, 'neck_twist')}<div>{_plain_table(heads, rows)}</div></div>"
    )
    return card("The twist of the neck", inside, TEXTS["neck"])


def _worst(numbers: Mapping[str, Any], pictures: Sequence[Picture]) -> str:
    worst = [picture for picture in pictures if picture.kind == "worst fits"]
    if not worst:
        return ""
    posed = any(model["pose_generalisation"] for model in numbers["models"])
    lead = TEXTS["worst"].format(measure="pose" if posed else "model", count=_with(numbers))
    parts = [
        f"<div class='by-model'><h3>{escape(name)}</h3><div class='pictures'>"
        f"{''.join(_picture(fit, named=False) for fit in chosen)}</div></div>"
        for name, chosen in groupby(worst, key=lambda picture: picture.model)
    ]
    return card("Worst fits", _scale(worst, ERROR_RAMP, "mm") + "".join(parts), lead)


def _with(numbers: Mapping[str, Any]) -> str:
    count = numbers["shown"]
    return "" if count is None else f" with {count} shape coefficient{'s' * (count != 1)}"


def _picture(picture: Picture, named: bool = True) -> str:
    description = f"{picture.kind}, {picture.model}: {picture.caption}"
    name = picture.model if named else ""
    return figure(picture.caption, picture.content, bold=name, alt=description)


def _scale(pictures: Sequence[Picture], ramp: Sequence[str], unit: str) -> str:
    low, high = (f"{value:.2g}".replace("-", "−") for value in pictures[0].scale)
    bar = f"<i style='background: linear-gradient(90deg, {', '.join(ramp)})'></i>"
    return f"<p class='scale'><span>{low}</span>{bar}<span>{high} {escape(unit)} or more</span></p>"


def _plain_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(
        f"<th{'' if k < 2 else ' class=number'} scope='col'>{escape(head)}</th>"
        for k, head in enumerate(heads)
    )
    lines = [
        f"<tr><th scope='row'>{escape(row[0])}</th><td>{escape(row[1])}</td>"
        f"{''.join(f'<td class=number>{escape(cell)}</td>' for cell in row[2:])}</tr>"
        for row in rows
    ]
    return f"<table><tr>{top}</tr>{''.join(lines)}</table>"


def measures_table(numbers: Mapping[str, Any], looks: Mapping[str, Any]) -> str:
    """Groups of rows, a column for each number of shape coefficients; ``looks`` are those of
    `model_looks`.
    """
    models = numbers["models"]
    curves = [model[key] for model in models for key in MEASURES if model[key]]
    counts = sorted({count for curve in curves for count in curve["counts"]})
    heads = "".join(f"<th class='number' scope='col'>{count}</th>" for count in counts)
    groups = []
    for key, title in MEASURES.items():
        for error, note in (
            ("mean_mm", "to the registrations"),
            ("clean_mean_mm", "to their noise-free meshes"),
        ):
            rows = {m["name"]: _by_count(m[key], error) for m in models if m[key] and m[key][error]}
            groups.append(_group(f"{title}, mm", note, rows, counts, looks, "{:.2f}".format))
    gains = {
        m["name"]: _by_count(m["removed_by_pose_shapes"], "percent")
        for m in models
        if m["removed_by_pose_shapes"]
    }
    groups.append(
        _group(
            "Removed by pose blend shapes, %",
            TEXTS["removed"],
            gains,
            counts,
            looks,
            "{:.0f}".format,
            largest=True,
        )
    )
    times = {model["name"]: _by_count(model["run_time"], "median_ms") for model in models}
    groups.append(_group("Run time, ms", "of one surface", times, counts, looks, "{:.2f}".format))
    return (
        "<table class='measures'><thead><tr><th scope='col'>Shape "
        f"coefficients</th>{heads}</tr></thead>"
        f"{''.join(groups)}</table>"
    )


def _by_count(curve: Mapping[str, Any], key: str) -> dict[int, float]:
    return dict(zip(curve["counts"], curve[key], strict=True))


def _group(
    title: str,
    note: str,
    rows: Mapping[str, Mapping[int, float]],
    counts: Sequence[int],
    looks: Mapping[str, Any],
    text: Callable[[float], str],
    largest: bool = False,
) -> str:
    if not rows:
        return ""
    best = {
        count: (max if largest else min)(
            (text(row[count]) for row in rows.values() if count in row), key=float, default=""
        )
        for count in counts
    }
    lines = [
        "<tr class='group'><th "
        f"colspan='{len(counts) + 1}'>{escape(title)}<small>{escape(note)}</small></th></tr>"
    ]
    for name, row in rows.items():
        cells = "".join(
            _cell(text(row[k]) if k in row else "–", len(rows) > 1 and best[k]) for k in counts
        )
        lines.append(f"<tr><th scope='row'>{_dot(looks[name])}{escape(name)}</th>{cells}</tr>")
    return f"<tbody>{''.join(lines)}</tbody>"


def _cell(text: str, best: str | bool) -> str:
    return f"<td class='number{' best' if text == best else ''}'>{text}</td>"


def _dot(look: Mapping[str, Any]) -> str:
    dashed = " dashed" if look["linestyle"] == "--" else ""
    return (
        f"<i class='dot{dashed}' style='border-color: "
        f"var(--series-{SERIES.index(look['color'])})'></i>"
    )
