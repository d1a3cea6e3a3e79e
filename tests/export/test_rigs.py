"""Rigs: bones along limbs, by the names of other programs, and the same surface through all."""

import json
from itertools import pairwise

import numpy as np
import pytest
from read_fbx import Fbx
from read_glb import Glb
from scipy.spatial.transform import Rotation
from synthetic_fit import synthetic_fit, tube_body

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.animation import animate, one_sided
from habitus.export.driven import drivers
from habitus.export.motion import LIGHT, export_motion
from habitus.export.rigging import Bones, rigged
from habitus.export.rigs import RIGS, rig_named
from habitus.export.skeleton import bone_axes
from habitus.jobs.exporting import export_file

FRAMES = (0, 7, 19)
CHAINS = {
    "mixamo": (
        ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", "HeadTop_End"),
        ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "LeftToe_End"),
        ("Spine2", "RightShoulder", "RightArm", "RightForeArm", "RightHand"),
        ("LeftHand", *(f"LeftHandThumb{k}" for k in range(1, 5))),
        ("LeftHand", *(f"LeftHandPinky{k}" for k in range(1, 5))),
    ),
    "manny": (
        ("root", "pelvis", *(f"spine_0{k}" for k in range(1, 6)), "neck_01", "neck_02", "head"),
        ("pelvis", "thigh_r", "calf_r", "foot_r", "ball_r"),
        ("spine_05", "clavicle_l", "upperarm_l", "lowerarm_l", "hand_l"),
        ("hand_l", "thumb_01_l", "thumb_02_l", "thumb_03_l"),
        ("hand_r", "index_metacarpal_r", "index_01_r", "index_02_r", "index_03_r"),
    ),
    "humanoid": (
        ("Hips", "Spine", "Chest", "UpperChest", "Neck", "Head", "LeftEye"),
        ("Hips", "LeftUpperLeg", "LeftLowerLeg", "LeftFoot", "LeftToes"),
        ("UpperChest", "RightShoulder", "RightUpperArm", "RightLowerArm", "RightHand"),
        ("RightHand", "RightThumbProximal", "RightThumbIntermediate", "RightThumbDistal"),
        ("LeftHand", "LeftLittleProximal", "LeftLittleIntermediate", "LeftLittleDistal"),
    ),
    "vrm": (
        ("hips", "spine", "chest", "upperChest", "neck", "head", "jaw"),
        ("hips", "leftUpperLeg", "leftLowerLeg", "leftFoot", "leftToes"),
        ("upperChest", "leftShoulder", "leftUpperArm", "leftLowerArm", "leftHand"),
        ("rightHand", "rightThumbMetacarpal", "rightThumbProximal", "rightThumbDistal"),
    ),
    "rokoko": (
        ("Root", "Hips", "Spine1", "Spine2", "Spine3", "Spine4", "Neck", "Head"),
        ("Hips", "RightThigh", "RightShin", "RightFoot", "RightToe", "RightToeTip"),
        ("Spine4", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
        ("LeftHand", "LeftFinger1Metacarpal", "LeftFinger1Proximal", "LeftFinger1Distal"),
        ("LeftHand", "LeftFinger2Metacarpal", "LeftFinger2Proximal", "LeftFinger2Medial"),
    ),
}
"""Parents before children, written down apart from the tables."""


def walking(soft: bool = True):
    return synthetic_fit(20, soft=soft, body=tube_body(posedirs=True), rate_hz=60.0)


def surfaces(path):
    """The surface in some frames, by a reader that shares nothing with the writers."""
    if path.suffix == ".glb":
        return [Glb(path).vertices(frame / 60.0) for frame in FRAMES]
    if path.suffix == ".fbx":
        return [Fbx(path).vertices(frame) for frame in FRAMES]
    Usd = pytest.importorskip("pxr.Usd", reason="no usd-core here")
    from read_usd import skinned

    return [skinned(Usd.Stage.Open(str(path)), frame) for frame in FRAMES]


@pytest.mark.parametrize("ending", ["glb", "fbx", "usdc"])
def test_the_surface_is_the_same_through_every_rig(tmp_path, ending):
    fit = walking()
    known = tmp_path / f"world.{ending}"
    export_motion(fit, known, correctives="pca:8", bones="world")
    expected = surfaces(known)
    rigs = ({}, {"root_bone": True}, {"rig": "mixamo"}, {"rig": "rokoko", "root_bone": True})
    for k, options in enumerate(rigs):
        path = tmp_path / f"{k}.{ending}"
        export_motion(fit, path, correctives="pca:8", **options)
        for found, right in zip(surfaces(path), expected, strict=True):
            assert np.abs(found - right).max() < 1e-5, options


