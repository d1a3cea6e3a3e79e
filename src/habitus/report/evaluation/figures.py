"""Figures of the evaluation report as SVG, like those of S 5: errors, variance, run time and girth
of the neck of several models.

matplotlib draws them in the colours of the light page; `inline` makes them follow the page's theme.
"""

import io
import re
from collections.abc import Sequence
from typing import Any

from habitus.errors import require_extra

SERIES = ("#0b6e7f", "#d9480f", "#6741d9", "#2f9e44", "#c2255c", "#1971c2", "#a07800", "#7a5c4d")
"""Colours of models on a light page; `page.css` has them again, and those of a dark page."""
INK = "#17212b"
MUTED = "#566472"
GRID = "#dfe4e9"
MARKERS = "osD^vPX*"
_NAMES = {INK: "--ink", MUTED: "--muted", GRID: "--line"} | {
    colour: f"--series-{k}" for k, colour in enumerate(SERIES)
}
_STYLE = {
    "svg.fonttype": "none",
    "font.size": 12.0,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "axes.titlesize": 12.0,
    "axes.titleweight": "bold",
    "axes.axisbelow": True,
    "lines.linewidth": 2.0,
    "lines.markersize": 6.0,
    "legend.frameon": False,
}


def figures(numbers: dict[str, Any]) -> dict[str, str]:
    """The figures that an evaluation's numbers give, by name, as whole SVG files. Raises
    HabitusError without matplotlib.
    """
    models = numbers["models"]
    looks = model_looks(numbers["models"])
    drawn = {
        "model_generalisation": _errors(models, looks, "model_generalisation"),
        "pose_generalisation": _errors(models, looks, "pose_generalisation"),
        "cumulative_variance": _variance(models, looks),
        "run_time": _run_time(models, looks),
        "neck_twist": _neck(models, looks),
    }
    return {name: text for name, text in drawn.items() if text is not None}


