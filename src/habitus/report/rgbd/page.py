"""The report of a fit to depth views: one HTML file that opens offline, with pictures, numbers and
the body in 3D.
"""

import base64
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.body.measurement_names import DEFINITIONS
from habitus.errors import shown
from habitus.export.png import png
from habitus.observe.srgb import srgb_bytes
from habitus.report.facts import LONGEST_NAME
from habitus.report.fit.blob import Blob
from habitus.report.parts import (
    banner,
    card,
    file_links,
    measurements_table,
    notes_list,
    numbers_table,
    tiles,
)
from habitus.report.rgbd.pictures import ERROR_MM, PAPER, Picture, light_ball, view_pictures
from habitus.report.shell import shell
from habitus.report.still import SCRIPTS, STYLE, Look, still, still_data
from habitus.results.metrics import finite

if TYPE_CHECKING:
    from habitus.fit.points.depth_result import RgbdFit
    from habitus.fit.points.texture import Skin

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
    numbers = finite(numbers)
    blob = Blob()
    looks = _looks(fit, skin)
    data = still_data(looks, blob)
    title = f"{shown(fit.capture_name, LONGEST_NAME)} · habitus"
    content = [
        _head(fit, numbers),
        still(looks, "The fitted body as the first view shows it"),
        *_views(fit),
        _light(fit),
        card("Measurements", measurements_table(fit.measurements)),
        _how(fit, numbers),
        file_links(FILES),
    ]
    return shell(
        title,
        "\n".join(content),
        data=data | {"arrays": blob.contents, "bytes": blob.size},
        arrays={"report-arrays": blob.base64()},
        scripts=SCRIPTS,
        styles=[STYLE, "rgbd.css"],
        without_script="The body in 3D needs JavaScript; pictures and numbers do not.",
    )


def _head(fit: "RgbdFit", numbers: dict[str, Any]) -> str:
    views = numbers["views"]
    count = f"{len(views)} view{'s' * (len(views) != 1)}"
    facts = [
        count,
        f"body {fit.body_name}",
        f"person parted from the room by {numbers['parted_by']}",
    ]
    found = [
        (
            "Depth error",
            f"{numbers['depth_error_mm']['median']:.1f}",
            "mm",
            "median, across the surface",
        ),
        ("95 % are below", f"{numbers['depth_error_mm']['p95']:.0f}", "mm", "in the worst view"),
        (
            "Explained",
            f"{100 * min(view['explained'] for view in views):.1f}",
            "%",
            "of the person's pixels",
        ),
    ]
    for name, label in (
        ("height_m", "Height"),
        ("waist_circumference_m", "Waist"),
        ("hip_circumference_m", "Hip"),
    ):
        if name in fit.measurements:
            found.append(
                (label, f"{100 * fit.measurements[name]:.1f}", "cm", DEFINITIONS[name].says)
            )
    return (
        f"<h1>{escape(shown(fit.capture_name, LONGEST_NAME))}</h1><p "
        f"class='facts'>{escape(' · '.join(facts))}</p>"
        f"{banner(numbers['verdict'])}{tiles(found)}"
    )


def _views(fit: "RgbdFit") -> list[str]:
    said = (
        f"Depth errors go from red (the person is {ERROR_MM:.0f} mm nearer than the body) over "
        "white to blue "
        f"({ERROR_MM:.0f} mm further away); grey is where only one of both is."
    )
    sections = []
    for made, view in zip(view_pictures(fit), fit.evidence.views, strict=True):
        figures = "".join(
            f"<figure><img alt='{escape(name)}' "
            f"src='{_uri(picture)}'><figcaption>{escape(name)}</figcaption></figure>"
            for name, picture in made.pictures.items()
        )
        floor = "on the floor that was found" if view.on_floor else "no floor found"
        facts = (
            f"turned {view.turn_deg:+.0f}° · depth {view.median_mm:.1f} mm median (noise "
            f"{view.noise_mm:.1f}), bias "
            f"{view.bias_mm:+.1f} mm · {100 * view.explained:.1f} % explained, "
            f"{100 * view.outside:.1f} % of the body "
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
        "A white ball in the light that was found: spherical harmonics of nine numbers a "
        "channel. Colours are "
        f"explained to {100 * found.residual:.1f} % of full scale; "
        f"{100 * (found.seen > 0).mean():.0f} % of the "
        "surface was seen, the rest is filled in smoothly. The colour camera was moved by "
        f"({shift}) mm. Albedo "
        "is known up to one factor and tint, which light could have as well."
    )
    return (
        "<section class='card'><h2>Light</h2><div class='ball'>"
        "<img alt='A ball in the light that was found' "
        f"src='{_uri(light_ball(found))}'><p>{escape(told)}</p>"
        "</div></section>"
    )


def _how(fit: "RgbdFit", numbers: dict[str, Any]) -> str:
    costs = numbers_table(
        (TERMS.get(name, name), f"{value:,.4g}") for name, value in fit.costs.items()
    )
    times = numbers_table(
        (name, f"{value:.2f} s") for name, value in numbers["stage_seconds"].items()
    )
    known = card("What to know", notes_list(fit.warnings))
    return f"<div class='columns'>{known}{card('Energy and time', costs + times)}</div>"


def _looks(fit: "RgbdFit", skin: "Skin | None") -> list[Look]:
    """The person as the first view shows them: in their own colours, without, and as betas alone
    have them.
    """
    vertices = np.asarray(fit.vertices(0))
    faces = fit.body.faces
    looks = [Look("Form", "The fitted person in the first view's pose.", vertices, faces)]
    if fit.skin is not None:
        model = np.asarray(fit.body(fit.betas, fit.pose[0], fit.trans[0]).vertices)
        most = 1e3 * np.abs(fit.skin).max()
        told = f"The body of betas alone, which the person's skin is off by {most:.0f} mm at most."
        looks.append(Look("Betas alone", told, model, faces))
    if skin is None:
        return looks
    fits = fit.body.full_vertices is not None and len(skin.vertex_albedo) != len(vertices)
    albedo = skin.vertex_albedo[fit.body.full_vertices] if fits else skin.vertex_albedo
    told = (
        "The fitted person in the first view's pose, in the colours of their skin, the light "
        "taken out."
    )
    return [Look("Colours", told, vertices, faces, colours=srgb_bytes(albedo)), *looks]


def _uri(picture: Picture) -> str:
    """A picture as part of the page, as tall as a page shows it."""
    step = max(1, -(-picture.shape[0] // 640))
    small = picture[::step, ::step]
    opaque = np.dstack([small, np.full(small.shape[:2], 255, np.uint8)])
    opaque[(small == PAPER).all(-1), 3] = 0
    return "data:image/png;base64," + base64.b64encode(png(opaque)).decode("ascii")
