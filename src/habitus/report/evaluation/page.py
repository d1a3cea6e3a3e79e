"""The report of an evaluation: one HTML file that opens offline, with a table of all models,
figures and pictures.
"""

import base64
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import Any

from habitus.report.evaluation.figures import inline, model_looks
from habitus.report.evaluation.pictures import CHANGE_RAMP, ERROR_RAMP
from habitus.report.evaluation.table import measures_table
from habitus.report.parts import card
from habitus.report.shell import ALONE, shell

Number = float | None


@dataclass(frozen=True, eq=False)
class Picture:
    """A PNG of a model: its ``kind`` ("model error map", "pose error map", "neck" or "worst fits")
    says where it goes.

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
    """The report as text. ``numbers`` are those of evaluation.json, ``plots`` whole SVG files by
    their names.
    """
    models = numbers["models"]
    looks = model_looks(numbers["models"])
    measured = (
        "the registrations' noise-free meshes"
        if numbers["dataset"]["noise_free"]
        else "the registrations"
    )
    sections = [
        card(
            "All models",
            f"<div class='scroll'>{measures_table(numbers, looks)}</div>",
            "How far fits end from the meshes, on average over vertices and meshes, with the "
            "first so many shape "
            "coefficients. The best of a column is set off.",
        ),
        _figure(
            plots,
            "model_generalisation",
            "Model generalisation",
            "Shape and pose are fitted to each registration: can the model take the form of "
            "people it has not seen?",
        ),
        _figure(
            plots,
            "pose_generalisation",
            "Pose generalisation",
            "The shape comes from a person's first registration, only the pose is fitted to the "
            "others: are shape and "
            "pose told apart, and do pose blend shapes say how bodies deform?",
        ),
        "<div class='columns'>",
        _figure(
            plots,
            "cumulative_variance",
            "Cumulative variance",
            "How much of the variance of shape the first so many coefficients explain "
            f"({_variance_of(models)}).",
        ),
        _figure(
            plots,
            "run_time",
            "Run time",
            "For one surface from new shape and pose; with 0 coefficients the shape was made "
            "before. Medians, one "
            "surface at a time, on the machine that wrote this.",
        ),
        "</div>",
        _error_maps(numbers, pictures, measured),
        _necks(numbers, plots, pictures),
        _worst(numbers, pictures),
    ]
    return shell(
        f"{len(models)} body model{'s' * (len(models) > 1)} evaluated · habitus",
        "\n".join([_head(numbers), *sections]),
        styles=["evaluation.css"],
        foot=f"{ALONE} evaluation.json beside it has every number, the folder figures every "
        "figure.",
    )


# -- words -----------------------------------------------------------------------------------------


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
    return (
        "<h1>Body models, evaluated</h1>\n<p "
        f"class='facts'>{escape(' · '.join(filter(None, facts)))}</p>\n"
        f"<p class='verdict'>{escape(verdict(numbers))}</p>"
    )


def _counted(count: int, one: str, many: str) -> str:
    return f"{count:,} {one if count == 1 else many}"


def verdict(numbers: Mapping[str, Any]) -> str:
    """The result in a sentence or three."""
    models = numbers["models"]
    shown = numbers["shown"]
    best = {}
    for key in ("model_generalisation", "pose_generalisation"):
        known = [(at_count(model[key], shown), model["name"]) for model in models if model[key]]
        best[key] = min(known, key=lambda each: each[0][0], default=None)
    (errors, name), posed = best["model_generalisation"], best["pose_generalisation"]
    text = f"{name} is nearest to new people, {_distance(*errors)}"
    if posed:
        same = "and" if posed[1] == name else f"{posed[1]}"
        text += f", {same} to new poses of known people, {_distance(*posed[0])}"
    text += "." if shown is None else f", with {shown} shape coefficient{'s' * (shown != 1)}."
    gains = [
        (_gain(model, shown), model["name"]) for model in models if model["removed_by_pose_shapes"]
    ]
    if gains:
        gain, name = max(gains)
        verb = "remove" if gain >= 0 else "add"
        text += (
            f" The pose blend shapes of {name} {verb} {abs(gain):.0f} % of the error in new poses."
        )
    return text


def at_count(curve: Mapping[str, Any], count: int | None) -> tuple[float, Number]:
    """A curve's mean errors (mm), to the registrations and to the same without noise, at a number
    of coefficients.
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


