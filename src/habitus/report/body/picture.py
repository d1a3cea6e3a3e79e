"""A picture of a person with every tape laid on: front and side as one SVG, for which nothing else
is needed.
"""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from jaxtyping import Float

from habitus.body.measurements import MeasuringKit
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.report.body.drawing import SCALE, VIEWS, View, skin
from habitus.report.evaluation.figures import INK, MUTED, SERIES

_MARGIN = 24.0
_LINE = 15.0
_LEADER = 150.0
_ALONG = 0.7  # cosine with the line of sight
_STYLE = f"text{{font:11px sans-serif;fill:{INK}}}.v{{fill:{MUTED}}}path{{stroke-linejoin:round}}"


def tape_picture(
    body: BodyModel, rest_vertices: Float[np.ndarray, "V 3"], found: Mapping[str, float]
) -> str:
    """The SVG of a person at rest (V, 3) whose measurements were ``found``.

    Raises HabitusError for a body without tapes.
    """
    kit = body.measuring_kit
    if kit is None or not kit.tapes:
        raise HabitusError(f"{body.name} has no tapes to draw; expected a person's body")
    parts = []
    left = _MARGIN
    height = 0.0
    for name, axes in VIEWS.items():
        flat = rest_vertices @ axes.T
        low = flat[:, :2].min(0)
        high = flat[:, :2].max(0)
        view = View(axes, np.array([low[0] - left / SCALE, -high[1] - _MARGIN / SCALE]))
        height = max(height, float((high[1] - low[1]) * SCALE + 2 * _MARGIN))
        parts += [skin(view, rest_vertices, body.faces), *_tapes(view, kit, rest_vertices)]
        left += float((high[0] - low[0]) * SCALE + _MARGIN)
        if name == "front":
            parts += _labels(view, kit, rest_vertices, found, left)
            left += _LEADER
    rows = _others(kit, found, left)
    width = left + 190.0
    height = max(height, 2 * _MARGIN + _LINE * len(rows))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" '
        f'height="{height:.0f}"><style>{_STYLE}</style><rect width="100%" height="100%" '
        'fill="#fff"/>'
        f"{''.join([*parts, *rows])}</svg>\n"
    )


def _colour(k: int) -> str:
    return SERIES[k % len(SERIES)]


def _tapes(view: View, kit: MeasuringKit, vertices: np.ndarray) -> list[str]:
    """Each tape's part that the viewer sees; none of those that go around the line of sight."""
    lines = []
    for k, tape in enumerate(kit.tapes):
        for ring in tape.rings:
            if np.abs(np.cross(*ring.axes) @ view.axes[2]) > _ALONG:
                continue
            around = ring.tape(vertices)
            points = view.seen(around)
            inward = view.seen(around.mean(0)[None])[0, 2]
            ends = np.roll(points, -1, axis=0)
            seen = 0.5 * (points[:, 2] + ends[:, 2]) >= inward
            path = "".join(
                f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}"
                for a, b in zip(points[seen], ends[seen], strict=True)
            )
            lines.append(f'<path fill="none" stroke="{_colour(k)}" stroke-width="2" d="{path}"/>')
    return lines


def _labels(
    view: View, kit: MeasuringKit, vertices: np.ndarray, found: Mapping[str, float], left: float
) -> list[str]:
    """Names and lengths beside the front view, each led to its tape on the viewer's right."""
    ends = []
    for k, tape in enumerate(kit.tapes):
        points = view.seen(tape.rings[0].tape(vertices))
        ends.append((float(points[:, 1].mean()), k, points[points[:, 0].argmax()]))
    lines = []
    free = -np.inf
    for height, k, point in sorted(ends, key=lambda end: end[0]):
        free = max(free + _LINE, height)
        name = f"{kit.tapes[k].name}_circumference_m"
        lines.append(
            f'<path fill="none" stroke="{_colour(k)}" stroke-width=".7" d="M{point[0]:.1f} '
            f"{point[1]:.1f}"
            f'L{left - 8:.1f} {free:.1f}H{left - 2:.1f}"/><text x="{left:.1f}" y="{free + 4:.1f}">'
            f'{escape(_words(name))} <tspan class="v">{_said(name, found[name])}</tspan></text>'
        )
    return lines


def _others(kit: MeasuringKit, found: Mapping[str, float], left: float) -> list[str]:
    """All other measurements, a line each."""
    drawn = {f"{tape.name}_circumference_m" for tape in kit.tapes}
    rows: Sequence[str] = [name for name in found if name not in drawn]
    return [
        f'<text x="{left:.1f}" y="{_MARGIN + _LINE * (k + 1):.1f}">{escape(_words(name))} '
        f'<tspan class="v">{_said(name, found[name])}</tspan></text>'
        for k, name in enumerate(rows)
    ]


def _words(name: str) -> str:
    plain = name.removesuffix("_m").removesuffix("_kg").removesuffix("_circumference")
    return plain.replace("_", " ").capitalize()


def _said(name: str, value: float) -> str:
    return f"{value:.1f} kg" if name.endswith("_kg") else f"{100 * value:.1f} cm"
