"""The report of registered scans: one HTML file that opens offline, with pictures and numbers."""

import base64
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus import __version__
from habitus.errors import shown
from habitus.report.png import png
from habitus.report.registration.pictures import RAMP, coloured, plain, splatted, spread, views
from habitus.rotations import matrix_from_rotvec

if TYPE_CHECKING:
    from habitus.fit.registration.result import ScanFit

FAR_MM, MODEL_MM = 5.0, 20.0
FAR_TONE = 0.5
_STYLE = """body{font:15px/1.5 system-ui,sans-serif;margin:24px auto;max-width:1180px;padding:0 16px;color:#2b2722;
background:#fbf9f6}h1{font-size:24px;margin:0}figure{display:inline-block;margin:8px 20px 8px 0;vertical-align:top}
figcaption{color:#6f675d;font-size:13px}img{height:400px;max-width:100%}table{border-collapse:collapse;margin:8px 0}
td,th{text-align:left;padding:3px 18px 3px 0;border-bottom:1px solid #e4ded5}td.n{text-align:right;
font-variant-numeric:tabular-nums}.good{color:#2f7d4f}.doubtful{color:#a86a00}.failed{color:#b3261e}
.ramp{display:inline-block;width:120px;height:9px;vertical-align:middle;background:linear-gradient(90deg,RAMP)}
@media(prefers-color-scheme:dark){body{background:#1d1b19;color:#ece7df}td,th{border-color:#3b3733}
figcaption{color:#a59c90}}""".replace("RAMP", ",".join(RAMP))


def scan_page(fit: "ScanFit", numbers: Mapping[str, Any]) -> str:
    """The report of one scan as text; ``numbers`` are those of metrics.json."""
    name = escape(shown(fit.scan_name))
    verdict = fit.verdict
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in verdict.reasons)
    notes = "".join(f"<li>{escape(shown(note, 300))}</li>" for note in fit.notes)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{name} · habitus</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
        f'img-src data:"><style>{_STYLE}</style></head><body><h1>{name}</h1>'
        f'<p><b class="{verdict.level}">{verdict.level}</b></p><ul>{reasons}</ul>{_figures(fit)}'
        f"{_colours(fit)}<h2>Distances of the scan</h2>{_distances(numbers)}<h2>The person</h2>{_measures(numbers)}"
        f"{f'<h2>What was done to the scan</h2><ul>{notes}</ul>' if notes else ''}"
        f"<p>Written by habitus {__version__}. Everything is in this file; it loads nothing and sends nothing.</p>"
        "</body></html>\n"
    )


def _figures(fit: "ScanFit") -> str:
    cloud, faces = fit.cloud, fit.body.faces
    looks = views(matrix_from_rotvec(fit.pose[0]))
    count = len(fit.vertices)
    model = spread(fit.model_vertices, faces, plain(count))
    surface = spread(fit.vertices, faces, plain(count))
    trust = spread(fit.vertices, faces, coloured(1.0 - fit.weights, 1.0))
    near = fit.far_from_surface
    shown_as = {
        "the scan": (cloud.points, cloud.normals, plain(len(cloud.points))),
        "the model": model,
        "the registered surface": surface,
        f"the scan, 0 to {FAR_MM:g} mm from the surface": (cloud.points, cloud.normals, coloured(1e3 * near, FAR_MM)),
        "where the scan tells nothing (dark): vertices of weight 0": trust,
    }
    parts = []
    for caption, given in shown_as.items():
        sparse = caption.startswith("the scan")
        pictures = [splatted(*given, turn, cloud.points, size=2 if sparse else 1) for turn in looks.values()]
        images = "".join(_picture(one, caption) for one in pictures)
        ramp = ' <span class="ramp"></span>' if "mm" in caption else ""
        parts.append(f"<figure>{images}<figcaption>{escape(caption)}{ramp}</figcaption></figure>")
    return "".join(parts)


def _colours(fit: "ScanFit") -> str:
    """The texture that scans share, and how far this one is from the others'; nothing where colours were not used."""
    if fit.colours is None:
        return ""
    grid, told = fit.colours.grid, fit.colours
    places = grid.placed(fit.vertices)
    bright = (told.albedo / max(float(np.percentile(told.albedo, 99.5)), 1e-6)).clip(0.0, 1.0) ** (1 / 2.2)
    looks = views(matrix_from_rotvec(fit.pose[0]))
    parts = []
    for caption, colours in (
        ("the person's colours, as all scans show them", bright),
        (f"how far this scan's colours are from the others', 0 to {FAR_TONE:g}", coloured(told.apart, FAR_TONE)),
    ):
        given = spread(places, grid.triangles, colours)
        images = "".join(_picture(splatted(*given, turn, places), caption) for turn in looks.values())
        parts.append(f"<figure>{images}<figcaption>{escape(caption)}</figcaption></figure>")
    return (
        f"<h2>Colours</h2><p>They differ from other scans' by {told.before:.3f} (log of linear light) where geometry "
        f"had the surface, by {told.after:.3f} once it slid by {1e3 * told.slid:.2f} mm on average. A patch that stays "
        f"apart, of the form of a mark or a hem, is skin that colours could not bring home.</p>{''.join(parts)}"
    )


def _picture(image: np.ndarray, caption: str) -> str:
    return f'<img alt="{escape(caption)}" src="data:image/png;base64,{base64.b64encode(png(image)).decode()}">'


def _distances(numbers: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><th>to the {what}</th>"
        + "".join(f'<td class="n">{numbers[key][each]:.2f} mm</td>' for each in ("median", "p95", "max"))
        + "</tr>"
        for what, key in (("surface", "scan_to_surface_mm"), ("model", "scan_to_model_mm"))
    )
    seen, matched = 100 * numbers["seen"], 100 * numbers["matched"]
    return (
        f"<table><tr><th></th><th>median</th><th>95 %</th><th>largest</th></tr>{rows}</table>"
        f"<p>The scan shows {seen:.0f} % of the body's vertices; {matched:.1f} % of its points are the body's.</p>"
    )


def _measures(numbers: Mapping[str, Any]) -> str:
    rows = "".join(
        f'<tr><th>{escape(name.rpartition("_")[0].replace("_", " "))}</th><td class="n">'
        + (f"{value:.1f} kg" if name.endswith("_kg") else f"{100 * value:.1f} cm")
        + "</td></tr>"
        for name, value in numbers["body_measurements"].items()
    )
    root = float(np.sqrt(np.mean(np.square(numbers["betas"]))))
    return f"<p>Shape: {root:.2f} times as far from the mean as people usually are.</p><table>{rows}</table>"