def test_without_options_bones_point_along_their_limbs(tmp_path):
    """In the files, by their own rest transforms: +y towards the one bone below."""
    fit = walking(soft=False)
    export_motion(fit, tmp_path / "a.glb")
    export_motion(fit, tmp_path / "a.fbx")
    glb = Glb(tmp_path / "a.glb")
    checked = 0
    for node in glb.json["nodes"]:
        if len(below := node.get("children", [])) == 1:
            way = np.array(glb.json["nodes"][below[0]]["translation"])
            assert way[1] > (1 - 1e-9) * np.linalg.norm(way), node["name"]
            checked += 1
    assert checked >= 14
    fbx = Fbx(tmp_path / "a.fbx")
    for limb in fbx.limbs():
        if len(below := fbx.below(limb.values[0], "Model")) == 1:
            way = np.array(below[0].prop("Lcl Translation"))
            assert way[1] > (1 - 1e-9) * np.linalg.norm(way), limb.values[1]
        assert limb.prop("Lcl Rotation") == [0.0, 0.0, 0.0]


def test_world_bones_are_not_turned(tmp_path):
    export_motion(walking(), tmp_path / "a.glb", bones="world")
    nodes = Glb(tmp_path / "a.glb").json["nodes"]
    assert all(node.get("rotation", [0, 0, 0, 1]) == [0, 0, 0, 1] for node in nodes)


@pytest.mark.parametrize("name", ["neutral", "female", "male"])
def test_knees_and_elbows_are_bent_the_right_way_about_x(name):
    """A slight bend at rest, of any person, about the axis that a solver of IK shall use."""
    body = hb.load_body(name)
    rng = np.random.default_rng(1)
    names = body.joint_names.index
    for _ in range(20):
        betas = rng.normal(size=body.num_betas)
        joints, vertices = body.rest_joints(betas), body.rest_vertices(betas)
        axes = bone_axes(body, joints, vertices)
        assert np.allclose(axes.transpose(0, 2, 1) @ axes, np.eye(3), atol=1e-12)
        assert np.allclose(np.linalg.det(axes), 1.0)
        for side in ("left", "right"):
            for upper, lower, sign in (("hip", "knee", -1), ("shoulder", "elbow", 1)):
                first = axes[names(f"{side}_{upper}")]
                bend = first.T @ axes[names(f"{side}_{lower}")][:, 1]
                angle = np.degrees(np.arctan2(sign * bend[2], bend[1]))
                assert 0.5 < angle < 12, (side, upper, angle)


@pytest.mark.parametrize("rig", RIGS)
def test_names_and_hierarchy(tmp_path, rig):
    path = tmp_path / "a.glb"
    export_file("neutral", path, rig=rig, root_bone=True)
    nodes = Glb(path).json["nodes"]
    prefix = "mixamorig:" if rig == "mixamo" else ""
    parent = {nodes[c]["name"]: node["name"] for node in nodes for c in node.get("children", [])}
    for chain in CHAINS[rig]:
        for above, below in pairwise(chain):
            assert parent[prefix + below] == prefix + above
    root = rig_named(rig).root
    assert nodes[0]["name"] == root and parent[prefix + CHAINS[rig][1][0]] == root
    names = [node["name"] for node in nodes]
    assert len(set(names)) == len(names)
    assert not {"left_knee", "right_wrist", "spine1", "left_index1"} & set(names)


def test_a_bone_on_the_floor_carries_the_way(tmp_path):
    fit = walking(soft=False)
    export_motion(fit, tmp_path / "a.fbx", rig="manny", root_bone=True)
    fbx = Fbx(tmp_path / "a.fbx")
    limbs = {limb.values[1].split("\0")[0]: limb.values[0] for limb in fbx.limbs()}
    for frame in FRAMES:
        world = fbx.world(frame)
        root, pelvis = (world[limbs[name]] for name in ("root", "pelvis"))
        assert np.allclose(root[[0, 2], 3], pelvis[[0, 2], 3], atol=1e-4)
        assert abs(root[1, 3]) < 1e-6 and np.allclose(root[:3, 2], [0, 1, 0], atol=1e-6)
    rest = fbx.geometry["Vertices"].values[0].reshape(-1, 3)
    assert abs(rest[:, 1].min()) < 1e-4  # cm


