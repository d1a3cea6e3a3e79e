"""What a fit is given: samples that no body can reach never get into it."""

import numpy as np
import planted as p
import pytest

from habitus.fit.markers.recordings import Recording, without_outliers

LABELS = tuple("abcdefgh")


def recorded(observed):
    return Recording("made-up", observed, 100.0)


@pytest.fixture
def observed():
    return np.random.default_rng(0).normal(size=(30, 8, 3)) * 0.5 + [3.0, -200.0, 1.0]


def test_samples_beyond_reach_are_left_out_and_named(observed):
    wild = observed.copy()
    wild[4:7, 2], wild[9, 5] = 1e6, [3.0, -200.0, 40.0]
    found = without_outliers(recorded(wild), LABELS)
    gone = np.isnan(found.observed[..., 0])
    assert gone.sum() == 4 and gone[4:7, 2].all() and gone[9, 5]
    assert [(s.label, s.frames) for s in found.suspects] == [
        ("c", 3),
        ("f", 1),
    ] and "4 samples" in found.warnings[0]
    np.testing.assert_array_equal(found.observed[~gone], observed[~gone])


@pytest.mark.parametrize("scale", [1.0, 0.1, 10.0])
def test_sound_samples_of_any_unit_and_gaps_are_left_alone(observed, scale):
    observed[3], observed[:, 1], observed[5, :6] = np.nan, np.nan, np.nan
    given = recorded(scale * observed)
    assert without_outliers(given, LABELS) is given


def test_a_marker_a_thousand_kilometres_away_does_not_take_the_body_along():
    clean = p.plant(frames=16)
    wild = clean.observed.copy()
    wild[:, clean.column("LKNE")] = 1e6
    wild[7, clean.column("C7")] = -1e6
    fit = p.fit(clean, wild, p.settings(annealing=(10.0,), frames=2, soft_tissue=False))
    assert np.nanmax(fit.errors_mm) < 30 and np.abs(fit.trans - clean.trans).max() < 0.1
    assert {"LKNE", "C7"} <= {suspect.label for suspect in fit.suspects}
