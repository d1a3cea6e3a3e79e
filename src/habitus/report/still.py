"""A body that stands still, turned in 3D: a few looks at it, surfaces and points, of which a page
shows one at a time.

`Look` is what is seen, `still` the HTML around it; `SCRIPTS` draw it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from habitus.report.fit.blob import Blob
from habitus.report.shell import THEME

SCRIPTS = (THEME, "viewer_inflate.js", "viewer_data.js", "still_viewer.js")
STYLE = "still.css"
MOST_POINTS = 30_000
"""Points of a cloud that a page holds: some 10 bytes each."""


@dataclass(frozen=True, eq=False)
class Look:
    """Points (N, 3; m, y up) of a surface with ``faces`` (F, 3), or of a cloud with ``normals`` (N,
    3).

    ``name`` stands on its button, ``told`` under the picture; ``colours`` (N, 3) are sRGB, grey
    where None; ``ramp`` are the colours of a scale, the first for ``ends[0]``, the last for
    ``ends[1]``.
    """

    name: str
    told: str
    points: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"] | None = None
    normals: Float[np.ndarray, "N 3"] | None = None
    colours: UInt8[np.ndarray, "N 3"] | None = None
    ramp: Sequence[str] = ()
    ends: tuple[str, str] = ("", "")


def still_data(
    looks: Sequence[Look], blob: Blob, over: Look | None = None, facing: float = 0.0
) -> dict[str, Any]:
    """What the script is told; arrays go into ``blob``. ``over``: points that can be laid over any
    look.

    ``facing`` (radians about the vertical) is where the body looks: it is seen from there at first.
    """
    every = np.concatenate([look.points for look in looks])
    low = every.min(0)
    high = every.max(0)
    known: dict[int, str] = {}
    return {
        "looks": [_packed(look, blob, known, (low, high)) for look in looks],
        "over": None if over is None else _packed(over, blob, known, (low, high)),
        "middle": ((low + high) / 2).tolist(),
        "size": float(max(high[1] - low[1], 0.6 * np.hypot(*(high - low)[[0, 2]]))),
        "facing": facing,
    }


def still(looks: Sequence[Look], title: str, over: str = "") -> str:
    """The HTML: a button for each look, for what is laid over it, and for turning."""
    buttons = "".join(
        f"<button type='button' data-look='{k}' "
        f"aria-pressed='{str(k == 0).lower()}'>{escape(look.name)}</button>"
        for k, look in enumerate(looks)
    )
    more = (
        f"<button type='button' id='over' aria-pressed='false'>{escape(over)}</button>"
        if over
        else ""
    )
    told = "".join(
        f"<p class='told'{' hidden' if k else ''} "
        f"data-told='{k}'>{escape(look.told)}{_scale(look)}</p>"
        for k, look in enumerate(looks)
    )
    return (
        f"<section class='card still' id='still' aria-label='{escape(title)}'><div "
        "class='over'><div class='segments' "
        f"role='group' aria-label='What is shown'>{buttons}</div>{more}<button type='button' "
        "id='spin' "
        "aria-pressed='true'>Turn</button></div><canvas id='body' tabindex='0' role='img' "
        f"aria-label='{escape(title)}. Drag to turn it, use the wheel to come nearer.'></canvas>"
        "<p class='hint' id='hint'>Drag to turn, wheel to come nearer, twice to begin "
        f"anew.</p>{told}</section>"
    )


def _packed(
    look: Look, blob: Blob, known: dict[int, str], box: tuple[np.ndarray, np.ndarray]
) -> dict[str, Any]:
    """A look by the names of its arrays in the blob; ``known`` are those that are there already, by
    identity.
    """
    count = len(look.points)
    some = (
        slice(None)
        if look.faces is not None
        else slice(None, None, max(1, -(-count // MOST_POINTS)))
    )

    def name(array: np.ndarray | None, what: str) -> str | None:
        if array is None:
            return None
        if id(array) not in known:
            known[id(array)] = found = f"{what}{len(known)}"
            _add(blob, found, what, array if what == "faces" else array[some], box)
        return known[id(array)]

    parts = {
        "points": look.points,
        "faces": look.faces,
        "normals": look.normals,
        "colours": look.colours,
    }
    return {what: name(array, what) for what, array in parts.items()} | {
        "spacing": _spacing(look.points[some])
    }


def _add(
    blob: Blob, name: str, what: str, array: np.ndarray, box: tuple[np.ndarray, np.ndarray]
) -> None:
    if what == "points":
        blob.add_points(name, array, *box)
    elif what == "faces":
        blob.add(name, array.astype("u2" if array.max() < 65536 else "u4"))
    elif what == "normals":
        blob.add(name, np.round(127 * np.pad(array, ((0, 0), (0, 1)))).astype("i1"))
    else:
        blob.add(name, np.pad(array, ((0, 0), (0, 1)), constant_values=255).astype("u1"))


def _spacing(points: np.ndarray) -> float:
    """How far points of a cloud of a person lie apart, roughly (m): they cover some 2 square
    metres.
    """
    return float(np.sqrt(2.0 / max(len(points), 1)))


def _scale(look: Look) -> str:
    if not look.ramp:
        return ""
    first, last = map(escape, look.ends)
    return (
        f" <span class='scale-of'>{first} <i style='background: linear-gradient(90deg, "
        f"{', '.join(look.ramp)})'></i>"
        f" {last}</span>"
    )
