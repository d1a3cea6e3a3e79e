"""Points without names of a planted person: what they are is found again, in any order, broken,
with ghosts.
"""

from functools import cache

import numpy as np
import planted
import pytest

from habitus.errors import HabitusError
from habitus.fit.labels.clouds import Clouds, tracklets
from habitus.fit.labels.exchanges import resolve_exchanges
from habitus.fit.labels.recipe import Known, label_points
from habitus.fit.labels.settings import LabelSettings
from habitus.observe.marker_prediction import marked_body
from habitus.observe.markers import attach

FRAMES = 36


@cache
def capture() -> planted.Planted:
    return planted.plant(FRAMES, seed=3, placement=0.008)


@cache
def known() -> Known:
    """The person as another capture would tell."""
    truth = capture()
    attachment = attach(
        truth.latent_markers, planted.rest(truth.betas), np.asarray(truth.body.faces)
    )
    return Known(truth.betas, attachment, truth.pose[::9])


def clouds_of(markers: np.ndarray, seed: int = 0, ghosts: int = 0) -> tuple[Clouds, np.ndarray]:
    """The points in another order in each frame, and what each is, -1 for ghosts."""
    rng, (frames, count) = np.random.default_rng(seed), markers.shape[:2]
    extra = np.nanmean(markers, axis=1, keepdims=True) + rng.normal(
        scale=0.5, size=(frames, ghosts, 3)
    )
    both = np.concatenate([markers, extra], axis=1)
    label = np.append(np.arange(count), np.full(ghosts, -1))
    order = np.array([rng.permutation(len(label)) for _ in range(frames)])
    both = np.take_along_axis(both, order[..., None], axis=1)
    return Clouds.of(both, planted.RATE_HZ, "+y"), label[order][np.isfinite(both).all(axis=2)]


def labelled(markers: np.ndarray, seed: int = 0, ghosts: int = 0, who: Known | None = None):
    truth = capture()
    clouds, label = clouds_of(markers, seed, ghosts)
    return (
        label_points(
            truth.body,
            truth.prior,
            truth.layout,
            clouds,
            who,
            LabelSettings(fit=planted.settings()),
        ),
        label,
        clouds,
    )


def test_a_layout_is_enough_to_name_the_points_and_to_leave_ghosts_alone():
    result, truth, _ = labelled(capture().observed, ghosts=2)
    named = result.label >= 0
    assert np.mean(result.label[named] == truth[named]) > 0.99
    assert np.mean(result.label[truth >= 0] == truth[truth >= 0]) > 0.97


def test_the_order_of_the_points_does_not_matter():
    one, first, _ = labelled(capture().observed, seed=1, who=known())
    other, second, _ = labelled(capture().observed, seed=2, who=known())
    for result, truth in ((one, first), (other, second)):
        assert np.mean(result.label == truth) > 0.99
    rows = np.repeat(np.arange(FRAMES), len(capture().layout))
    sort = [np.lexsort((truth, rows)) for truth in (first, second)]
    assert np.array_equal(one.label[sort[0]], other.label[sort[1]])


def test_broken_trajectories_keep_their_names():
    rng = np.random.default_rng(5)
    markers = capture().observed.copy()
    for _ in range(40):
        first = rng.integers(FRAMES)
        markers[first : first + rng.integers(3, 10), rng.integers(markers.shape[1])] = np.nan
    result, truth, _ = labelled(markers, who=known())
    assert np.mean(result.label == truth) > 0.99


def test_nobody_takes_the_name_of_a_marker_that_is_not_there():
    markers = capture().observed.copy()
    gone = capture().columns("LFHD", "RKNE", "STRN")
    markers[:, gone] = np.nan
    result, truth, _ = labelled(markers, who=known())
    assert np.mean(np.isin(result.label, gone)) < 1e-3
    assert np.mean(result.label == truth) > 0.99


def test_twins_under_each_others_names_are_put_right():
    truth = capture()
    clouds, label = clouds_of(truth.observed)
    first, second = truth.columns("LWRA", "LWRB")
    wrong = np.where(label == first, second, np.where(label == second, first, label))
    frames = np.arange(0, FRAMES, 6)
    rig = marked_body(truth.body, known().betas, known().attachment)
    prior = truth.prior.for_joints(truth.body.joint_names)
    state = truth.pose[frames], truth.trans[frames]
    weights = np.full(len(truth.layout), 800.0)
    right, sure = resolve_exchanges(
        rig, prior, clouds, tracklets(clouds), wrong, frames, state, weights
    )
    looked = np.isin(clouds.frame, frames)
    assert np.array_equal(right[looked], label[looked])
    assert sure[[first, second]].min() > 0.6


def test_too_few_points_are_refused():
    with pytest.raises(HabitusError, match=r"at most 4 points .* expected at least 6"):
        labelled(capture().observed[:, :4])
