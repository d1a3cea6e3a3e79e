"""Maps of topology: places on a surface, whatever its shape and pose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from habitus.errors import HabitusError
from habitus.mesh.surface_map import SurfaceMap


def random_map(seed: int, count: int = 30, vertices: int = 12) -> SurfaceMap:
    rng = np.random.default_rng(seed)
    faces = np.stack([rng.permutation(vertices)[:3] for _ in range(20)])
    face = rng.integers(0, len(faces), count)
    return SurfaceMap(
        "made",
        face,
        faces[face],
        rng.dirichlet(np.ones(3), count),
        rng.random(count) < 0.9,
        np.stack([rng.permutation(count)[:3] for _ in range(20)]),
        vertices,
    )


@given(st.integers(0, 10_000))
def test_motions_and_scales_pass_through(seed):
    places = random_map(seed)
    rng = np.random.default_rng(seed + 1)
    surface = rng.normal(size=(2, places.surface_vertices, 3))
    turn, shift, scale = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3), 1.7
    moved = places.vertices(scale * surface @ turn.T + shift)
    expected = scale * places.vertices(surface) @ turn.T + shift
    np.testing.assert_allclose(moved, expected, atol=1e-12)


@given(st.integers(0, 10_000))
def test_the_matrix_is_the_map(seed):
    places = random_map(seed)
    surface = np.random.default_rng(seed).normal(size=(places.surface_vertices, 3))
    np.testing.assert_allclose(places.matrix() @ surface, places.vertices(surface), atol=1e-12)
    np.testing.assert_allclose(places.matrix().sum(1), 1.0, atol=1e-12)


def test_another_surface_is_refused():
    places = random_map(0)
    with pytest.raises(HabitusError, match="a surface of 13 vertices; the map to made expects 12"):
        places.vertices(np.zeros((13, 3)))
