"""A fit that failed is tried again before it is called so, and says what was done."""

import numpy as np
import planted as p
import pytest

from habitus.fit.markers.attempts import iterate_attempts
from habitus.fit.markers.recipe import Recording, fit_recording, known_subject
from habitus.solve.sequence import Level

WRONG = ("LFHD", "RTOE", "LFIN", "RKNE", "C7", "LHEE", "STRN")
HASTY = p.settings(annealing=(10.0,), frames=2, soft_tissue=False)


@pytest.fixture(scope="module")
def clean():
    return p.plant(frames=16)


def attempted(planted, observed, which=HASTY):
    recordings = [Recording("planted", np.array(observed), p.RATE_HZ, "+y")]
    return list(iterate_attempts(planted.body, planted.prior, planted.layout, recordings, which))


def shuffled(planted, *labels):
    columns = planted.columns(*labels)
    order = np.arange(len(planted.layout))
    order[columns] = np.roll(columns, 1)
    return planted.observed[:, order]


def test_labels_that_nothing_fits_are_left_out_and_the_rest_is_right(clean):
    (fit,) = attempted(clean, shuffled(clean, *WRONG))
    assert set(fit.left_out) >= set(WRONG) and len(fit.left_out) <= len(WRONG) + 4
    assert not set(fit.labels) & set(fit.left_out)
    assert (
        fit.verdict.level == "doubtful"
        and "Left out" in str(fit.verdict)
        and "tried again" in str(fit.verdict)
    )
    assert fit.tried[0].endswith(f": that with {len(fit.left_out)} labels left out is kept.")
    assert np.nanmean(fit.errors("pose")) < 0.005
    suspects = {s.label: s.frames for s in fit.suspects}
    assert all(suspects[label] == len(clean.observed) for label in fit.left_out)
    assert all(any(label in text for text in fit.warnings) for label in fit.left_out)


def test_a_hopeless_capture_ends_early_and_is_not_tried_again(clean):
    """All labels on other markers: half of them are far from any body after two steps."""
    which = p.settings(frames=2, soft_tissue=False)
    order = np.random.default_rng(0).permutation(len(clean.layout))
    (fit,) = attempted(clean, clean.observed[:, order], which)
    assert fit.shape_status == "hopeless" and fit.tried == () and fit.verdict.level == "failed"
    (sound,) = attempted(clean, clean.observed, which)
    assert sound.shape_status in ("converged", "iterations")


def test_a_shape_that_no_sound_fit_comes_of_is_not_settled(clean):
    """Noise of 40 mm: the last step, which took most of the iterations, is solved once."""
    noise = np.random.default_rng(0).normal(size=clean.observed.shape)
    iterations = {}
    for rough in (np.inf, p.settings().rough):
        which = p.settings(frames=4, rough=rough)
        recordings = [Recording("planted", clean.observed + 0.04 * noise, p.RATE_HZ, "+y")]
        subject = known_subject(clean.body, clean.prior, clean.layout, recordings, which)[1]
        iterations[rough] = subject.shape.iterations
    assert iterations[p.settings().rough] < 0.8 * iterations[np.inf]


def test_poses_after_a_hopeless_shape_take_at_most_twice_the_work_of_sound_ones(clean, monkeypatch):
    """Frames visited by the solver; before, none converged and all sweeps were made."""
    order = np.random.default_rng(0).permutation(len(clean.layout))
    which = p.settings(frames=2)
    plain_sweep = Level.sweep
    visits = {}
    cases = {
        "sound": clean.observed,
        "other labels": clean.observed[:, order],
        "feet for metres": clean.observed / 0.3048,
    }
    for kind, observed in cases.items():
        recordings = [Recording("planted", observed, p.RATE_HZ, "+y")]
        (recording,), subject = known_subject(
            clean.body, clean.prior, clean.layout, recordings, which
        )
        assert subject.hopeless == (kind != "sound")
        counts = []

        def counted(level, active, counts=counts):
            counts.append(int(np.sum(active)))
            return plain_sweep(level, active)

        monkeypatch.setattr(Level, "sweep", counted)
        fit = fit_recording(recording, subject, which)
        monkeypatch.undo()
        visits[kind] = sum(counts)
    assert max(visits.values()) <= 2 * visits["sound"], visits
    assert fit.verdict.level == "failed" and "check the unit of length" in str(fit.verdict)
