"""Parts that pages share: verdict, tiles, cards, tables, files. Every text from outside is escaped
here.
"""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

from habitus.body.measurement_names import DEFINITIONS
from habitus.errors import shown

VERDICTS = {
    "good": "This fit is good.",
    "doubtful": "This fit is doubtful: look before you use it.",
    "failed": "This fit has failed: do not use it.",
}
LONGEST_REASON = 300
Tile = tuple[str, str, str, str]
"""What a number is, the number, its unit, and more about it."""


def banner(verdict: Mapping[str, Any]) -> str:
    """A verdict and its reasons, in its colour."""
    level = verdict["level"]
    items = "".join(
        f"<li>{escape(shown(reason, LONGEST_REASON))}</li>" for reason in verdict["reasons"]
    )
    role = "status" if level == "good" else "alert"
    return (
        f"<div class='banner {level}' "
        f"role='{role}'><strong>{VERDICTS[level]}</strong><ul>{items}</ul></div>\n"
    )


def tiles(those: Iterable[Tile]) -> str:
    """The numbers that are read first."""
    form = "<div><dt>{}</dt><dd>{} <small>{}</small></dd><dd>{}</dd></div>"
    return f"<dl class='tiles'>{''.join(form.format(*map(escape, one)) for one in those)}</dl>"


def card(title: str, inside: str, lead: str = "") -> str:
    """A section with a heading and, under it, a sentence that says what is seen; ``inside`` is
    HTML.
    """
    told = f"<p class='lead'>{escape(lead)}</p>" if lead else ""
    return f"<section class='card'><h2>{escape(title)}</h2>{told}{inside}</section>"


def numbers_table(rows: Iterable[Sequence[str]], heads: Sequence[str] = ()) -> str:
    """A table whose first column says what the row is and whose others are numbers."""
    top = "".join(f"<th scope='col'{_kind(k)}>{escape(head)}</th>" for k, head in enumerate(heads))
    lines = (
        f"<tr><th scope='row'>{escape(row[0])}</th>"
        + "".join(f"<td class='number'>{escape(cell)}</td>" for cell in row[1:])
        + "</tr>"
        for row in rows
    )
    return f"<table>{f'<thead><tr>{top}</tr></thead>' if heads else ''}<tbody>{''.join(lines)}</tbody></table>"  # noqa: E501


def measurements_table(measurements: Mapping[str, float]) -> str:
    """What a person measures, with the names that standards give it."""
    rows = "".join(
        f"<tr><td>{escape(DEFINITIONS[name].says)}</td><td>{escape(DEFINITIONS[name].iso)}</td><td class='number'>"  # noqa: E501
        + (f"{value:.1f} kg" if name.endswith("_kg") else f"{100 * value:.1f} cm")
        + "</td></tr>"
        for name, value in measurements.items()
    )
    head = (
        "<tr><th scope='col'>What</th><th scope='col'>ISO</th><th scope='col' "
        "class='number'>Value</th></tr>"
    )
    return f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>"


def notes_list(notes: Iterable[str]) -> str:
    """What is to be known, a sentence each."""
    items = "".join(f"<li>{escape(shown(text, 400))}</li>" for text in notes) or "<li>Nothing.</li>"
    return f"<ul>{items}</ul>"


def file_links(files: Mapping[str, str]) -> str:
    """Links to the files that lie beside the page, each with what it is; nothing where there are
    none.
    """
    items = (
        f"<li><a href='{escape(quote(name))}'{'' if name == 'obj' else ' download'}>{escape(name)}</a> "  # noqa: E501
        f"<span>{escape(what)}</span></li>"
        for name, what in files.items()
    )
    return (
        f"<ul class='files' aria-label='Files beside this page'>{''.join(items)}</ul>"
        if files
        else ""
    )


def _kind(column: int) -> str:
    return " class='number'" if column else ""
