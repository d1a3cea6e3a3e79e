"""The page of an archive in a real browser: thousands of rows, sorted and filtered; nothing in a
name can spoil it.
"""

import json
import re
from html import unescape

import numpy as np
import pytest
from browser import visit

from habitus.export.png import small_png
from habitus.report.archive import MAX_PICTURES, palette, write_archive_page

COUNT = 3000
NASTY = "</script><script>alert(1)</script><b>&'\u202e"
DOT = small_png(np.ones((2, 3), np.uint8), palette())


def capture(k: int) -> dict:
    """Every tenth is doubtful, every hundredth could not be fitted; errors grow."""
    row = {
        "path": f"s{k % 40}/c{k:04d}.c3d",
        "person": "",
        "folder": f"s{k % 40}/c{k:04d}",
        "subject": f"s{k % 40}",
    }
    row |= {
        "frames": 100 + k,
        "rate_hz": 100.0,
        "picture": DOT,
        "state": "done",
        "reason": "",
        "numbers": {},
    }
    if k % 100 == 99:
        return row | {"state": "failed", "reason": f"{NASTY} {k}", "picture": None}
    level, reasons = ("doubtful", [f"a hip seen by nobody {k}"]) if k % 10 == 5 else ("good", [])
    errors = {"pose": {"mean": k / 100, "p95": k / 50}, "soft_tissue": None}
    numbers = {
        "verdict": {"level": level, "reasons": reasons},
        "marker_error_mm": errors,
        "frames": 100 + k,
    }
    body = {"height_m": 1.7, "mass_kg": 70.0}
    more = {
        "rate_hz": 100.0,
        "markers": 41,
        "suspect_markers": [],
        "body_measurements": body,
        "layout": "cmu-41",
    }
    return row | {"numbers": numbers | more}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Three thousand captures of forty subjects."""
    path = tmp_path_factory.mktemp("archive") / "index.html"
    subjects = [
        {"name": f"s{k}", "measured": {"height_m": 1.5 + k / 100}, "picture": DOT}
        for k in range(40)
    ]
    write_archive_page(path, NASTY, map(capture, range(COUNT)), subjects, COUNT)
    return path


STEPS = """
<script>
const told = [], one = query => document.querySelector(query), all = query => document.querySelectorAll(query);
const count = () => +document.body.dataset.shown, first = () => one('#rows th').textContent;
const shot = what => told.push([what, count(), first(), all('#rows tr').length]);
const click = (query, k = 0) => all(query)[k].click();
const type = (id, text) => { one(id).value = text; one(id).dispatchEvent(new Event('input')); };
shot('address');
told.push([...one('#rows tr').cells].map(cell => cell.textContent));
click('#reset'); shot('all');
click('#heads button', 3); click('#heads button', 3); shot('worst');
click('[data-level="doubtful"]'); shot('doubtful');
type('#least', '20'); shot('from 20 mm');
type('#subject', 's5'); shot('of s5'); told.push(location.hash);
click('#reset'); type('#search', 's7 c00'); shot('search');
type('#search', 'alert(1)'); shot('reasons');
click('#reset'); click('[data-view="subjects"]'); click('#heads button', 5); shot('subjects');
click('#rows button'); shot('a subject');
document.body.dataset.told = JSON.stringify(told);
</script>
"""


def test_sorting_and_filters_show_what_they_should(page, tmp_path):
    scripted = page.with_name("scripted.html")
    scripted.write_text(page.read_text("utf-8").replace("</body>", STEPS + "</body>"), "utf-8")
    dom = visit(scripted, tmp_path, fragment="levels=doubtful&sort=-error&subject=s35")
    told = json.loads(unescape(re.search(r'data-told="([^"]*)"', dom)[1]))
    row = told.pop(1)
    address = told.pop(6)
    assert row[1:7] == [
        "s35/c2995.c3da hip seen by nobody 2995",
        "s35",
        "doubtful",
        "30.0 mm",
        "59.9 mm",
        "30.9 s",
    ]
    counts = {what: (count, first) for what, count, first, _ in told}
    assert max(drawn for *_, drawn in told) < 60  # of thousands, those in sight
    assert counts["address"] == (75, "s35/c2995.c3da hip seen by nobody 2995")
    assert counts["all"] == (COUNT, "s0/c0000.c3d") and counts["worst"] == (COUNT, "s38/c2998.c3d")
    assert (counts["doubtful"][0], counts["from 20 mm"][0]) == (300, 100)
    assert counts["of s5"][0] == sum(
        k % 10 == 5 and k % 40 == 5 and k >= 2000 for k in range(COUNT)
    )
    assert set(address[1:].split("&")) == {
        "sort=-error",
        "levels=doubtful",
        "least=20",
        "subject=s5",
    }
    assert counts["search"][0] == sum("c00" in f"c{k:04d}" and k % 40 == 7 for k in range(COUNT))
    assert counts["reasons"][0] == 30 and NASTY[:8] in counts["reasons"][1]
    assert counts["subjects"] == (40, "s0") and counts["a subject"][0] == 75


def test_nothing_is_fetched_and_pictures_end_where_a_page_would_be_too_large(page, tmp_path):
    text = page.read_text("utf-8")
    assert not re.search(r"https?://(?!www\.w3\.org)", text) and text.count("<script") == 3
    assert text.count("iVBOR") == COUNT - 30 + 40
    write_archive_page(tmp_path / "index.html", "x", [capture(1)], [], MAX_PICTURES + 1)
    assert "iVBOR" not in (tmp_path / "index.html").read_text("utf-8")
