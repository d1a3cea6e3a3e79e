import numpy as np
import pytest
from bars import HingedBar, bent

from habitus.population.flesh.dynamics import Matter, Swing, swing

RATE = 120.0


@pytest.fixture(scope="module")
def hinge():
    return HingedBar((8, 1, 1), (0.4, 0.1, 0.1))


def test_flesh_that_moves_evenly_feels_nothing(hinge):
    poses = np.repeat(bent(0)[None], 6, 0)
    trans = np.outer(np.arange(6), [0.02, 0.01, 0.0])
    frames = list(swing(hinge.flesh, hinge, poses, trans, RATE, Swing()))
    np.testing.assert_allclose(frames[-1], hinge.flesh.cage.nodes + trans[-1], atol=1e-9)


def test_flesh_overshoots_a_stop_and_comes_to_rest_in_two_seconds(hinge):
    """Softer flesh further; damping takes the energy out."""
    count = 240
    trans = np.zeros((count, 3))
    trans[:, 1] = 0.03 * np.minimum(np.arange(count), 6)
    poses = np.repeat(bent(0)[None], count, 0)
    reached = {}
    for shear in (5e3, 5e4):
        frames = swing(hinge.flesh, hinge, poses, trans, RATE, Swing(Matter(shear=shear)))
        off = np.array(
            [np.abs(nodes - at - hinge.flesh.cage.nodes).max() for nodes, at in zip(frames, trans, strict=True)]
        )
        reached[shear] = off.max()
        assert off[6:30].max() > 5 * off[-20:].max()
        assert off[-20:].max() < 1e-3
    assert reached[5e3] > 2 * reached[5e4] > 1e-3
