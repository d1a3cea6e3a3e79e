"""The report of a fit to depth views: one HTML file that opens offline, with pictures, numbers and the body in 3D."""

import base64
from functools import cache
from html import escape
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus import __version__
from habitus.body.measurement_names import DEFINITIONS
from habitus.errors import shown
from habitus.report.facts import LONGEST_NAME
from habitus.report.fit.blob import Blob
from habitus.report.fit.sections import VERDICTS
from habitus.report.metrics import finite
from habitus.report.png import png
from habitus.report.rgbd.pictures import ERROR_MM, PAPER, Picture, light_ball, srgb_bytes, view_pictures
from habitus.report.shell import json_for_script

if TYPE_CHECKING:
    from habitus.fit.rgbd.result import RgbdFit
    from habitus.fit.rgbd.texture import Skin

SCRIPTS = ("viewer_inflate.js", "rgbd_viewer.js")
TERMS = {
    "depth": "E_D: depth, observed and the body's",
    "outline": "Body where the room behind was seen",
    "colour": "E_C: colours, observed and rendered",
    "floor": "E_F: soles on the floor",
    "shape": "E_S: shapes that few people have",
    "pose": "E_P: poses away from the start's",
}
FILES = {
    "body.npz": "shape, poses, albedo and light, for Python",
    "body.glb": "the person in their own colours, for Blender, game engines and web viewers",
    "measurements.csv": "height, girths and lengths",
    "metrics.json": "the numbers of this page, for programs",
}


def rgbd_page(fit: "RgbdFit", numbers: dict[str, Any], skin: "Skin | None" = None) -> str:
    """The report as text. numbers: `habitus.report.rgbd.numbers.rgbd_metrics` of the fit."""
    numbers, blob = finite(numbers), Blob()
    _add_body(fit, skin, blob)
    data = {"arrays": blob.contents, "bytes": blob.size, "height": fit.measurements.get("height_m", 1.7)}
    return Template(_asset("rgbd.html")).substitute(
        title=escape(f"{shown(fit.capture_name, LONGEST_NAME)} · habitus"),
        version=__version__,
        css=(_asset("page.css") + _asset("page_parts.css") + _asset("rgbd.css")).replace(
            "@dark", _asset("page_dark.css")
        ),
        head=_head(fit, numbers),
        views="\n".join(_views(fit)),
        light=_light(fit),
        sections=_measurements(fit) + _how(fit, numbers),
        files=_files(),
        footer=escape(f"Written by habitus {__version__}. Everything is in this file; it loads and sends nothing."),
        data=json_for_script(data),
        arrays=blob.base64(),
        script="\n".join(_asset(name) for name in SCRIPTS),
    )


def _head(fit: "RgbdFit", numbers: dict[str, Any]) -> str:
    verdict, views = numbers["verdict"], numbers["views"]
    items = "".join(f"<li>{escape(shown(reason, 300))}</li>" for reason in verdict["reasons"])
    role = "status" if verdict["level"] == "good" else "alert"
    count = f"{len(views)} view{'s' * (len(views) != 1)}"
    facts = [count, f"body {fit.body_name}", f"person parted from the room by {numbers['parted_by']}"]
    tiles = [
        ("Depth error", f"{numbers['depth_error_mm']['median']:.1f}", "mm", "median, across the surface"),
        ("95 % are below", f"{numbers['depth_error_mm']['p95']:.0f}", "mm", "in the worst view"),
        ("Explained", f"{100 * min(view['explained'] for view in views):.1f}", "%", "of the person's pixels"),
    ]
    for name, label in (("height_m", "Height"), ("waist_circumference_m", "Waist"), ("hip_circumference_m", "Hip")):
        if name in fit.measurements:
            tiles.append((label, f"{100 * fit.measurements[name]:.1f}", "cm", DEFINITIONS[name].says))
    form = "<div><dt>{}</dt><dd>{} <small>{}</small></dd><dd>{}</dd></div>"
    return (
        f"<h1>{escape(shown(fit.capture_name, LONGEST_NAME))}</h1><p class='facts'>{escape(' · '.join(facts))}</p>"
        f"<div class='banner {verdict['level']}' role='{role}'><strong>{VERDICTS[verdict['level']]}</strong>"
        f"<ul>{items}</ul></div><dl class='tiles'>{''.join(form.format(*map(escape, tile)) for tile in tiles)}</dl>"
    )


