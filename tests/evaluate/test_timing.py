"""Forward times: what is called how often, and that more work takes longer."""

import time
from dataclasses import dataclass

import numpy as np
import pytest
from tube_body import tube_body

from habitus.errors import HabitusError
from habitus.evaluate.posable import PosableBody
from habitus.evaluate.result import time_forward


@dataclass
class _Sleeper:
    name: str
    num_betas: int
    per_beta: float

    def fit(self, target, *, num_betas, betas=None, start=None):
        raise AssertionError

    def forward(self, num_betas):
        def function(betas, pose):
            assert betas.shape == (num_betas,) and pose.shape == (7, 3)
            time.sleep(self.per_beta * (1 + num_betas))
            return pose

        return function


def test_medians_follow_the_work_of_each_model():
    slow, fast = time_forward(
        [_Sleeper("slow", 8, 2e-3), _Sleeper("fast", 4, 5e-4)], (0, 4, 100), joints=7, repeats=5
    )
    assert (slow.model, slow.counts, fast.counts) == ("slow", (0, 4, 8), (0, 4))
    assert slow.seconds.shape == (3, 5) and (np.diff(slow.medians) > 5e-3).all()
    assert (slow.medians >= [2e-3, 1e-2, 1.8e-2]).all() and slow.medians[1] > fast.medians[1]


def test_bodies_are_timed():
    (found,) = time_forward([PosableBody(tube_body())], (0, 2, 4), joints=10, repeats=2)
    assert found.counts == (0, 2, 4) and (found.seconds > 0).all()


def test_no_repeats_are_refused():
    with pytest.raises(HabitusError, match="at least 1"):
        time_forward([], (1,), joints=7, repeats=0)
