import numpy as np
import pytest
from bars import bar, surface

from habitus_lab.population.flesh.refine import refined


@pytest.mark.parametrize("longest", [0.3, 0.12, 0.05])
def test_refined_surface_is_the_same_one_with_short_edges(longest):
    cage = bar((1, 2, 3), (0.5, 0.3, 0.2))
    faces = surface(cage)
    points, parts = refined(cage.nodes, faces, longest)
    edges = np.sort(np.concatenate([parts[:, [0, 1]], parts[:, [1, 2]], parts[:, [2, 0]]]), 1)
    assert np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1).max() <= longest
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    a, b, c = points[parts].transpose(1, 0, 2)
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(0.5 * 0.3 * 0.2)
    assert np.array_equal(points[: len(cage.nodes)], cage.nodes)
