"""The viewer of still bodies: surfaces and clouds of points in 3D, of which a page shows one at a
time, and can lay one more over it.

`Look` is one of them, `still_page` the page around them; `SCRIPTS` draw them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from habitus.export.png import png
from habitus.report import drawing
from habitus.report.shell import NO_SCRIPT_STILL, THEME, Blob, card, figure, shell

SCRIPTS = (THEME, "viewer_inflate.js", "viewer_data.js", "still_viewer.js")
STYLE = "still.css"
MAX_POINTS = 30_000
"""Points of a cloud that a page holds: some 10 bytes each."""
SKIN_AREA = 2.0
"""Square metres that the points of a person's cloud cover, roughly: gives their spacing."""
SHALLOW = 0.6
"""Height over width below which the width determines the scale of the viewer."""
PICTURE_HEIGHT = 480
"""Pixels of a still picture."""


@dataclass(frozen=True, eq=False)
class Look:
    """Points (N, 3; m, y up) of a surface with ``faces`` (F, 3), or of a cloud with ``normals`` (N,
    3).

    ``name`` is the text of its button, ``caption`` stands under it; ``colours`` (N, 3) are sRGB,
    grey where None; ``ramp`` are the colours of a scale whose first is for ``ends[0]`` and whose
    last for ``ends[1]``.
    """

    name: str
    caption: str
    points: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"] | None = None
    normals: Float[np.ndarray, "N 3"] | None = None
    colours: UInt8[np.ndarray, "N 3"] | None = None
    ramp: Sequence[str] = ()
    ends: tuple[str, str] = ("", "")


def still_page(
    title: str,
    sections: tuple[str, str],
    looks: Sequence[Look],
    name: str,
    over: Look | None = None,
    facing: float = 0.0,
    styles: Sequence[str] = (),
) -> str:
    """A page with the viewer between two sections of HTML.

    ``name`` describes what is viewed; ``over`` can be laid over any look; ``facing`` (radians about
    the vertical, from +z) is the direction in which the person faces, from where it is seen first.
    """
    blob = Blob()
    data = _still_data(looks, blob, over, facing)
    above, below = sections
    return shell(
        title,
        "\n".join((above, _still_html(looks, name, over), below)),
        data=data | {"arrays": blob.contents, "bytes": blob.size},
        arrays={"report-arrays": blob.base64()},
        scripts=SCRIPTS,
        styles=[STYLE, *styles],
        without_script=NO_SCRIPT_STILL,
    )


def still_pictures(looks: Sequence[Look], root: Float[np.ndarray, "3 3"]) -> str:
    """A card with pictures of all looks from the front and the back, for readers and printers
    without a 3D viewer; ``root`` is the rotation of the person's pelvis.
    """
    views = drawing.facing_views(root).values()
    figures = []
    for look in looks:
        contents = [png(_picture(look, axes)) for axes in views]
        scale = f", {look.ends[0]} to {look.ends[1]}" if look.ramp else ""
        figures.append(figure(look.name + scale, *contents, alt=look.name))
    return card("Front and back", f"<div class='shots pairs'>{''.join(figures)}</div>")


def _picture(look: Look, axes: Float[np.ndarray, "3 3"]) -> drawing.Rgba:
    count = len(look.points)
    colours = drawing.plain_colours(count) if look.colours is None else look.colours / 255.0
    if look.faces is not None:
        return drawing.picture(look.points, look.faces, colours, axes, height=PICTURE_HEIGHT)
    assert look.normals is not None
    return drawing.point_picture(look.points, look.normals, colours, axes, height=PICTURE_HEIGHT)


def _still_data(
    looks: Sequence[Look], blob: Blob, over: Look | None, facing: float
) -> dict[str, Any]:
    """What the script reads; arrays go into ``blob``."""
    points = np.concatenate([look.points for look in looks])
    low = points.min(0)
    high = points.max(0)
    known: dict[int, str] = {}
    return {
        "looks": [_packed(look, blob, known, (low, high)) for look in looks],
        "over": None if over is None else _packed(over, blob, known, (low, high)),
        "middle": ((low + high) / 2).tolist(),
        "size": float(max(high[1] - low[1], SHALLOW * np.hypot(*(high - low)[[0, 2]]))),
        "facing": facing,
    }


def _still_html(looks: Sequence[Look], title: str, over: Look | None) -> str:
    """A button for each look, one for what is laid over it, and one for turning."""
    buttons = "".join(
        f"<button type='button' data-look='{k}' "
        f"aria-pressed='{str(k == 0).lower()}'>{escape(look.name)}</button>"
        for k, look in enumerate(looks)
    )
    overlay = (
        f"<button type='button' id='over' aria-pressed='false'>{escape(over.name)}</button>"
        if over
        else ""
    )
    captions = "".join(
        f"<p class='caption'{' hidden' if k else ''} data-caption='{k}'>"
        f"{escape(look.caption)}{_scale(look)}</p>"
        for k, look in enumerate(looks)
    )
    return (
        f"<section class='card still' id='still' aria-label='{escape(title)}'><div class='over'>"
        "<div class='segments' role='group' aria-label='What is shown'>"
        f"{buttons}</div>{overlay}<button type='button' id='spin' aria-pressed='true'>Rotate"
        "</button></div><canvas id='body' tabindex='0' role='img' "
        f"aria-label='{escape(title)}. Drag to rotate, use the wheel to zoom.'></canvas>"
        "<p class='hint' id='hint'>Drag to rotate, wheel to zoom, double click to reset.</p>"
        f"{captions}</section>"
    )


def _packed(
    look: Look, blob: Blob, known: dict[int, str], box: tuple[np.ndarray, np.ndarray]
) -> dict[str, Any]:
    """A look by the names of its arrays in the blob; ``known`` are the names of arrays that are
    there already, by identity.
    """
    stride = max(1, -(-len(look.points) // MAX_POINTS)) if look.faces is None else 1

    def name(array: np.ndarray | None, kind: str) -> str | None:
        if array is None:
            return None
        if id(array) not in known:
            known[id(array)] = f"{kind}{len(known)}"
            _add(blob, known[id(array)], kind, array if kind == "faces" else array[::stride], box)
        return known[id(array)]

    parts = {
        "points": look.points,
        "faces": look.faces,
        "normals": look.normals,
        "colours": look.colours,
    }
    spacing = float(np.sqrt(SKIN_AREA / max(len(look.points[::stride]), 1)))
    return {kind: name(array, kind) for kind, array in parts.items()} | {"spacing": spacing}


def _add(
    blob: Blob, name: str, kind: str, array: np.ndarray, box: tuple[np.ndarray, np.ndarray]
) -> None:
    if kind == "points":
        blob.add_points(name, array, *box)
    elif kind == "faces":
        blob.add(name, array.astype("u2" if array.max() < 65536 else "u4"))
    elif kind == "normals":
        blob.add(name, np.round(127 * np.pad(array, ((0, 0), (0, 1)))).astype("i1"))
    else:
        blob.add(name, np.pad(array, ((0, 0), (0, 1)), constant_values=255).astype("u1"))


def _scale(look: Look) -> str:
    if not look.ramp:
        return ""
    first, last = map(escape, look.ends)
    return (
        f" <span class='scale-of'>{first} <i style='background: linear-gradient(90deg, "
        f"{', '.join(look.ramp)})'></i>"
        f" {last}</span>"
    )
