"""The report of a registered scan: one HTML file that opens offline, with the surface in 3D,
pictures and numbers.
"""

import base64
from collections.abc import Iterator, Mapping
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
    Tile,
    banner,
    card,
    file_links,
    measurements_table,
    notes_list,
    numbers_table,
    tiles,
)
from habitus.report.registration.pictures import RAMP, coloured, plain, splatted, spread, views
from habitus.report.shell import shell
from habitus.report.still import SCRIPTS, STYLE, Look, still, still_data
from habitus.results.metrics import finite
from habitus.rotations import matrix_from_rotvec

if TYPE_CHECKING:
    from habitus.fit.points.scan_result import ScanFit

FAR_MM = 5.0
MODEL_MM = 20.0
FAR_TONE = 0.5
FILES = {
    "surface.ply": "the scan's surface in the body's topology, in metres, y up",
    "surface.glb": "the same, for Blender, game engines and web viewers",
    "model.ply": "the body model under it",
    "rest.ply": "the surface carried back to rest, for habitus measure",
    "body.npz": "shape, pose, surface and vertex weights, for Python",
    "metrics.json": "the numbers of this page, for programs",
}


def scan_page(fit: "ScanFit", numbers: Mapping[str, Any]) -> str:
    """The report of one scan as text; ``numbers`` are those of metrics.json."""
    numbers = finite(numbers)
    blob = Blob()
    looks = [*_looks(fit), *_looks_at_colours(fit)]
    ahead = matrix_from_rotvec(fit.pose[0])[:, 2]
    scan = Look("The scan", "", fit.cloud.points, normals=fit.cloud.normals)
    data = still_data(looks, blob, over=scan, facing=float(np.arctan2(ahead[0], ahead[2])))
    content = [
        _head(fit, numbers),
        still(looks, "The registered surface", over="Scan over it"),
        _colours(fit),
        _pictures(fit, looks),
        f"<div class='columns'>{_distances(numbers)}{card('What was done to the scan', notes_list(fit.notes))}</div>",  # noqa: E501
        card("The person", measurements_table(numbers["body_measurements"]), _shape(numbers)),
        file_links(FILES),
    ]
    return shell(
        f"{shown(fit.scan_name, LONGEST_NAME)} · habitus",
        "\n".join(content),
        data=data | {"arrays": blob.contents, "bytes": blob.size},
        arrays={"report-arrays": blob.base64()},
        scripts=SCRIPTS,
        styles=[STYLE],
        without_script="The surface in 3D needs JavaScript; pictures and numbers do not.",
    )


def _head(fit: "ScanFit", numbers: Mapping[str, Any]) -> str:
    facts = [
        f"{numbers['points']:,} points",
        f"body {numbers['body']}",
        f"{numbers['up_axis']} was up",
    ]
    return (
        f"<h1>{escape(shown(fit.scan_name, LONGEST_NAME))}</h1><p "
        f"class='facts'>{escape(' · '.join(facts))}</p>"
        f"{banner(numbers['verdict'])}{tiles(_tiles(numbers))}"
    )


def _tiles(numbers: Mapping[str, Any]) -> Iterator[Tile]:
    near = numbers["scan_to_surface_mm"]
    model = numbers["scan_to_model_mm"]
    yield (
        "Scan to surface",
        f"{near['median']:.2f}",
        "mm",
        f"median; to the model {model['median']:.1f} mm",
    )
    yield "95 % are below", f"{near['p95']:.1f}", "mm", f"largest {near['max']:.0f} mm"
    yield (
        "Off together",
        f"{100 * numbers['lost']:.2f}",
        "%",
        "of the scan, in one place: a lost hand is half a percent",
    )
    yield (
        "Seen",
        f"{100 * numbers['seen']:.0f}",
        "%",
        "of the body's vertices; the rest continues the model",
    )
    for name, label in (("height_m", "Height"), ("waist_circumference_m", "Waist")):
        if name in numbers["body_measurements"]:
            value = 100 * numbers["body_measurements"][name]
            yield label, f"{value:.1f}", "cm", DEFINITIONS[name].says


