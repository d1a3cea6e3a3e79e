"""What goes wrong in captures is put right or named: exchanged labels, fallen and missing markers,
empty frames.
"""

from dataclasses import replace

import numpy as np
import pytest
from planted import NOISE, fit, plant, settings

from habitus.errors import HabitusError
from habitus.fit.markers.recipe import Recording, fit_markers

QUICK = settings(annealing=(10.0, 1.0), soft_tissue=False)


@pytest.fixture(scope="module")
def clean():
    return plant()


@pytest.fixture(scope="module")
def fitted(clean):
    return fit(clean)


@pytest.fixture(scope="module")
def quickly(clean):
    return fit(clean, which=QUICK)


def exchanged(planted, first, second, frames=slice(None)):
    observed = planted.observed.copy()
    pair = planted.columns(first, second)
    observed[frames, pair] = observed[frames, pair[::-1]]
    return observed


def accused(found) -> dict[str, tuple[str, int]]:
    return {suspect.label: (suspect.reason, suspect.frames) for suspect in found.suspects}


def test_a_clean_capture_accuses_nobody(clean, fitted):
    assert fitted.suspects == () and not fitted.flagged_frames.any() and fitted.warnings == ()
    np.testing.assert_array_equal(fitted.observed_markers, clean.observed)
    assert fitted.marker_weights.min() > 0.8
    assert fitted.labels == clean.layout.labels


@pytest.mark.parametrize("pair", [("LFWT", "LBWT"), ("LKNE", "LSHN")])
def test_a_pair_that_changes_places_for_a_time_is_put_back(clean, quickly, pair):
    found = fit(clean, exchanged(clean, *pair, slice(20, 40)), QUICK)
    np.testing.assert_array_equal(found.observed_markers, clean.observed)
    first, second = pair
    assert accused(found) == {
        first: (f"swapped with {second}; exchanged back", 20),
        second: (f"swapped with {first}; exchanged back", 20),
    }
    assert np.nanmedian(found.errors("pose")) < np.nanmedian(quickly.errors("pose")) + 2 * NOISE


@pytest.mark.parametrize(
    "pair",
    [
        ("LFWT", "LBWT"),  # latent markers end at each other's places
        ("CLAV", "STRN"),
        ("LWRA", "LWRB"),  # the forearm is half-turned
        ("T10", "STRN"),  # front and back
        ("C7", "CLAV"),
        ("LKNE", "RKNE"),  # the other side
    ],
)
def test_a_pair_exchanged_throughout_is_put_right(clean, quickly, pair):
    found = fit(clean, exchanged(clean, *pair), QUICK)
    np.testing.assert_array_equal(found.observed_markers, clean.observed)
    first, second = pair
    assert accused(found) == {
        first: (f"swapped with {second}; exchanged back", 60),
        second: (f"swapped with {first}; exchanged back", 60),
    }
    np.testing.assert_allclose(found.latent_markers, quickly.latent_markers, atol=12 * NOISE)
    np.testing.assert_allclose(found.betas, quickly.betas, atol=0.1)


def test_two_pairs_exchanged_throughout_are_put_right(clean, quickly):
    observed = exchanged(replace(clean, observed=exchanged(clean, "LKNE", "RKNE")), "T10", "STRN")
    found = fit(clean, observed, QUICK)
    np.testing.assert_array_equal(found.observed_markers, clean.observed)
    assert {suspect.label for suspect in found.suspects} == {"LKNE", "RKNE", "T10", "STRN"}
    np.testing.assert_allclose(found.betas, quickly.betas, atol=0.1)


def test_a_wrong_label_is_not_exchanged_with_another(clean):
    observed = clean.observed.copy()
    shoulder, elbow = clean.columns("LSHO", "LELB")
    observed[:, shoulder] = observed[:, elbow] + 0.02
    found = fit(clean, observed, QUICK)
    np.testing.assert_array_equal(found.observed_markers, observed)
    assert set(accused(found)) == {"LSHO"} and "wrong label" in accused(found)["LSHO"][0]


def test_frames_of_an_exchange_count_where_both_markers_are_seen(clean):
    observed = exchanged(clean, "CLAV", "STRN")
    observed[5:12, clean.column("CLAV")] = np.nan
    found = fit(clean, observed, QUICK)
    assert accused(found)["STRN"] == ("swapped with CLAV; exchanged back", 53)
    assert np.isnan(found.observed_markers[5:12, clean.column("STRN")]).all()


