"""The report of a registered scan: one HTML file that opens offline, with the surface in 3D,
pictures and numbers.
"""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from habitus.errors import shown
from habitus.observe.light import srgb_bytes
from habitus.report.drawing import ERROR_RAMP, Look, ramp_colours, still_page, still_pictures
from habitus.report.shell import (
    MAX_NAME,
    Tile,
    banner,
    card,
    columns,
    file_links,
    heading,
    measurement_tiles,
    measurements_table,
    notes_list,
    numbers_table,
    solution_card,
    tiles,
)
from habitus.results.save import finite
from habitus.rotations import matrix_from_rotvec

if TYPE_CHECKING:
    from habitus.fit.points.scan_result import ScanFit

MAX_DISTANCE_MM = 5.0
"""Where the colours of distances between scan and surface end: five times a scanner's noise."""
MAX_OFFSET_MM = 20.0
"""Where the colours of distances between surface and model end."""
MAX_TONE = 0.5
"""Where the colours of differences of colour end, logarithm of linear light."""
TEXTS = {
    "surface": "The registered surface, in the body's topology.",
    "scan": "The scan as read, without floor and loose pieces.",
    "distances": "Distance of the scan's points from the surface.",
    "model": "The body model under the surface: shape and pose without the free surface.",
    "offset": "Distance of the surface from the model.",
    "weights": "Vertex weights: 0 in holes of the scan, where the surface continues the model.",
    "colours": "The person's colours, as all scans show them, with the light removed.",
    "difference": "Difference of this scan's colours from the others' (log of linear light).",
    "tone": (
        "Before colours were used they differed from those of the other scans by {before:.3f} (log "
        "of linear light), after by {after:.3f}; the surface slid by {slid:.2f} mm on average. A "
        "patch of difference with the outline of a birthmark or a hem shows skin that is still "
        "out of place."
    ),
    "matched": "{share:.1f} % of the scan's points belong to the body.",
    "unexplained": "of the scan, in one connected part; a missing hand has half a percent",
    "seen": "of the body's vertices; the rest continues the model",
    "cloth": (
        "The skin under loose clothes is estimated from where the cloth touches it, from head, "
        "hands and feet, and from the shapes of people."
    ),
    "shape": (
        "Measured on the registered surface at rest. The shape is {times:.2f} standard deviations "
        "from the mean (root mean square of the coefficients)."
    ),
}
TERMS = {
    "points": "Distance of the scan from the model",
    "shape": "Shape prior",
    "pose": "Pose prior",
}
FILES = {
    "surface.ply": "the scan's surface in the body's topology, in metres, y up",
    "surface.glb": "the same, for Blender, game engines and web viewers",
    "model.ply": "the body model under the surface",
    "rest.ply": "the surface in the rest pose, for habitus measure",
    "body.npz": "shape, pose, surface and vertex weights, for Python",
    "metrics.json": "the numbers of this page, for programs",
}
TILES = {"height_m": "Height", "waist_circumference_m": "Waist"}


def scan_page(fit: "ScanFit", numbers: Mapping[str, Any]) -> str:
    """The report of one scan as text; ``numbers`` are those of metrics.json."""
    numbers = finite(numbers)
    looks = [*_looks(fit), *_colour_looks(fit)]
    root = matrix_from_rotvec(fit.pose[0])
    scan = Look("Overlay scan", "", fit.cloud.points, normals=fit.cloud.normals)
    below = [
        _colours(fit),
        still_pictures(looks, root),
        columns(_distances(numbers), card("Processing of the scan", notes_list(fit.notes))),
        _cloth(numbers),
        columns(
            card("Measurements", measurements_table(numbers["body_measurements"]), _shape(numbers)),
            _solution(numbers),
        ),
        file_links(FILES),
    ]
    return still_page(
        f"{shown(fit.scan_name, MAX_NAME)} · habitus",
        (_head(fit, numbers), "\n".join(below)),
        looks,
        "The registered surface",
        over=scan,
        facing=float(np.arctan2(root[0, 2], root[2, 2])),
    )


def _head(fit: "ScanFit", numbers: Mapping[str, Any]) -> str:
    facts = [
        f"{numbers['points']:,} points",
        f"body {numbers['body']}",
        f"up axis {numbers['up_axis']}",
    ]
    return heading(fit.scan_name, facts) + banner(numbers["verdict"]) + tiles(_tiles(numbers))


