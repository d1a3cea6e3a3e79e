"""The HTML that all pages share: one file that opens offline, with its head, foot, styles and
scripts, and the parts from which contents are made (banner, tiles, cards, tables, the player,
arrays packed into one text).

Every text that comes from outside is escaped here.
"""

import base64
import json
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from string import Template
from types import MappingProxyType
from typing import Any
from urllib.parse import quote

import numpy as np

from habitus import __version__
from habitus.body.measurement_names import DEFINITIONS, plain_measurement, shown_measurement
from habitus.errors import shown

THEME = "page_theme.js"
"""Light and dark, for pages whose scripts need nothing else."""
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
"""Scripts of pages with the player."""
OFFLINE = "Everything is in this file; it loads nothing and sends nothing."
NO_SCRIPT = "The player and the plots need JavaScript; the numbers above and below do not."
NO_SCRIPT_STILL = "The body in 3D needs JavaScript; pictures and numbers do not."
VERDICTS = {
    "good": "This fit is good.",
    "doubtful": "This fit is doubtful: check it before use.",
    "failed": "This fit has failed: do not use it.",
}
STATUSES = {
    "converged": "converged",
    "iterations": "stopped at the limit of iterations",
    "stalled": "stopped: no step lowers the cost further",
    "stopped": "stopped by the caller",
}
"""The words for a solver's status."""
COSTS_LEAD = (
    "Half of the weighted sum of squares of each term at the solution. The costs have no unit; "
    "compare them between fits of one input."
)
MAX_NAME = 120
"""Characters of a name out of a file that a page shows."""
MAX_REASON = 300
"""Characters of a reason of a verdict that a page shows."""
MAX_NOTE = 400
"""Characters of a note or a warning that a page shows."""
Tile = tuple[str, str, str, str]
"""Name of a number, the number, its unit, and a remark."""


def shell(
    title: str,
    content: str,
    *,
    data: Any = None,
    arrays: Mapping[str, str] = MappingProxyType({}),
    scripts: Sequence[str] = (THEME,),
    styles: Sequence[str] = (),
    foot: str = OFFLINE,
    without_script: str = "",
) -> str:
    """The whole page as text.

    ``content`` is HTML; the scripts read ``data``, as JSON, and ``arrays``, base64 text by element
    id. ``foot`` is the page's last sentence; ``without_script`` tells readers whose browser runs no
    scripts what is missing.
    """
    elements = [
        f'<script type="text/plain" id="{name}">{packed}</script>'
        for name, packed in arrays.items()
    ]
    if data is not None:
        json_text = json_for_script(data)
        elements.insert(0, f'<script type="application/json" id="report-data">{json_text}</script>')
    missing = f'<noscript><p class="card">{escape(without_script)}</p></noscript>'
    return Template(asset("shell.html")).substitute(
        title=escape(title),
        version=__version__,
        css=_styles(tuple(styles)),
        content=content,
        footer=escape(f"Written by habitus {__version__}. {foot}"),
        noscript=missing if without_script else "",
        data="\n".join(elements),
        script=_script(tuple(scripts)),
    )


def player(description: str, layers: str, last: int, keys: str = "", hint: str = "") -> str:
    """The HTML of the 3D player: a sentence on what it shows, its buttons for layers, and how many
    of them (``last``) have keys.
    """
    return Template(asset("player.html")).substitute(
        description=escape(description), layers=layers, last=last, keys=keys, hint=hint
    )


