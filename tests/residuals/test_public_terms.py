"""Terms that a user gives to `habitus.minimize`: a planted body is found; each term is what it is
named for.
"""

import numpy as np
import torch
from synthetic_fit import reference_vertices, tube_body

import habitus as hb
from habitus.body.prior import shipped_prior
from habitus.observe.markers import attach


def test_a_planted_body_is_found_from_its_markers():
    body = tube_body(betas=3)
    rng = np.random.default_rng(2)
    betas = rng.normal(size=(1, 3))
    pose = 0.2 * rng.normal(size=(1, 24, 3))
    trans = rng.normal(size=(1, 3))
    sites = np.arange(0, body.num_vertices, 2)
    observed = reference_vertices(body, betas, pose, trans, sites)[0]
    observed[3] = np.nan
    zeros = (torch.zeros(size, dtype=torch.float64) for size in ((3,), (24, 3), (3,)))
    terms = {
        "markers": hb.terms.Markers(body, observed, sites),
        "pose": hb.terms.PosePrior(body),
        "betas": hb.terms.ShapePrior(),
    }
    weights = {"markers": 1e4, "pose": 1e-6, "betas": 1e-6}
    start = dict(zip(("betas", "pose", "trans"), zeros, strict=True))
    found = hb.minimize(terms, start, weights=weights, max_iterations=120)
    np.testing.assert_allclose(found.values["betas"], betas[0], atol=5e-3)
    np.testing.assert_allclose(found.values["trans"], trans[0], atol=1e-3)
    np.testing.assert_allclose(
        body(*found.values.values()).vertices[sites[10:]],
        reference_vertices(body, betas, pose, trans, sites[10:])[0],
        atol=2e-3,
    )


def test_markers_off_the_skin_ride_on_their_triangles():
    body = tube_body(betas=2)
    rng = np.random.default_rng(3)
    rest = np.asarray(body.v_template)
    attachment = attach(rest[[5, 90]] + 0.01 * rng.normal(size=(2, 3)), rest, body.faces)
    state = [torch.as_tensor(0.1 * rng.normal(size=size)) for size in ((2,), (24, 3), (3,))]
    nowhere = hb.terms.Markers(body, np.zeros((2, 3)), attachment)(*state)
    again = hb.terms.Markers(body, nowhere.numpy(), attachment)(*state)
    np.testing.assert_allclose(again, 0.0, atol=1e-12)


def test_the_pose_prior_is_the_shipped_one_and_leaves_the_root_free():
    prior = shipped_prior().for_joints(hb.load_body("default").joint_names)
    pose = torch.as_tensor(0.3 * np.random.default_rng(4).normal(size=(24, 3)))
    off = pose[1:].flatten().numpy() - prior.mean
    residual = hb.terms.PosePrior()(pose)
    np.testing.assert_allclose(residual @ residual, off @ prior.precision @ off, rtol=1e-9)
    turned = pose.clone()
    turned[0] += 1.0
    np.testing.assert_array_equal(hb.terms.PosePrior()(turned), residual)


def test_acceleration_is_zero_at_constant_velocity():
    steady = torch.arange(5.0)[:, None, None] * torch.ones(4, 3)
    assert not hb.terms.Acceleration()(steady).any()
    assert hb.terms.Acceleration()(steady**2).shape == (3, 3, 3)
    torch.testing.assert_close(hb.terms.Acceleration()(steady**2), torch.full((3, 3, 3), 2.0))
