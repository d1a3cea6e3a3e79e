"""Latent markers on a body of unknown shape: the compiled kernel against the surface Jacobian."""

import numpy as np
import pytest

from habitus.io.models.bodies import load_body
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.markers import MarkerAttachment, attach, marker_jacobian

FRAMES = 5  # more than one group of SIMD lanes is, and the second not full


@pytest.mark.parametrize("joints", ["smpl", "smplh"])
def test_the_kernel_gives_the_surface_jacobian(joints):
    body = load_body("default", joints=joints)
    rng = np.random.default_rng(3)
    triangles = body.faces[rng.choice(len(body.faces), 30, replace=False)]
    betas = rng.normal(size=body.num_betas)
    pose = 0.6 * rng.normal(size=(FRAMES, body.num_joints, 3))
    trans = rng.normal(size=(FRAMES, 3))
    coefficients = 0.02 * rng.normal(size=(len(triangles), 3))
    held = MarkerAttachment(triangles, coefficients)
    found = LatentMarkers(body, triangles)._moved(held, betas, pose, trans)
    expected = marker_jacobian(body, held, betas, pose, trans)
    for name in expected._fields:
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), atol=1e-11, err_msg=name
        )


def test_derivatives_are_those_of_the_markers():
    body = load_body("default")
    rng = np.random.default_rng(4)
    betas = rng.normal(size=body.num_betas)
    rest = body.rest_vertices(betas)
    latent = rest[rng.choice(body.num_vertices, 12, replace=False)] + 0.01
    markers = LatentMarkers(body, attach(latent, rest, body.faces).triangles)
    pose = 0.4 * rng.normal(size=(FRAMES, body.num_joints, 3))
    trans = rng.normal(size=(FRAMES, 3))
    found = markers.jacobian(betas, latent, pose, trans)
    np.testing.assert_allclose(found.markers, markers(betas, latent, pose, trans), atol=1e-12)
    step = rng.normal(size=betas.shape)
    ahead, behind = (
        markers(betas + sign * 1e-6 * step, latent, pose, trans) for sign in (1.0, -1.0)
    )
    np.testing.assert_allclose(found.by_betas @ step, (ahead - behind) / 2e-6, atol=1e-7)
