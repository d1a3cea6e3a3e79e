"""`layout="discover"`: what is found is fitted and written beside the fit; what is not decided is
doubtful.
"""

import numpy as np
import pytest
from planted import person, plant

import habitus as hb
from habitus.errors import HabitusError
from habitus.fit.discover.result import Discovery
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.jobs.subjects import known_labels
from habitus.markers.layouts import MarkerLayout

HASTY = MoshSettings(annealing=(10.0,), frames=3)


@pytest.fixture(scope="module")
def planted():
    return plant(frames=8)


@pytest.fixture(scope="module")
def capture(planted):
    labels = tuple(f"m{k}" for k in range(len(planted.layout)))
    return Capture("walk", labels, planted.observed, 30.0, "+y")


@pytest.fixture(autouse=True)
def found(planted, capture, monkeypatch):
    """A discovery that is done at once: these tests ask what becomes of it."""
    from dataclasses import replace

    markers = tuple(
        replace(marker, label=label, aliases=(), optional=False, confidence=0.8)
        for label, marker in zip(capture.labels[1:], planted.layout.markers[1:], strict=True)
    )
    result = Discovery(
        MarkerLayout("discovered", markers),
        {"m0": "lies off the body"},
        ("Left and right are not decided.",),
        ("a note",),
    )
    monkeypatch.setattr("habitus.fit.discover.recipe.discover", lambda *known: result)
    return result


def test_what_was_found_is_fitted_written_and_fits_again(capture, found, tmp_path):
    fit = hb.Mosh(layout="discover", soft_tissue="none", settings=HASTY).fit(
        capture, person(), out=tmp_path
    )
    assert fit.labels == found.layout.labels and fit.layout_confidence == pytest.approx(0.8)
    file = tmp_path / "walk" / "layout.toml"
    assert set(load_layout(file).markers) == set(found.layout.markers)
    assert "layout.toml" in (tmp_path / "walk" / "report.html").read_text("utf-8")
    again = hb.Mosh(layout=file, soft_tissue="none", settings=HASTY).fit(capture, person())
    np.testing.assert_allclose(again.pose, fit.pose, atol=1e-9)
    assert again.discovered_layout == "" and again.doubts == ()


def test_what_is_not_decided_makes_a_fit_doubtful_and_is_kept_with_it(capture, found, tmp_path):
    fit = hb.Mosh(layout="discover", soft_tissue="none", settings=HASTY).fit(
        capture, person(), out=tmp_path
    )
    assert fit.verdict.level != "good" and found.doubts[0] in fit.verdict.reasons
    read = hb.load_fit(tmp_path / "walk" / "body.npz", person())
    assert read.doubts == fit.doubts and read.verdict.level == fit.verdict.level
    assert "a note" in fit.warnings


@pytest.mark.parametrize("asked", [{"hold_out": ("m3",)}, {"hold_out_every": 5}])
def test_markers_that_tell_their_own_places_cannot_be_held_out(capture, asked):
    with pytest.raises(
        HabitusError, match=r"each determines its own place; fit again with the layout.toml"
    ):
        hb.Mosh(layout="discover", **asked).fit(capture, person())


def test_labels_that_layouts_know_help_and_others_do_not(planted):
    known = known_labels((*planted.layout.labels, "XYZ1"), person())
    assert set(known) == set(planted.layout.labels) and known["C7"].landmark == "c7"
    assert not known_labels(tuple(f"m{k}" for k in range(20)), person())
