"""Planted registrations are what they say: exact in the class, out of reach outside it, the same
for the same seed.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from habitus.body.pose_features import POSE_FEATURES
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.rotations import matrix_from_rotvec
from habitus_lab.population.bulging_flesh import out_of_class_surface
from habitus_lab.population.coarse_bodies import coarse_body, mirrored_names
from habitus_lab.population.faults import FAULTS, spoil
from habitus_lab.population.planted_body import planted_truth
from habitus_lab.population.poses import joint_limits, motion_poses, resting_poses, sample_poses
from habitus_lab.population.registrations import PAPERS_SIZE, body_of, planted_registrations

SIDE = np.array([-1.0, 1.0, 1.0])
TURN = np.array([1.0, -1.0, -1.0])
SMALL = {
    "subjects": 3,
    "poses_per_subject": 4,
    "shape_people": 5,
    "test_subjects": 2,
    "test_poses": 3,
}


@pytest.fixture(scope="module")
def people():
    return load_body("default")


@pytest.fixture(scope="module")
def coarse(people):
    return coarse_body(people, 600)


@pytest.fixture(scope="module")
def truth(coarse):
    return planted_truth(coarse, seed=3)


@pytest.fixture(scope="module")
def flesh(coarse):
    return out_of_class_surface(coarse)


@pytest.fixture(scope="module", params=["truth", "flesh"])
def surface(request):
    return request.getfixturevalue(request.param)


def some_states(surface, count, seed=0):
    body = body_of(surface)
    rng = np.random.default_rng(seed)
    pose = sample_poses(rng, count, joint_limits(body.joint_names))
    betas = rng.standard_normal((count, body.num_betas)).clip(-2, 2)
    return torch.from_numpy(betas), torch.from_numpy(pose)


def mirrored(body, vertices, pose):
    return vertices[:, body.mirror] * torch.from_numpy(SIDE), pose[
        :, mirrored_names(body.joint_names)
    ] * TURN


# coarse bodies


def test_a_coarse_body_is_closed_symmetric_and_made_of_the_bodys_vertices(people, coarse):
    mesh = trimesh.Trimesh(coarse.v_template, coarse.faces, process=False)
    assert 560 <= coarse.num_vertices <= 600
    assert (
        mesh.is_watertight
        and mesh.is_winding_consistent
        and mesh.euler_number == 2
        and mesh.body_count == 1
    )
    assert mesh.volume == pytest.approx(
        trimesh.Trimesh(people.v_template, people.faces, process=False).volume, rel=0.06
    )
    assert {*map(tuple, coarse.v_template.tolist())} <= {*map(tuple, people.v_template.tolist())}
    np.testing.assert_array_equal(coarse.v_template[coarse.mirror] * SIDE, coarse.v_template)
    turned = {tuple(sorted(face)) for face in coarse.mirror[coarse.faces].tolist()}
    assert turned == {tuple(sorted(face)) for face in coarse.faces.tolist()}


def test_a_coarse_body_moves_as_the_whole_one(people, coarse):
    places = {tuple(point): k for k, point in enumerate(people.v_template.tolist())}
    rows = [places[tuple(point)] for point in coarse.v_template.tolist()]
    betas, pose = some_states(coarse, 4)
    apart = (coarse(betas, pose).vertices - people(betas, pose, vertices=rows).vertices).norm(
        dim=-1
    )
    assert apart.mean() < 0.005  # joints are regressed anew
    rest = torch.zeros(1, people.num_betas, dtype=torch.float64)
    assert (coarse.rest_joints(rest) - people.rest_joints(rest)).norm(dim=-1).max() < 0.001
    np.testing.assert_allclose(coarse.joint_regressor.sum(1), 1)
    assert coarse.joint_regressor.min() >= 0


def test_bodies_that_cannot_be_made_coarse_are_refused(people, coarse):
    with pytest.raises(HabitusError, match="mirror"):
        coarse_body(replace(people, mirror=None), 600)
    with pytest.raises(HabitusError, match="3 vertices asked"):
        coarse_body(coarse, 3)


# poses


def test_poses_keep_to_the_limits_and_use_every_joint(coarse):
    limits = joint_limits(coarse.joint_names)
    pose = sample_poses(np.random.default_rng(0), 400, limits)
    assert (pose >= np.minimum(limits.low, 0) - 1e-12).all() and (
        pose <= np.maximum(limits.high, 0) + 1e-12
    ).all()
    turned = np.degrees(np.linalg.norm(pose, axis=-1))
    assert ((turned > 10).mean(0) > 0.1).all()
    wide = limits.high - limits.low > np.radians(20)
    assert (np.ptp(pose, axis=0)[wide] > 0.7 * (limits.high - limits.low)[wide]).all()


def test_left_and_right_have_mirrored_limits_and_some_poses_are_symmetric(coarse):
    limits = joint_limits(coarse.joint_names)
    low = limits.low[limits.mirror] * TURN
    high = limits.high[limits.mirror] * TURN
    np.testing.assert_allclose(np.minimum(low, high), limits.low)
    np.testing.assert_allclose(np.maximum(low, high), limits.high)
    pose = sample_poses(np.random.default_rng(0), 400, limits)
    right = np.flatnonzero(limits.mirror < np.arange(24))
    alike = (pose[:, right] == pose[:, limits.mirror[right]] * TURN).all((1, 2))
    assert 0.2 < alike.mean() < 0.4


def test_bends_go_the_way_people_bend(people):
    """A flexed knee lifts the ankle backwards, a flexed elbow brings the wrist forward, an A-pose
    lowers the wrists.
    """
    limits = joint_limits(people.joint_names)
    names = people.joint_names.index
    still = people().joints
    for side in ("left", "right"):
        for joint, end in (("knee", "ankle"), ("elbow", "wrist")):
            k = names(f"{side}_{joint}")
            most = np.where(
                np.abs(limits.low[k]) > np.abs(limits.high[k]), limits.low[k], limits.high[k]
            )
            pose = {f"{side}_{joint}": most * (np.abs(most) > np.radians(100))}
            moved = people(pose=pose).joints[names(f"{side}_{end}")] - still[names(f"{side}_{end}")]
            assert (moved[2] < -0.1) if joint == "knee" else (moved[2] > 0.1)
    stand = resting_poses(np.random.default_rng(0), 2, limits)
    wrists = people(pose=stand).joints[:, [names("left_wrist"), names("right_wrist")], 1]
    assert (wrists[0] < wrists[1] - 0.2).all()


def test_joints_of_unknown_names_turn_anywhere_in_a_ball():
    pose = sample_poses(np.random.default_rng(0), 500, joint_limits(("root", "tail1", "tail2")))
    turned = np.linalg.norm(pose, axis=-1)
    assert turned.max() <= 0.9 and np.abs(pose.mean((0, 1))).max() < 0.1
    assert np.mean(turned < 0.9 * 0.5 ** (1 / 3)) == pytest.approx(
        0.5, abs=0.05
    )  # half the ball's volume


def test_motion_poses_are_frames_far_apart(tmp_path):
    rng = np.random.default_rng(0)
    walk = np.repeat(rng.standard_normal((6, 24, 3)), 50, axis=0) + 1e-3 * rng.standard_normal(
        (300, 24, 3)
    )
    np.savez(tmp_path / "walk.npz", poses=walk.reshape(300, 72))
    poses = motion_poses([tmp_path / "walk.npz"], 6, 24)
    apart = np.linalg.norm((poses[:, None] - poses).reshape(6, 6, -1), axis=-1)
    assert apart[~np.eye(6, dtype=bool)].min() > 1 and not poses[:, 0].any()
    np.savez(tmp_path / "hands.npz", poses=rng.standard_normal((9, 156)))
    assert not motion_poses([tmp_path / "hands.npz"], 3, 24)[:, 22:].any()
    with pytest.raises(HabitusError, match="9 frames"):
        motion_poses([tmp_path / "hands.npz"], 10, 24)
    np.savez(tmp_path / "odd.npz", joints=walk)
    with pytest.raises(HabitusError, match="odd"):
        motion_poses([tmp_path / "odd.npz"], 2, 24)


# surfaces


def test_the_mirrored_pose_gives_the_mirrored_surface(surface):
    body = body_of(surface)
    betas, pose = some_states(surface, 4)
    vertices = surface(betas, pose).vertices
    expected, turned = mirrored(body, vertices, pose)
    torch.testing.assert_close(surface(betas, turned).vertices, expected, rtol=0, atol=1e-9)


def test_planted_pose_shapes_are_as_large_as_asked_and_stay_near_their_joint(truth):
    shapes = torch.as_tensor(truth.posedirs).unflatten(2, (-1, 9))
    rest = torch.as_tensor(truth.joint_template)
    bends = torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    feature = (matrix_from_rotvec(bends / bends.norm(dim=1, keepdim=True)) - torch.eye(3)).flatten(
        1
    )
    shift = (shapes @ feature.T).norm(dim=1)  # (V, J - 1, bends)
    np.testing.assert_allclose(shift.amax(0).mean(1), 0.01, rtol=0.15)
    far = torch.cdist(torch.as_tensor(truth.v_template), rest[1:]) > 0.4
    assert shift.amax(2)[far].max() < 1e-4
    with pytest.raises(HabitusError, match="has pose blend shapes"):
        planted_truth(truth)


def test_bulges_are_no_linear_function_of_rotations_yet_near_one(coarse, flesh):
    """Regressed on vec(R - I), held-out bulges keep a tenth and more of their size, and lose most
    of it.
    """
    _, pose = some_states(flesh, 1500)
    bulge = (
        flesh.effort(pose) @ flesh.bulges
    )  # of the template's girth: what is left is the angle's doing
    features = POSE_FEATURES["rotations"].of_pose(pose, matrix_from_rotvec(pose))
    fitted = torch.linalg.lstsq(features[:1200], bulge[:1200], driver="gelsd").solution
    left = (bulge[1200:] - features[1200:] @ fitted).norm() / bulge[1200:].norm()
    assert 0.1 < left < 0.5
    exact = features @ fitted  # the same regression finds what is linear
    again = torch.linalg.lstsq(features[:1200], exact[:1200], driver="gelsd").solution
    assert (exact[1200:] - features[1200:] @ again).norm() < 1e-6 * exact[1200:].norm()


def test_bulges_depend_on_shape_and_vanish_at_rest(flesh):
    betas, pose = some_states(flesh, 12)
    bare = replace(flesh, bulges=torch.zeros_like(flesh.bulges))
    assert torch.equal(flesh(betas, 0 * pose).vertices, bare(betas, 0 * pose).vertices)
    bulge = (flesh(betas, pose[:1]).vertices - bare(betas, pose[:1]).vertices).norm(dim=-1)
    assert bulge.max() > 0.01
    felt = bulge.mean(0) > 0.002
    assert felt.sum() > 5 and (bulge[:, felt].std(0) / bulge[:, felt].mean(0)).mean() > 0.05
    thick = flesh.girths(betas).mean(1)
    assert np.corrcoef(thick, bulge.mean(1))[0, 1] > 0.5


def test_only_bodies_with_known_joints_have_muscles(coarse):
    nameless = replace(coarse, joint_names=tuple(f"bone{k}" for k in range(24)))
    with pytest.raises(HabitusError, match="no joint with a known muscle"):
        out_of_class_surface(nameless)
    with pytest.raises(HabitusError, match="no mirror"):
        out_of_class_surface(replace(coarse, mirror=None))


# data sets


def test_a_data_set_has_the_sets_asked_for(truth):
    planted = planted_registrations(truth, **SMALL)
    data = planted.registrations
    assert [data.set.count(name) for name in ("pose", "shape", "test")] == [12, 5, 6]
    assert [len(data.where(set=name).subjects) for name in ("pose", "shape", "test")] == [3, 5, 2]
    assert len(data.subjects) == 10 and len(set(data.name)) == len(data) == 23
    assert planted.joints.shape == (10, 24, 3)
    for k, person in enumerate(data.subject_index):
        np.testing.assert_allclose(
            planted.joints[person], truth.rest_joints(planted.betas[k]), atol=1e-12
        )
    assert len(np.unique(planted.betas, axis=0)) == 10
    assert {"female", "male"} >= set(data.sex) and all(
        len({data.sex[k] for k in np.flatnonzero(data.subject_index == p)}) == 1 for p in range(10)
    )


def test_the_papers_size_is_the_papers(truth):
    planted = planted_registrations(truth, **PAPERS_SIZE)
    assert [planted.registrations.set.count(name) for name in ("pose", "shape")] == [1786, 3800]
    assert len(planted.registrations.where(set="pose").subjects) == 40
    assert planted.registrations.read(5000).shape == (truth.num_vertices, 3)


def test_clean_vertices_are_the_surface_itself(surface):
    planted = planted_registrations(surface, **SMALL, dtype=np.float64)
    state = (torch.from_numpy(values) for values in (planted.betas, planted.pose, planted.trans))
    np.testing.assert_allclose(planted.clean[:], surface(*state).vertices.numpy(), atol=1e-12)


def test_noise_is_as_large_as_asked_and_registrations_are_read_alike_in_any_company(surface):
    planted = planted_registrations(surface, **SMALL, noise_rms=0.002)
    read = planted.registrations.vertices[:]
    assert read.dtype == np.float32
    off = read.astype(float) - planted.clean[:]
    assert np.sqrt((off**2).sum(-1).mean()) == pytest.approx(0.002, rel=0.01)
    assert abs(off.mean()) < 2e-5 and abs(np.corrcoef(off[0].ravel(), off[1].ravel())[0, 1]) < 0.1
    rows = np.array([22, 3, 3, 7])
    np.testing.assert_allclose(planted.registrations.vertices[rows], read[rows], atol=2e-7)
    np.testing.assert_allclose(planted.registrations.vertices[7], read[7], atol=2e-7)
    again = planted_registrations(surface, **SMALL, noise_rms=0.002)
    assert np.array_equal(again.registrations.vertices[:], read)
    other = planted_registrations(surface, **SMALL, noise_rms=0.002, seed=1)
    assert not np.allclose(other.registrations.vertices[:], read, atol=0.01)


def test_a_data_set_can_be_written_and_read(truth, tmp_path):
    lazy = planted_registrations(truth, **SMALL).registrations.vertices[:]
    stored = planted_registrations(truth, **SMALL, out=tmp_path / "data").registrations.vertices
    assert isinstance(stored, np.memmap)
    np.testing.assert_allclose(stored, lazy, atol=2e-7)
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["vertices.npy"]
    (tmp_path / "file").touch()
    with pytest.raises(HabitusError, match="cannot write"):
        planted_registrations(truth, **SMALL, out=tmp_path / "file")


def test_motions_take_the_place_of_sampled_poses(truth):
    motions = np.random.default_rng(0).standard_normal((30, 24, 3))
    planted = planted_registrations(truth, **SMALL, motions=motions)
    free = [k for k, name in enumerate(planted.registrations.name) if not name.endswith("-000")]
    used = [np.flatnonzero((motions[:, 1:] == planted.pose[k, 1:]).all((1, 2))) for k in free]
    assert sorted(map(len, used)) == [1] * 13 and len({int(k[0]) for k in used}) == 13
    with pytest.raises(HabitusError, match="at least 13 poses"):
        planted_registrations(truth, **SMALL, motions=motions[:12])


def test_numbers_without_sense_are_refused(truth):
    for wrong in ({"poses_per_subject": [1, 2]}, {"shape_people": -1}, {"poses_per_subject": 0}):
        with pytest.raises(HabitusError, match="asked for"):
            planted_registrations(truth, **{**SMALL, **wrong})


# faults


@pytest.mark.parametrize("kind", ["hole", "torn", "shuffled", "millimetres"])
def test_a_broken_registration_is_the_only_one_changed(truth, kind):
    planted = planted_registrations(truth, **SMALL)
    before = planted.registrations.vertices[:]
    after = spoil(planted, kind, 5).registrations.vertices
    same = np.array(
        [np.array_equal(a, b, equal_nan=True) for a, b in zip(before, after[:], strict=True)]
    )
    assert np.flatnonzero(~same).tolist() == [5]
    np.testing.assert_allclose(after[5], after[:][5], atol=1e-3 if kind == "millimetres" else 2e-7)
    off = np.linalg.norm(after[5] - before[5], axis=-1)
    amount = {
        "hole": np.isnan(off).sum() == 1,
        "torn": (off > 0.01).mean() == pytest.approx(0.1, abs=0.01),
    }
    amount |= {"shuffled": (off > 0.1).mean() > 0.5, "millimetres": np.ptp(after[5][:, 1]) > 800}
    assert amount[kind]


def test_mislabelled_and_unposed_are_what_they_say(truth):
    planted = planted_registrations(truth, **SMALL)
    data = planted.registrations
    wrong = spoil(planted, "mislabelled", 5).registrations
    changed = [k for k in range(len(data)) if data.subject[k] != wrong.subject[k]]
    assert changed == [5] and wrong.subject[5] in data.where(set=data.set[5]).subjects
    elbow = truth.joint_names.index("left_elbow")
    stiff = spoil(planted, "unposed", elbow)
    assert not stiff.pose[:, elbow].any() and planted.pose[:, elbow].any()
    unmoved = [k for k in range(truth.num_joints) if k != elbow]
    assert np.array_equal(stiff.pose[:, unmoved], planted.pose[:, unmoved])
    state = (torch.from_numpy(values[3:5]) for values in (stiff.betas, stiff.pose, stiff.trans))
    off = stiff.registrations.vertices[3:5] - truth(*state).vertices.numpy()
    assert np.sqrt((off**2).sum(-1).mean()) == pytest.approx(0.001, rel=0.05)


def test_unknown_faults_are_refused(truth):
    planted = planted_registrations(truth, **SMALL)
    for kind, index in (("stolen", 0), *((kind, 99) for kind in FAULTS)):
        with pytest.raises(HabitusError, match="asked for"):
            spoil(planted, kind, index)
    alone = planted_registrations(truth, **{**SMALL, "subjects": 1})
    with pytest.raises(HabitusError, match="no other person"):
        spoil(alone, "mislabelled", 0)