def json_for_script(value: Any) -> str:
    """JSON that is safe inside a <script> element whatever its strings hold."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return re.sub("[<>&\u2028\u2029]", lambda match: f"\\u{ord(match[0]):04x}", text)


@cache
def asset(name: str) -> str:
    """A file of the folder ``web``."""
    return files("habitus.report.web").joinpath(name).read_text("utf-8")


@cache
def _styles(more: tuple[str, ...]) -> str:
    sheets = "".join(map(asset, ("page.css", "page_parts.css", *more)))
    return sheets.replace("@dark", asset("page_dark.css"))


@cache
def _script(names: tuple[str, ...]) -> str:
    text = "\n".join(map(asset, names))
    if re.search(r"</script", text, re.IGNORECASE):
        raise ValueError("a page's script contains a closing script tag")
    return text


def heading(title: object, facts: Iterable[str]) -> str:
    """Title of the page, and under it facts in one line."""
    return (
        f"<h1>{escape(shown(title, MAX_NAME))}</h1>\n"
        f"<p class='facts'>{escape(' · '.join(facts))}</p>\n"
    )


def banner(verdict: Mapping[str, Any]) -> str:
    """A verdict and its reasons, in its colour, and the levels of parts that differ from it."""
    level = verdict["level"]
    parts = verdict.get("parts") or {}
    named = " · ".join(
        f"<span class='{part['level']}'>{escape(name)} {escape(part['level'])}</span>"
        for name, part in parts.items()
    )
    differ = any(part["level"] != level for part in parts.values())
    by_part = f"<p class='parts'>{named}</p>" if differ else ""
    items = "".join(
        f"<li>{escape(shown(reason, MAX_REASON))}</li>" for reason in verdict["reasons"]
    )
    role = "status" if level == "good" else "alert"
    return (
        f"<div class='banner {level}' role='{role}'>"
        f"<strong>{VERDICTS[level]}</strong>{by_part}<ul>{items}</ul></div>\n"
    )


def tiles(rows: Iterable[Tile]) -> str:
    """The most important numbers."""
    form = "<div><dt>{}</dt><dd>{} <small>{}</small></dd><dd>{}</dd></div>"
    return f"<dl class='tiles'>{''.join(form.format(*map(escape, row)) for row in rows)}</dl>"


def measurement_tiles(
    measurements: Mapping[str, float], labels: Mapping[str, str]
) -> Iterable[Tile]:
    """A tile for each length of ``labels`` (name -> label) that was measured."""
    for name, label in labels.items():
        if name in measurements:
            yield label, f"{100 * measurements[name]:.1f}", "cm", DEFINITIONS[name].says


def card(title: str, inside: str, lead: str = "") -> str:
    """A section with a heading, a sentence under it, and ``inside``, which is HTML."""
    sentence = f"<p class='lead'>{escape(lead)}</p>" if lead else ""
    return f"<section class='card'><h2>{escape(title)}</h2>{sentence}{inside}</section>"


def columns(*cards: str) -> str:
    """Cards beside each other where the window is wide enough."""
    return f"<div class='columns'>{''.join(cards)}</div>"


def numbers_table(rows: Iterable[Sequence[str]], heads: Sequence[str] = ()) -> str:
    """A table whose first column names the row and whose other columns are numbers."""
    top = "".join(
        f"<th scope='col'{_column_class(k)}>{escape(head)}</th>" for k, head in enumerate(heads)
    )
    lines = (
        f"<tr><th scope='row'>{escape(row[0])}</th>"
        + "".join(f"<td class='number'>{escape(cell)}</td>" for cell in row[1:])
        + "</tr>"
        for row in rows
    )
    head = f"<thead><tr>{top}</tr></thead>" if heads else ""
    return f"<table>{head}<tbody>{''.join(lines)}</tbody></table>"


def _column_class(column: int) -> str:
    return " class='number'" if column else ""


def measurements_table(measurements: Mapping[str, float]) -> str:
    """Measurements of a person, with their names in ISO standards; definitions show on hovering."""
    rows = "".join(
        f"<tr><th scope='row' title='{escape(DEFINITIONS[name].says)}'>"
        f"{escape(measurement_name(name))}</th><td>{escape(DEFINITIONS[name].iso)}</td>"
        f"<td class='number'>{measurement_text(name, value)}</td></tr>"
        for name, value in measurements.items()
    )
    head = (
        "<tr><th scope='col'>Measurement</th><th scope='col'>ISO</th>"
        "<th scope='col' class='number'>Value</th></tr>"
    )
    return f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>"


def measurement_name(key: str) -> str:
    """ "waist_circumference_m" as "Waist circumference"."""
    key = plain_measurement(key)
    for unit in ("_l", "_years"):
        key = key.removesuffix(unit)
    return key.replace("_", " ").capitalize()


def measurement_text(key: str, value: Any) -> str:
    """A measurement with its unit, which its name ends in; lengths in cm."""
    if not isinstance(value, (int, float)):
        return str(value)
    if key.endswith("_years"):
        return f"{value:g} years"
    return f"{value:.3g}" if plain_measurement(key) == key else shown_measurement(key, value)


def solution_card(
    status: str,
    costs: Mapping[str, float],
    names: Mapping[str, str],
    stages: Mapping[str, str] = MappingProxyType({}),
    rows: Iterable[Sequence[str]] = (),
) -> str:
    """The solver's status and the final cost of each term of the energy, and other ``rows`` between
    them. ``names`` are the terms' names in words, ``stages`` the words for prefixes of the terms.
    """
    cells = [("Status", STATUSES.get(status, status))] if status else []
    table = numbers_table([*cells, *rows])
    terms = [(_term(key, names, stages), f"{value:,.4g}") for key, value in costs.items()]
    sums = f"<h3>Cost of each term</h3><p class='lead'>{COSTS_LEAD}</p>{numbers_table(terms)}"
    return card("Solution", table + (sums if terms else ""))


def _term(key: str, names: Mapping[str, str], stages: Mapping[str, str]) -> str:
    prefix = next((start for start in stages if key.startswith(start)), "")
    name = key.removeprefix(prefix)
    text = names.get(name, shown(name, MAX_NAME).replace("_", " "))
    return f"{stages[prefix]}: {text[:1].lower()}{text[1:]}" if prefix else text


def notes_list(notes: Iterable[str]) -> str:
    """Notes, a sentence each."""
    items = "".join(f"<li>{escape(shown(text, MAX_NOTE))}</li>" for text in notes)
    return f"<ul>{items or '<li>Nothing.</li>'}</ul>"


def file_links(descriptions: Mapping[str, str]) -> str:
    """Links to the files beside the page, each with a description; empty where there are none."""
    items = "".join(
        f"<li><a href='{escape(quote(name))}'{'' if name == 'obj' else ' download'}>"
        f"{escape(name)}</a> <span>{escape(text)}</span></li>"
        for name, text in descriptions.items()
    )
    return f"<ul class='files' aria-label='Files beside this page'>{items}</ul>" if items else ""


def image_uri(content: bytes) -> str:
    """A PNG file's content as part of a page."""
    return "data:image/png;base64," + base64.b64encode(content).decode("ascii")


