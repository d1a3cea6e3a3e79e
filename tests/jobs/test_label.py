"""A capture whose labels were taken away gets them back, as a file, with a report; what cannot be
is refused.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.fit.labels.settings import LabelSettings
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import read_capture
from habitus.jobs.label import label
from habitus.jobs.options import MoshOptions


def test_a_real_capture_gets_its_labels_back_by_another_one(shared: Path, tmp_path: Path) -> None:
    named = read_capture(shared / "mocap" / "testsample.c3d")[:60]
    order = np.random.default_rng(0).permutation(len(named.labels))
    raw = replace(
        named,
        labels=tuple(f"*{k}" for k in range(len(order))),
        markers=np.array(named.markers[:, order]),
        name="raw",
    )
    write_c3d(raw, tmp_path / "raw.c3d")
    found = label(
        tmp_path / "raw.c3d", tmp_path / "out.c3d", like=shared / "mocap" / "testsample.c3d"
    )
    again = read_capture(tmp_path / "out.c3d")
    report = json.loads((tmp_path / "out.labels.json").read_text())
    right = [
        np.nanmax(np.abs(again.markers[:, again.labels.index(name)] - named.markers[:, column]))
        < 1e-4
        for column, name in enumerate(named.labels)
        if name in again.labels
    ]
    assert len(right) >= 0.95 * len(named.labels) and np.mean(right) > 0.95
    assert again.rate_hz == named.rate_hz and report["like"] == "testsample"
    assert found.summary == report["summary"] and "labelled" in found.summary
    assert report["points"] == sum(piece["points"] for piece in report["tracklets"])
    solved = report["convergence"]
    assert solved["status"] in ("converged", "iterations") and solved["iterations"] > 0
    assert 0 < solved["converged_frames"] <= solved["registered_frames"]
    assert found.capture().labels == again.labels


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"min_confidence": 2.0}, "expected a confidence of 0 to 1"),
        ({"layout": "no-such"}, "no layout 'no-such'"),
        ({"out": "out.txt"}, "ends in .c3d or .trc"),
        ({"settings": LabelSettings(min_points=50)}, "expected at least 50"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path: Path, options: dict, words: str) -> None:
    raw = tmp_path / "raw.c3d"
    points = (
        np.random.default_rng(0).uniform(0, 1.8, size=(5, 40, 3))
        + 0.001 * np.arange(5)[:, None, None]
    )
    capture = read_capture_like(points)
    write_c3d(capture, raw)
    with pytest.raises(HabitusError, match=words):
        label(raw, **{"layout": "cmu-41"} | options)


def read_capture_like(points: np.ndarray):
    from habitus.io.captures.read import Capture

    return Capture("raw", tuple(f"*{k}" for k in range(points.shape[1])), points, 100.0, "+z")


def test_labels_come_from_the_file_or_are_found() -> None:
    MoshOptions(label="auto")
    with pytest.raises(HabitusError, match="expected 'given' or 'auto'"):
        MoshOptions(label="guess")


def test_the_command_tells_an_example(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["label", "--help"])
    assert "--like static_labelled.c3d" in " ".join(capsys.readouterr().out.split())
