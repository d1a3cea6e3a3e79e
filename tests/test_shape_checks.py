"""Shapes that signatures state are checked while tests run."""

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError
from shape_checks import CALLS, begin_test, first_calls, shapes_only

from habitus.mesh.normals import vertex_normals


def test_a_wrong_shape_is_an_error_in_the_package():
    with pytest.raises(TypeCheckError, match="vertices"):
        vertex_normals(np.zeros((5, 4)), np.array([[0, 1, 2]]))


def test_the_first_calls_in_each_test_are_checked():
    @first_calls(typechecker=shapes_only)
    def same(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        return points

    for _ in range(2):
        begin_test()
        for _ in range(CALLS - 1):
            same(np.zeros((2, 3)))
        with pytest.raises(TypeCheckError):
            same(np.zeros((2, 4)))
        assert same(np.zeros((2, 4))).shape == (2, 4)