def _tiles(numbers: Mapping[str, Any]) -> Iterator[Tile]:
    surface = numbers["scan_to_surface_mm"]
    model = numbers["scan_to_model_mm"]
    remark = f"median; to the model {model['median']:.1f} mm"
    yield "Scan to surface", f"{surface['median']:.2f}", "mm", remark
    yield "95 % are below", f"{surface['p95']:.1f}", "mm", f"largest {surface['max']:.0f} mm"
    yield "Unexplained", f"{100 * numbers['unexplained_fraction']:.2f}", "%", TEXTS["unexplained"]
    yield "Observed", f"{100 * numbers['observed_fraction']:.0f}", "%", TEXTS["seen"]
    yield from measurement_tiles(numbers["body_measurements"], TILES)


def _looks(fit: "ScanFit") -> list[Look]:
    """What can be viewed in 3D."""
    cloud = fit.cloud
    faces = fit.body.faces
    offset = np.linalg.norm(fit.vertices - fit.model_vertices, axis=1)
    return [
        Look("Surface", TEXTS["surface"], fit.vertices, faces),
        Look("Scan", TEXTS["scan"], cloud.points, normals=cloud.normals),
        Look(
            "Distances",
            TEXTS["distances"],
            cloud.points,
            normals=cloud.normals,
            colours=_colour_bytes(1e3 * fit.far_from_surface, MAX_DISTANCE_MM),
            ramp=ERROR_RAMP,
            ends=("0", f"{MAX_DISTANCE_MM:g} mm or more"),
        ),
        Look("Model", TEXTS["model"], fit.model_vertices, faces),
        Look(
            "Offset",
            TEXTS["offset"],
            fit.vertices,
            faces,
            colours=_colour_bytes(1e3 * offset, MAX_OFFSET_MM),
            ramp=ERROR_RAMP,
            ends=("0", f"{MAX_OFFSET_MM:g} mm or more"),
        ),
        Look(
            "Weights",
            TEXTS["weights"],
            fit.vertices,
            faces,
            colours=_colour_bytes(1.0 - fit.weights, 1.0),
            ramp=ERROR_RAMP,
            ends=("1", "0"),
        ),
    ]


def _colour_looks(fit: "ScanFit") -> list[Look]:
    """The texture that the scans share and this scan's difference from it; none where colours were
    not used.
    """
    texture = fit.colours
    if texture is None:
        return []
    points = texture.grid.placed(fit.vertices)
    triangles = texture.grid.triangles
    bright = texture.albedo / max(float(np.percentile(texture.albedo, 99.5)), 1e-6)
    return [
        Look("Colours", TEXTS["colours"], points, triangles, colours=srgb_bytes(bright)),
        Look(
            "Difference of colours",
            TEXTS["difference"],
            points,
            triangles,
            colours=_colour_bytes(texture.apart, MAX_TONE),
            ramp=ERROR_RAMP,
            ends=("0", f"{MAX_TONE:g} or more"),
        ),
    ]


def _colours(fit: "ScanFit") -> str:
    """How much colours moved the surface; empty where they were not used."""
    if fit.colours is None:
        return ""
    used = fit.colours
    text = TEXTS["tone"].format(before=used.before, after=used.after, slid=1e3 * used.slid)
    return card("Colours", "", text)


def _cloth(numbers: Mapping[str, Any]) -> str:
    """How far loose clothes and hair are off the skin; empty where the scan was taken for skin."""
    rows = [(region, f"{mm:.0f}") for region, mm in numbers["cloth_to_skin_mm"].items()]
    if not rows:
        return ""
    heads = ("", "median distance from the skin, mm")
    return card("Clothes and hair", numbers_table(rows, heads), TEXTS["cloth"])


def _distances(numbers: Mapping[str, Any]) -> str:
    keys = (("To the surface", "scan_to_surface_mm"), ("To the model", "scan_to_model_mm"))
    rows = [
        (name, *(f"{numbers[key][measure]:.2f} mm" for measure in ("median", "p95", "max")))
        for name, key in keys
    ]
    lead = TEXTS["matched"].format(share=100 * numbers["matched_fraction"])
    return card(
        "Distances of the scan", numbers_table(rows, ("", "median", "95 %", "largest")), lead
    )


def _solution(numbers: Mapping[str, Any]) -> str:
    """Status and costs, as far as metrics.json has them, and the seconds of each stage."""
    rows = [
        (name.replace("_", " ").capitalize(), f"{value:.2f} s")
        for name, value in numbers["stage_seconds"].items()
    ]
    return solution_card(numbers.get("status") or "", numbers.get("costs") or {}, TERMS, rows=rows)


def _shape(numbers: Mapping[str, Any]) -> str:
    betas = np.array(numbers["betas"] or [0.0])
    return TEXTS["shape"].format(times=float(np.sqrt(np.mean(betas**2))))


def _colour_bytes(values: Float[np.ndarray, " N"], limit: float) -> UInt8[np.ndarray, "N 3"]:
    return np.round(255 * ramp_colours(values, limit)).astype(np.uint8)
