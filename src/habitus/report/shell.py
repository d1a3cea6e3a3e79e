"""What the pages of fits and of comparisons share: one HTML file that opens offline, its styles, scripts and player."""

import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from habitus import __version__

VIEWER = (
    "viewer_math.js",
    "viewer_inflate.js",
    "viewer_data.js",
    "viewer_shaders.js",
    "viewer_gl.js",
    "viewer_skin.js",
    "viewer_scene.js",
    "viewer_camera.js",
    "viewer_layers.js",
    "viewer_player.js",
    "viewer_recorder.js",
    "page_controls.js",
    "page_plots.js",
    "page_angles.js",
    "page_parts.js",
)


def shell(
    title: str,
    content: str,
    data: Any,
    arrays: Mapping[str, str],
    scripts: Sequence[str],
    styles: Sequence[str] = (),
) -> str:
    """The page as text. ``content`` is HTML; ``data``, as JSON, and arrays in base64 by id, are the scripts'."""
    elements = (f'<script type="text/plain" id="{name}">{packed}</script>' for name, packed in arrays.items())
    footer = f"Written by habitus {__version__}. Everything is in this file; it loads nothing and sends nothing."
    return Template(asset("shell.html")).substitute(
        title=escape(title),
        version=__version__,
        css=_styles(tuple(styles)),
        content=content,
        footer=escape(footer),
        data=json_for_script(data),
        arrays="\n".join(elements),
        script=_script(tuple(scripts)),
    )


def player(told: str, layers: str, last: int, keys: str = "", hint: str = "") -> str:
    """The 3D player's HTML: what it shows, in a sentence; its buttons for layers, ``last`` of them with keys."""
    return Template(asset("player.html")).substitute(told=escape(told), layers=layers, last=last, keys=keys, hint=hint)


def json_for_script(value: Any) -> str:
    """JSON that may stand inside a <script> element whatever its strings hold."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return re.sub("[<>&\u2028\u2029]", lambda found: f"\\u{ord(found[0]):04x}", text)


@cache
def asset(name: str) -> str:
    """A file of the pages."""
    return files("habitus.report.web").joinpath(name).read_text("utf-8")


@cache
def _styles(more: tuple[str, ...]) -> str:
    sheets = "".join(map(asset, ("page.css", "page_parts.css", *more)))
    return sheets.replace("@dark", asset("page_dark.css"))


@cache
def _script(names: tuple[str, ...]) -> str:
    text = "\n".join(map(asset, names))
    if re.search(r"</script", text, re.IGNORECASE):
        raise ValueError("a page's script must not hold a closing script tag")
    return text
