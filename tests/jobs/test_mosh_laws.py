"""From a capture's file to a fit: held-out markers by name and by rotation, causal and whole, one
person or several.
"""

from dataclasses import replace

import numpy as np
import pytest
from planted import attach, carried, degrees_apart, person, place_by_hand, plant, rest

from habitus.errors import HabitusError
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_placements
from habitus.jobs.mosh import mosh

EVERY = 14


@pytest.fixture(scope="module")
def planted():
    return plant(frames=8)


@pytest.fixture(scope="module")
def longer():
    return plant(frames=30)


def written(planted, folder, name="walk", observed=None):
    markers = planted.observed if observed is None else observed
    write_c3d(
        Capture(name, planted.layout.labels, np.array(markers), 30.0, "+y"), folder / f"{name}.c3d"
    )
    return folder / f"{name}.c3d"


@pytest.fixture(scope="module")
def file(planted, tmp_path_factory):
    return written(planted, tmp_path_factory.mktemp("captures"))


def run(path, **options):
    return mosh(path, layout="cmu-41", body=person(), **({"soft_tissue": "none"} | options))[0]


@pytest.fixture(scope="module")
def whole(file):
    return run(file)


@pytest.fixture(scope="module")
def held(file, planted):
    return run(file, hold_out=planted.layout.labels[::EVERY])


def test_what_the_file_holds_is_what_is_fitted(planted, whole):
    order = [planted.column(label) for label in whole.labels]
    np.testing.assert_allclose(whole.observed_markers, planted.observed[:, order], atol=1e-5)
    assert whole.capture_name == "walk" and whole.rate_hz == 30.0 and whole.held_out is None
    assert np.abs(whole.betas - planted.betas).max() < 0.4
    assert set(whole.stage_seconds) >= {"read", "shape", "pose"} and whole.startup_seconds >= 0


def test_held_out_errors_are_distances_from_where_the_others_make_one_expect_them(planted, held):
    labels = planted.layout.labels[::EVERY]
    assert held.held_out.labels == labels and not set(labels) & set(held.labels)
    assert set(held.labels) | set(labels) == set(planted.layout.labels)
    layout = replace(planted.layout, markers=tuple(planted.layout[label] for label in labels))
    others = planted.layout.restricted_to(held.labels)
    told = load_placements().expected(
        others, held.latent_markers - place_by_hand(held.betas, others), layout
    )
    attachment = attach(
        told + place_by_hand(held.betas, layout), rest(held.betas), np.asarray(person().faces)
    )
    predicted = carried(attachment, held.betas, *held.pose_stage)
    by_hand = np.linalg.norm(predicted - planted.observed[:, planted.columns(*labels)], axis=2)
    np.testing.assert_allclose(held.held_out.pose, by_hand, atol=2e-5)
    assert held.held_out.soft_tissue is None and by_hand.max() > 1e-3


def test_held_out_markers_have_no_say(planted, held, tmp_path):
    """Moved by 4 cm, they change their own errors and nothing else."""
    labels = planted.layout.labels[::EVERY]
    observed = planted.observed.copy()
    observed[:, planted.columns(*labels)] += (0.0, 0.04, 0.0)
    moved = run(written(planted, tmp_path, observed=observed), hold_out=labels)
    np.testing.assert_array_equal(moved.betas, held.betas)
    np.testing.assert_array_equal(moved.pose, held.pose)
    change = moved.held_out.pose - held.held_out.pose
    assert np.abs(change).max() < 0.04 + 1e-5 and np.abs(change).max() > 0.01


def test_rotation_holds_out_each_marker_once(planted, file, whole):
    rotated = run(file, hold_out_every=3)
    np.testing.assert_array_equal(rotated.betas, whole.betas)
    labels = whole.labels
    assert rotated.held_out.labels == labels[::3] + labels[1::3] + labels[2::3]
    named = run(file, hold_out=labels[1::3]).held_out
    second = [rotated.held_out.labels.index(label) for label in named.labels]
    assert len(second) == len(labels[1::3])
    np.testing.assert_array_equal(rotated.held_out.pose[:, second], named.pose)
    assert np.isfinite(rotated.held_out.pose).all() and rotated.held_out.pose.mean() < 0.03
    assert rotated.held_out.pose.mean() > np.nanmean(rotated.errors("pose"))


@pytest.mark.parametrize("every", [0, 1, 43, -2])
def test_a_rotation_that_leaves_nothing_is_refused(file, every):
    with pytest.raises(HabitusError, match=f"hold-out-every is {every}; expected 2 to 42"):
        run(file, hold_out_every=every)


def test_causal_follows_the_whole_sequence(longer, tmp_path):
    """Smooth motion: what comes later adds little to what a frame and those before it tell."""
    file = written(longer, tmp_path)
    whole = run(file)
    causal = run(file, causal=True, soft_tissue="shape")
    assert causal.soft_tissue is None and causal.status == "causal" and whole.status != "causal"
    np.testing.assert_allclose(causal.betas, whole.betas, atol=1e-12)
    apart = degrees_apart(causal.pose, whole.pose)[3:]
    assert np.median(apart) < 1.0 and apart.max() < 8.0
    assert np.linalg.norm(causal.trans - whole.trans, axis=1)[3:].mean() < 5e-3
    assert np.nanmean(causal.errors("pose")) < 1.3 * np.nanmean(whole.errors("pose"))
    distance = causal.errors("pose")
    np.testing.assert_allclose(
        causal.marker_weights, (1.0 / (1.0 + (distance / 0.10) ** 2)) ** 2, rtol=1e-9
    )


def test_causal_begins_at_the_first_frame_with_markers_and_stays_over_gaps(longer, tmp_path):
    observed = longer.observed.copy()
    observed[:3, 2:] = np.nan
    observed[12:14] = np.nan
    found = run(written(longer, tmp_path, observed=observed), causal=True)
    expected = np.zeros(30, dtype=bool)
    expected[[0, 1, 2, 12, 13]] = True
    np.testing.assert_array_equal(found.flagged_frames, expected)
    assert degrees_apart(found.pose[:, 0], longer.pose[:, 0])[4:].max() < 10.0
    np.testing.assert_allclose(found.trans[4:], longer.trans[4:], atol=0.03)
