"""Shapes beyond the first are nested; what is learned on one form is carried to another's betas."""

import numpy as np

from habitus_lab.default_body.pose_shapes import _rewritten
from habitus_lab.default_body.shape_space import principal_shapes, with_further_shapes


def _people(rng):
    """Symmetric bodies (80, 20, 3) along 12 directions, their mirror, and two measurements."""
    mirror = np.concatenate([np.arange(10, 20), np.arange(10)])
    left = rng.normal(size=(12, 10, 3)) * 0.8 ** np.arange(12)[:, None, None]
    shapes = np.concatenate([left, left * [-1, 1, 1]], 1)
    base = rng.normal(size=(10, 3))
    people = np.concatenate([base, base * [-1, 1, 1]]) + np.tensordot(
        rng.normal(size=(80, 12)), shapes, 1
    )
    return people, mirror, people[:, :2, 1]


def test_further_shapes_leave_the_first_alone_and_close_the_space():
    rng = np.random.default_rng(0)
    people, mirror, measures = _people(rng)
    area = rng.uniform(0.5, 2, 20)
    area = area + area[mirror]
    first = principal_shapes(people, 4, mirror, measures)
    nobody = np.zeros((0, 20, 3))
    every = with_further_shapes(first, people, 8, mirror, measures, area, nobody, 0.3)
    np.testing.assert_array_equal(every.shapedirs[..., :4], first.shapedirs)
    np.testing.assert_array_equal(every.betas[:, :4], first.betas)
    spread = np.cov(every.betas.T)
    np.testing.assert_allclose(spread, np.eye(12), atol=1e-3)
    np.testing.assert_allclose(every.bodies(every.betas), people, atol=1e-4)
    left = every.shapedirs[..., 4:]
    weighed = (left * np.sqrt(area)[:, None, None]).reshape(-1, 8)
    square = weighed.T @ weighed
    np.testing.assert_allclose(square, np.diag(np.diag(square)), atol=1e-4 * square.max())
    assert (np.diff(np.diag(square)) < 0).all()


def test_others_widen_the_space_and_leave_the_first_shapes_alone():
    rng = np.random.default_rng(2)
    people, mirror, measures = _people(rng)
    first = principal_shapes(people, 4, mirror, measures)
    left = rng.normal(size=(10, 3))
    bump = np.concatenate([left, left * [-1, 1, 1]])  # what no person varies by
    others = people[:9] + rng.normal(size=(9, 1, 1)) * bump
    arguments = people, 9, mirror, measures, np.ones(20)
    without = with_further_shapes(first, *arguments, others[:0], 1.0)
    wider = with_further_shapes(first, *arguments, others, 1.0)
    np.testing.assert_array_equal(wider.shapedirs[..., :4], first.shapedirs)

    def miss(space):
        return np.abs(space.bodies(space.fit(others)) - others).max()

    assert miss(wider) < 1e-3 < 0.1 < miss(without)


def test_blocks_times_betas_are_the_same_for_new_betas():
    rng = np.random.default_rng(1)
    blocks = rng.normal(size=(3, 5, 4)).astype(np.float32)
    turn = np.eye(2) + 0.2 * rng.normal(size=(2, 2))
    new = rng.normal(size=2)
    before = blocks[0] + np.tensordot(turn @ new, blocks[1:], 1)
    rewritten = _rewritten(blocks, turn)
    np.testing.assert_allclose(
        rewritten[0] + np.tensordot(new, rewritten[1:], 1), before, atol=1e-5
    )
