"""Names and labels out of files stay text in every page: in Chromium none of them runs as a script or
becomes an element, whatever is clicked.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from browser import chromium
from injection import FILE_NAME, HOSTILE, TEXTS, ran
from page_samples import depth_fit, registered
from synthetic_fit import synthetic_fit
from tube_people import written_tubes

from habitus.fit.markers.suspects import Suspect
from habitus.jobs.evaluate import evaluate
from habitus.jobs.evaluation_files import evaluation_numbers
from habitus.parallel.workers import Threads
from habitus.report import write_index, write_report
from habitus.report.archive import write_archive_page
from habitus.report.comparison.differences import differences
from habitus.report.comparison.numbers import numbers as comparison_numbers
from habitus.report.comparison.page import comparison_page
from habitus.report.evaluation.figures import figures
from habitus.report.evaluation.page import Picture, training_page
from habitus.report.registration import scan_page
from habitus.report.rgbd import rgbd_page
from habitus.results.save import scan_metrics


def spoilt_fit():
    labels = tuple(f"{TEXTS[k % len(TEXTS)]}{k}" for k in range(12))
    return synthetic_fit(
        frames=8, labels=labels, capture_name=HOSTILE, layout_name=HOSTILE, body_name=HOSTILE,
        warnings=TEXTS, status=HOSTILE, settings={HOSTILE: HOSTILE}, recorded={HOSTILE: HOSTILE},
        costs={HOSTILE: 1.0}, suspects=(Suspect(labels[0], HOSTILE, 3),),
    )  # fmt: skip


def fit(folder: Path) -> Path:
    write_report(spoilt_fit(), folder / "page.html")
    return folder / "page.html"


def compare(folder: Path) -> Path:
    one = spoilt_fit()
    found = differences(one, one)
    names = (HOSTILE, TEXTS[2])
    links = (f"javascript:{TEXTS[0]}", FILE_NAME)
    page = comparison_page(found, comparison_numbers(found, names), names, links)
    (folder / "page.html").write_text(page, "utf-8")
    return folder / "page.html"


def register(folder: Path) -> Path:
    made = registered(HOSTILE)
    found = scan_metrics(made) | {"body": HOSTILE, "up_axis": HOSTILE, "status": HOSTILE}
    found |= {"verdict": {"level": "doubtful", "reasons": list(TEXTS)}, "costs": {HOSTILE: 1.0}}
    (folder / "page.html").write_text(scan_page(made, found), "utf-8")
    return folder / "page.html"


def rgbd(folder: Path) -> Path:
    (folder / "page.html").write_text(rgbd_page(*depth_fit(HOSTILE)), "utf-8")
    return folder / "page.html"


def archive(folder: Path) -> Path:
    row = {
        "path": HOSTILE, "person": HOSTILE, "folder": FILE_NAME, "subject": HOSTILE, "frames": 9,
        "rate_hz": 100.0, "picture": None, "state": "done", "reason": "",
        "numbers": {
            "verdict": {"level": "doubtful", "reasons": list(TEXTS)}, "layout": HOSTILE,
            "marker_error_mm": {"pose": {"mean": 1.0, "p95": 2.0}, "soft_tissue": None},
            "frames": 9, "rate_hz": 100.0, "markers": 41, "body_measurements": {"height_m": 1.7},
            "suspect_markers": [{"label": text, "reason": HOSTILE, "frames": 1} for text in TEXTS],
        },
    }  # fmt: skip
    failed = {**row, "state": "failed", "reason": HOSTILE, "numbers": {}, "path": TEXTS[1]}
    person = {"name": HOSTILE, "measured": {"height_m": 1.7}, "picture": None}
    write_archive_page(folder / "page.html", HOSTILE, iter([row, failed]), [person], 2)
    return folder / "page.html"


def index(folder: Path) -> Path:
    for name in (FILE_NAME, "second"):
        (folder / name).mkdir()
        (folder / name / "report.html").write_text("")
        verdict = {"level": "failed", "reasons": list(TEXTS)}
        found = {"layout": HOSTILE, "verdict": verdict, "capture": HOSTILE, "body": HOSTILE}
        (folder / name / "metrics.json").write_text(json.dumps(found))
    page = write_index(folder)
    assert page is not None
    return page


def evaluation(folder: Path) -> Path:
    paths = written_tubes(folder)
    found = evaluate(
        [paths["tubes"]], paths["noisy"], folder / "out", counts=(1, 2), repeats=1,
        workers=Threads(1),
    )  # fmt: skip
    first = found.models[0]
    shape = replace(first.shape, registrations=tuple(HOSTILE for _ in first.shape.registrations))
    model = replace(first, model=replace(first.model, label=HOSTILE), shape=shape)
    numbers = evaluation_numbers(replace(found, dataset=HOSTILE, models=(model,)))
    picture = Picture("worst fits", HOSTILE, "x.png", HOSTILE, b"", (0.0, 1.0))
    page = training_page(numbers, figures(numbers), [picture])
    (folder / "page.html").write_text(page, "utf-8")
    return folder / "page.html"


PAGES = (fit, compare, register, rgbd, archive, index, evaluation)


@pytest.mark.parametrize("make", PAGES, ids=lambda make: make.__name__)
def test_no_text_becomes_a_script_or_an_element(make: Callable[[Path], Path], tmp_path):
    chromium()
    assert ran(make(tmp_path), tmp_path) == []


def test_the_probe_sees_a_page_that_does_not_escape(tmp_path):
    chromium()
    for text in (*TEXTS[:5], TEXTS[6]):
        page = (
            f"<html><head><title>a</title></head><body><input value='{text}'>{text}</body></html>"
        )
        (tmp_path / "page.html").write_text(page, "utf-8")
        assert ran(tmp_path / "page.html", tmp_path), text
