import base64
import json
import re
import zlib
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body

from habitus.errors import HabitusError, shown
from habitus.fit.markers.solution import HeldOut
from habitus.fit.markers.suspects import Suspect
from habitus.parallel import blocks
from habitus.report import write_report
from habitus.report.fit import texts
from habitus.report.fit.page import _ordinal, report_page
from habitus.report.fit.scene import player_stride
from habitus.report.shell import Blob, json_for_script
from habitus.results.save import marker_metrics

NASTY = "</script><script>alert(1)</script><b>&\u2028\"'"


def data_of(page: str) -> dict:
    return json.loads(
        re.search(
            r'<script type="application/json" id="report-data">(.*?)</script>', page, re.DOTALL
        )[1]
    )


def array_of(page: str, name: str) -> np.ndarray:
    text = re.search(
        r'<script type="text/plain" id="report-arrays">(.*?)</script>', page, re.DOTALL
    )[1]
    entry = data_of(page)["arrays"][name]
    count = int(np.prod(entry["shape"]))
    kind = np.dtype(f"<{entry['type']}")
    packed = zlib.decompress(base64.b64decode(text))
    assert len(packed) == data_of(page)["bytes"]
    flat = np.frombuffer(packed, kind, count, entry["start"]).reshape(entry["shape"])
    if entry.get("steps"):
        planes = (
            np.frombuffer(packed, "u1", count * kind.itemsize, entry["start"])
            .reshape(kind.itemsize, -1)
            .T
        )
        steps = np.ascontiguousarray(planes).view(f"<u{kind.itemsize}").reshape(entry["shape"])
        flat = np.cumsum(steps, axis=0, dtype=f"u{kind.itemsize}").view(kind)
    if "step" not in entry:
        return flat
    return np.where(flat == 65535, np.nan, np.array(entry["low"]) + np.array(entry["step"]) * flat)


