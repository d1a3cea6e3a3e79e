"""The one table of an evaluation's report: errors and run times of all models."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from habitus.report.evaluation.figures import SERIES

REMOVED = (
    "of the error in pose generalisation without them, against noise-free meshes where "
    "there are any"
)


def measures_table(numbers: Mapping[str, Any], looks: Mapping[str, Any]) -> str:
    """Groups of rows, a column for each number of shape coefficients; ``looks`` are those of
    `model_looks`.
    """
    models = numbers["models"]
    curves = [
        model[key]
        for model in models
        for key in ("model_generalisation", "pose_generalisation")
        if model[key]
    ]
    counts = sorted({count for curve in curves for count in curve["counts"]})
    heads = "".join(f"<th class='number' scope='col'>{count}</th>" for count in counts)
    groups = []
    for key, title in (
        ("model_generalisation", "Model generalisation"),
        ("pose_generalisation", "Pose generalisation"),
    ):
        for what, note in (
            ("mean_mm", "to the registrations"),
            ("clean_mean_mm", "to their noise-free meshes"),
        ):
            rows = {m["name"]: _by_count(m[key], what) for m in models if m[key] and m[key][what]}
            groups.append(_group(f"{title}, mm", note, rows, counts, looks, "{:.2f}".format))
    gains = {
        m["name"]: _by_count(m["removed_by_pose_shapes"], "percent")
        for m in models
        if m["removed_by_pose_shapes"]
    }
    groups.append(
        _group(
            "Removed by pose blend shapes, %",
            REMOVED,
            gains,
            counts,
            looks,
            "{:.0f}".format,
            most=True,
        )
    )
    times = {model["name"]: _by_count(model["run_time"], "median_ms") for model in models}
    groups.append(_group("Run time, ms", "one surface", times, counts, looks, "{:.2f}".format))
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
    most: bool = False,
) -> str:
    if not rows:
        return ""
    best = {
        count: (max if most else min)(
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
