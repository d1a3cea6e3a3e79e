"""Poses chosen for what they tell of the shape."""

import numpy as np
import pytest
from synthetic_fit import tube_body

from habitus.body.prior import PosePrior
from habitus.fit.markers.energy import Placement
from habitus.fit.selection.poses import choose_poses
from habitus.fit.selection.problem import SelectionSettings


@pytest.fixture(scope="module")
def choice():
    return chosen(SelectionSettings())


def chosen(settings):
    body = tube_body(betas=4)
    rng = np.random.default_rng(0)
    prior = PosePrior(body.joint_names[1:], np.zeros(69), 0.05 * np.eye(69))
    vertices = np.arange(0, body.num_vertices, 60)
    spreads = [np.full(len(vertices), value) for value in (0.01, 0.001, 0.02)]
    poses = 0.4 * rng.normal(size=(6, 24, 3))
    poses[3] = 0.0
    poses[4] = poses[5]
    return choose_poses(body, prior, Placement(vertices, *spreads), poses, 5, settings=settings)


def test_each_pose_tells_more_and_the_first_is_the_best(choice):
    assert len(choice.poses) == len(set(choice.poses)) == 5
    assert (np.diff(choice.errors) < 0).all()
    assert (
        choice.errors[0] == pytest.approx(choice.alone.min())
        and choice.poses[0] == choice.alone.argmin()
    )


def test_chosen_ones_tell_more_than_random_ones(choice):
    assert all(
        best <= random + 1e-12 for best, random in zip(choice.errors, choice.random, strict=True)
    )


def test_the_same_pose_twice_tells_the_same_alone(choice):
    assert choice.alone[4] == pytest.approx(choice.alone[5])


def test_where_skin_slips_less_frames_tell_more(choice):
    firm = chosen(SelectionSettings(slip=0.001))
    assert (np.array(firm.errors) < choice.errors).all()