def _looks(fit: "ScanFit") -> list[Look]:
    """What can be turned in 3D."""
    cloud = fit.cloud
    faces = fit.body.faces
    away = coloured(1e3 * fit.far_from_surface, FAR_MM)
    trust = coloured(1.0 - fit.weights, 1.0)
    apart = 1e3 * np.linalg.norm(fit.vertices - fit.model_vertices, axis=1)
    return [
        Look("Surface", "The registered surface, in the body's topology.", fit.vertices, faces),
        Look(
            "Scan",
            "The scan as it was read: floor and islands left out.",
            cloud.points,
            normals=cloud.normals,
        ),
        Look(
            "Distances",
            "The scan's points by how far they lie from the surface.",
            cloud.points,
            normals=cloud.normals,
            colours=_bytes(away),
            ramp=RAMP,
            ends=("0", f"{FAR_MM:g} mm or more"),
        ),
        Look(
            "Model",
            "The body model under the surface: its shape and pose alone.",
            fit.model_vertices,
            faces,
        ),
        Look(
            "Off the model",
            "The surface by how far it was moved from the model.",
            fit.vertices,
            faces,
            colours=_bytes(coloured(apart, MODEL_MM)),
            ramp=RAMP,
            ends=("0", f"{MODEL_MM:g} mm or more"),
        ),
        Look(
            "Weights",
            "Where the scan tells of the surface: vertex weights, 0 in holes, where it "
            "continues the model.",
            fit.vertices,
            faces,
            colours=_bytes(trust),
            ramp=RAMP,
            ends=("1", "0"),
        ),
    ]


def _looks_at_colours(fit: "ScanFit") -> list[Look]:
    """The texture that scans share, and how far this one is from the others'; none where colours
    were not used.
    """
    if fit.colours is None:
        return []
    told = fit.colours
    places = fit.colours.grid.placed(fit.vertices)
    triangles = fit.colours.grid.triangles
    bright = told.albedo / max(float(np.percentile(told.albedo, 99.5)), 1e-6)
    return [
        Look(
            "Colours",
            "The person's colours, as all scans show them, the light taken out.",
            places,
            triangles,
            colours=srgb_bytes(bright),
        ),
        Look(
            "Colours apart",
            "How far this scan's colours are from the others' (log of linear light).",
            places,
            triangles,
            colours=_bytes(coloured(told.apart, FAR_TONE)),
            ramp=RAMP,
            ends=("0", f"{FAR_TONE:g} or more"),
        ),
    ]


def _colours(fit: "ScanFit") -> str:
    """What colours came to, in words; nothing where they were not used."""
    if fit.colours is None:
        return ""
    told = fit.colours
    text = (
        f"They differ from other scans' by {told.before:.3f} (log of linear light) where geometry "
        "had the surface, by "
        f"{told.after:.3f} once it slid by {1e3 * told.slid:.2f} mm on average. A patch that "
        "stays apart, of the form "
        "of a mark or a hem, is skin that colours could not bring home."
    )
    return card("Colours", "", text)


def _pictures(fit: "ScanFit", looks: list[Look]) -> str:
    """The same from before and behind, for readers and printers without a 3D viewer."""
    turns = views(matrix_from_rotvec(fit.pose[0])).values()
    figures = []
    for look in looks:
        colours = plain(len(look.points)) if look.colours is None else look.colours / 255.0
        given = (
            (look.points, look.normals, colours)
            if look.faces is None
            else spread(look.points, look.faces, colours)
        )
        size = 2 if look.faces is None else 1
        images = "".join(
            f"<img alt='{escape(look.name)}' "
            f"src='data:image/png;base64,{base64.b64encode(png(one)).decode()}'>"
            for one in (splatted(*given, turn, fit.cloud.points, size=size) for turn in turns)
        )
        scale = f", {look.ends[0]} to {look.ends[1]}" if look.ramp else ""
        figures.append(
            f"<figure>{images}<figcaption>{escape(look.name + scale)}</figcaption></figure>"
        )
    return card("From before and behind", f"<div class='shots pairs'>{''.join(figures)}</div>")


def _distances(numbers: Mapping[str, Any]) -> str:
    keys = (("To the surface", "scan_to_surface_mm"), ("To the model", "scan_to_model_mm"))
    rows = [
        (name, *(f"{numbers[key][each]:.2f} mm" for each in ("median", "p95", "max")))
        for name, key in keys
    ]
    said = f"{100 * numbers['matched']:.1f} % of the scan's points are the body's."
    return card(
        "Distances of the scan", numbers_table(rows, ("", "median", "95 %", "largest")), said
    )


def _shape(numbers: Mapping[str, Any]) -> str:
    root = float(np.sqrt(np.mean(np.square(numbers["betas"])))) if numbers["betas"] else 0.0
    return (
        f"Of the registered surface at rest. Its shape is {root:.2f} times as far from the "
        "mean as people usually are."
    )


def _bytes(colours: np.ndarray) -> np.ndarray:
    return np.round(255 * colours).astype(np.uint8)
