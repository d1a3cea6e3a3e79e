"""The page of a gait analysis: strides, curves of cycles, contacts and the residual; one HTML file
that opens offline and prints well.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.arrays import runs
from habitus.body.anatomy import SIDES
from habitus.errors import shown
from habitus.gait.analysis import MAX_RESIDUAL, GaitAnalysis
from habitus.gait.cycles import POINTS, symmetry
from habitus.report.shell import (
    MAX_NAME,
    Tile,
    banner,
    card,
    file_links,
    heading,
    notes_list,
    numbers_table,
    shell,
    tiles,
)
from habitus.results.gait import (
    NUMBERS,
    fit_verdict,
    not_validated,
    side_curves,
    stride_means,
    units_of,
)

WIDTH, HEIGHT, LEFT, BOTTOM = 230.0, 150.0, 34.0, 18.0
"""SVG units of one plot, and its margins."""
COLOURS = {"left": "#c0392b", "right": "#1f6fb2"}
CONVENTIONS = {
    "isb": "ISB's (Wu et al. 2002, 2005)",
    "pig": "Plug-in Gait's",
    "opensim": "those of OpenSim's coordinates",
}
NUMBER_TEXTS = {
    "stride_time_s": ("Stride time", "s", 2, 1.0),
    "stride_length_m": ("Stride length", "m", 2, 1.0),
    "speed_m_s": ("Speed", "m/s", 2, 1.0),
    "cadence_steps_min": ("Cadence", "steps/min", 0, 1.0),
    "stance_share": ("Stance", "% of the cycle", 1, 100.0),
    "step_length_m": ("Step length", "m", 2, 1.0),
    "step_width_m": ("Step width", "m", 2, 1.0),
    "double_support_share": ("Double support", "% of the cycle", 1, 100.0),
}
FILES = {
    "angles.csv": "angles of every frame",
    "cycles.csv": "angles and forces of each stride at 0 to 100 %",
    "dynamics.csv": "moments, powers, ground forces and residual of every frame",
    "gait.json": "the numbers of this page, for programs",
}
NOT_VALIDATED = (
    "Grey: not validated. Markers on the skin do not determine these angles; they follow the pose "
    "prior, and other methods do not agree about them."
)


def gait_page(
    analysis: GaitAnalysis,
    bands: Mapping[str, Float[np.ndarray, "101 2"]] = MappingProxyType({}),
    opensim: Mapping[str, Any] | None = None,
) -> str:
    """The report as text. bands: a laboratory's reference curves by name, mean and standard
    deviation (`habitus.io.bands`). opensim: the check of a scaled model (`habitus.jobs.opensim`).
    """
    strides = "".join(_strides(analysis)) or "<p class='quiet'>No stride was found.</p>"
    verdict = fit_verdict(analysis)
    files = dict(FILES)
    if not analysis.contacts:
        del files["dynamics.csv"]
    parts = [
        heading(analysis.name, _facts(analysis)),
        *([] if verdict is None else [banner(verdict)]),
        tiles(_tiles(analysis)),
        card("Strides", strides, _events_lead(analysis)),
        *_curves(analysis, bands),
        *_forces(analysis),
        *([] if opensim is None else [_opensim(opensim)]),
        card("Notes", notes_list(_notes(analysis))),
        file_links(files),
    ]
    title = f"{shown(analysis.name, MAX_NAME)} · gait · habitus"
    return shell(title, "\n".join(parts), styles=["gait.css"])


def _facts(analysis: GaitAnalysis) -> list[str]:
    count = len(analysis.strides)
    return [
        f"{len(analysis.angles.values)} frames at {analysis.rate_hz:g} Hz",
        f"{count} stride{'' if count == 1 else 's'}",
        f"angles by the convention {analysis.angles.convention}",
        f"mass {analysis.masses.total:.1f} kg, {analysis.masses.source}",
    ]


def _tiles(analysis: GaitAnalysis) -> list[Tile]:
    means = stride_means(analysis.strides)
    out: list[Tile] = []
    for name in ("speed_m_s", "cadence_steps_min", "stride_length_m"):
        known = [value for own in means.values() if (value := own[name]) is not None]
        if known:
            title, unit, digits, factor = NUMBER_TEXTS[name]
            value = factor * float(np.mean(known))
            out.append((title, f"{value:.{digits}f}", unit, "mean of all strides"))
    share = analysis.residual_share
    if share is not None:
        says = "of the plates' force, mean" if share <= MAX_RESIDUAL else "too much: see Forces"
        out.append(("Residual", f"{100 * share:.1f}", "% of body weight", says))
    return out


def _events_lead(analysis: GaitAnalysis) -> str:
    parts = [f"{side}: from {own.source}" for side, own in analysis.events.items()]
    return f"Foot strikes and offs, {'; '.join(parts)}. Mean of each side's strides."


def _strides(analysis: GaitAnalysis) -> list[str]:
    if not analysis.strides:
        return []
    means = stride_means(analysis.strides)
    rows = []
    for name in NUMBERS:
        title, unit, digits, factor = NUMBER_TEXTS[name]
        cells = [means[side][name] for side in SIDES]
        texts = ["" if c is None else f"{factor * c:.{digits}f}" for c in cells]
        share = symmetry(*([] if cell is None else [cell] for cell in cells))
        differ = "" if share is None else f"{round(100 * share):+d} %"
        rows.append((f"{title} ({unit})", *texts, differ))
    counts = [str(sum(s.side == side for s in analysis.strides)) for side in SIDES]
    rows.insert(0, ("Strides", *counts, ""))
    return [numbers_table(rows, ("", "Left", "Right", "Right to left"))]


def _curves(analysis: GaitAnalysis, bands: Mapping[str, np.ndarray]) -> list[str]:
    """Cards with a plot for each curve, both sides over each other."""
    if not analysis.strides:
        return []
    sides = {side: side_curves(analysis, side) for side in SIDES}
    names = next(iter(sides.values()))[0]
    unsure, units = not_validated(analysis), units_of(analysis)
    groups: dict[str, list[str]] = {"Angles": [], "Forces, moments and powers": []}
    for k, name in enumerate(names):
        curves = {side: own[:, :, k] for side, (_, own) in sides.items()}
        if not any(np.isfinite(own).any() for own in curves.values()):
            continue
        group = "Forces, moments and powers" if name in units else "Angles"
        unit = units.get(name, "°")
        groups[group].append(_plot(name, unit, curves, bands.get(name), name in unsure))
    lead = {
        "Angles": f"Conventions: {CONVENTIONS[analysis.angles.convention]}. Each stride is a "
        f"thin line, the mean a thick one; red left, blue right, from strike to strike. "
        f"{NOT_VALIDATED}",
        "Forces, moments and powers": "Internal moments, which muscles and ligaments exert, per "
        "kg; in stances on plates and in swings.",
    }
    return [
        card(title, f"<div class='plots'>{''.join(plots)}</div>", lead[title])
        for title, plots in groups.items()
        if plots
    ]


def _plot(
    name: str,
    unit: str,
    curves: Mapping[str, Float[np.ndarray, "n 101"]],
    band: Float[np.ndarray, "101 2"] | None,
    unsure: bool,
) -> str:
    """One curve over the cycle as SVG."""
    known = np.concatenate([own[np.isfinite(own)] for own in curves.values()])
    if band is not None:
        known = np.concatenate([known, band[:, 0] - band[:, 1], band[:, 0] + band[:, 1]])
    low, high = float(known.min()), float(known.max())
    pad = 0.06 * (high - low) or 1.0
    low, high = low - pad, high + pad

    def at(percent: np.ndarray, values: np.ndarray) -> list[str]:
        x = LEFT + (WIDTH - LEFT - 10.0) * percent / 100.0
        y = 16.0 + (HEIGHT - BOTTOM - 16.0) * (high - values) / (high - low)
        return [f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True)]

    grid = np.linspace(0.0, 100.0, POINTS)
    parts = [f"<text class='title' x='2' y='10'>{name.replace('_', ' ')} ({unit})</text>"]
    for value in (low + pad, high - pad):
        ((place),) = at(np.zeros(1), np.array([value]))
        y = place.partition(",")[2]
        parts.append(
            f"<text x='{LEFT - 3:.0f}' y='{float(y) + 3:.1f}' text-anchor='end'>{value:.3g}</text>"
        )
    if low < 0.0 < high:
        ends = at(np.array([0.0, 100.0]), np.zeros(2))
        parts.append(f"<polyline points='{' '.join(ends)}' fill='none' stroke='#bbb'/>")
    for percent in (0, 50, 100):
        x = LEFT + (WIDTH - LEFT - 10.0) * percent / 100.0
        parts.append(
            f"<text x='{x:.0f}' y='{HEIGHT - 5:.0f}' text-anchor='middle'>{percent}</text>"
        )
    if band is not None:
        edge = at(grid, band[:, 0] + band[:, 1]) + at(grid, band[:, 0] - band[:, 1])[::-1]
        parts.append(f"<polygon points='{' '.join(edge)}' fill='#8aa' opacity='.25'/>")
    for side, own in curves.items():
        lines = [(curve, 0.6, 0.45) for curve in own]
        whole = [curve for curve in own if np.isfinite(curve).any()]
        if whole:
            stack = np.stack(whole)
            counts = np.isfinite(stack).sum(0)
            mean = np.where(counts > 0, np.nansum(stack, 0) / np.maximum(counts, 1), np.nan)
            lines.append((mean, 1.8, 1.0))
        for curve, width, opacity in lines:
            for first, last in runs(np.isfinite(curve)):
                points = " ".join(at(grid[first:last], curve[first:last]))
                parts.append(
                    f"<polyline points='{points}' fill='none' stroke='{COLOURS[side]}' "
                    f"stroke-width='{width}' opacity='{opacity}'/>"
                )
    style = " class='unsure'" if unsure else ""
    return (
        f"<svg viewBox='0 0 {WIDTH:.0f} {HEIGHT:.0f}' role='img' "
        f"aria-label='{name.replace('_', ' ')}'{style}>{''.join(parts)}</svg>"
    )


def _forces(analysis: GaitAnalysis) -> list[str]:
    """Contacts with plates, and how well forces and motion agree."""
    if not analysis.contacts:
        return []
    rows = [
        (
            f"Plate {contact.plate}",
            contact.side or "nobody",
            "before the first frame" if contact.start is None else f"{contact.start:.2f}",
            "after the last frame" if contact.end is None else f"{contact.end:.2f}",
            f"{100 * contact.distance:.0f}",
            contact.refused or "used",
        )
        for contact in analysis.contacts
    ]
    heads = ("", "Foot", "From s", "To s", "Foot to centre of pressure cm", "Forces")
    share, bias = analysis.residual_share, analysis.vertical_bias
    lead = "No frame has all of its contacts on plates; forces and motion cannot be compared."
    if share is not None and bias is not None:
        lead = (
            f"Where all contacts are on plates, their forces differ from what the motion needs by "
            f"{100 * share:.1f} % of the body weight (mean), vertically by {100 * bias:+.1f} %."
        )
        if share > MAX_RESIDUAL:
            lead += (
                f" That is more than {100 * MAX_RESIDUAL:.0f} %: a plate's zero, the mass, or a "
                "contact beside the plates is off, and so are the moments."
            )
    return [card("Forces", numbers_table(rows, heads), lead)]


def _opensim(check: Mapping[str, Any]) -> str:
    """A scaled OpenSim model: its lengths, and how well it follows the markers."""
    lengths = []
    for name, own in check["measures"].items():
        mine, its = own["person_mm"], own["generic_model_mm"]
        lengths.append((name, f"{its:.0f}", f"{mine:.0f}", f"{mine / its:.2f}"))
    joints = [
        (name.replace("_", " "), f"{value:.0f}", f"{fit:.0f}", f"{value - fit:+.0f}")
        for name, value in check["joints_mm"]["scaled_model"].items()
        if (fit := check["joints_mm"]["fit"].get(name)) is not None
    ]
    verdict, whole = check["verdict"], check["marker_rms_mm"]
    share = check["residual_share_of_weight"]
    lead = [
        f"{check['generic_model']}, scaled to the person by pairs of landmarks: "
        f"{verdict['level']}.",
        *verdict["reasons"],
        "" if whole is None else f"In all frames markers are {whole:.1f} mm (RMS) off.",
        f"They were placed on {check['markers_placed_on']}.",
        ""
        if share is None
        else f"Inverse dynamics leaves {100 * share:.1f} % of the body weight (mean) to no one.",
        "Joints of a model are other points than the fit's, and scale nothing.",
    ]
    tables = (
        numbers_table(lengths, ("Landmarks, mm", "Generic model", "Person", "Ratio"))
        + numbers_table(joints, ("Joints, mm", "Scaled model", "Fit", "Difference"))
    )  # fmt: skip
    return card("OpenSim", tables, shown(" ".join(filter(None, lead)), 2000))


def _notes(analysis: GaitAnalysis) -> Sequence[str]:
    from_markers = ", ".join(f"{n} ({label})" for n, label in analysis.angles.sources.items())
    hips = ", ".join(f"{side} {value:.0f} mm" for side, value in analysis.centres_mm.items())
    return [
        f"Landmarks from the person's own markers: {from_markers or 'none'}; all others are the "
        "fitted template's.",
        f"Hip centres are the body model's; a regression (Harrington 2007) puts them {hips} away.",
        *analysis.notes,
    ]
