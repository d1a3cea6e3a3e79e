"""Pictures of a marker selection as SVG, for which nothing else is needed: the curve (M Fig. 5),
markers (Fig. 4).
"""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.report.body.drawing import SCALE, View, skin
from habitus.report.evaluation.figures import GRID, INK, MUTED, SERIES

_SIDES = {
    "front": np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
    "back": np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
}
_MARGIN = 24.0
_LINE = 16.0
_WIDTH = 640.0
_HEIGHT = 400.0
_LEFT = 64.0
_BOTTOM = 56.0
_DEEP = 0.02  # metres behind the skin up to which a marker shows
_STYLE = f"text{{font:12px sans-serif;fill:{INK}}}.v{{fill:{MUTED}}}"


def curve_picture(errors: Mapping[int, float], start: int, goal: str) -> str:
    """The error (m) over the number of markers, the set that it started from marked."""
    counts = sorted(errors)
    values = 1e3 * np.array([errors[count] for count in counts])
    top = _rounded(float(values.max()))
    right = max(counts)
    low = 0.0

    def place(count: float, value: float) -> tuple[float, float]:
        x = _LEFT + (_WIDTH - _LEFT - _MARGIN) * count / right
        return x, _MARGIN + (_HEIGHT - _MARGIN - _BOTTOM) * (1.0 - (value - low) / (top - low))

    parts = []
    for k in range(6):
        x, y = place(0, top * k / 5)
        parts.append(f'<path stroke="{GRID}" d="M{x:.1f} {y:.1f}H{_WIDTH - _MARGIN:.1f}"/>')
        parts.append(
            f'<text class="v" x="{x - 8:.1f}" y="{y + 4:.1f}" '
            f'text-anchor="end">{top * k / 5:g}</text>'
        )
    for count in range(0, right + 1, 10):
        x, y = place(count, 0.0)
        parts.append(
            f'<text class="v" x="{x:.1f}" y="{y + 18:.1f}" text-anchor="middle">{count}</text>'
        )
    line = "L".join(
        "{:.1f} {:.1f}".format(*place(c, v)) for c, v in zip(counts, values, strict=True)
    )
    parts.append(f'<path fill="none" stroke="{SERIES[0]}" stroke-width="2" d="M{line}"/>')
    x, y = place(start, 1e3 * errors[start])
    parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{SERIES[1]}"/>')
    said = f"start: {start} markers, {1e3 * errors[start]:.1f} mm"
    parts.append(f'<text x="{x + 8:.1f}" y="{y - 10:.1f}">{said}</text>')
    middle = 0.5 * (_LEFT + _WIDTH)
    parts.append(
        f'<text x="{middle:.0f}" y="{_HEIGHT - 12:.0f}" text-anchor="middle">number of '
        "markers</text>"
    )
    parts.append(
        f'<text x="{_LEFT:.0f}" y="{_MARGIN - 8:.0f}">error of the {escape(goal)} (mm, RMS)</text>'
    )
    return _svg(_WIDTH, _HEIGHT, parts)


def marker_picture(
    body: BodyModel, vertices: Int[np.ndarray, " C"], kinds: Sequence[int], names: Sequence[str]
) -> str:
    """Markers on the template, front and back, in the colour of their kind; ``names`` say what
    kinds there are.
    """
    rest = body.v_template
    parts = []
    left = _MARGIN
    fills = ("#f2c14e", "#e8590c", "#ffffff", "#9aa5b1")
    low = rest.min(axis=0)
    high = rest.max(axis=0)
    width = (high[0] - low[0]) * SCALE
    height = (high[1] - low[1]) * SCALE
    for side, axes in _SIDES.items():
        flat = rest @ axes.T
        view = View(
            axes, np.array([flat[:, 0].min() - left / SCALE, -flat[:, 1].max() - _MARGIN / SCALE])
        )
        parts.append(skin(view, rest, body.faces))
        parts += _dots(view, rest, body, vertices, [fills[kind] for kind in kinds])
        parts.append(f'<text class="v" x="{left:.0f}" y="{_MARGIN:.0f}">{side}</text>')
        left += width + _MARGIN
    for k, name in enumerate(names):
        y = _MARGIN + height - _LINE * (len(names) - k)
        parts.append(
            f'<circle cx="{_MARGIN + 6:.0f}" cy="{y:.0f}" r="5" fill="{fills[k]}" stroke="{INK}"/>'
        )
        parts.append(f'<text x="{_MARGIN + 18:.0f}" y="{y + 4:.0f}">{escape(name)}</text>')
    return _svg(left, height + 2 * _MARGIN, parts)


def _dots(
    view: View,
    rest: Float[np.ndarray, "V 3"],
    body: BodyModel,
    vertices: np.ndarray,
    colours: Sequence[str],
) -> list[str]:
    """The markers that the viewer sees: no skin lies before them."""
    seen = view.seen(rest[vertices])
    all_seen = view.seen(rest)
    out = []
    for point, colour in zip(seen, colours, strict=True):
        near = np.hypot(*(all_seen[:, :2] - point[:2]).T) < _DEEP * SCALE
        if all_seen[near, 2].max() < point[2] + 2.5 * _DEEP * SCALE:
            out.append(
                f'<circle cx="{point[0]:.1f}" cy="{point[1]:.1f}" r="5" fill="{colour}" '
                f'stroke="{INK}"/>'
            )
    return out


def _rounded(value: float) -> float:
    """The next round number that is not below."""
    size = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(next(step * size for step in (1, 2, 2.5, 5, 10) if step * size >= value))


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" '
        f'height="{height:.0f}"><style>{_STYLE}</style><rect width="100%" height="100%" '
        'fill="#fff"/>'
        f"{''.join(parts)}</svg>\n"
    )