# -- figures and pictures --------------------------------------------------------------------------


def _figure(plots: Mapping[str, str], name: str, title: str, lead: str) -> str:
    if name not in plots:
        return ""
    return card(title, _plot(plots, name), lead)


def _plot(plots: Mapping[str, str], name: str) -> str:
    return f"<figure class='plot-figure' id='figure-{name}'>{inline(plots[name], name)}</figure>"


def _error_maps(numbers: Mapping[str, Any], pictures: Sequence[Picture], measured: str) -> str:
    inside = []
    for kind, title in (
        ("model error map", "Model generalisation"),
        ("pose error map", "Pose generalisation"),
    ):
        chosen = [each for each in pictures if each.kind == kind]
        if chosen:
            inside.append(
                f"<h3>{title}</h3><div class='pictures maps'>{''.join(map(_img, chosen))}</div>"
            )
    maps = [each for each in pictures if each.kind.endswith("error map")]
    lead = (
        f"Mean distance of each vertex from {measured}{_with(numbers)}, on the mean person, "
        "front and back."
    )
    return (
        card("Where the error is", _scale(maps, ERROR_RAMP, "mm") + "".join(inside), lead)
        if maps
        else ""
    )


def _necks(
    numbers: Mapping[str, Any], plots: Mapping[str, str], pictures: Sequence[Picture]
) -> str:
    necks = [each for each in pictures if each.kind == "neck"]
    if not necks:
        return ""
    twists = {
        model["name"]: model["neck_twist"] for model in numbers["models"] if model["neck_twist"]
    }
    heads = ("Model", "Features", "Girth lost at the widest turns", "Left and right differ by")
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
    lead = (
        "The head turned to the right, not, and to the left. Blend skinning thins a neck that is "
        "turned to either "
        "side. Pose blend shapes driven by raw angles can mend one side only by spoiling the "
        "other; those driven by "
        "entries of rotation matrices can mend both. Girth is the mean distance of the neck's "
        "vertices from the axis."
    )
    inside = (
        f"{_scale(necks, CHANGE_RAMP, '% further from the axis than at rest')}"
        f"<div class='pictures wide'>{''.join(map(_img, necks))}</div>"
        "<div class='columns "
        f"beside'>{_plot(plots, 'neck_twist')}<div>{_plain_table(heads, rows)}</div></div>"
    )
    return card("The twist of the neck", inside, lead)


def _worst(numbers: Mapping[str, Any], pictures: Sequence[Picture]) -> str:
    worst = [each for each in pictures if each.kind == "worst fits"]
    if not worst:
        return ""
    posed = any(model["pose_generalisation"] for model in numbers["models"])
    lead = (
        f"The registrations that each model fits worst in {'pose' if posed else 'model'} "
        "generalisation"
        f"{_with(numbers)}: the registration in grey, and the fit with its distance from it."
    )
    parts = [
        f"<div class='by-model'><h3>{escape(name)}</h3><div class='pictures'>"
        f"{''.join(_img(each, named=False) for each in chosen)}</div></div>"
        for name, chosen in groupby(worst, key=lambda each: each.model)
    ]
    return card("Worst fits", _scale(worst, ERROR_RAMP, "mm") + "".join(parts), lead)


def _with(numbers: Mapping[str, Any]) -> str:
    count = numbers["shown"]
    return "" if count is None else f" with {count} shape coefficient{'s' * (count != 1)}"


def _img(picture: Picture, named: bool = True) -> str:
    data = base64.b64encode(picture.content).decode("ascii")
    name = f"<b>{escape(picture.model)}</b>" if named else ""
    caption = f"<figcaption>{name}{escape(picture.caption)}</figcaption>"
    words = escape(f"{picture.kind}, {picture.model}: {picture.caption}", quote=True)
    return f'<figure><img src="data:image/png;base64,{data}" alt="{words}">{caption}</figure>'


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
