"""The shape space against a singular value decomposition of everything at once, and what must hold
of it.
"""

import tracemalloc

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.learn.shape import shape_space
from habitus.learn.shape.shape_space import ShapeSpace, principal_shapes


def people(count, vertices=50, rank=12, seed=0, noise=0.001):
    rng = np.random.default_rng(seed)
    basis = rng.normal(size=(rank, vertices, 3)) * (0.1 * 0.7 ** np.arange(rank))[:, None, None]
    mean = rng.normal(size=(vertices, 3)) + np.array([3.0, 0, 0])
    varied = np.tensordot(rng.normal(size=(count, rank)), basis, 1)
    return mean + varied + noise * rng.normal(size=(count, vertices, 3))


class Streamed:
    """Surfaces that can only be fetched in slices, and that note how many at once."""

    def __init__(self, surfaces):
        self.surfaces = surfaces
        self.shape = surfaces.shape
        self.most = 0

    def __getitem__(self, rows):
        self.most = max(self.most, len(self.surfaces[rows]))
        return self.surfaces[rows]


@pytest.mark.parametrize("count", [20, 400])  # fewer and more than the 150 numbers of a surface
@pytest.mark.parametrize("block", [1, 150 * 7, 2**24])
def test_as_a_singular_value_decomposition_in_any_blocks(count, block, monkeypatch):
    monkeypatch.setattr(shape_space, "_BLOCK", block)
    surfaces = people(count)
    streamed = Streamed(surfaces)
    space = principal_shapes(streamed, 8)
    assert streamed.most == max(1, min(block // 150, count))
    flat = surfaces.reshape(count, -1)
    _, values, directions = np.linalg.svd(flat - flat.mean(0), full_matrices=False)
    values = values / np.sqrt(count - 1)
    expected = (values[:, None] * directions)[:8]
    found = space.directions.reshape(150, 8).T
    expected *= np.sign((expected * found).sum(1, keepdims=True))
    assert np.allclose(space.mean.ravel(), flat.mean(0), rtol=0, atol=1e-12)
    assert np.allclose(found, expected, rtol=0, atol=1e-8)
    assert np.allclose(space.variances, values[: len(space.variances)] ** 2, rtol=1e-9)
    assert len(space.variances) == min(count - 1, 150)


@pytest.mark.parametrize("count", [20, 400])
def test_a_coefficient_is_a_standard_deviation(count):
    surfaces = people(count)
    space = principal_shapes(surfaces, 6)
    betas = space.coefficients(surfaces)
    assert np.allclose(np.cov(betas.T), np.eye(6), atol=1e-9)
    gram = space.directions.reshape(-1, 6).T @ space.directions.reshape(-1, 6)
    assert np.allclose(gram, np.diag(space.variances[:6]), atol=1e-10)


def test_there_and_back():
    space = principal_shapes(people(30), 6)
    betas = np.random.default_rng(1).normal(size=(4, 2, 6))
    assert np.allclose(space.coefficients(space.reconstruct(betas)), betas, atol=1e-10)
    first = np.concatenate([betas[..., :2], np.zeros((4, 2, 4))], -1)
    assert np.allclose(space.reconstruct(betas[..., :2]), space.reconstruct(first), atol=1e-14)


def test_error_falls_with_every_direction_as_the_variances_say():
    surfaces = people(30)
    space = principal_shapes(surfaces, 29)
    betas = space.coefficients(surfaces)
    errors = [((space.reconstruct(betas[:, :n]) - surfaces) ** 2).sum() / 29 for n in range(30)]
    assert (np.diff(errors) < 0).all() and errors[-1] < 1e-20
    assert np.allclose(1 - np.array(errors[1:]) / errors[0], space.cumulative_variance, atol=1e-12)
    assert np.isclose(space.cumulative_variance[-1], 1)


def test_fewer_surfaces_than_directions_give_one_less_than_surfaces():
    assert principal_shapes(people(5), 10).num_betas == 4
    doubled = np.concatenate([people(5), people(5)])
    space = principal_shapes(doubled, 10)
    assert space.num_betas == 4 and np.isfinite(space.coefficients(doubled)).all()


def test_weights_count_like_copies_and_nothing_counts_not_at_all():
    surfaces = people(12)
    times = np.array([1, 2, 3, 0] * 3)
    weighted = principal_shapes(surfaces, 5, weights=0.1 * times)
    copies = principal_shapes(np.repeat(surfaces, times, axis=0), 5)
    assert np.allclose(weighted.mean, copies.mean, atol=1e-12)
    share = times / times.sum()
    biased = weighted.variances[:5] * (1 - (share**2).sum())
    assert np.allclose(biased, copies.variances[:5] * (times.sum() - 1) / times.sum())
    assert len(weighted.variances) == 8
    kept = principal_shapes(surfaces[times > 0], 5)
    equal = principal_shapes(surfaces, 5, weights=(times > 0) * 7.0)
    assert np.allclose(equal.directions, kept.directions, atol=1e-9)


def test_signs_hold_for_more_surfaces_and_other_orders():
    surfaces = people(60)
    one = principal_shapes(surfaces, 4)
    other = principal_shapes(surfaces[::-1], 4)
    assert np.allclose(one.directions, other.directions, atol=1e-9)
    grown = one.mean - one.mean.mean(0)
    assert (np.tensordot(grown, one.directions, 2) > 0).all()


def test_a_direction_that_does_not_grow_has_its_largest_entry_positive():
    mean = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    lean = np.array([[0, 0, -0.3], [0, 0, 0.1], [0, 0, 0.1], [0, 0, 0.1]])
    space = principal_shapes(mean + np.array([-1, 0.2, 0.8])[:, None, None] * lean, 3)
    assert space.num_betas == 1
    assert space.directions[0, 2, 0] > 0 > space.directions[1, 2, 0]


def test_where_surfaces_stand_moves_only_the_mean():
    surfaces = people(20)
    place = np.array([1.0, -2.0, 3.0])
    one = principal_shapes(surfaces, 4)
    other = principal_shapes(surfaces + place, 4)
    assert np.allclose(other.mean, one.mean + place)
    assert np.allclose(other.directions, one.directions, atol=1e-9)


def test_a_mapped_file_is_not_held_in_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(shape_space, "_BLOCK", 2**17)
    file = np.memmap(tmp_path / "surfaces", np.float32, "w+", shape=(300, 2000, 3))
    file[:] = people(300, vertices=2000)
    tracemalloc.start()
    space = principal_shapes(file, 5)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 0.5 * 8 * file.size
    in_memory = principal_shapes(np.array(file, dtype=np.float64), 5)
    assert np.allclose(space.directions, in_memory.directions, atol=1e-8)


@pytest.mark.wrong_shapes
@pytest.mark.parametrize(
    "surfaces, count, weights, said",
    [
        (people(1), 3, None, "1 surfaces"),
        (np.ones((4, 5, 3)), 3, None, "alike"),
        (np.full((4, 5, 3), np.nan), 3, None, "not finite"),
        (people(4), 0, None, "1 or more"),
        (people(4), 3, np.ones(3), "one finite number"),
        (people(4), 3, np.array([1, 1, -1, 1]), "one finite number"),
        (people(4), 3, np.array([0, 0, 1, 0]), "1 surfaces"),
    ],
)
def test_what_cannot_be_is_said(surfaces, count, weights, said):
    with pytest.raises(HabitusError, match=said):
        principal_shapes(surfaces, count, weights=weights)


def test_coefficients_are_found_again_in_a_space_whose_directions_are_not_orthogonal():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(50, 3, 4)) + rng.normal(size=(50, 3, 1))
    space = ShapeSpace(rng.normal(size=(50, 3)), directions, (directions**2).sum((0, 1)))
    betas = rng.normal(size=(2, 5, 4))
    surfaces = space.mean + np.einsum("vck,abk->abvc", directions, betas)
    np.testing.assert_allclose(space.coefficients(surfaces), betas, atol=1e-9)