def test_a_fallen_marker_has_no_say():
    """With the same frames in the shape stage: spread frames are chosen by distances of markers,
    and a marker that fell makes other frames differ most.

    The median of three captures: in one of five a shoulder marker settles 10 mm further along the
    skin in one of the two fits.
    """
    which = settings(frame_choice="random")
    means, largest = [], []
    for seed in (1, 2, 3):
        clean = plant(seed=seed)
        knee = clean.column("RKNE")
        observed = clean.observed.copy()
        observed[30:, knee] += (0.0, -0.3, 0.1)
        found = fit(clean, observed, which)
        assert list(accused(found)) == ["RKNE"]
        reason, frames = accused(found)["RKNE"]
        assert frames == 30 and "from frame 30 on" in reason
        weights = found.marker_weights
        assert weights[30:, knee].max() < 0.05 < 0.9 < weights[:30, knee].min()
        others = np.arange(len(clean.layout)) != knee
        assert weights[:, others].min() > 0.8
        np.testing.assert_array_equal(found.observed_markers, observed)
        whole = fit(clean, which=which)
        apart = np.linalg.norm(found.predicted_pose_stage - whole.predicted_pose_stage, axis=2)
        means.append(apart[:, others].mean())
        largest.append(apart[:, others].max())
    assert np.median(means) < 1.4 * NOISE and np.median(largest) < 0.006


def test_a_marker_that_is_never_seen_is_as_if_the_layout_had_none(clean):
    gone = clean.column("T10")
    observed = clean.observed.copy()
    observed[:, gone] = np.nan
    rest = tuple(marker for marker in clean.layout.markers if marker.label != "T10")
    fewer = replace(clean, layout=replace(clean.layout, markers=rest))
    one = fit(clean, observed, QUICK)
    two = fit(fewer, np.delete(clean.observed, gone, axis=1), QUICK)
    assert one.labels == two.labels == fewer.layout.labels
    np.testing.assert_array_equal(one.betas, two.betas)
    np.testing.assert_array_equal(one.pose, two.pose)


def test_gaps_stay_gaps_and_are_bridged(clean, quickly):
    observed = clean.observed.copy()
    observed[25:35, clean.columns("LFIN", "LWRA", "LWRB")] = np.nan
    found = fit(clean, observed, QUICK)
    hidden = ~np.isfinite(observed[..., 0])
    np.testing.assert_array_equal(found.visible, ~hidden)
    assert (
        np.isnan(found.errors("pose")[hidden]).all() and (found.marker_weights[hidden] == 0).all()
    )
    moved = np.linalg.norm(found.predicted_pose_stage - clean.exact, axis=2)
    assert (
        moved[~hidden].mean() < np.nanmean(quickly.errors("pose")) + NOISE
        and moved[hidden].max() < 0.1
    )


@pytest.mark.parametrize("left,flagged", [(3, True), (4, False)])
def test_frames_with_fewer_than_four_markers_are_flagged(clean, left, flagged):
    observed = clean.observed.copy()
    observed[40:45, left:] = np.nan
    found = fit(clean, observed, QUICK)
    expected = np.zeros(60, dtype=bool)
    expected[40:45] = flagged
    np.testing.assert_array_equal(found.flagged_frames, expected)
    assert [w.startswith("5 of 60 frames hold fewer than 4 markers") for w in found.warnings] == [
        True
    ] * flagged
    assert np.isfinite(found.pose).all() and np.isfinite(found.trans).all()
    np.testing.assert_allclose(found.trans[40:45], clean.trans[40:45], atol=0.15)


def test_too_few_markers_in_every_frame_are_refused(clean):
    observed = clean.observed.copy()
    for frame in range(60):
        observed[frame, np.arange(len(clean.layout)) % 14 != frame % 14] = np.nan
    with pytest.raises(HabitusError, match="at most 3 known markers"):
        fit(clean, observed)


def test_two_captures_of_one_subject_share_their_shape(clean):
    parts = {"a": slice(30), "b": slice(30, 60)}
    told = []
    halves = [Recording(name, clean.observed[part], 30.0, "+y") for name, part in parts.items()]
    fits = fit_markers(
        clean.body,
        clean.prior,
        clean.layout,
        halves,
        QUICK,
        lambda stage, share: told.append((stage, share)),
    )
    one, two = fits
    assert (one.capture_name, two.capture_name) == ("a", "b")
    assert told == [("shape", 0.0), ("a", 0.0), ("b", 0.5)]
    np.testing.assert_array_equal(one.betas, two.betas)
    np.testing.assert_array_equal(one.latent_markers, two.latent_markers)
    np.testing.assert_allclose(two.trans.mean(0), clean.trans[30:].mean(0), atol=0.02)
