"""Pose blend shapes without their zeros: the same surfaces, whatever the batch, the dtype and the
vertices.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

import habitus.body.body_arrays as views
from habitus.body.kernels import local_shapes
from habitus.io.models.bodies import load_body

SOME = np.arange(0, 1200, 3)


@pytest.fixture(scope="module")
def body():
    """The default body with random blend shapes of the joints that move each vertex."""
    bare = load_body("default")
    rng = np.random.default_rng(0)
    drivers = tuple(np.flatnonzero(bare.skinning_weights.any(0))[1:].tolist())
    near = bare.skinning_weights[:, list(drivers)] > 0.05
    posedirs = (
        0.01 * rng.normal(size=(bare.num_vertices, 3, len(drivers), 9)) * near[:, None, :, None]
    )
    return replace(
        bare, posedirs=posedirs.reshape(bare.num_vertices, 3, -1), pose_joints=drivers, finer=None
    )


def state(body, batch, seed=0):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(batch, 4)),
        0.4 * rng.normal(size=(batch, body.num_joints, 3)),
        rng.normal(size=(batch, 3)),
    )


@pytest.mark.parametrize("batch", [1, 3, 5, 67])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_without_the_zeros_the_surface_is_the_same(body, batch, dtype, monkeypatch):
    given = [part.astype(dtype) for part in state(body, batch)]
    kind = body.prepare(given[0], vertices=SOME)
    assert kind.rows.local is not None
    found = kind(*given[1:]).vertices
    monkeypatch.setattr(views, "local_shapes", lambda *_: None)
    with_zeros = body.prepare(given[0], vertices=SOME)
    assert with_zeros.rows.local is None
    np.testing.assert_allclose(
        found, with_zeros(*given[1:]).vertices, atol=1e-12 if dtype == np.float64 else 3e-6
    )


def test_one_shape_in_many_poses_and_gradients(body):
    betas, pose, trans = state(body, 6)
    one = body.prepare(betas[0], vertices=SOME)(pose, trans).vertices
    many = body(np.repeat(betas[:1], 6, 0), pose, trans, vertices=SOME).vertices
    np.testing.assert_allclose(one, many, atol=1e-12)
    turned = torch.tensor(pose, requires_grad=True)  # readable code, dense blend shapes
    np.testing.assert_allclose(
        body(betas[0], turned, trans, vertices=SOME).vertices.detach(), one, atol=1e-12
    )


def test_it_is_done_where_it_pays(body):
    posedirs = body.posedirs[SOME]
    assert local_shapes(posedirs, 9, 1) is not None
    assert local_shapes(None, 9, 1) is None
    assert local_shapes(posedirs, 3, 1) is None  # other features
    assert local_shapes(posedirs, 9, 2) is None  # times shape coefficients
    assert local_shapes(posedirs[:100], 9, 1) is None  # few vertices
    assert local_shapes(posedirs + 1.0, 9, 1) is None  # no zeros
