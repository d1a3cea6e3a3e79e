"""Arrow matrices against the same matrices written out."""

import numpy as np
import pytest
import scipy.linalg

from habitus.solve.arrow import ArrowMatrix


@pytest.fixture(params=[(5, 3, 4), (1, 1, 1), (7, 6, 2), (0, 3, 4)])
def arrow(request) -> ArrowMatrix:
    shared, count, width = request.param
    rng = np.random.default_rng(shared)
    rows = rng.normal(size=(count, 3 * (shared + width), shared + width))
    grams = np.swapaxes(rows, 1, 2) @ rows
    return ArrowMatrix(
        grams[:, :shared, :shared].sum(0), grams[:, shared:, :shared], grams[:, shared:, shared:]
    )


def test_product_diagonal_and_solution_are_those_of_the_dense_matrix(arrow):
    dense = arrow.dense()
    rng = np.random.default_rng(1)
    vector = rng.normal(size=len(dense))
    damping = rng.uniform(size=len(dense))
    np.testing.assert_allclose(arrow @ vector, dense @ vector)
    np.testing.assert_allclose(arrow.diagonal(), np.diagonal(dense))
    np.testing.assert_allclose(
        arrow.solve(damping, vector), np.linalg.solve(dense + np.diag(damping), vector)
    )


def test_an_indefinite_matrix_is_refused(arrow):
    with pytest.raises(scipy.linalg.LinAlgError):
        arrow.solve(np.full(len(arrow.dense()), -1e6), np.ones(len(arrow.dense())))
