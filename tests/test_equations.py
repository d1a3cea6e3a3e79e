"""The table of equations leads to functions that are there, and the glossary to names that the code
has.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PLACES = sorted(
    set(re.findall(r"`([\w/]+\.py):([\w.]+)`", (ROOT / "docs" / "equations.md").read_text()))
)


@pytest.mark.parametrize(("file", "name"), PLACES, ids=lambda part: str(part))
def test_an_equation_is_where_the_table_says(file, name):
    folder = ROOT / "lab" / "src" if file.startswith("habitus_lab/") else ROOT / "src" / "habitus"
    body = ast.parse((folder / file).read_text()).body
    for part in name.split("."):
        found = [node for node in body if getattr(node, "name", None) == part]
        assert found, f"{file} has no {name}"
        body = getattr(found[0], "body", [])


def test_every_equation_of_the_papers_is_in_the_table():
    text = (ROOT / "docs" / "equations.md").read_text()
    tables = dict(re.findall(r"^## (\w+).*?\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE))
    assert _numbers(tables["The"], 0) | _numbers(tables["Learning"], 0) >= {*range(1, 18)}
    assert _numbers(tables["Markers"], 0) >= {*range(1, 12)}


def _numbers(table: str, column: int) -> set[int]:
    """The equations' numbers of a column: 5, 6 and ranges such as 1–13."""
    found: set[int] = set()
    for line in table.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        for part in re.split(r",\s*", cells[column]) if len(cells) > column else ():
            ends = re.fullmatch(r"(\d+)(?:–(\d+))?", part)
            if ends:
                found |= {*range(int(ends[1]), int(ends[2] or ends[1]) + 1)}
    return found