def figure(caption: str, *contents: bytes, bold: str = "", alt: str = "") -> str:
    """Pictures (contents of PNG files) with a caption that may begin with a bold name."""
    images = "".join(
        f"<img alt='{escape(alt or caption)}' src='{image_uri(content)}'>" for content in contents
    )
    name = f"<b>{escape(bold)}</b>" if bold else ""
    return f"<figure>{images}<figcaption>{name}{escape(caption)}</figcaption></figure>"


MISSING = 65535
"""The 16-bit value of a coordinate that is not known."""


class Blob:
    """Collects named arrays; ``contents`` says how to read each of them back."""

    def __init__(self) -> None:
        self.contents: dict[str, dict[str, Any]] = {}
        self._chunks: list[bytes] = []
        self.size = 0

    def add(self, name: str, array: np.ndarray, steps: bool = False, **facts: Any) -> None:
        """Add an array of u1, i1, u2, i2, u4 or f4.

        ``steps`` stores integers of one or two bytes as the differences of neighbouring rows, which
        compress better where these are similar; ``facts`` are added to the table of contents.
        """
        data = np.ascontiguousarray(array)
        kind = data.dtype.newbyteorder("<").str[1:]
        if kind not in ("u1", "i1", "u2", "i2", "u4", "f4"):
            raise TypeError(
                f"{name} is {data.dtype}; the report's script reads u1, i1, u2, i2, u4 and f4"
            )
        entry = {"type": kind, "shape": list(data.shape), "start": self.size}
        self.contents[name] = entry | ({"steps": True} if steps else {}) | facts
        padded = (
            _row_steps(data)
            if steps
            else data.astype(data.dtype.newbyteorder("<"), copy=False).tobytes()
        )
        padded += b"\0" * (-len(padded) % 4)
        self._chunks.append(padded)
        self.size += len(padded)

    def add_points(
        self, name: str, points: np.ndarray, low: np.ndarray, high: np.ndarray, steps: bool = False
    ) -> None:
        """Add points (…, 3), quantised to 16 bits an axis between ``low`` and ``high`` (3,) and
        clipped there; points with NaN become MISSING.
        """
        step = np.maximum(high - low, 1e-6) / (MISSING - 1)
        with np.errstate(invalid="ignore"):
            levels = np.clip(np.round((points - low) / step), 0, MISSING - 1)
        missing = ~np.isfinite(points).all(axis=-1, keepdims=True)
        self.add(
            name,
            np.where(missing, MISSING, levels).astype("u2"),
            steps,
            low=low.tolist(),
            step=step.tolist(),
        )

    def base64(self) -> str:
        """All arrays as one text; level 4 takes half the time of level 6 for 1 % more bytes."""
        return base64.b64encode(zlib.compress(b"".join(self._chunks), 4)).decode("ascii")


def _row_steps(data: np.ndarray) -> bytes:
    """Differences of rows (modulo the type's range), the low bytes of all before the high bytes,
    which compresses well.
    """
    whole = data.view(f"u{data.itemsize}").reshape(len(data), -1)
    steps = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1])).astype(f"<u{data.itemsize}")
    return steps.reshape(-1, 1).view("u1").T.tobytes()
