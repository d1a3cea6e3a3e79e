"""CITATION.cff says what the package says."""

import re
from pathlib import Path

import habitus

FILE = Path(__file__).parents[1] / "CITATION.cff"


def test_the_citation_is_of_this_version_and_names_the_three_papers():
    text = FILE.read_text("utf-8")
    assert re.search(r"^version: (.+)$", text, re.MULTILINE)[1] == habitus.__version__
    own, references = text.split("references:")
    assert "name: The habitus developers" in own and "given-names" not in own
    assert (
        re.findall(r"year: (\d+)", references) == ["2014", "2015", "2017"]
        and references.count("title:") == 3
    )
