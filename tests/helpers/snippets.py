"""Code in the project's pages: commands of a shell and Python, each with its page and line."""

import ast
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    *("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"),
    *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))),
    *("lab/README.md", "benchmarks/README.md", "programs/README.md", "blender/README.md"),
]
_SHELL = re.compile(
    r"(\S*/)?(habitus|pip|pipx|uvx?|python3?|make|dask|OMP_NUM_THREADS=1|export|apptainer"
    r"|podman|kubectl|sbatch|conda|docker|gh|git)\s"
)


@dataclass(frozen=True)
class Snippet:
    """A piece of code: ``kind`` is "shell", "python", the language of its fence, or "text"."""

    page: str
    line: int
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


@cache
def snippets() -> tuple[Snippet, ...]:
    """All code blocks of all pages; indented ones in pieces, split where the kind changes."""
    return tuple(piece for page in PAGES for piece in _of_page(page))


def commands(snippet: Snippet) -> Iterator[tuple[int, str]]:
    """Line number and text of each command of a shell snippet, continued lines joined, without
    comments.
    """
    lines = snippet.text.splitlines()
    at = 0
    while at < len(lines):
        first, whole = at, lines[at]
        while whole.endswith("\\"):
            at += 1
            whole = whole[:-1] + lines[at].strip()
        at += 1
        if bare := re.sub(r"(^|\s+)#.*$", "", whole).strip():
            yield snippet.line + first, bare


@cache
def inline() -> tuple[tuple[str, int, str], ...]:
    """Page, line and text of every `code span`."""
    return tuple(
        (page, (token.map or [0])[0] + 1, " ".join(child.content.split()))
        for page in PAGES
        for token in _tokens(page)
        for child in token.children or ()
        if child.type == "code_inline"
    )


def _tokens(page: str) -> list:
    text = (ROOT / page).read_text(encoding="utf-8")
    return MarkdownIt("commonmark").enable("table").parse(text)


def _of_page(page: str) -> Iterator[Snippet]:
    for token in _tokens(page):
        if token.type == "fence":
            kind = {"bash": "shell", "sh": "shell"}.get(token.info, token.info)
            yield Snippet(page, token.map[0] + 2, kind, token.content)
        elif token.type == "code_block":
            yield from _pieces(page, token.map[0] + 1, token.content)


def _pieces(page: str, line: int, text: str) -> Iterator[Snippet]:
    """An indented block's parts between blank lines; Python that needs them all stays together."""
    if _is_python(text):
        yield Snippet(page, line, "python", text)
        return
    part: list[str] = []
    for number, row in enumerate([*text.splitlines(), ""], line):
        if row.strip():
            part.append(row)
        elif part:
            yield from _by_kind(page, number - len(part), part)
            part = []


def _by_kind(page: str, line: int, rows: list[str]) -> Iterator[Snippet]:
    """Leading commands, and what follows them."""
    count = 0
    while count < len(rows) and (
        _SHELL.match(rows[count]) or (count and rows[count - 1].endswith("\\"))
    ):
        count += 1
    if count:
        yield Snippet(page, line, "shell", "\n".join(rows[:count]))
    if rest := "\n".join(rows[count:]):
        kind = "python" if _is_python(rest) else "text"
        yield Snippet(page, line + count, kind, rest)


def _is_python(text: str) -> bool:
    try:
        return bool(ast.parse(textwrap.dedent(text)).body)
    except SyntaxError:
        return False
