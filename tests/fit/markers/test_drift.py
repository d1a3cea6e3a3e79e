"""Markers that slide over the skin are named; those that only share their limb with one are not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from planted import RATE_HZ, attach, fit, plant, rest, settings

from habitus.fit.markers.drift import find_drifts, limb_axes, limb_of, trends
from habitus.fit.markers.settings import DRIFT, MoshSettings, sequence_settings
from habitus.observe.marker_rig import marker_rig
from habitus_lab.population.marker_faults import drifting

QUICK = settings(annealing=(10.0, 1.0), soft_tissue=False)
SCALE = 0.05  # metres


@pytest.fixture(scope="module")
def clean():
    return plant(frames=60)


@pytest.fixture(scope="module")
def attachment(clean):
    return attach(clean.latent_markers, rest(clean.betas), np.asarray(clean.body.faces))


def sliding(planted, attachment, observed, label, way):
    column = planted.column(label)
    axes = limb_axes(planted.body, planted.pose)[:, limb_of(planted.body, attachment)[column]]
    return drifting(observed, column, axes, np.asarray(way))


def named(planted, attachment, observed, rate_hz=RATE_HZ) -> set[str]:
    """Whom the known person's markers accuse; poses start where they are."""
    rig = marker_rig(planted.body, planted.betas, attachment)
    truth = SimpleNamespace(pose=planted.pose, trans=planted.trans)
    scales = np.full(observed.shape[1], SCALE)
    prior = planted.prior.for_joints(planted.body.joint_names)
    lam = sequence_settings(MoshSettings(), warm=True)
    found = find_drifts(planted.body, attachment, rig, observed, scales, rate_hz, prior, truth, lam)
    assert all(0.03 < drift.distance < 0.09 for drift in found)
    return {planted.layout.labels[drift.marker] for drift in found}


def test_a_trend_is_measured_against_its_scatter():
    rng = np.random.default_rng(0)
    frames = 200
    off = 0.004 * rng.normal(size=(frames, 4, 3))
    off[:, 1] += np.linspace(-0.03, 0.03, frames)[:, None] * np.array([0.6, 0.0, 0.8])
    off[:, 2] += 0.03 * np.sin(np.linspace(0, 12, frames))[:, None]
    off[30:60, 1], off[5:, 3] = np.nan, np.nan
    way, steady = trends(off)
    assert abs(way[1] - 0.06 * (1 - 1 / DRIFT.parts)) < 0.01 and steady[1] > 10.0
    assert way[0] < 0.005 and steady[2] < 5.0 and way[3] == 0.0


def test_a_marker_that_is_far_off_has_no_trend():
    off = np.zeros((100, 2, 3))
    off[50:, 0, 2] = 0.5
    assert trends(off)[0][0] == 0.0


@pytest.mark.parametrize("seen", [slice(0, 200), slice(0, 140), slice(80, 200)])
def test_a_marker_that_is_seen_for_a_while_slides_as_far_as_it_would_in_all(seen):
    off = np.full((200, 1, 3), np.nan)
    off[seen, 0] = np.outer(np.linspace(0.0, 1.0, 200)[seen], [0.03, 0.0, -0.04])
    np.testing.assert_allclose(trends(off)[0], 0.05 * (1 - 1 / DRIFT.parts), rtol=0.01)


@pytest.mark.filterwarnings("error")
def test_parts_without_samples_are_no_reason_to_warn():
    off = np.zeros((100, 2, 3))
    off[5:, 0] = np.nan
    assert trends(off)[0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    "ways",
    [
        {},
        {"LWRA": (0.0, 0.045, 0.04)},
        {"T10": (0.06, 0.0, 0.0)},
        {"LFHD": (0.0, 0.06, 0.0)},
        {"LELB": (0.06, 0.0, 0.0), "LSHN": (0.0, 0.05, 0.03)},
        {"RKNE": (0.0, 0.06, 0.0), "RSHN": (0.06, 0.0, 0.0)},
    ],
)
def test_markers_that_slide_are_named_and_nobody_else(clean, attachment, ways):
    observed = clean.observed
    for label, way in ways.items():
        observed = sliding(clean, attachment, observed, label, way)
    assert named(clean, attachment, observed) == set(ways)


def test_a_short_capture_has_no_slow_drift(clean, attachment):
    observed = sliding(clean, attachment, clean.observed, "T10", (0.06, 0.0, 0.0))
    few = replace(clean, pose=clean.pose[:29], trans=clean.trans[:29])
    assert named(few, attachment, observed[:29]) == set()


@pytest.mark.parametrize("frames", [2 * DRIFT.parts - 1, 2 * DRIFT.parts])
def test_a_slow_capture_needs_a_few_frames(clean, attachment, frames):
    some = np.linspace(0, 59, frames).astype(int)
    observed = sliding(clean, attachment, clean.observed, "T10", (0.06, 0.0, 0.0))[some]
    few = replace(clean, pose=clean.pose[some], trans=clean.trans[some])
    assert named(few, attachment, observed, rate_hz=5.0) == (
        {"T10"} if frames == 2 * DRIFT.parts else set()
    )


def test_a_fit_tells_of_it(clean, attachment):
    found = fit(
        clean, sliding(clean, attachment, clean.observed, "RKNE", (0.04, 0.045, 0.0)), QUICK
    )
    assert [suspect.label for suspect in found.suspects] == ["RKNE"]
    told = found.suspects[0]
    assert told.reason.startswith("drift: slid") and told.frames == 60 and not told.corrected
