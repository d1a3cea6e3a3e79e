import numpy as np
import pytest
from bars import HingedBar, bent

from habitus_lab.population.flesh.dynamics import Matter, Swing, stills, swing

RATE = 60.0


@pytest.fixture(scope="module")
def hinge():
    return HingedBar((8, 1, 1), (0.4, 0.1, 0.1))


def test_flesh_that_moves_evenly_feels_nothing(hinge):
    poses = np.repeat(bent(0)[None], 6, 0)
    trans = np.outer(np.arange(6), [0.02, 0.01, 0.0])
    frames = list(swing(hinge.flesh, hinge, poses, trans, RATE, Swing()))
    np.testing.assert_allclose(frames[-1], hinge.flesh.cage.nodes, atol=1e-9)


def test_flesh_overshoots_a_stop_and_comes_to_rest_in_two_seconds(hinge):
    """Softer flesh further; damping takes the energy out."""
    count = 120
    trans = np.zeros((count, 3))
    trans[:, 1] = 0.06 * np.minimum(np.arange(count), 3)
    poses = np.repeat(bent(0)[None], count, 0)
    reached = {}
    for shear in (5e3, 5e4):
        frames = swing(hinge.flesh, hinge, poses, trans, RATE, Swing(Matter(shear=shear)))
        off = np.array([np.abs(nodes - hinge.flesh.cage.nodes).max() for nodes in frames])
        reached[shear] = off.max()
        assert off[3:15].max() > 5 * off[-10:].max()
        assert off[-10:].max() < 1e-3
    assert reached[5e3] > 2 * reached[5e4] > 1e-3


def test_flesh_at_rest_is_where_motion_dies_down_to_and_is_carried_between(hinge):
    poses = np.array([bent(angle) for angle in np.linspace(0, 30, 9)])
    still = list(stills(hinge.flesh, hinge, poses, Swing(stride=4, steps=20)))
    assert len(still) == len(poses)
    held = np.concatenate([poses, np.repeat(poses[-1:], 60, 0)])
    *_, last = swing(hinge.flesh, hinge, held, np.zeros((len(held), 3)), RATE, Swing())
    assert np.abs(last - still[-1]).max() < 1e-3
    every = np.array(list(stills(hinge.flesh, hinge, poses, Swing(stride=1, steps=12))))
    assert np.abs(np.array(still) - every).max() < 3e-3 < np.abs(every - every[0]).max()
