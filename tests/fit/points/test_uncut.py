"""A free surface adds no place where it cuts itself."""

import numpy as np
import trimesh

from habitus.fit.points.correspondences import Topology
from habitus.fit.points.free_surface import uncut
from habitus.mesh.intersections import intersecting_pairs

BALL = trimesh.creation.icosphere(3, 0.1)
COUNT = len(BALL.vertices)
FACES = np.concatenate([np.asarray(BALL.faces), np.asarray(BALL.faces) + COUNT])


def thighs(apart: float) -> np.ndarray:
    """Two balls side by side (m), their middles so far apart."""
    one = np.asarray(BALL.vertices)
    return np.concatenate([one, one + np.array([apart, 0.002, 0.001])])


def swollen(model: np.ndarray, by: float) -> np.ndarray:
    middles = np.repeat([model[:COUNT].mean(0), model[COUNT:].mean(0)], COUNT, axis=0)
    return model + by * (model - middles) / 0.1


def test_what_swells_into_itself_goes_back_there_and_nowhere_else():
    topology = Topology.of(FACES, 2 * COUNT)
    model = thighs(0.203)
    surface = swollen(model, 0.006)
    assert (
        len(intersecting_pairs(model, FACES)) == 0 and len(intersecting_pairs(surface, FACES)) > 5
    )
    found = uncut(topology, model, surface)
    assert len(intersecting_pairs(found, FACES)) == 0
    moved = np.linalg.norm(found - surface, axis=1)
    assert moved[np.abs(surface[:, 0] - 0.1) > 0.06].max() == 0.0 and moved.max() < 0.006


def test_where_the_model_cuts_itself_the_surface_may():
    topology = Topology.of(FACES, 2 * COUNT)
    model = thighs(0.19)
    found = uncut(topology, model, swollen(model, 1e-5))
    before = {tuple(pair) for pair in intersecting_pairs(model, FACES)}
    assert before and {tuple(pair) for pair in intersecting_pairs(found, FACES)} <= before
    np.testing.assert_array_equal(uncut(topology, model, model), model)
