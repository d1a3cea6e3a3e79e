import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body

from habitus.body.gender import female_probability, said_of
from habitus.fit.markers.result import betas_covariance
from habitus.fit.markers.solution import HeldOut
from habitus.fit.markers.suspects import Suspect
from habitus.parallel import blocks
from habitus.results.save import marker_metrics, write_json

KEYS = {
    *(
        "capture",
        "body",
        "layout",
        "frames",
        "rate_hz",
        "markers",
        "missing_fraction",
        "warnings",
        "gender",
    ),
    *(
        "marker_error_mm",
        "held_out_error_mm",
        "held_out_known_placement_mm",
        "suspect_markers",
        "unobserved_segments",
        "stage_seconds",
        "frames_per_second",
    ),
    *("body_measurements", "verdict", "age_years"),
}


def no_constants(name):
    raise AssertionError(f"{name} is not JSON")


def test_keys_are_those_of_the_design():
    found = marker_metrics(synthetic_fit())
    assert set(found) == KEYS
    assert set(found["stage_seconds"]) == {
        "read",
        "shape",
        "pose",
        "soft_tissue",
        "export",
        "total",
        "startup",
    }
    assert set(found["marker_error_mm"]["pose"]) == {"mean", "median", "p95", "max", "per_marker"}
    assert found["frames_per_second"]["pose"] == pytest.approx(90 / 0.8)


def test_markers_that_were_put_right_are_told_from_those_still_wrong():
    told = marker_metrics(
        synthetic_fit(
            suspects=(Suspect("M02", "fell", 4), Suspect("M03", "put back", 7, corrected=True))
        )
    )
    assert told["suspect_markers"] == [
        {"label": "M02", "reason": "fell", "frames": 4, "corrected": False},
        {"label": "M03", "reason": "put back", "frames": 7, "corrected": True},
    ]


def test_errors_are_distances_over_visible_markers_in_mm():
    observed = np.full((4, 4, 3), np.nan)
    observed[:3, 0] = [[0.001, 0, 0], [0.002, 0, 0], [0, 0, 0.003]]
    observed[0, 1] = [0, 0.006, 0.008]
    fit = synthetic_fit(
        4, 4, soft=False, observed_markers=observed, predicted_pose_stage=np.zeros_like(observed)
    )
    found = marker_metrics(fit)
    error = found["marker_error_mm"]["pose"]
    assert error["mean"] == pytest.approx(4) and error["median"] == pytest.approx(2.5)
    assert error["max"] == pytest.approx(10) and 3 < error["p95"] < 10
    assert error["per_marker"] == pytest.approx(
        {"M00": 2, "M01": 10, "M02": np.nan, "M03": np.nan}, nan_ok=True
    )
    assert (
        found["missing_fraction"] == pytest.approx(0.75)
        and found["marker_error_mm"]["soft_tissue"] is None
    )


def test_never_seen_marker_is_null_in_the_file(tmp_path):
    fit = synthetic_fit()
    observed = fit.observed_markers.copy()
    observed[:, 5] = np.nan
    unseen = replace(fit, observed_markers=observed)
    write_json(tmp_path / "metrics.json", marker_metrics(unseen))
    found = json.loads((tmp_path / "metrics.json").read_text("utf-8"), parse_constant=no_constants)
    assert found["marker_error_mm"]["pose"]["per_marker"]["M05"] is None
    assert found["marker_error_mm"]["pose"]["mean"] > 0


def test_nothing_seen_at_all(tmp_path):
    fit = synthetic_fit(soft=False)
    unseen = replace(fit, observed_markers=np.full_like(fit.observed_markers, np.nan))
    write_json(tmp_path / "m.json", marker_metrics(unseen))
    found = json.loads((tmp_path / "m.json").read_text("utf-8"), parse_constant=no_constants)
    assert found["missing_fraction"] == 1 and found["marker_error_mm"]["pose"]["mean"] is None


def test_held_out_markers_have_their_own_labels():
    held = HeldOut(("CHIN",), np.array([[0.01], [np.nan], [0.03]]), None)
    found = marker_metrics(synthetic_fit(3, held_out=held))["held_out_error_mm"]
    assert found["pose"]["mean"] == pytest.approx(20) and found["pose"][
        "per_marker"
    ] == pytest.approx({"CHIN": 20.0})
    assert found["soft_tissue"] is None


def test_held_out_markers_at_told_places_are_told_beside_them():
    held = HeldOut(("CHIN", "NOSE"), np.array([[0.03, 0.04]]), None)
    told = HeldOut(("CHIN", "NOSE"), np.array([[0.005, np.nan]]), None)
    found = marker_metrics(synthetic_fit(3, held_out=held, held_out_known_placement=told))
    assert found["held_out_error_mm"]["pose"]["mean"] == pytest.approx(35)
    assert found["held_out_known_placement_mm"]["pose"]["mean"] == pytest.approx(5)
    assert marker_metrics(synthetic_fit(3, held_out=held))["held_out_known_placement_mm"] is None


def test_gender_is_a_probability():
    body = replace(tube_body(), female_direction=(np.ones(6), 0.5))
    fit = synthetic_fit(3, body=body)
    found = marker_metrics(fit)["gender"]
    probability = female_probability(body, fit.betas, betas_covariance(fit))
    assert found == {
        "female_probability": probability,
        "decision": said_of(probability),
        "model": "neutral",
    }
    assert marker_metrics(synthetic_fit(3))["gender"] is None


def test_a_fit_with_the_model_of_a_sex_says_why():
    fit = synthetic_fit(3, gender="male")
    assert marker_metrics(fit)["gender"] == {
        "female_probability": None,
        "decision": None,
        "model": "male",
    }
    chosen = replace(fit, female_probability=0.07)
    assert marker_metrics(chosen)["gender"] == {
        "female_probability": 0.07,
        "decision": "male",
        "model": "male",
    }


def test_numbers_are_exact_where_memory_is_short(monkeypatch):
    fit = synthetic_fit()
    plenty = marker_metrics(fit)
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    monkeypatch.setattr(blocks, "BLOCK", 16)
    short = marker_metrics(fit)
    for stage, errors in plenty["marker_error_mm"].items():
        found = short["marker_error_mm"][stage]
        assert {k: found[k] for k in ("mean", "median", "p95", "max")} == {
            k: errors[k] for k in ("mean", "median", "p95", "max")
        }
        assert found["per_marker"] == pytest.approx(errors["per_marker"], rel=1e-12)
    assert short["missing_fraction"] == plenty["missing_fraction"]


def test_suspects_say_whether_they_were_put_right():
    right = SimpleNamespace(label="M01", reason="exchanged", frames=5, corrected=True)
    fit = replace(synthetic_fit(frames=6), suspects=(right, Suspect("M02", "fell", 2)))
    assert [one["corrected"] for one in marker_metrics(fit)["suspect_markers"]] == [True, False]
