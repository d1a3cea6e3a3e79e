"""Principal components in one pass, whatever fits into memory."""

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.learn.dynamics.regression import principal_components


def _rows(seed=0, frames=90, ways=5):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(frames, ways))
        * [8, 4, 2, 1, 0.5][:ways]
        @ np.linalg.qr(rng.normal(size=(60, ways)))[0].T
    )


@pytest.mark.parametrize("size", [1, 7, 90])
@pytest.mark.parametrize("rank", [5, 40])
def test_blocks_of_any_size_give_the_singular_vectors(size, rank):
    rows = _rows()
    found = principal_components([rows[k : k + size] for k in range(0, 90, size)], 3, rank)
    _, values, axes = np.linalg.svd(rows, full_matrices=False)
    flat = found.directions.reshape(60, 3)
    np.testing.assert_allclose(np.linalg.norm(flat, axis=0), values[:3] / np.sqrt(90), rtol=1e-7)
    assert np.abs(np.sum(flat / np.linalg.norm(flat, axis=0) * axes[:3].T, axis=0)).min() > 1 - 1e-9
    np.testing.assert_allclose((found.coefficients**2).mean(0), 1.0, rtol=1e-9)
    np.testing.assert_allclose(found.shares, values[:3] ** 2 / (values**2).sum(), rtol=1e-7)
    assert (flat[np.abs(flat).argmax(0), range(3)] > 0).all()


def test_each_persons_mean_is_the_persons_own():
    rows = _rows()
    group = np.repeat([0, 1, -1], 30)
    shift = 20 * np.random.default_rng(1).normal(size=(2, 60))
    plain = principal_components([rows], 2, 30, group)
    moved = rows.copy()
    moved[:30] += shift[0]
    moved[30:60] += shift[1]
    found = principal_components(np.array_split(moved, 6), 2, 30, group)
    np.testing.assert_allclose(found.directions, plain.directions, atol=1e-8)
    np.testing.assert_allclose(found.coefficients, plain.coefficients, atol=1e-7)
    np.testing.assert_allclose(found.coefficients[:30].mean(0), 0.0, atol=1e-9)
    assert np.abs(found.coefficients[60:].mean(0)).max() > 1e-3


def test_too_few_ways_of_moving():
    with pytest.raises(HabitusError, match="3 components asked of surfaces that move in 2 ways"):
        principal_components([_rows(ways=2)], 3, 8)
    with pytest.raises(HabitusError, match="no dynamics to learn"):
        principal_components([np.zeros((9, 60))], 1, 8)
