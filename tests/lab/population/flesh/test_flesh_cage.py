import numpy as np
import pytest
from bars import bar, surface

from habitus.errors import HabitusError
from habitus_lab.population.flesh.cage import Cage, positive_cage
from habitus_lab.population.flesh.flesh import make_flesh
from habitus_lab.population.flesh.skin import make_skin
from habitus_lab.population.flesh.warp import warped


@pytest.fixture(scope="module")
def cage():
    return bar((6, 3, 3), (0.6, 0.3, 0.3))


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(0.01, 0.29, (200, 3)) * [2, 1, 1]


def test_tetrahedra_of_either_orientation_fill_the_box(cage):
    mixed = cage.tets.copy()
    mixed[::2] = mixed[::2][:, [1, 0, 2, 3]]
    assert positive_cage(cage.nodes, mixed).volumes.sum() == pytest.approx(0.6 * 0.3 * 0.3)
    with pytest.raises(HabitusError, match="flat or inverted"):
        Cage(cage.nodes, mixed)


def test_embedded_points_follow_linear_motion(cage, points):
    embedding, tets = cage.embed(points)
    assert embedding.weights.min() > -1e-9
    assert np.array_equal(embedding.corners, cage.tets[tets])
    linear = np.random.default_rng(1).normal(size=(3, 3))
    np.testing.assert_allclose(embedding(cage.nodes @ linear + 1), points @ linear + 1, atol=1e-12)


def test_smooth_embedding_is_exact_for_quadratic_motion_inside(cage, points):
    """Where a node's neighbourhood is symmetric its mean gradient is exact, and so is what the
    nodes add up to.
    """
    inner = points[((points > 0.11) & (points < [0.49, 0.19, 0.19])).all(1)]
    assert len(inner) > 3

    def bend(p):
        return p + np.stack([p[:, 0] * p[:, 1], p[:, 0] ** 2, 0 * p[:, 2]], 1)

    embedding, _ = cage.embed(inner)
    smooth = cage.smooth(embedding, inner)
    np.testing.assert_allclose(smooth @ bend(cage.nodes), bend(inner), atol=1e-12)
    assert np.abs(embedding(bend(cage.nodes)) - bend(inner)).max() > 1e-3


def test_numbers_spread_harmonically(cage, points):
    embedding, _ = cage.embed(points)
    spread = cage.spread(embedding, points @ np.array([[1.0], [2.0], [-1.0]]) + 3, 1e6)
    np.testing.assert_allclose(embedding(spread)[:, 0], points @ [1.0, 2.0, -1.0] + 3, atol=1e-4)
    inner = ((cage.nodes > 0.05) & (cage.nodes < [0.55, 0.25, 0.25])).all(1)
    np.testing.assert_allclose(
        spread[inner, 0], cage.nodes[inner] @ [1.0, 2.0, -1.0] + 3, atol=0.02
    )


def test_cage_follows_another_skin(cage):
    used = np.unique(surface(cage))
    embedding, _ = cage.embed(cage.nodes[used])
    wide = cage.nodes[used] * [1.1, 1.5, 1.0]
    found = warped(cage, embedding, wide)
    np.testing.assert_allclose(embedding(found.nodes), wide, atol=2e-3)


def test_elastic_warp_takes_over_where_the_harmonic_one_inverts(cage):
    """A dent deeper than the tetrahedra under it."""
    used = np.unique(surface(cage))
    skin = cage.nodes[used].copy()
    top = (
        (skin[:, 1] > 0.29) & (np.abs(skin[:, 0] - 0.3) < 0.05) & (np.abs(skin[:, 2] - 0.15) < 0.1)
    )
    skin[top, 1] -= 0.16
    embedding, _ = cage.embed(cage.nodes[used])
    harmonic = cage.nodes + cage.spread(embedding, skin - cage.nodes[used], 20.0)
    corners = harmonic[cage.tets]
    assert (np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0).any()
    found = warped(cage, embedding, skin)
    assert np.abs(embedding(found.nodes) - skin).mean() < 2e-3
    with pytest.raises(HabitusError, match="mesh the person's own skin"):
        warped(cage, embedding, skin, flattest=0.99)


def test_mass_is_the_volume_and_held_tetrahedra_take_no_part(cage):
    skin = make_skin(cage, cage.nodes[:1], np.zeros((0, 3), int), np.zeros(0, int))
    bones, _ = cage.embed(cage.nodes[:1])
    flesh = make_flesh(cage, 20, bones, np.ones(1), skin)
    assert flesh.mass.sum() == pytest.approx(0.6 * 0.3 * 0.3)
    assert len(flesh.tets) + (cage.tets >= 20).all(1).sum() == len(cage.tets)
