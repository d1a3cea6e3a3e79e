"""The index over several captures: it grows with each run, and nothing in a folder of results can
spoil it.
"""

import json
import re
from html import unescape
from urllib.parse import unquote

import pytest
from synthetic_fit import synthetic_fit

from habitus.errors import HabitusError
from habitus.report import write_index
from habitus.results.save import marker_metrics, write_json

NASTY = "</td><script>alert(1)</script>\u202e&'\x1b"


def result(folder, numbers) -> None:
    folder.mkdir(parents=True)
    (folder / "report.html").write_text("")
    (folder / "metrics.json").write_text(
        numbers if isinstance(numbers, str) else json.dumps(numbers)
    )


def rows(page: str) -> list[list[str]]:
    found = re.findall(r"<tr>(.*?)</tr>", page.split("<tbody>")[1], re.DOTALL)
    return [
        [unescape(re.sub("<[^>]*>", "", cell)) for cell in re.findall(r"<t[hd].*?</t[hd]>", row)]
        for row in found
    ]


def test_one_row_a_capture_and_it_grows(tmp_path):
    assert write_index(tmp_path) is None and not list(tmp_path.iterdir())
    fit = synthetic_fit(frames=20)
    numbers = marker_metrics(fit) | {
        "verdict": {"level": "doubtful", "reasons": ["a hip seen by nobody"]}
    }
    (tmp_path / "b").mkdir()
    write_json(tmp_path / "b" / "metrics.json", numbers)
    (tmp_path / "b" / "report.html").write_text("")
    page = write_index(tmp_path).read_text("utf-8")
    (row,) = rows(page)
    final = numbers["marker_error_mm"]["soft_tissue"]
    assert row[:6] == [
        "b",
        "doubtful",
        f"{final['mean']:.1f} mm",
        f"{final['p95']:.1f} mm",
        "20 at 120 Hz",
        "12",
    ]
    assert (
        "a hip seen by nobody" in page and 'href="http' not in page and page.count("<script") == 1
    )
    result(tmp_path / "a" / "deeper", {"frames": 3})
    assert [row[0] for row in rows(write_index(tmp_path).read_text("utf-8"))] == ["a/deeper", "b"]


@pytest.mark.parametrize(
    "numbers",
    ["", "[1, 2", "[]", "null", '{"frames": NaN, "marker_error_mm": 3, "verdict": "good", '
                                '"suspect_markers": {}}',
     '{"verdict": {"level": ["x"], "reasons": 5}, "body_measurements": {"height_m": "tall"}}', "[" * 100_000],
)  # fmt: skip
def test_a_spoilt_file_is_a_row_and_no_error(tmp_path, numbers):
    result(tmp_path / "spoilt", numbers)
    result(tmp_path / "sound", {"frames": 7})
    found = rows(write_index(tmp_path).read_text("utf-8"))
    assert [row[0] for row in found] == ["sound", "spoilt"] and found[0][4] == "7"


def test_names_are_safe_and_links_lead_to_their_pages(tmp_path):
    name = "odd name #1 ?<b>&'\u202e\n"
    result(tmp_path / name, {"layout": NASTY, "verdict": {"level": "failed", "reasons": [NASTY]}})
    result(tmp_path / ".half-written", {})
    (tmp_path / "elsewhere").symlink_to(tmp_path / name)
    page = write_index(tmp_path).read_text("utf-8")
    assert (
        page.count("<script") == 1
        and "\x1b" not in page
        and "\u202e" not in page
        and len(rows(page)) == 1
    )
    assert (tmp_path / unquote(unescape(re.search(r"href='(.*?)'", page)[1]))).is_file()


def test_unwritable_folder_is_one_clear_error(tmp_path, monkeypatch):
    result(tmp_path / "a", {})
    (tmp_path / "index.html").mkdir()
    with pytest.raises(HabitusError, match="cannot write"):
        write_index(tmp_path)
