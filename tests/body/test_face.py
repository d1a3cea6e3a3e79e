"""Face units and identity: what they add, that every path gives the same surface, and that they
travel with a body.
"""

from dataclasses import replace

import numpy as np
import pytest
from face_body import JAW, with_face

import habitus as hb
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body, save_body
from habitus.rotations import matrix_from_rotvec


@pytest.fixture(scope="module")
def body():
    return with_face(load_body("female", joints="smplx"))


def test_a_unit_moves_skin_and_turns_its_joint(body):
    weight = 0.7
    moved = np.zeros((body.num_vertices, 3))
    moved[body.face.vertices] = weight * body.face.unit_directions[..., 1]
    plain = replace(body, face=None)
    rest = plain.rest_vertices([1.0]) + moved
    pose = np.zeros((body.num_joints, 3))
    pose[body.joint_names.index(JAW)] = [0.1 + weight * 0.35, 0, 0]
    expected = plain.prepare([1.0]).moved(rest.T.ravel(), pose, np.zeros(3))
    found = body([1.0], pose={JAW: (0.1, 0, 0)}, face={"jawOpen": weight})
    np.testing.assert_allclose(found.vertices, expected.vertices, atol=1e-12)
    np.testing.assert_allclose(found.joints, plain([1.0], pose).joints, atol=1e-12)


def test_every_path_gives_the_same_surface(body):
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    face = rng.uniform(0, 1, (4, 3))
    identity = rng.normal(size=(4, 4))
    betas = rng.normal(size=(4, 5))
    many = body(betas, face=face, face_betas=identity).vertices
    named = dict(zip(body.face_unit_names, face.T, strict=True))
    np.testing.assert_array_equal(many, body(betas, face=named, face_betas=identity).vertices)
    rows = zip(betas, face, identity, strict=True)
    single = [body(b, face=f, face_betas=i).vertices for b, f, i in rows]
    np.testing.assert_allclose(many, np.stack(single), atol=1e-12)
    some = body.face.vertices[::5]
    part = body(betas, face=face, face_betas=identity, vertices=some).vertices
    np.testing.assert_allclose(many[:, some], part, atol=1e-12)
    tensor = torch.tensor(face, requires_grad=True)
    readable = body(torch.tensor(betas), face=tensor, face_betas=torch.tensor(identity)).vertices
    np.testing.assert_allclose(many, readable.detach().numpy(), atol=1e-12)
    readable.sum().backward()
    step = 1e-6 * np.eye(3)[1]
    ends = [body(betas, face=face + s * step, face_betas=identity).vertices.sum() for s in (1, -1)]
    assert tensor.grad is not None
    assert tensor.grad[:, 1].sum().item() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5)


def test_identity_places_joints_and_units_do_not(body):
    rest = body().joints
    np.testing.assert_allclose(body(face={"smile": 1.0}).joints, rest, atol=1e-12)
    moved = replace(
        body,
        v_template=body.v_template + body.face.directions(body.num_vertices)[..., 1],
        face=None,
    )
    found = body(face_betas=[0, 1.0])
    np.testing.assert_allclose(found.joints, moved().joints, atol=1e-12)
    np.testing.assert_allclose(found.vertices, moved().vertices, atol=1e-12)


def test_a_body_without_a_jaw_opens_its_mouth_all_the_same(body):
    plain = body.with_joints("smpl")
    one = {"jawOpen": 1.0}
    np.testing.assert_allclose(plain(face=one).vertices, body(face=one).vertices, atol=1e-9)
    half = plain(face={"jawOpen": 0.5}).vertices - body(face={"jawOpen": 0.5}).vertices
    arm = np.linalg.norm(body.v_template - body.joint_template[body.joint_names.index(JAW)], axis=1)
    moving = body.skinning_weights[:, body.joint_names.index(JAW)] > 0
    sag = np.linalg.norm(0.5 * (matrix_from_rotvec(np.array([0.35, 0, 0])) + np.eye(3))[1:, 1])
    assert np.linalg.norm(half, axis=1).max() <= (1 - sag + 1e-2) * arm[moving].max()


def test_ages_and_files_keep_the_face(body, tmp_path):
    child = body.at_age(8)
    ratio = child.face.unit_directions / body.face.unit_directions
    assert np.ptp(ratio) < 1e-9
    assert ratio.mean() < 0.9
    for name in ("face.npz", "face.pkl"):
        for one in (body, body.with_joints("smpl")):
            save_body(one, tmp_path / name)
            again = load_body(tmp_path / name)
            assert again.face_unit_names == body.face_unit_names
            weights = {"smile": 0.4, "jawOpen": 0.9}
            before = one(face=weights, face_betas=[1.0, -2.0]).vertices
            after = again(face=weights, face_betas=[1.0, -2.0]).vertices
            np.testing.assert_allclose(before, after, atol=1e-8)


def test_bad_weights_are_named(body):
    with pytest.raises(HabitusError, match=r"no face unit 'jawopen'; did you mean jawOpen"):
        body(face={"jawopen": 1.0})
    with pytest.raises(HabitusError, match=r"face has shape \(2,\); expected \(\*batch, 3\)"):
        body(face=[1.0, 2.0])
    with pytest.raises(HabitusError, match=r"face_betas has shape \(5,\); expected \(\*batch, 4\)"):
        body(face_betas=np.zeros(5))
    with pytest.raises(HabitusError, match="has no face units"):
        replace(hb.load_body("female"), face=None)(face={"jawOpen": 1.0})