def test_page_is_alone_and_whole(tmp_path):
    write_report(synthetic_fit(), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text("utf-8")
    assert page.startswith("<!doctype html>") and page.rstrip().endswith("</html>")
    assert (
        not re.search(r"""(?:src|href)\s*=\s*["'](?!data:)""", page)
        and "@import" not in page
        and "url(" not in page
    )
    assert "$" not in re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_held_out_errors_at_known_placements_have_a_column_of_their_own():
    held, told = (HeldOut(("CHIN",), np.full((3, 1), error), None) for error in (0.0321, 0.0054))
    plain, both = (
        report_page(synthetic_fit(3, held_out=held, **more))
        for more in ({}, {"held_out_known_placement": told})
    )
    assert "32.1 mm" in plain and "5.4 mm" not in plain and "known placement" not in plain
    assert "32.1 mm" in both and "5.4 mm" in both and "Pose stage, known placement" in both


def test_strings_cannot_break_out():
    labels = tuple(f"{NASTY}{k}" for k in range(12))
    fit = synthetic_fit(
        labels=labels,
        capture_name=NASTY,
        layout_name=NASTY,
        body_name=NASTY,
        warnings=(NASTY,),
        status=NASTY,
        settings={NASTY: NASTY},
        recorded={NASTY: NASTY},
        costs={NASTY: 1.0},
        suspects=(Suspect(labels[0], NASTY, 3),),
    )
    page = report_page(fit)
    assert "alert(1)</script>" not in page and "<script>alert" not in page
    assert page.count("<script") == 3 and page.count("</script>") == 3
    assert data_of(page)["labels"] == [shown(label) for label in labels]
    assert shown(NASTY) in unescape(page)


@pytest.mark.parametrize("level", ["good", "doubtful", "failed"])
def test_the_verdict_stands_above_everything_else(level):
    fit = synthetic_fit(3)
    numbers = marker_metrics(fit) | {"verdict": {"level": level, "reasons": ["First.", NASTY]}}
    page = report_page(fit, numbers)
    banner = re.search(r"<div class='banner (\w+)'.*?</div>", page, re.DOTALL)
    told = unescape(banner[0])
    assert (
        banner[1] == level and "First." in told and shown(NASTY) in told and "<b>" not in banner[0]
    )
    assert page.index("<h1>") < banner.start() < page.index("<dl class='tiles'>")
    assert f".banner.{level} " in page


@pytest.mark.parametrize("value", ["</script>", "<!--", "]]>", "\u2028\u2029", "&amp;", "ü\\\"'"])
def test_json_in_script_round_trips(value):
    text = json_for_script({value: [value]})
    assert json.loads(text) == {value: [value]} and "<" not in text and "\u2028" not in text


def test_markers_survive_packing():
    fit = synthetic_fit(rate_hz=60.0)
    page = report_page(fit)
    turned = lambda points: points[..., [0, 2, 1]] * [1, 1, -1]  # noqa: E731
    observed = array_of(page, "observed")
    assert np.array_equal(np.isnan(observed), np.isnan(fit.observed_markers))
    assert np.nanmax(np.abs(observed - turned(fit.observed_markers))) < 1e-4
    assert (
        np.abs(array_of(page, "soft_tissue/predicted") - turned(fit.predicted_soft_tissue)).max()
        < 1e-4
    )


def test_ghost_far_away_does_not_cost_precision():
    fit = synthetic_fit(rate_hz=60.0)
    observed = fit.observed_markers.copy()
    observed[3, 3] = [1000.0, 0, 0]
    packed = array_of(report_page(replace(fit, observed_markers=observed)), "observed")
    near = np.delete(packed - observed[..., [0, 2, 1]] * [1, 1, -1], 3, axis=1)
    assert np.nanmax(np.abs(near)) < 1e-4


def test_long_captures_are_thinned_and_say_so():
    page = report_page(synthetic_fit(frames=200, rate_hz=120.0))
    assert data_of(page)["scene"]["stride"] == 2 and data_of(page)["scene"]["rate"] == 60
    assert "every 2nd frame" in page and array_of(page, "observed").shape[0] == 100
    assert array_of(page, "pose/meanError").shape == (200,)
    slow = synthetic_fit(frames=100, rate_hz=50.0)
    assert player_stride(slow, 2) == 1 and "class='note'" not in report_page(slow)


@pytest.mark.parametrize(
    ("stride", "words"),
    [(2, "2nd"), (3, "3rd"), (4, "4th"), (11, "11th"), (321, "321st"), (1312, "1,312th")],
)
def test_strides_are_ordinals(stride, words):
    assert _ordinal(stride) == words


def test_a_page_made_where_memory_is_short_is_the_same(monkeypatch):
    fit = synthetic_fit(frames=200)
    plenty = report_page(fit)
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    monkeypatch.setattr(blocks, "BLOCK", 16)
    short = report_page(fit)
    for name in ("pose/meanError", "soft_tissue/worstError", "visible", "errorMap", "observed"):
        np.testing.assert_array_equal(array_of(short, name), array_of(plenty, name))
    assert data_of(short)["plots"] == data_of(plenty)["plots"]


def test_plots_of_very_long_captures_are_binned():
    fit = synthetic_fit(frames=7000, markers=5, soft=False)
    page = report_page(fit)
    frames = data_of(page)["plots"]["plotFrames"]
    means = array_of(page, "pose/meanError")
    assert len(frames) == len(means) <= 3000 and frames[0] == 0
    errors = 1e3 * fit.errors("pose")
    assert means[0] == pytest.approx(np.nanmean(np.nanmean(errors[: frames[1]], axis=1)), rel=1e-5)


@pytest.mark.parametrize("kind", ["u1", "i1", "u2", "i2"])
def test_steps_between_rows_lose_nothing(kind):
    rng = np.random.default_rng(0)
    bounds = np.iinfo(kind)
    given = rng.integers(bounds.min, bounds.max, (50, 3, 2), dtype=kind, endpoint=True)
    blob = Blob()
    blob.add("first", np.zeros(3, "u1"))
    blob.add("given", given, True)
    page = (
        '<script type="application/json" '
        f'id="report-data">{json.dumps({"arrays": blob.contents, "bytes": blob.size})}'
        f'</script><script type="text/plain" id="report-arrays">{blob.base64()}</script>'
    )
    assert np.array_equal(array_of(page, "given"), given)


def test_blob_refuses_what_the_script_cannot_read():
    with pytest.raises(TypeError, match="float64"):
        Blob().add("x", np.zeros(3))


@pytest.mark.parametrize(
    "changes", [{"soft": False}, {"suspects": (), "warnings": ()}, {"frames": 1}, {"up_axis": "+y"}]
)
def test_variants_write(changes):
    assert 'id="player"' in report_page(synthetic_fit(**({"frames": 12} | changes)))


def test_nothing_seen_still_writes():
    fit = synthetic_fit(frames=5, soft=False, body=tube_body(posedirs=True))
    page = report_page(replace(fit, observed_markers=np.full_like(fit.observed_markers, np.nan)))
    assert texts.NO_MARKERS in page


def test_unwritable_place_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(HabitusError, match="cannot write"):
        write_report(synthetic_fit(frames=2), tmp_path / "file" / "r.html")


def test_unobserved_segments_are_listed_and_packed():
    fit = synthetic_fit(frames=24, markers=110, soft=False)
    arm = fit.latent_markers[:, 0] > 0.3
    blind = replace(fit, marker_weights=np.where(arm, 0.0, fit.marker_weights))
    pages = [report_page(one) for one in (fit, blind)]
    assert ['data-layer="guessed"' in page for page in pages] == [False, True]
    assert "left forearm, left hand" in pages[1] and "left forearm" not in pages[0]
    levels = array_of(pages[1], "guessed")
    names = fit.body.joint_names
    assert (levels[:, names.index("left_elbow")] == 255).all() and not levels[
        :, names.index("right_elbow")
    ].any()
    assert {one["joint"] for one in marker_metrics(blind)["unobserved_segments"]} == {
        "left_elbow",
        "left_wrist",
    }


def test_tapes_lie_where_they_measure():
    fit = synthetic_fit(frames=2)
    page = report_page(fit)
    rest = fit.body.rest_vertices(fit.betas)
    kit = fit.body.measuring_kit
    points = array_of(page, "tapes")
    laid = [ring.tape(rest) for tape in kit.tapes for ring in tape.rings]
    np.testing.assert_allclose(points, np.concatenate(laid), atol=1e-6)
    told = data_of(page)["scene"]["tapes"]
    assert [one["points"] for one in told] == [len(points) for points in laid]
    assert all(f"data-tape='{one['name']}'" in page for one in told)
