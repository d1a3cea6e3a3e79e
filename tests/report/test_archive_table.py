"""Page, table and manifest of an archive say the same."""

import json
import re

import duckdb
import pytest
from synthetic_fit import synthetic_fit

from habitus.report.archive import write_archive_page, write_table
from habitus.results.save import finite, marker_metrics


@pytest.fixture(scope="module")
def rows():
    """Two captures that were fitted, one that was not."""
    plain = finite(marker_metrics(synthetic_fit(frames=20)))
    marked = plain | {
        "suspect_markers": [{"label": "a'b", "reason": "ghost", "frames": 3, "corrected": False}]
    }
    marked |= {"warnings": ['odd "words", \n and lines'], "age_years": 8.0}
    base = {
        "person": "",
        "subject": "ann",
        "state": "done",
        "reason": "",
        "frames": 20,
        "rate_hz": 120.0,
        "seconds": 1.0,
    }
    return [
        base | {"path": "a.c3d", "folder": "a", "numbers": plain, "picture": b"x"},
        base | {"path": "b's.c3d", "folder": "b's", "numbers": marked, "picture": b"x"},
        base
        | {
            "path": "c.c3d",
            "folder": "c",
            "state": "failed",
            "reason": "no",
            "numbers": {},
            "picture": None,
        },
    ]


def test_every_number_is_in_the_table(rows, tmp_path):
    write_table(tmp_path / "it's.parquet", iter(rows))
    table = duckdb.read_parquet(str(tmp_path / "it's.parquet"))
    found = [dict(zip(table.columns, row, strict=True)) for row in table.fetchall()]
    assert [row["capture"] for row in found] == ["a.c3d", "b's.c3d", "c.c3d"]
    for given, row in zip(rows[:2], found, strict=False):
        numbers = given["numbers"]
        pose = numbers["marker_error_mm"]["pose"]
        assert row["marker_error_mm.pose.mean"] == pose["mean"] and row["frames"] == 20
        assert row["marker_error_mm.pose.per_marker"] == pose["per_marker"]
        assert row["body_measurements.height_m"] == numbers["body_measurements"]["height_m"]
        assert (
            row["verdict.level"] == numbers["verdict"]["level"]
            and row["warnings"] == numbers["warnings"]
        )
        assert (
            row["suspect_markers"] == numbers["suspect_markers"]
            and row["age_years"] == numbers["age_years"]
        )
    assert (found[2]["state"], found[2]["reason"], found[2]["marker_error_mm.pose.mean"]) == (
        "failed",
        "no",
        None,
    )
    assert {path.name for path in tmp_path.iterdir()} == {"it's.parquet"}


def test_page_and_table_tell_the_same(rows, tmp_path):
    write_table(tmp_path / "all.parquet", rows)
    write_archive_page(tmp_path / "index.html", "all", rows, [], 3)
    text = (tmp_path / "index.html").read_text("utf-8")
    shown = json.loads(re.search(r'id="captures-data">(.*?)</script>', text, re.DOTALL)[1])
    sql = (
        'SELECT capture, coalesce("marker_error_mm.soft_tissue.mean", '
        '"marker_error_mm.pose.mean"), frames FROM'
    )
    told = duckdb.sql(f"{sql} '{tmp_path / 'all.parquet'}'").fetchall()
    assert [row[0] for row in shown] == [row[0] for row in told]
    for row, (_, mean, frames) in zip(shown[:2], told, strict=False):
        assert row[5] == pytest.approx(mean, abs=0.006) and row[7] == frames
    assert shown[2][3] == "not fitted" and shown[2][4] == ["no"]