def model_looks(models: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Colour, marker and dashes of each model by its name; one without its pose blend shapes is
    dashed.
    """
    full = [model["name"] for model in models if model["without_pose_shapes_of"] is None]
    looks = {}
    for model in models:
        k = full.index(model["without_pose_shapes_of"] or model["name"])
        plain = model["without_pose_shapes_of"] is not None
        looks[model["name"]] = {
            "color": SERIES[k % len(SERIES)],
            "marker": MARKERS[(k + k // len(SERIES)) % len(MARKERS)],
            "linestyle": "--" if plain else "-",
            "markerfacecolor": "none" if plain else SERIES[k % len(SERIES)],
        }
    return looks


def inline(svg: str, name: str) -> str:
    """A figure as a part of a page: in the page's colours, with numbers of its own, without
    addresses.
    """
    text = svg[svg.index("<svg") :]
    text = re.sub(r"<(metadata|style).*?</\1>", "", text, flags=re.DOTALL)
    text = (
        re.sub(
            r'\s(?:xmlns(?::\w+)?|version|width|height)="[^"]*"',
            "",
            text[: (end := text.index(">"))],
        )
        + text[end:]
    )
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'((?:xlink:)?href="#|url\(#)', rf"\g<1>{name}-", text).replace(
        "xlink:href", "href"
    )
    for colour, variable in _NAMES.items():
        text = text.replace(colour, f"var({variable})")
    return text


def _errors(models: Sequence[dict[str, Any]], looks: dict[str, Any], measure: str) -> str | None:
    """S Figs. 11 and 12: to the registrations and, where there are any, to the meshes without
    noise.
    """
    curves = {model["name"]: model[measure] for model in models if model[measure]}
    if not curves:
        return None
    panels = [("mean_mm", "to the registrations")]
    if all(curve["clean_mean_mm"] for curve in curves.values()):
        panels.append(("clean_mean_mm", "to the meshes without noise"))
    plot = _Plot(len(panels))
    for axes, (key, title) in zip(plot.axes, panels, strict=True):
        for name, curve in curves.items():
            axes.plot(curve["counts"], curve[key], label=_label(name), **looks[name])
        _coefficients(axes, [k for curve in curves.values() for k in curve["counts"]])
        axes.set(title=title if len(panels) > 1 else None, ylabel="mean absolute vertex error (mm)")
    return plot.svg(measure)


def _run_time(models: Sequence[dict[str, Any]], looks: dict[str, Any]) -> str:
    """S Fig. 14."""
    plot = _Plot()
    for model in models:
        times = model["run_time"]
        plot.axes[0].plot(
            times["counts"], times["median_ms"], label=_label(model["name"]), **looks[model["name"]]
        )
    _coefficients(plot.axes[0], [k for model in models for k in model["run_time"]["counts"]])
    plot.axes[0].set_ylabel("time for one surface (ms)")
    plot.axes[0].set_ylim(bottom=0)
    return plot.svg("run_time")


def _variance(models: Sequence[dict[str, Any]], looks: dict[str, Any]) -> str:
    """S Fig. 9."""
    plot = _Plot()
    for model in models:
        if model["without_pose_shapes_of"] is None:
            share = [0.0, *(100 * each for each in model["cumulative_variance"]["share"])]
            look = looks[model["name"]] | {"marker": "", "label": _label(model["name"])}
            plot.axes[0].plot(range(len(share)), share, **look)
    plot.axes[0].set(
        xlabel="number of shape coefficients", ylabel="cumulative variance (%)", ylim=(0, 102)
    )
    plot.axes[0].set_xlim(left=0)
    return plot.svg("cumulative_variance")


def _neck(models: Sequence[dict[str, Any]], looks: dict[str, Any]) -> str | None:
    """T Fig. 5-16 as a number: girth of the neck against how far the head is turned."""
    necks = {model["name"]: model["neck_twist"] for model in models if model["neck_twist"]}
    if not necks:
        return None
    plot = _Plot()
    for name, twist in necks.items():
        girth = [100 * each for each in twist["girth"]]
        plot.axes[0].plot(
            twist["angles"], girth, label=_label(name), **looks[name] | {"marker": ""}
        )
    plot.axes[0].axhline(100, color=MUTED, linewidth=1, zorder=1)
    plot.axes[0].axvline(0, color=MUTED, linewidth=1, zorder=1)
    plot.axes[0].set(
        xlabel="head turned to the right  ·  angle (°)  ·  to the left",
        ylabel="girth of the neck (% of rest)",
    )
    plot.axes[0].set_xticks(range(-90, 91, 30))
    return plot.svg("neck_twist")


def _coefficients(axes: Any, counts: Sequence[int]) -> None:
    """An axis of numbers of coefficients: even to 1, then by their logarithm where they reach
    far.
    """
    ticks = sorted(set(counts))
    if max(ticks) > 12:
        axes.set_xscale("symlog", linthresh=1)
    axes.set_xticks(ticks, [str(k) for k in ticks])
    axes.minorticks_off()
    axes.set_xlabel("number of shape coefficients")


def _label(name: str) -> str:
    """A name that matplotlib neither typesets as a formula nor leaves out."""
    return "\u200b" + name.replace("$", r"\$")


class _Plot:
    """Axes beside each other with one legend below."""

    def __init__(self, panels: int = 1):
        self._matplotlib = require_extra("matplotlib", "figures")
        self._figure_module = require_extra("matplotlib.figure", "figures")
        with self._matplotlib.rc_context(_STYLE):
            self._figure = self._figure_module.Figure(
                figsize=(8.0 * panels, 4.8), layout="constrained"
            )
            self.axes = [self._figure.add_subplot(1, panels, k + 1) for k in range(panels)]

    def svg(self, name: str) -> str:
        """The whole file."""
        with self._matplotlib.rc_context(_STYLE | {"svg.hashsalt": name}):
            handles, labels = self.axes[0].get_legend_handles_labels()
            columns = 2 * len(self.axes) if max(map(len, labels)) > 18 else 3 * len(self.axes)
            self._figure.legend(
                handles, labels, loc="outside lower center", ncols=min(columns, len(labels))
            )
            text = io.StringIO()
            self._figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
        return text.getvalue()
