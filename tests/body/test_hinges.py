"""Hinge correctives: what they add, that their derivatives are exact, and that they travel with a
body.
"""

from dataclasses import replace

import numpy as np
import pytest
from hinged_body import KNEE, with_hinges
from synthetic_fit import tube_body

import habitus as hb
from habitus.body.jacobians import surface_jacobian
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body, save_body


@pytest.fixture(scope="module")
def body():
    return with_hinges(load_body("female"))


def bent(body, degrees):
    pose = np.zeros((body.num_joints, 3))
    pose[body.joint_names.index(KNEE)] = [np.radians(degrees), 0.1, -0.05]
    pose[body.joint_names.index("left_elbow"), 1] = -0.5
    return pose


def offsets_by_hand(body, betas, pose):
    """What the channels add at rest, from the definition."""
    entries = hb.rotations.matrix_from_rotvec(pose) - np.eye(3)
    hinges = body.hinges
    total = np.zeros((body.num_vertices, 3))
    for c, joint in enumerate(hinges.joint):
        feature = entries[joint].ravel()
        weight = np.clip(hinges.rows[c] @ feature - hinges.bias[c], 0, 1) ** 2
        total += hinges.directions[:, :, c, 0] * (weight - hinges.linear[c] @ feature)
        total += weight * hinges.directions[:, :, c, 1:] @ betas[:2]
    return total


@pytest.mark.parametrize("degrees", [-20.0, 40.0, 100.0, 140.0])
def test_channels_add_what_their_definition_says(body, degrees):
    betas = np.array([1.5, -0.7, 0.3])
    pose = bent(body, degrees)
    plain = replace(body, hinges=None)
    moved = replace(
        plain, v_template=plain.v_template + offsets_by_hand(body, betas, pose), finer=None
    )
    expected = plain.prepare(betas).moved((moved.rest_vertices(betas)).T.ravel(), pose, np.zeros(3))
    surface = body(betas, pose)
    np.testing.assert_allclose(surface.vertices, expected.vertices, atol=1e-9)
    np.testing.assert_allclose(surface.joints, plain(betas, pose).joints, atol=1e-12)


def test_every_path_gives_the_same_surface(body):
    torch = pytest.importorskip("torch")
    betas = np.random.default_rng(1).normal(size=(5, 10))
    pose = np.stack([bent(body, t) for t in (0, 70, 100, 120, 150)])
    many = body(betas, pose).vertices
    single = np.stack([body(b, p).vertices for b, p in zip(betas, pose, strict=True)])
    readable = body(torch.tensor(betas), torch.tensor(pose, requires_grad=True)).vertices
    some = np.flatnonzero(body.hinges.directions.any((1, 2, 3)))[::7]
    np.testing.assert_allclose(many, single, atol=1e-12)
    np.testing.assert_allclose(many, readable.detach().numpy(), atol=1e-12)
    np.testing.assert_allclose(many[:, some], body(betas, pose, vertices=some).vertices, atol=1e-12)
    plain = body.hinges.without_linear(body.posedirs, body.drivers)
    person = replace(body, posedirs=plain, hinges=body.hinges.for_person(betas[4]))
    np.testing.assert_allclose(person(betas[4], pose[4]).vertices, many[4], atol=1e-12)


@pytest.mark.parametrize("degrees", [40.0, 85.0, 110.0, 140.0])
def test_derivatives_are_exact(body, degrees):
    some = np.flatnonzero(body.hinges.directions.any((1, 2, 3)))[::40]
    betas = np.array([1.0, -0.5, *np.zeros(body.num_betas - 2)])
    pose = bent(body, degrees)
    jacobian = surface_jacobian(body, betas, pose, vertices=some)
    np.testing.assert_allclose(
        jacobian.surface.vertices, body(betas, pose, vertices=some).vertices, atol=1e-12
    )
    step = 1e-6
    knee = body.joint_names.index(KNEE)
    for axis in range(3):
        change = np.zeros_like(pose)
        change[knee, axis] = step
        ahead, behind = (body(betas, pose + s * change, vertices=some).vertices for s in (1, -1))
        slope = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(jacobian.vertices_pose[:, :, knee, axis], slope, atol=1e-7)
    for beta in range(4):
        change = step * np.eye(body.num_betas)[beta]
        ahead, behind = (body(betas + s * change, pose, vertices=some).vertices for s in (1, -1))
        slope = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(jacobian.vertices_betas[:, :, beta], slope, atol=1e-7)


def test_hinges_travel_with_a_body(body, tmp_path):
    pose = bent(body, 130)
    betas = np.array([1.0, 2.0])
    save_body(body, tmp_path / "body.npz")
    read = load_body(tmp_path / "body.npz")
    np.testing.assert_allclose(read(betas, pose).vertices, body(betas, pose).vertices, atol=1e-6)
    one = body.with_betas(1)
    assert one.hinges.num_shapes == 1
    np.testing.assert_allclose(one([1.0], pose).vertices, body([1.0], pose).vertices, atol=1e-12)
    fewer = body.with_joints("smpl")
    named = {body.joint_names[j] for j in body.hinges.joint}
    assert {fewer.joint_names[j] for j in fewer.hinges.joint} == named
    child = body.at_age(8)
    assert np.abs(child.hinges.directions).max() < np.abs(body.hinges.directions).max()


def test_files_for_others_have_the_pose_blend_shapes_that_stand_in_for_hinges(tmp_path):
    body = with_hinges(tube_body(posedirs=True))
    plain = replace(body, hinges=None)
    pose = bent(body, 130)
    save_body(body, tmp_path / "body.pkl")
    read = load_body(tmp_path / "body.pkl")
    assert read.hinges is None
    np.testing.assert_allclose(read((), pose).vertices, plain((), pose).vertices, atol=1e-9)
    save_body(body, tmp_path / "body.npz")
    save_body(plain, tmp_path / "plain.npz")
    with np.load(tmp_path / "body.npz") as file, np.load(tmp_path / "plain.npz") as without:
        more = set(file.files) - set(without.files)
        assert more == {"hinge_joints", "hinge_rows", "hinge_bias", "hinge_linear", "hingedirs"}
        np.testing.assert_array_equal(file["posedirs"], without["posedirs"])


def test_hinges_that_do_not_fit_are_refused(body):
    hinges = body.hinges
    root = replace(hinges, joint=np.zeros(4, np.int64))
    with pytest.raises(HabitusError, match="which drive no pose blend shapes"):
        replace(body, hinges=root)
    with pytest.raises(HabitusError, match="shape coefficients"):
        replace(body, shapedirs=body.shapedirs[..., :1], people_mean=None, people_skew=None)
    with pytest.raises(HabitusError, match="'rotations' and no shape_features"):
        thirds = body.posedirs[..., : 3 * len(body.drivers)]
        replace(body, posedirs=thirds, pose_features="angles")
    assert replace(body, posedirs=None).hinges is None
