"""Motion on any rigged character: limbs point as the person's do, feet stand, and all that the
character's file held is in it still.
"""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from foreign_rigs import MIXAMO
from made_character import parts_of, write_character
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.glb import write_glb
from habitus.fit.retarget.recipe import turned
from habitus.fit.retarget.rig_names import VRM_PARTS
from habitus.io.models.bodies import load_body
from habitus.io.motions.gltf import read_gltf_motion
from habitus.io.people import read_motion
from habitus.jobs.characters import retarget_to_character
from habitus.rotations import up_rotation

BONES = [
    (f"{side}_{one}", f"{side}_{other}")
    for side in ("left", "right")
    for one, other in (
        ("hip", "knee"),
        ("knee", "ankle"),
        ("shoulder", "elbow"),
        ("elbow", "wrist"),
    )
]


@pytest.fixture(scope="module")
def walk() -> BodyMotion:
    made = BodyMotion.of(synthetic_fit(60, rate_hz=60.0))
    body = load_body("default")
    motion = BodyMotion(
        body, np.zeros(body.num_betas), made.pose[:, : body.num_joints], made.trans, 60.0, "+z"
    )
    motion = replace(motion, up_axis=made.up_axis)
    return replace(turned(motion, up_rotation(made.up_axis)), up_axis="+y")


@pytest.fixture(scope="module")
def standing(walk) -> BodyMotion:
    """A person who sways on feet that nearly stand."""
    time = np.arange(60)[:, None] / 60.0
    pose = np.repeat(0.3 * walk.pose[:1], 60, axis=0)
    pose[:, 0] = 0.0
    trans = np.array([0.0, 0.9, 0.0]) + 0.02 * np.sin(4.0 * time) * [1.0, 0.0, 0.5]
    return replace(walk, pose=pose, trans=trans)


def _places(path, names=MIXAMO) -> dict[str, np.ndarray]:
    """Our joints' places in the last animation of a file, by the reader of motions."""
    motion = read_gltf_motion(path)
    at = {name.removeprefix("rig:"): k for k, name in enumerate(motion.rig.names)}
    return {ours: motion.places[:, at[name]] for ours, name in names.items()}


def _last_animation_first(path) -> None:
    """Put the last animation in the place of the first, for readers of the first one."""
    document, data = parts_of(path)
    document["animations"] = document["animations"][::-1]
    _write(path, document, data)


def _write(path, document: dict, data: bytes) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    path.write_bytes(head + chunks + struct.pack("<I4s", len(data), b"BIN\0") + data)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"stretch": (0.7, 0.6, 0.7), "arms": 0.0},
        {"stretch": (1.2, 1.3, 1.2), "facing": np.pi, "scale": 1.0},
    ],
)
def test_limbs_of_the_file_point_as_the_persons_do(walk, options, tmp_path):
    write_character(tmp_path / "a.glb", **options)
    moved = retarget_to_character(walk, tmp_path / "a.glb", out=tmp_path / "b.glb")
    _last_animation_first(tmp_path / "b.glb")
    places = _places(tmp_path / "b.glb")
    turn = up_rotation("+y")
    facing = options.get("facing", 0.0)
    turn = np.array(
        [[np.cos(facing), 0, np.sin(facing)], [0, 1, 0], [-np.sin(facing), 0, np.cos(facing)]]
    )
    joints = dict(zip(walk.body.joint_names, np.moveaxis(walk.joints(), 1, 0), strict=True))
    for one, other in BONES:
        theirs = places[other] - places[one]
        ours = (joints[other] - joints[one]) @ turn.T
        cosine = (theirs * ours).sum(1)
        cosine /= np.linalg.norm(theirs, axis=1) * np.linalg.norm(ours, axis=1)
        angles = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
        # legs give way to feet that keep their place
        assert angles.max() < (1.0 if "elbow" in (one + other) else 30.0), (one, angles.max())
    solved = dict(
        zip(moved.motion.body.joint_names, np.moveaxis(moved.motion.joints(), 1, 0), strict=True)
    )
    for name in ("pelvis", "left_ankle", "right_wrist", "head"):
        np.testing.assert_allclose(places[name], solved[name] @ turn.T, atol=2e-5)


