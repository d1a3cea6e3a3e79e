"""Diagrams as SVG files: a person with the tapes of the measurements, the markers of a selection (M
Fig. 4) and the curve of its error (M Fig. 5). Bodies in them are pictures of `drawing`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float, Int

from habitus.body.measurement_names import plain_measurement
from habitus.body.measurements import MeasuringKit
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export.png import small_png
from habitus.report.drawing import (
    BACK,
    FRONT,
    LEFT_SIDE,
    draw_surface,
    shade_palette,
    shades,
)
from habitus.report.evaluation.figures import GRID, INK, MUTED, SERIES
from habitus.report.shell import image_uri, measurement_text

SCALE = 420.0
"""SVG units a metre."""
PIXELS = 2
"""Pixels of a body's picture per SVG unit."""
_MARGIN = 24.0
_LINE = 16.0
"""Height of a line of text."""
_LEADER = 150.0
"""Width of the labels beside the front view."""
_LISTED = 190.0
"""Width of the list of other measurements."""
_WIDTH = 640.0
_HEIGHT = 400.0
_LEFT = 64.0
_BOTTOM = 56.0
_MAX_CROSSING = 0.7
"""Cosine between a tape's normal and the line of sight, above which the tape is not drawn."""
_MIN_FACING = 0.3
"""Share of a path's outward way along the line of sight, from which on it is drawn."""
_MARKER_DEPTH = 0.02
"""Metres behind the skin up to which a marker shows."""
_MARKER_FILLS = ("#f2c14e", "#e8590c", "#ffffff", "#9aa5b1")
_STYLE = f"text{{font:12px sans-serif;fill:{INK}}}.v{{fill:{MUTED}}}path{{stroke-linejoin:round}}"


