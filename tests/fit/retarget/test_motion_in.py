"""Motion in: our own skeleton comes back as it was; another's gives the same motion whatever its
names, its rest pose, its unit and its order of channels are.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_rigs import MIXAMO, a_pose, along_x, bvh_text, foreign, walk_motion

from habitus.body.measurements import find_soles
from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.bvh import write_bvh
from habitus.fit.retarget.legs import skeleton_of
from habitus.fit.retarget.recipe import RETARGET
from habitus.fit.retarget.rig_matching import match_rig
from habitus.fit.retarget.rig_motions import stand_slip
from habitus.fit.retarget.rig_names import TABLES
from habitus.io.models.bodies import load_body
from habitus.io.motions.bvh import read_bvh
from habitus.io.people import read_motion
from habitus.rotations import up_rotation

NAMELESS = {ours: f"bone {k}" for k, ours in enumerate(MIXAMO)}


@pytest.fixture(scope="module")
def walk() -> BodyMotion:
    return walk_motion()


def _read(folder: Path, motion, **options) -> BodyMotion:
    path = folder / "foreign.bvh"
    path.write_text(bvh_text(motion, **options))
    return read_motion(path)


def _degrees_apart(one: BodyMotion, other: BodyMotion) -> np.ndarray:
    turns = [skeleton_of(each).world[..., :3] for each in (one, other)]
    trace = np.einsum("tjab,tjab->tj", *turns)
    return np.rad2deg(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))


@pytest.mark.parametrize(("name", "joints"), [("default", "smpl"), ("female", "smplx")])
def test_our_own_skeleton_comes_back(name, joints, tmp_path):
    rng = np.random.default_rng(0)
    body = load_body(name, joints=joints)
    pose = np.cumsum(0.03 * rng.normal(size=(30, body.num_joints, 3)), axis=0)
    trans = np.cumsum(0.01 * rng.normal(size=(30, 3)), axis=0)
    motion = BodyMotion(body, rng.normal(size=body.num_betas), pose, trans, 120.0, "+y")
    write_bvh(motion, tmp_path / "own.bvh")
    back = read_motion(tmp_path / "own.bvh")
    assert back.rate_hz == 120.0 and back.body.joint_names == body.joint_names
    np.testing.assert_allclose(back.betas, motion.betas, atol=1e-3)
    np.testing.assert_allclose(back.vertices(), motion.vertices(), atol=1e-5)
    np.testing.assert_allclose(back.joints(), motion.joints(), atol=1e-5)


def test_a_renamed_skeleton_gives_the_same_pose(walk, tmp_path):
    back = _read(tmp_path, foreign(walk, MIXAMO))
    apart = _degrees_apart(walk, back)
    legs = [k for k, n in enumerate(walk.body.joint_names) if "knee" in n or "hip" in n]
    others = [k for k in range(walk.body.num_joints) if k not in legs]
    assert apart[:, others].max() < 1.0  # legs give way to feet on the ground
    assert apart[:, legs].mean() < 5.0
    lengths = [
        np.linalg.norm(np.diff(m.joints(0)[[1, 4, 7]], axis=0), axis=1) for m in (walk, back)
    ]
    np.testing.assert_allclose(*lengths, atol=0.01)


@pytest.mark.parametrize(
    "changes",
    [
        {"rest": a_pose(), "unit": 1.0},
        {"rest": a_pose(60.0), "unit": 1e3},
        {"world": up_rotation("+z").T},
        {"names": NAMELESS},
        {"names": NAMELESS, "rest": a_pose(), "unit": 39.37},
    ],
)
def test_names_rest_pose_unit_and_world_change_nothing(walk, changes, tmp_path):
    expected = _read(tmp_path, foreign(walk, MIXAMO))
    back = _read(tmp_path, foreign(walk, **{"names": MIXAMO, **changes}))
    np.testing.assert_allclose(back.joints(), expected.joints(), atol=1e-3)


@pytest.mark.parametrize("order", ["XYZ", "ZYX", "YXZ"])
def test_the_order_of_channels_changes_nothing(walk, order, tmp_path):
    expected = _read(tmp_path, foreign(walk, MIXAMO))
    back = _read(tmp_path, foreign(walk, MIXAMO), order=order, positions_last=True)
    np.testing.assert_allclose(back.joints(), expected.joints(), atol=1e-5)


def test_bones_along_one_axis_at_rest_need_a_frame_that_stands(walk, tmp_path):
    standing = np.zeros_like(walk.pose[:1])
    motion = replace(
        walk,
        pose=np.concatenate([standing, walk.pose]),
        trans=np.concatenate([walk.trans[:1], walk.trans]),
    )
    back = _read(tmp_path, foreign(motion, MIXAMO, along_x(motion)))
    assert any("frame 0, which stands" in note for note in back.made)
    hands = [k for k, name in enumerate(walk.body.joint_names) if "hand" in name]
    apart = np.delete(_degrees_apart(motion, back), hands, axis=1)
    assert apart.mean() < 3.0


def test_feet_that_stand_do_so_on_the_body(walk, tmp_path):
    slow = replace(
        walk, pose=np.repeat(walk.pose[:1], 40, 0), trans=np.repeat(walk.trans[:1], 40, 0)
    )
    time = np.arange(40)[:, None] / 60.0
    sway = slow.trans + 0.02 * np.sin(3.0 * time) * [1.0, 0.0, 0.5]
    back = _read(tmp_path, foreign(replace(slow, trans=sway), MIXAMO))
    soles = find_soles(back.body, RETARGET.contacts)
    still = np.ones((40, 2, 3), bool)
    assert np.sqrt(np.mean(stand_slip(back, soles, still) ** 2)) < 0.003
    assert back.vertices()[..., 1].min() > -1e-3


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_every_table_is_found_by_its_names(walk, table):
    theirs = {ours: name for name, ours in table.names().items()}
    names = {ours: theirs.get(ours, f"x {ours}") for ours in walk.body.joint_names}
    rig = foreign(walk, names).rig
    match = match_rig(rig)
    assert match.how in {each.name for each in TABLES}
    for ours in walk.body.joint_names:
        if "hand" not in ours and ours in match.joints:
            assert rig.names[match.joints[ours]] == names[ours]
    assert {"pelvis", "spine3", "left_knee", "right_elbow"} <= set(match.joints)


def test_what_is_no_person_is_refused_in_one_line(tmp_path):
    text = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    text += "End Site\n{\nOFFSET 0 1 0\n}\n}\nMOTION\nFrames: 1\nFrame Time: 0.01\n0 0 0\n"
    (tmp_path / "pole.bvh").write_text(text)
    assert read_bvh(tmp_path / "pole.bvh").rig.num_joints == 2
    with pytest.raises(HabitusError, match="no person's skeleton") as error:
        read_motion(tmp_path / "pole.bvh")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MOTION", "", "no HIERARCHY"),
        ("Frame Time: 0.01", "Frame Time: nan", "Frame Time"),
        ("Zrotation", "Wrotation", "CHANNELS"),
        ("\n0 0 0\n", "\n0 0\n", "values below MOTION"),
        ("\n0 0 0\n", "\n0 0 x\n", "no number"),
        ("OFFSET 0 0 0", "", "OFFSET"),
    ],
)
def test_damage_is_named(old, new, message, tmp_path):
    text = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    text += "End Site\n{\nOFFSET 0 1 0\n}\n}\nMOTION\nFrames: 1\nFrame Time: 0.01\n0 0 0\n"
    (tmp_path / "a.bvh").write_text(text.replace(old, new, 1))
    with pytest.raises(HabitusError, match=message):
        read_bvh(tmp_path / "a.bvh")


def test_feet_are_known_by_ankles_where_there_are_no_toes(walk, tmp_path):
    names = {ours: name for ours, name in MIXAMO.items() if "foot" not in ours}
    back = _read(tmp_path, foreign(walk, names))
    assert np.isfinite(back.joints()).all()


def test_the_person_may_be_given(walk, tmp_path):
    person = tmp_path / "person.npz"
    betas = np.zeros(walk.body.num_betas)
    betas[0] = 1.0
    np.savez(person, betas=betas, body="default")
    (tmp_path / "a.bvh").write_text(bvh_text(foreign(walk, MIXAMO)))
    back = read_motion(tmp_path / "a.bvh", person)
    np.testing.assert_array_equal(back.betas, betas)
    assert read_motion(tmp_path / "a.bvh", "female").body.name == "female"
