"""Moving surfaces carried back to the rest pose."""

from dataclasses import replace

import numpy as np
import pytest
from soft_people import soft_people
from soft_tubes import soft_tubes

from habitus.errors import HabitusError
from habitus.learn.dynamics.sequences import check_sequences, rest_residuals, unposed
from habitus.parallel.workers import Threads
from habitus.rotations import matrix_from_rotvec


def test_what_skinning_did_is_undone_exactly_where_it_keeps_volume():
    rng = np.random.default_rng(0)
    turn = matrix_from_rotvec(rng.normal(size=(40, 2, 3)) * 0.35).mean(1)
    assert np.linalg.det(turn).min() > 0.5
    offsets = rng.normal(size=(40, 3))
    np.testing.assert_allclose(
        unposed(turn, (turn @ offsets[..., None])[..., 0]), offsets, atol=1e-12
    )


def test_where_skinning_squeezes_flat_nothing_blows_up():
    """Half of a twist by up to half a turn; noise of 1 mm may not become metres."""
    angles = np.linspace(0, np.pi, 200)
    turns = 0.5 * (np.eye(3) + matrix_from_rotvec(np.stack([0 * angles, angles, 0 * angles], 1)))
    noise = 1e-3 * np.random.default_rng(1).normal(size=(200, 3))
    found = unposed(turns, noise)
    assert np.linalg.norm(found, axis=1).max() < 4 * np.linalg.norm(noise, axis=1).max()
    shifts = np.linalg.norm(
        np.diff(unposed(turns, np.tile([1e-3, 0, 0], (200, 1))), axis=0), axis=1
    )
    assert shifts.max() < 1e-4  # and it changes smoothly


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
@pytest.mark.parametrize("threads", [1, 2])
def test_residuals_are_the_planted_blend_shapes(skinning, threads):
    body = soft_tubes(skinning=skinning, pose_shapes=0.003)
    data = soft_people(body, people=1, sequences=2, frames=70)
    found = list(rest_residuals(replace(body, dynamics=None), data, Threads(threads)))
    assert [k for k, _ in found] == [0, 0, 1, 1]
    rows = np.concatenate([block for _, block in found])
    directions = body.dynamics.directions.reshape(-1, 2)
    left = rows - rows @ np.linalg.pinv(directions).T @ directions.T
    assert np.sqrt((left**2).mean()) < 0.02 * np.sqrt((rows**2).mean())


def test_holes_count_as_not_moved_and_surfaces_at_rest_stand_in_for_the_body():
    body = soft_tubes()
    (one,) = soft_people(body, people=1, sequences=1, frames=20)
    bare = replace(body, dynamics=None)
    meshes = one.registrations
    holes = np.array(meshes.vertices)
    holes[:, 5] = np.nan
    (_, rows), *_ = rest_residuals(
        bare, [replace(one, registrations=replace(meshes, vertices=holes))], Threads(1)
    )
    assert not rows.reshape(20, -1, 3)[:, 5].any() and rows.any()
    half = np.where(np.arange(300) < 9, 0.5, 1.0)
    (_, less), *_ = rest_residuals(
        bare, [replace(one, registrations=replace(meshes, weights=half))], Threads(1)
    )
    (_, full), *_ = rest_residuals(bare, [one], Threads(1))
    np.testing.assert_allclose(
        less.reshape(20, -1, 3), full.reshape(20, -1, 3) * half[:, None], atol=1e-12
    )
    still = bare(one.betas, one.pose, one.trans).vertices
    away = np.sin(9 * still)  # what the body does not know of that pose
    known = replace(
        one, still=still + away, registrations=replace(meshes, vertices=meshes.vertices + away)
    )
    (_, found), *_ = rest_residuals(bare, [known], Threads(1))
    (_, plain), *_ = rest_residuals(bare, [one], Threads(1))
    np.testing.assert_allclose(found, plain, atol=1e-9)


def test_registrations_of_some_vertices():
    body = soft_tubes()
    (one,) = soft_people(body, people=1, sequences=1, frames=20)
    ids = np.arange(40, 160)
    words = {key: getattr(one.registrations, key) for key in ("subject", "sex", "set", "name")}
    meshes = type(one.registrations)(
        one.registrations.vertices[:, ids], np.array([[0, 1, 2]]), **words
    )
    (_, whole), *_ = rest_residuals(body, [one], Threads(1))
    (_, some), *_ = rest_residuals(
        body, [replace(one, registrations=meshes, vertex_ids=ids)], Threads(1)
    )
    some = some.reshape(20, -1, 3)
    whole = whole.reshape(20, -1, 3)
    np.testing.assert_array_equal(some[:, ids], whole[:, ids])
    assert not some[:, :40].any()
    with pytest.raises(
        HabitusError, match=r"registrations of 120 vertices; tubes has 300.*vertex_ids"
    ):
        replace(one, registrations=meshes).for_body(body)


def test_poses_of_other_joints_are_found_by_name():
    body = soft_tubes()
    (one,) = soft_people(body, people=1, sequences=1, frames=6)
    names = (*reversed(body.joint_names), "tail")
    pose = np.concatenate([one.pose[:, ::-1], np.zeros((6, 1, 3))], 1)
    found = replace(one, pose=pose, joint_names=names, betas=one.betas[:2]).for_body(body)
    np.testing.assert_array_equal(found.pose, one.pose)
    assert found.betas.shape == (4,)


@pytest.mark.wrong_shapes
def test_poses_that_the_body_cannot_take_are_refused():
    body = soft_tubes()
    (one,) = soft_people(body, people=1, sequences=1, frames=6)
    names = (*body.joint_names, "tail")
    pose = np.concatenate([one.pose, np.full((6, 1, 3), 0.1)], 1)
    with pytest.raises(HabitusError, match="joint 'tail' moves"):
        replace(one, pose=pose, joint_names=names).for_body(body)
    with pytest.raises(HabitusError, match="a pose of 9 joints without names"):
        replace(one, pose=one.pose[:, :9]).for_body(body)
    with pytest.raises(HabitusError, match="has no trans; expected betas, pose and trans, or none"):
        replace(one, trans=None).for_body(body)
    with pytest.raises(HabitusError, match="betas of shape"):
        replace(one, betas=np.zeros(5)).for_body(body)
    with pytest.raises(HabitusError, match=r"expected \(6, J, 3\)"):
        replace(one, trans=np.zeros((5, 3))).for_body(body)


def test_sequences_have_one_rate_and_some_length():
    one, other = soft_people(soft_tubes(), people=1, sequences=2, frames=6)
    assert check_sequences((one, other)) == 60.0
    with pytest.raises(HabitusError, match="60, 120 Hz; expected one rate"):
        check_sequences((one, replace(other, rate_hz=120.0)))
    with pytest.raises(HabitusError, match="0 sequences"):
        check_sequences(())
