"""Hinge channels: their rows tell a bend and nothing else, planted ones are recovered, and training
learns them at its end.
"""

from dataclasses import replace

import numpy as np
import pytest
from small_start import ALONE, BETAS, WARM, body_of, template_of

from habitus.body.pose_features import Hinges
from habitus.errors import HabitusError
from habitus.learn.options import SETTINGS, TrainOptions
from habitus.learn.posing.hinge_rows import hinge_row
from habitus.learn.steps.hinges import (
    Sample,
    channels_of,
    entries,
    hinge_axis,
    solve_fold,
    with_folds,
)
from habitus.learn.train import train_body
from habitus.mesh.known import Known
from habitus.mesh.registrations import Registrations
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

BODY = body_of()
JOINT = 2
NAME = BODY.joint_names[JOINT]
AXIS = np.array([0.0, -1.0, 0.0])
BEGINS = (50.0, 90.0)


def test_a_row_is_zero_where_the_fold_begins_and_blind_to_twist():
    rng = np.random.default_rng(0)
    bone = rng.normal(size=3)
    axis = np.cross(bone, rng.normal(size=3))
    axis /= np.linalg.norm(axis)
    row, bias = hinge_row(bone, axis, np.radians(90.0))
    angles = np.radians([-40.0, 0.0, 60.0, 90.0, 110.0, 155.0])
    values = entries(angles[:, None] * axis) @ row - bias
    assert (values[:3] < 0).all() and (np.diff(values[1:]) > 0).all()
    np.testing.assert_allclose(values[[3, 5]], [0.0, 1.0], atol=1e-12)
    twist = matrix_from_rotvec(0.8 * bone / np.linalg.norm(bone))
    bent = matrix_from_rotvec(angles[:, None] * axis)
    np.testing.assert_allclose(
        entries(rotvec_from_matrix(bent @ twist)) @ row - bias, values, atol=1e-12
    )


def planted():
    """The body with channels, at the vertices that their joint drives."""
    channels = channels_of(BODY, NAME, AXIS, BEGINS)
    rng = np.random.default_rng(1)
    driven = BODY.posedirs[..., 9 * (JOINT - 1) : 9 * JOINT].any((1, 2))
    directions = 0.02 * rng.normal(size=(BODY.num_vertices, 3, 2, 1 + BETAS))
    hinges = Hinges(
        np.full(2, JOINT),
        channels.rows,
        channels.bias,
        np.zeros((2, 9)),
        directions * driven[:, None, None, None],
    )
    return replace(BODY, hinges=hinges)


def folded_poses(count, seed):
    rng = np.random.default_rng(seed)
    poses = 0.1 * rng.normal(size=(count, BODY.num_joints, 3))
    poses[:, JOINT] += np.radians(rng.uniform(-10, 145, count))[:, None] * AXIS
    return poses


def samples_of(body, count, seed):
    rng = np.random.default_rng(seed + 100)
    for pose in folded_poses(count, seed):
        betas = rng.normal(size=BETAS)
        surface = body(betas, pose)
        ones = np.ones(body.num_vertices)
        rest = body.rest_vertices(betas), body.rest_joints(betas)
        yield Sample(surface.vertices, ones, pose, *rest, betas)


def test_planted_channels_are_recovered():
    truth = planted()
    channels = channels_of(BODY, NAME, AXIS, BEGINS)
    fold = solve_fold(
        BODY, channels, list(samples_of(truth, 60, 0)), BETAS, np.zeros((9, 9)), 0.0, 1e-10
    )
    found = with_folds(BODY, [fold])
    np.testing.assert_allclose(found.hinges.directions, truth.hinges.directions, atol=2e-4)
    for sample in samples_of(truth, 5, 7):
        np.testing.assert_allclose(
            found(sample.betas, sample.pose).vertices, sample.vertices, atol=1e-5
        )
    plain = replace(found, hinges=None)
    off = {"without": BODY, "stand-ins": plain}
    errors = {
        name: np.mean(
            [
                np.abs(body(s.betas, s.pose).vertices - s.vertices).mean()
                for s in samples_of(truth, 20, 3)
            ]
        )
        for name, body in off.items()
    }
    assert errors["stand-ins"] < errors["without"]


def registrations(body, subjects=4, each=30):
    rng = np.random.default_rng(3)
    betas = np.repeat(rng.normal(size=(subjects, BETAS)), each, 0)
    poses = folded_poses(subjects * each, 9)
    vertices = body(betas, poses).vertices
    names = tuple(map(str, range(len(vertices))))
    who = tuple(f"s{k // each}" for k in range(len(vertices)))
    known = Known(poses, np.zeros((len(poses), 3)), betas)
    rest = (("",) * len(names), ("pose",) * len(names), names)
    return Registrations(vertices, body.faces, who, *rest, known=known)


def test_training_learns_channels_at_its_end():
    truth = planted()
    data = registrations(truth)
    options = replace(
        WARM,
        rounds=2,
        fixed=("skinning_weights", "joint_regressor", "shapedirs", "people", "poses"),
        settings=replace(SETTINGS, hinge_joints=(NAME,)),
    )
    plain = train_body(data, template_of(BODY), options, body=BODY, workers=ALONE)
    trained = train_body(
        data, template_of(BODY), replace(options, hinges=BEGINS), body=BODY, workers=ALONE
    )
    assert plain.body.hinges is None
    assert hinge_axis(data.known.pose[:, JOINT]) @ AXIS > 0.98
    assert trained.body.hinges.num_channels == 2
    new = list(samples_of(truth, 20, 5))
    off = {
        name: np.mean([np.abs(body(s.betas, s.pose).vertices - s.vertices).mean() for s in new])
        for name, body in (("plain", plain.body), ("folded", trained.body))
    }
    assert off["folded"] < 0.5 * off["plain"]


def test_hinges_ask_for_what_they_need():
    with pytest.raises(HabitusError, match="'rotations' alone"):
        TrainOptions(hinges=(60.0,), pose_features="quaternions")
    with pytest.raises(HabitusError, match="0 to 150"):
        TrainOptions(hinges=(160.0,))
    with pytest.raises(HabitusError, match="leave out hinges"):
        train_body(
            registrations(planted(), 2, 3),
            template_of(BODY),
            replace(WARM, hinges=BEGINS),
            body=BODY,
        )
    with pytest.raises(HabitusError, match="one bone"):
        channels_of(BODY, BODY.joint_names[1], AXIS, BEGINS)