@dataclass(frozen=True, eq=False)
class View:
    """A view of a person: ``axes`` to the right, up and to the viewer, and the point (right, down;
    m) at the left top of the diagram.
    """

    axes: Float[np.ndarray, "3 3"]
    corner: Float[np.ndarray, " 2"]

    @classmethod
    def at(
        cls, axes: Float[np.ndarray, "3 3"], vertices: Float[np.ndarray, "V 3"], left: float
    ) -> "View":
        """The view in which vertices begin ``left`` units from the left and below the margin."""
        flat = vertices @ axes.T
        corner = [flat[:, 0].min() - left / SCALE, -flat[:, 1].max() - _MARGIN / SCALE]
        return cls(axes, np.array(corner))

    def seen(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Points of the body's space (m) in SVG units from the left top; depth grows towards the
        viewer.
        """
        turned = points @ self.axes.T
        flat = (turned[:, :2] * [1, -1] - self.corner) * SCALE
        return np.column_stack([flat, turned[:, 2] * SCALE])


def _skin(view: View, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> str:
    """A picture of the body in sixteen greys."""
    points = view.seen(vertices)
    low = np.floor(points.min(0)) - 1
    width, height = (np.ceil(points.max(0)) + 1 - low)[:2].astype(int)
    placed = (points - [*low[:2], 0.0]) * PIXELS
    drawn = draw_surface(
        placed, faces, np.ones_like(vertices), PIXELS * int(width), PIXELS * int(height)
    )
    content = small_png(shades(drawn), shade_palette(dark=(130, 126, 120), pale=(235, 231, 225)))
    return (
        f'<image x="{low[0]:.0f}" y="{low[1]:.0f}" width="{width}" height="{height}" '
        f'href="{image_uri(content)}"/>'
    )


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    size = f"{width:.0f} {height:.0f}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" width="{width:.0f}" '
        f'height="{height:.0f}"><style>{_STYLE}</style>'
        f'<rect width="100%" height="100%" fill="#fff"/>{"".join(parts)}</svg>\n'
    )


def tape_picture(
    body: BodyModel, rest_vertices: Float[np.ndarray, "V 3"], measurements: Mapping[str, float]
) -> str:
    """A person at rest (V, 3; m) from the front and the side, with all tapes, tailors' paths
    (dashed) and ``measurements``.

    Raises HabitusError for a body without tapes.
    """
    kit = body.measuring_kit
    if kit is None or not kit.tapes:
        raise HabitusError(f"{body.name} has no tapes to draw; expected a person's body")
    parts = []
    left = _MARGIN
    height = 0.0
    for axes in (FRONT, LEFT_SIDE):
        view = View.at(axes, rest_vertices, left)
        right, bottom = view.seen(rest_vertices)[:, :2].max(0)
        height = max(height, float(bottom + _MARGIN))
        parts += [_skin(view, rest_vertices, body.faces), *_tapes(view, kit, rest_vertices)]
        parts += _paths(view, kit, rest_vertices)
        left = float(right + _MARGIN)
        if axes is FRONT:
            parts += _labels(view, kit, rest_vertices, measurements, left)
            left += _LEADER
    rows = _others(kit, measurements, left)
    height = max(height, 2 * _MARGIN + _LINE * len(rows))
    return _svg(left + _LISTED, height, [*parts, *rows])


def _colour(k: int) -> str:
    return SERIES[k % len(SERIES)]


def _tapes(view: View, kit: MeasuringKit, vertices: np.ndarray) -> list[str]:
    """The visible part of each tape; tapes around the line of sight are left out."""
    lines = []
    for k, tape in enumerate(kit.tapes):
        for ring in tape.rings:
            if np.abs(np.cross(*ring.axes) @ view.axes[2]) > _MAX_CROSSING:
                continue
            line = ring.tape(vertices)
            points = view.seen(line)
            middle = view.seen(line.mean(0)[None])[0, 2]
            ends = np.roll(points, -1, axis=0)
            visible = 0.5 * (points[:, 2] + ends[:, 2]) >= middle
            path = "".join(
                f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}"
                for a, b in zip(points[visible], ends[visible], strict=True)
            )
            lines.append(f'<path fill="none" stroke="{_colour(k)}" stroke-width="2" d="{path}"/>')
    return lines


def _paths(view: View, kit: MeasuringKit, vertices: np.ndarray) -> list[str]:
    """Tailors' paths over the skin on the viewer's side, dashed, with level arms."""
    if kit.sewing is None:
        return []
    skin = vertices[kit.sewing.vertices]
    lines = []
    for leg, arc in kit.sewing.arcs.items():
        if np.dot(leg.out or (0.0, 0.0, 0.0), view.axes[2]) < _MIN_FACING:
            continue
        points = arc.points(skin)
        order = np.argsort((points - points[0]) @ (points[-1] - points[0]))
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y, _ in view.seen(points[order]))
        lines.append(
            f'<path fill="none" stroke="{INK}" stroke-width="1" stroke-dasharray="4 2" '
            f'd="M{path}"/>'
        )
    return lines


def _labels(
    view: View,
    kit: MeasuringKit,
    vertices: Float[np.ndarray, "V 3"],
    measurements: Mapping[str, float],
    left: float,
) -> list[str]:
    """Names and lengths beside the front view, each with a line to its tape."""
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
            f'<path fill="none" stroke="{_colour(k)}" stroke-width=".7" '
            f'd="M{point[0]:.1f} {point[1]:.1f}L{left - 8:.1f} {free:.1f}H{left - 2:.1f}"/>'
            + _line(name, measurements[name], left, free + 4)
        )
    return lines


def _others(kit: MeasuringKit, measurements: Mapping[str, float], left: float) -> list[str]:
    """The other measurements, a line each."""
    drawn = {f"{tape.name}_circumference_m" for tape in kit.tapes}
    rows: Sequence[str] = [name for name in measurements if name not in drawn]
    return [
        _line(name, measurements[name], left, _MARGIN + _LINE * (k + 1))
        for k, name in enumerate(rows)
    ]


def _line(name: str, value: float, left: float, y: float) -> str:
    """A measurement as a line of text."""
    title = plain_measurement(name).removesuffix("_circumference")
    return (
        f'<text x="{left:.1f}" y="{y:.1f}">{escape(title.replace("_", " ").capitalize())} '
        f'<tspan class="v">{measurement_text(name, value)}</tspan></text>'
    )


def curve_picture(errors: Mapping[int, float], start: int, goal: str) -> str:
    """The error (m) over the number of markers, with a dot at the first set, of ``start``."""
    counts = sorted(errors)
    values = 1e3 * np.array([errors[count] for count in counts])
    top = _rounded(float(values.max()))
    right = max(counts)

    def position(count: float, value: float) -> tuple[float, float]:
        x = _LEFT + (_WIDTH - _LEFT - _MARGIN) * count / right
        return x, _MARGIN + (_HEIGHT - _MARGIN - _BOTTOM) * (1.0 - value / top)

    parts = []
    for k in range(6):
        x, y = position(0, top * k / 5)
        parts.append(f'<path stroke="{GRID}" d="M{x:.1f} {y:.1f}H{_WIDTH - _MARGIN:.1f}"/>')
        parts.append(
            f'<text class="v" x="{x - 8:.1f}" y="{y + 4:.1f}" '
            f'text-anchor="end">{top * k / 5:g}</text>'
        )
    for count in range(0, right + 1, 10):
        x, y = position(count, 0.0)
        parts.append(
            f'<text class="v" x="{x:.1f}" y="{y + 18:.1f}" text-anchor="middle">{count}</text>'
        )
    line = "L".join(
        "{:.1f} {:.1f}".format(*position(c, v)) for c, v in zip(counts, values, strict=True)
    )
    parts.append(f'<path fill="none" stroke="{SERIES[0]}" stroke-width="2" d="M{line}"/>')
    x, y = position(start, 1e3 * errors[start])
    parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{SERIES[1]}"/>')
    label = f"start: {start} markers, {1e3 * errors[start]:.1f} mm"
    parts.append(f'<text x="{x + 8:.1f}" y="{y - 10:.1f}">{label}</text>')
    middle = 0.5 * (_LEFT + _WIDTH)
    parts.append(
        f'<text x="{middle:.0f}" y="{_HEIGHT - 12:.0f}" text-anchor="middle">'
        "number of markers</text>"
    )
    parts.append(
        f'<text x="{_LEFT:.0f}" y="{_MARGIN - 8:.0f}">error of the {escape(goal)} (mm, RMS)</text>'
    )
    return _svg(_WIDTH, _HEIGHT, parts)


def marker_picture(
    body: BodyModel, vertices: Int[np.ndarray, " C"], kinds: Sequence[int], names: Sequence[str]
) -> str:
    """Markers on the template, front and back, in the colour of their kind; ``names`` are those
    of the kinds.
    """
    rest = body.v_template
    parts = []
    left = _MARGIN
    bottom = 0.0
    colours = [_MARKER_FILLS[kind] for kind in kinds]
    for side, axes in {"front": FRONT, "back": BACK}.items():
        view = View.at(axes, rest, left)
        parts += [_skin(view, rest, body.faces), *_dots(view, rest, vertices, colours)]
        parts.append(f'<text class="v" x="{left:.0f}" y="{_MARGIN:.0f}">{side}</text>')
        right, bottom = view.seen(rest)[:, :2].max(0).tolist()
        left = right + _MARGIN
    for k, name in enumerate(names):
        y = bottom - _LINE * (len(names) - k)
        parts.append(
            f'<circle cx="{_MARGIN + 6:.0f}" cy="{y:.0f}" r="5" fill="{_MARKER_FILLS[k]}" '
            f'stroke="{INK}"/>'
        )
        parts.append(f'<text x="{_MARGIN + 18:.0f}" y="{y + 4:.0f}">{escape(name)}</text>')
    return _svg(left, bottom + _MARGIN, parts)


def _dots(
    view: View,
    rest: Float[np.ndarray, "V 3"],
    vertices: Int[np.ndarray, " C"],
    colours: Sequence[str],
) -> list[str]:
    """The visible markers: no skin is in front of them."""
    seen = view.seen(rest[vertices])
    all_seen = view.seen(rest)
    circles = []
    for point, colour in zip(seen, colours, strict=True):
        around = np.hypot(*(all_seen[:, :2] - point[:2]).T) < _MARKER_DEPTH * SCALE
        if all_seen[around, 2].max() < point[2] + 2.5 * _MARKER_DEPTH * SCALE:
            circles.append(
                f'<circle cx="{point[0]:.1f}" cy="{point[1]:.1f}" r="5" fill="{colour}" '
                f'stroke="{INK}"/>'
            )
    return circles


def _rounded(value: float) -> float:
    """The smallest of 1, 2, 2.5, 5 times a power of ten that is not below the value."""
    size = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(next(step * size for step in (1, 2, 2.5, 5, 10) if step * size >= value))
