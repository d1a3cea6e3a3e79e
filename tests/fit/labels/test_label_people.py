"""Several people's points: parted by where they stand and by their bodies, and each labelled by
itself.
"""

import numpy as np
import planted
import pytest

from habitus.errors import HabitusError
from habitus.fit.labels.clouds import Clouds, tracklets
from habitus.fit.labels.people import nearest_bodies, only, people_on_ground
from habitus.fit.labels.recipe import label_people
from habitus.fit.labels.settings import LabelSettings
from habitus.jobs.label import label

FRAMES = 6
APART = np.array([1.5, 0.0, 0.0])


def two() -> tuple[planted.Planted, Clouds, np.ndarray]:
    """A planted person, and the same going the other way beside; the true label of each point."""
    truth = planted.plant(FRAMES, seed=3, placement=0.008)
    beside = (
        truth.observed[::-1]
        - np.nanmean(truth.observed[-1], axis=0)
        + np.nanmean(truth.observed[0], axis=0)
        + APART
    )
    both = np.concatenate([truth.observed, beside], axis=1)
    rng = np.random.default_rng(0)
    order = np.array([rng.permutation(both.shape[1]) for _ in range(FRAMES)])
    clouds = Clouds.of(np.take_along_axis(both, order[..., None], axis=1), planted.RATE_HZ, "+y")
    return (
        truth,
        clouds,
        order[np.isfinite(np.take_along_axis(both, order[..., None], axis=1)).all(axis=2)],
    )


def test_people_are_parted_by_where_they_stand_and_by_their_bodies():
    truth, clouds, true = two()
    pieces = tracklets(clouds)
    count = len(truth.layout)
    who = people_on_ground(clouds, pieces, 2)
    same = who == true // count
    assert np.all(same) or not np.any(same)
    exact = [
        clouds.labelled(np.where(true // count == k, true % count, -1), count) for k in range(2)
    ]
    assert np.array_equal(
        nearest_bodies(clouds, pieces, [np.nan_to_num(e, nan=9.0) for e in exact]), true // count
    )
    part = only(clouds, who == 0)
    assert len(part) == len(clouds) and len(part.points) == (who == 0).sum()
    assert np.array_equal(part.frame, clouds.frame[who == 0])


def test_each_of_two_people_gets_the_labels_of_the_layout():
    truth, clouds, true = two()
    result = label_people(
        truth.body, truth.prior, truth.layout, clouds, 2, LabelSettings(fit=planted.settings())
    )
    count = len(truth.layout)
    label = result.label
    if np.mean(label // count == true // count) < 0.5:
        label = np.where(label >= 0, (label + count) % (2 * count), -1)
    assert np.mean(label == true) > 0.97 and len(result.sure) == 2 * count


def test_nobody_is_nobody_and_one_labelled_person_is_not_two(tmp_path):
    with pytest.raises(HabitusError, match="people = 0; expected how many"):
        label(tmp_path / "raw.c3d", people=0)
    with pytest.raises(HabitusError, match="supports one person"):
        label(tmp_path / "raw.c3d", people=2, like=tmp_path / "other.c3d")