def test_feet_that_stand_do_not_slip(standing, tmp_path):
    write_character(tmp_path / "a.glb")
    moved = retarget_to_character(standing, tmp_path / "a.glb")
    assert moved.standing > 0.5
    assert moved.slip[0] < 0.003
    assert moved.below[1] > -0.01


def test_nothing_of_the_characters_file_changes(walk, tmp_path):
    write_character(tmp_path / "a.glb")
    retarget_to_character(walk, tmp_path / "a.glb", out=tmp_path / "b.glb")
    (before, data), (after, more) = parts_of(tmp_path / "a.glb"), parts_of(tmp_path / "b.glb")
    for key, value in before.items():
        if key == "buffers":
            continue
        same = after[key][: len(value)] if isinstance(value, list) else after[key]
        assert same == value, key
    assert more[: len(data)] == data
    grown = {key for key in after if after[key] != before.get(key)}
    assert grown == {"animations", "accessors", "bufferViews", "buffers"}
    assert [each["name"] for each in after["animations"]] == ["own", walk.capture_name]


def test_names_that_say_nothing_give_the_same_motion(walk, tmp_path):
    write_character(tmp_path / "a.glb")
    write_character(tmp_path / "b.glb", {ours: f"b{k}" for k, ours in enumerate(MIXAMO)})
    first = retarget_to_character(walk, tmp_path / "a.glb").motion
    other = retarget_to_character(walk, tmp_path / "b.glb").motion
    order = [other.body.joint_names.index(n) for n in first.body.joint_names if n in MIXAMO]
    own = [first.body.joint_names.index(n) for n in first.body.joint_names if n in MIXAMO]
    np.testing.assert_allclose(other.joints()[:, order], first.joints()[:, own], atol=1e-3)


def test_a_vrm_names_its_bones_itself(walk, tmp_path):
    write_character(tmp_path / "a.glb", {ours: f"b{k}" for k, ours in enumerate(MIXAMO)})
    document, data = parts_of(tmp_path / "a.glb")
    nodes = {ours: 2 + k for k, ours in enumerate(walk.body.joint_names)}
    bones = {theirs: {"node": nodes[ours]} for theirs, ours in VRM_PARTS.items() if ours in nodes}
    document["extensions"] = {"VRMC_vrm": {"humanoid": {"humanBones": bones}}}
    _write(tmp_path / "a.vrm", document, data)
    moved = retarget_to_character(walk, tmp_path / "a.vrm", out=tmp_path / "b.vrm")
    assert moved.character.match.how == "the file's own list of bones"
    assert parts_of(tmp_path / "b.vrm")[0]["extensions"] == document["extensions"]


def test_our_own_character_comes_back_as_a_motion(walk, tmp_path):
    write_glb(walk, tmp_path / "own.glb")
    back = read_motion(tmp_path / "own.glb")
    np.testing.assert_allclose(back.joints(), walk.joints(), atol=1e-5)
    np.testing.assert_allclose(back.vertices(), walk.vertices(), atol=1e-5)


def test_a_foreign_character_in_motion_is_a_motion(walk, tmp_path):
    write_character(tmp_path / "a.glb", stretch=(1.0, 1.0, 1.0))
    retarget_to_character(walk, tmp_path / "a.glb", out=tmp_path / "b.glb")
    _last_animation_first(tmp_path / "b.glb")
    back = read_motion(tmp_path / "b.glb")
    joints = [walk.body.joint_names.index(f"{side}_elbow") for side in ("left", "right")]
    np.testing.assert_allclose(back.pose[:, joints], walk.pose[:, joints], atol=0.05)


def test_what_is_no_character_is_refused(walk, tmp_path):
    write_character(tmp_path / "a.glb")
    with pytest.raises(HabitusError, match=r"\.glb or \.vrm"):
        retarget_to_character(walk, tmp_path / "a.glb", out=tmp_path / "b.fbx")
    (tmp_path / "c.glb").write_bytes((tmp_path / "a.glb").read_bytes()[:900])
    with pytest.raises(HabitusError, match=r"c\.glb"):
        retarget_to_character(walk, tmp_path / "c.glb")
