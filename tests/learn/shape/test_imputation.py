"""Shapes with holes give the shape space that they give without."""

import numpy as np

from habitus.learn.shape.shape_space import principal_shapes, shapes_with_holes


def people(count=40, vertices=60, span=3):
    rng = np.random.default_rng(0)
    ways = 0.05 * rng.normal(size=(span, vertices, 3))
    mean = rng.normal(size=(vertices, 3))
    return (
        mean
        + np.tensordot(rng.normal(size=(count, span)), ways, 1)
        + 1e-4 * rng.normal(size=(count, vertices, 3))
    )


def test_what_is_unseen_is_found_from_the_rest():
    whole = people()
    seen = np.random.default_rng(1).random(whole.shape[:2]) > 0.3
    spoilt = np.where(seen[..., None], whole, whole.mean((0, 1)))
    filled, space = shapes_with_holes(spoilt, seen, 3, steps=30)
    assert np.array_equal(filled[seen], whole[seen])
    assert np.abs(filled - whole).max() < 2e-3 and np.abs(spoilt - whole).max() > 1.0
    expected = principal_shapes(whole, 3)
    assert np.abs(space.mean - expected.mean).max() < 5e-4
    cosines = np.abs(
        np.tensordot(space.directions, expected.directions, ((0, 1), (0, 1))).diagonal()
    )
    assert (cosines / expected.variances[:3] > 0.99).all()


def test_without_holes_nothing_changes():
    whole = people(12)
    filled, space = shapes_with_holes(whole, np.ones(whole.shape[:2], bool), 3)
    assert np.array_equal(filled, whole) and np.array_equal(
        space.mean, principal_shapes(whole, 3).mean
    )
