"""Markers at one place of a layout: their places on the body are found from points in any order,
some missing.
"""

from dataclasses import replace

import numpy as np
import planted

from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.clusters import clusters, separated
from habitus.fit.markers.energy import Placement, place
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import MarkerAttachment, attach, default_markers

THREE = [0, 17, 30]
OFFSETS = np.array([[0.02, 0.03, -0.05], [0.01, -0.04, 0.02], [0.015, 0.05, 0.04]])


def plated(truth: planted.Planted) -> Placement:
    """The layout's places, three markers at that of one."""
    placement = place(truth.layout, truth.body)
    vertices = placement.vertices.copy()
    vertices[THREE] = vertices[truth.column("LKNE")]
    distance = placement.distance.copy()
    distance[THREE] = 0.004
    return replace(placement, vertices=vertices, distance=distance)


def test_a_cluster_is_what_a_layout_has_at_one_place():
    truth = planted.plant(4, seed=3)
    assert [group.tolist() for group in clusters(plated(truth))] == [THREE]
    assert clusters(place(truth.layout, truth.body)) == []


def test_each_marker_of_a_cluster_is_where_its_points_are():
    truth = planted.plant(12, seed=3)
    placement = plated(truth)
    latent = default_markers(truth.body, truth.betas, placement.vertices, placement.distance)
    usual = attach(latent, planted.rest(truth.betas), np.asarray(truth.body.faces))
    coefficients = usual.coefficients.copy()
    coefficients[THREE] += OFFSETS
    points = predict(
        marked_body(truth.body, truth.betas, MarkerAttachment(usual.triangles, coefficients)),
        truth.pose,
        truth.trans,
    )
    rng = np.random.default_rng(0)
    shown = np.array([rng.permutation(frame[THREE]) for frame in points])
    shown[rng.integers(2, 12, 5), rng.integers(0, 3, 5)] = np.nan
    clouds = Clouds.of(shown, planted.RATE_HZ, "+y")
    nameless = np.full(len(clouds.points), -1)
    frames = np.arange(12)
    state = (truth.pose, truth.trans)
    found = separated(truth.body, truth.betas, usual, placement, clouds, nameless, frames, state)
    others = np.setdiff1d(np.arange(len(latent)), THREE)
    assert np.array_equal(found.coefficients[others], usual.coefficients[others])
    apart = np.linalg.norm(found.coefficients[THREE][:, None] - coefficients[THREE], axis=2)
    assert apart.min(axis=0).max() < 1e-6 and len(set(apart.argmin(axis=1))) == 3