def test_manny_rests_with_hanging_arms_and_says_what_that_moves(tmp_path):
    fit = walking(soft=False)
    written = export_motion(fit, tmp_path / "a.fbx", correctives="none", rig="manny")
    plain = export_motion(fit, tmp_path / "b.fbx", correctives="none")
    fbx = Fbx(tmp_path / "a.fbx")
    bind = {}
    pose = next(o for o in fbx.objects.values() if o.name == "Pose")
    for node in pose.all("PoseNode"):
        bind[node["Node"].values[0]] = node["Matrix"].values[0].reshape(4, 4).T
    limbs = {limb.values[1].split("\0")[0]: limb.values[0] for limb in fbx.limbs()}
    for side in "lr":
        way = bind[limbs[f"lowerarm_{side}"]][:3, 3] - bind[limbs[f"upperarm_{side}"]][:3, 3]
        down = np.degrees(np.arcsin(-way[1] / np.linalg.norm(way)))
        assert abs(down - rig_named("manny").arms_down) < 4
    away = [
        np.linalg.norm(a - b, axis=1).max()
        for a, b in zip(surfaces(tmp_path / "a.fbx"), surfaces(tmp_path / "b.fbx"), strict=True)
    ]
    assert 1e-5 < max(away) <= written.worst - plain.worst + 1e-5
    assert export_motion(fit, tmp_path / "c.fbx", correctives="none", rig="mixamo").worst == (
        plain.worst
    )


def test_drivers_count_rotations_from_the_rest_pose():
    """Manny's arms hang: the same pose has other rotations, and the same weights."""
    body = tube_body(posedirs=True)
    joints = body.num_joints
    still = BodyMotion(
        body, np.zeros(body.num_betas), np.zeros((2, joints, 3)), np.zeros((2, 3)), 30.0
    )
    animation = one_sided(animate(still, correctives="all"))
    hanging = rigged(animation, Bones("manny"))
    plain, moved = drivers(animation), drivers(hanging)
    assert moved["version"] == 2 and len(moved["channels"]) == len(plain["channels"]) > 100
    rng = np.random.default_rng(3)
    local = Rotation.from_rotvec(rng.normal(0, 0.7, (joints, 3))).as_matrix()
    turned, parents = hanging.skeleton.turned, body.parents
    names = [joint["name"] for joint in moved["joints"]]
    for old, new in zip(plain["channels"], moved["channels"], strict=True):
        joint = body.joint_names.index(old["joint"])
        assert names[joint] == new["joint"]
        counted = turned[parents[joint]] @ local[joint] @ turned[joint].T
        was = np.dot(old["row"], (local[joint] - np.eye(3)).ravel())
        now = np.dot(new["row"], (counted - np.eye(3)).ravel()) - new["bias"]
        assert abs(was - now) < 1e-6


def test_a_light_file_has_few_blend_shapes(tmp_path):
    fit = walking()
    light = export_motion(fit, tmp_path / "a.glb", light=True)
    whole = export_motion(fit, tmp_path / "b.glb", correctives="all")
    assert 0 < light.morphs <= LIGHT < whole.morphs and light.worst > 0
    names = Glb(tmp_path / "a.glb").json["meshes"][0]["extras"]["targetNames"]
    assert len(names) == light.morphs
    sizes = [path.stat().st_size for path in (tmp_path / "a.glb", tmp_path / "b.glb")]
    assert sizes[0] < 0.6 * sizes[1]
    for found, right in zip(
        surfaces(tmp_path / "a.glb"), surfaces(tmp_path / "b.glb"), strict=True
    ):
        assert np.abs(found - right).max() <= light.worst + 1e-4


def test_a_bvh_takes_the_names(tmp_path):
    fit = walking()
    export_motion(fit, tmp_path / "a.bvh", rig="rokoko")
    export_motion(fit, tmp_path / "b.bvh")
    a, b = ((tmp_path / name).read_text().split("MOTION") for name in ("a.bvh", "b.bvh"))
    assert "ROOT Hips" in a[0] and "JOINT LeftShin" in a[0] and "left_knee" not in a[0]
    assert a[1] == b[1]


@pytest.mark.parametrize(
    "name, options, said",
    [
        ("a.fbx", {"rig": "biped"}, "expected one of humanoid, manny"),
        ("a.fbx", {"bones": "up"}, "expected along or world"),
        ("a.trc", {"rig": "mixamo"}, "are for .glb, .fbx"),
        ("a.bvh", {"root_bone": True}, "rig for .bvh"),
        ("a.vrm", {"rig": "manny"}, "has the bones of vrm"),
        ("a.obj", {"light": True}, "light is for"),
        ("a.glb", {"light": True, "correctives": "all"}, "leave out correctives"),
    ],
)
def test_what_a_file_cannot_have(tmp_path, name, options, said):
    with pytest.raises(HabitusError, match=said):
        export_motion(walking(), tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_the_command_takes_the_options(tmp_path):
    from habitus.cli.main import main

    path = tmp_path / "a.fbx"
    options = ["--rig", "mixamo", "--root-bone", "--bake-correctives", "live:24"]
    main(["export", "male", "--out", str(path), *options])
    names = {limb.values[1].split("\0")[0] for limb in Fbx(path).limbs()}
    assert {"root", "mixamorig:Hips", "mixamorig:LeftHandIndex4"} <= names
    told = json.loads((tmp_path / "a.correctives.json").read_text())
    assert {joint["name"] for joint in told["joints"]} < names