def _views(fit: "RgbdFit") -> list[str]:
    said = (
        f"Depth errors go from red (the person is {ERROR_MM:.0f} mm nearer than the body) over white to blue "
        f"({ERROR_MM:.0f} mm further away); grey is where only one of both is."
    )
    sections = []
    for made, view in zip(view_pictures(fit), fit.evidence.views, strict=True):
        figures = "".join(
            f"<figure><img alt='{escape(name)}' src='{_uri(picture)}'><figcaption>{escape(name)}</figcaption></figure>"
            for name, picture in made.pictures.items()
        )
        floor = "on the floor that was found" if view.on_floor else "no floor found"
        facts = (
            f"turned {view.turn_deg:+.0f}° · depth {view.median_mm:.1f} mm median (noise {view.noise_mm:.1f}), bias "
            f"{view.bias_mm:+.1f} mm · {100 * view.explained:.1f} % explained, {100 * view.outside:.1f} % of the body "
            f"where the room was seen · outlines overlap by {100 * view.overlap:.0f} % · {floor}"
        )
        sections.append(
            f"<section class='card'><h2>{escape(shown(view.name, LONGEST_NAME))}</h2>"
            f"<p class='lead'>{escape(facts)}</p><div class='shots'>{figures}</div>"
            f"<p class='quiet small'>{escape(said)}</p></section>"
        )
    return sections


def _light(fit: "RgbdFit") -> str:
    found = fit.appearance
    if found is None:
        return ""
    shift = ", ".join(f"{1e3 * value:+.1f}" for value in found.shift.shift)
    told = (
        f"A white ball in the light that was found: spherical harmonics of nine numbers a channel. Colours are "
        f"explained to {100 * found.residual:.1f} % of full scale; {100 * (found.seen > 0).mean():.0f} % of the "
        f"surface was seen, the rest is filled in smoothly. The colour camera was moved by ({shift}) mm. Albedo "
        "is known up to one factor and tint, which light could have as well."
    )
    return (
        "<section class='card'><h2>Light</h2><div class='ball'>"
        f"<img alt='A ball in the light that was found' src='{_uri(light_ball(found))}'><p>{escape(told)}</p>"
        "</div></section>"
    )


def _measurements(fit: "RgbdFit") -> str:
    rows = "".join(
        f"<tr><td>{escape(DEFINITIONS[name].says)}</td><td>{escape(DEFINITIONS[name].iso)}</td><td class='number'>"
        + (f"{value:.1f} kg" if name.endswith("_kg") else f"{100 * value:.1f} cm")
        + "</td></tr>"
        for name, value in fit.measurements.items()
    )
    head = "<tr><th scope='col'>What</th><th scope='col'>ISO</th><th scope='col' class='number'>Value</th></tr>"
    table = f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>"
    return f"<section class='card'><h2>Measurements</h2>{table}</section>"


def _how(fit: "RgbdFit", numbers: dict[str, Any]) -> str:
    notes = "".join(f"<li>{escape(shown(text, 400))}</li>" for text in fit.warnings) or "<li>Nothing.</li>"
    costs = "".join(
        f"<tr><td>{escape(TERMS.get(name, name))}</td><td class='number'>{value:,.4g}</td></tr>"
        for name, value in fit.costs.items()
    )
    times = "".join(
        f"<tr><td>{escape(name)}</td><td class='number'>{value:.2f} s</td></tr>"
        for name, value in numbers["stage_seconds"].items()
    )
    return (
        f"<div class='columns'><section class='card'><h2>What to know</h2><ul>{notes}</ul></section>"
        f"<section class='card'><h2>Energy and time</h2><table>{costs}</table><table>{times}</table></section></div>"
    )


def _files() -> str:
    items = (
        f"<li><a href='{name}' download>{name}</a> <span>{escape(what)}</span></li>" for name, what in FILES.items()
    )
    return f"<ul class='files' aria-label='Files beside this page'>{''.join(items)}</ul>"


def _add_body(fit: "RgbdFit", skin: "Skin | None", blob: Blob) -> None:
    """The person as the first view shows them, with a colour for each vertex."""
    vertices = np.asarray(fit.vertices(0))
    middle = (vertices.min(0) + vertices.max(0)) / 2
    vertices = vertices - [middle[0], vertices[:, 1].min(), middle[2]]
    blob.add("vertices", vertices.astype("f4"))
    blob.add("faces", fit.body.faces.astype("u2" if len(vertices) < 65536 else "u4"))
    coarse = None
    if skin is not None:
        fits = fit.body.full_vertices is not None and len(skin.vertex_albedo) != len(vertices)
        coarse = skin.vertex_albedo[fit.body.full_vertices] if fits else skin.vertex_albedo
    colours = np.full((len(vertices), 3), 150, np.uint8) if coarse is None else srgb_bytes(coarse)
    blob.add("colours", np.pad(colours, ((0, 0), (0, 1)), constant_values=255))


def _uri(picture: Picture) -> str:
    """A picture as part of the page, as tall as a page shows it."""
    step = max(1, -(-picture.shape[0] // 640))
    small = picture[::step, ::step]
    opaque = np.dstack([small, np.full(small.shape[:2], 255, np.uint8)])
    opaque[(small == PAPER).all(-1), 3] = 0
    return "data:image/png;base64," + base64.b64encode(png(opaque)).decode("ascii")


@cache
def _asset(name: str) -> str:
    return files("habitus.report.web").joinpath(name).read_text("utf-8")
