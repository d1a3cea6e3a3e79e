"""A body at rest drawn as SVG: shaded triangles, seen from some side."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

SCALE = 420.0
"""SVG units a metre."""
_LAYER = 1.5  # SVG units of depth in which nothing hides anything
_LIGHT = np.array([-0.3, 0.5, 0.8]) / np.linalg.norm([-0.3, 0.5, 0.8])
VIEWS = {
    "front": np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
    "side": np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]),
}
"""Sides to look from: axes to the right, up, and to the viewer."""


@dataclass(frozen=True)
class View:
    """One look at the person: points turned to right, up and towards the viewer, in SVG units from
    its left top.
    """

    axes: Float[np.ndarray, "3 3"]
    corner: Float[np.ndarray, " 2"]

    def seen(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Points of the body's space (m) in SVG units from the left top; depth grows towards the
        viewer.
        """
        turned = points @ self.axes.T
        flat = (turned[:, :2] * [1, -1] - self.corner) * SCALE
        return np.column_stack([flat, turned[:, 2] * SCALE])


def skin(view: View, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> str:
    """The triangles that face the viewer, the far ones first, layer by layer, in sixteen greys."""
    points = view.seen(vertices)
    corners = points[faces]
    turned = vertices @ view.axes.T
    a, b, c = turned[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    front = np.flatnonzero(normal[:, 2] > 0)
    grey = np.round(15 * np.clip(normal[front] @ _LIGHT, 0, 1)).astype(int)
    order = np.lexsort([grey, np.floor(corners[front, :, 2].mean(1) / _LAYER)])
    front = front[order]
    grey = grey[order]
    runs = _runs(np.round(10 * corners[front, :, :2]).astype(int), grey)
    paths = "".join(
        f'<path fill="{shade}" stroke="{shade}" stroke-width="5" d="{path}"/>'
        for shade, path in runs
    )
    return f'<g transform="scale(.1)">{paths}</g>'


def _runs(corners: np.ndarray, grey: np.ndarray) -> Iterator[tuple[str, str]]:
    """Triangles (N, 3, 2) of one grey that follow each other, as one path."""
    first = corners[:, 0].tolist()
    steps = np.diff(corners, axis=1).reshape(len(corners), 4).tolist()
    each = [f"M{x} {y}l{a} {b} {c} {d}z" for (x, y), (a, b, c, d) in zip(first, steps, strict=True)]
    starts = np.flatnonzero(np.diff(grey, prepend=-1))
    for start, end in zip(starts, [*starts[1:], len(grey)], strict=True):
        level = 130 + 7 * int(grey[start])
        yield f"#{level:02x}{level - 4:02x}{level - 10:02x}", "".join(each[start:end])
