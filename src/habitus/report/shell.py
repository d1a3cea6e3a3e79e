"""What all pages share: one HTML file that opens offline, its head and foot, its styles and
scripts; and the player.
"""

import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from string import Template
from types import MappingProxyType
from typing import Any

from habitus import __version__

THEME = "page_theme.js"
"""Light and dark, for pages whose scripts need nothing else."""
ALONE = "Everything is in this file; it loads nothing and sends nothing."
WITHOUT_SCRIPT = "The player and the plots need JavaScript; the numbers above and below do not."
VIEWER = (
    THEME,
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
    *,
    data: Any = None,
    arrays: Mapping[str, str] = MappingProxyType({}),
    scripts: Sequence[str] = (THEME,),
    styles: Sequence[str] = (),
    foot: str = ALONE,
    without_script: str = "",
) -> str:
    """The page as text. ``content`` is HTML; ``data``, as JSON, and arrays in base64 by id, are the
    scripts'.

    ``foot`` is the last sentence; ``without_script`` says what a reader lacks whose browser runs
    none.
    """
    elements = [
        f'<script type="text/plain" id="{name}">{packed}</script>'
        for name, packed in arrays.items()
    ]
    if data is not None:
        elements.insert(
            0, f'<script type="application/json" id="report-data">{json_for_script(data)}</script>'
        )
    return Template(asset("shell.html")).substitute(
        title=escape(title),
        version=__version__,
        css=_styles(tuple(styles)),
        content=content,
        footer=escape(f"Written by habitus {__version__}. {foot}"),
        lacking=f'<noscript><p class="card">{escape(without_script)}</p></noscript>'
        if without_script
        else "",
        data="\n".join(elements),
        script=_script(tuple(scripts)),
    )


def player(told: str, layers: str, last: int, keys: str = "", hint: str = "") -> str:
    """The 3D player's HTML: what it shows, in a sentence; its buttons for layers, ``last`` of them
    with keys.
    """
    return Template(asset("player.html")).substitute(
        told=escape(told), layers=layers, last=last, keys=keys, hint=hint
    )


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
