"""Hinge channels in files: one blend shape each, with which readers make the body's own surface of
deep folds.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from hinged_body import KNEE, ROW, with_hinges
from read_fbx import Fbx
from read_glb import Glb
from synthetic_fit import synthetic_fit, tube_body

import habitus as hb
from habitus.export.animation import Animation, animate, one_sided
from habitus.export.driven import write_drivers
from habitus.export.fbx.write import write_fbx
from habitus.export.folds import beginning, fold_names
from habitus.export.glb import write_glb
from habitus.export.usd import write_usd
from habitus.learn.posing.hinge_rows import hinge_row
from habitus.rotations import up_rotation

DEGREES = (0, 100, 140)
FOLDS = tuple(f"{side}_knee_fold_{angle}" for side in ("left", "right") for angle in (60, 84))


def folding(soft: bool = False):
    """A fit of the hinged tubes, whose left knee is bent by `DEGREES`."""
    fit = synthetic_fit(3, soft=soft, body=with_hinges(tube_body(posedirs=True)))
    pose = fit.pose.copy()
    for frame, degrees in enumerate(DEGREES):
        pose[frame, fit.body.joint_names.index(KNEE)] = [np.radians(degrees), 0.1, -0.05]
    return replace(fit, pose=pose, pose_stage=(pose, fit.trans))


def glb_surfaces(fit, path, correctives):
    write_glb(fit, path.with_suffix(".glb"), correctives=correctives)
    glb = Glb(path.with_suffix(".glb"))
    return [glb.vertices(frame / fit.rate_hz) for frame in range(3)]


def fbx_surfaces(fit, path, correctives):
    write_fbx(fit, path.with_suffix(".fbx"), correctives=correctives)
    fbx = Fbx(path.with_suffix(".fbx"))
    return [fbx.vertices(frame) for frame in range(3)]


def usd_surfaces(fit, path, correctives):
    pytest.importorskip("pxr", reason="no usd-core here: pip install 'habitus[usd]'")
    from pxr import Usd
    from read_usd import skinned

    write_usd(fit, path.with_suffix(".usdc"), correctives=correctives)
    stage = Usd.Stage.Open(str(path.with_suffix(".usdc")))
    return [skinned(stage, frame) for frame in range(3)]


@pytest.mark.parametrize("surfaces", [glb_surfaces, fbx_surfaces, usd_surfaces])
@pytest.mark.parametrize(("correctives", "soft"), [("all", False), ("all", True), ("auto", True)])
def test_files_show_deep_folds(tmp_path, surfaces, correctives, soft):
    fit = folding(soft)
    turn = up_rotation(fit.up_axis)
    found = surfaces(fit, tmp_path / "a", correctives)
    away = np.linalg.norm(np.array(found) - fit.vertices() @ turn.T, axis=-1)
    assert away.max() < (1e-4 if correctives == "all" else 1.2e-4)
    plain = replace(fit, body=replace(fit.body, hinges=None))
    assert np.linalg.norm(plain.vertices(2) - fit.vertices(2), axis=-1).max() > 5e-3


def test_each_channel_is_one_blend_shape_whose_weight_is_the_channels():
    fit = folding()
    animation = one_sided(animate(fit, correctives="all"))
    names = [name for name in animation.morph_names if "fold" in name]
    assert tuple(names) == FOLDS
    person = fit.body.hinges.for_person(fit.betas)
    entries = hb.rotations.matrix_from_rotvec(fit.pose[:, person.joint]) - np.eye(3)
    known = np.clip((entries.reshape(3, -1, 9) * person.rows).sum(-1) - person.bias, 0, 1) ** 2
    for c, name in enumerate(names):
        at = animation.morph_names.index(name)
        np.testing.assert_allclose(animation.morphs[at], person.directions[:, :, c, 0], atol=1e-7)
        np.testing.assert_allclose(animation.tracks[0].morph_weights[:, at], known[:, c], atol=1e-6)
    assert known[2].max() > 0.5


def driven(animation: Animation, turns: np.ndarray, path) -> np.ndarray:
    """What the channels of the JSON add at rest, by its definition."""
    told = json.loads(write_drivers(animation, path).read_text())
    assert told["version"] == 2
    found = np.zeros(animation.morphs.shape[1:])
    for channel in told["channels"]:
        turn = turns[animation.body.joint_names.index(channel["joint"])] - np.eye(3)
        base = float(np.dot(channel["row"], turn.ravel())) - channel["bias"]
        weight = min(1.0, max(0.0, base)) ** channel["power"]
        found += weight * animation.morphs[animation.morph_names.index(channel["name"])]
    return found


@pytest.mark.parametrize("correctives", ["all", "live:207"])
def test_other_poses_get_their_own_folds(tmp_path, correctives):
    fit = folding()
    body = fit.body
    still = replace(fit, pose=np.zeros_like(fit.pose))
    animation = one_sided(animate(still, correctives=correctives))
    assert set(FOLDS) < set(animation.morph_names)
    turns = hb.rotations.matrix_from_rotvec(fit.pose[2])
    entries = (turns - np.eye(3)).reshape(-1, 9)
    coefficients = body.hinges.coefficients(entries[1:].ravel(), fit.betas, body.drivers)
    moved = body.hinges.directions.reshape(-1, 3, len(coefficients)) @ coefficients
    linear = body.hinges.without_linear(body.posedirs, body.drivers) @ entries[1:].ravel()
    away = driven(animation, turns, tmp_path / "a.fbx") - linear - moved
    assert np.abs(away).max() < 1e-5 and np.abs(moved).max() > 5e-3


def test_few_directions_come_with_all_folds():
    animation = one_sided(animate(folding(), correctives="live:9"))
    assert set(FOLDS) < set(animation.morph_names)
    assert 9 + 4 <= len(animation.morph_names) <= 18 + 4


@pytest.mark.parametrize("begin", [0.0, 7.5, 60.0, 90.0, 115.0, 135.0, 150.0])
def test_a_fold_begins_where_no_smaller_turn_reaches_it(begin):
    bone, axis = np.array([0.1, -1.0, 0.05]), np.array([1.0, 0.2, 0.1])
    row, bias = hinge_row(bone, axis, np.radians(begin))
    assert beginning(row, bias) == pytest.approx(begin, abs=1e-3)
    vectors = np.random.default_rng(0).normal(size=(20000, 3))
    turns = hb.rotations.matrix_from_rotvec(vectors * np.random.default_rng(1).uniform(0, 2))
    angles = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    reached = (turns - np.eye(3)).reshape(-1, 9) @ row > bias
    assert (angles[reached] > begin - 1e-3).all()


def test_names_tell_the_angle_or_a_number():
    assert fold_names(np.tile(ROW, (2, 1)), np.array([0.5, 0.9])) == ("fold_60", "fold_84")
    assert fold_names(np.tile(ROW, (2, 1)), np.array([0.5, 0.5])) == ("fold_1", "fold_2")
    assert beginning(ROW, 2.5) == 180.0
