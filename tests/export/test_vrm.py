"""VRM 1.0: the humanoid that the specification asks for, at rest in its T-pose.

The schemas of vrm-c/vrm-specification and Khronos' validator are asked where they are: set
VRM_SCHEMAS to the folder ``specification/VRMC_vrm-1.0/schema``, with jsonschema installed, and
NODE_PATH to gltf-validator.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from read_glb import Glb
from rigged_body import random_body
from synthetic_fit import synthetic_fit, tube_body

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.motion import export_motion
from habitus.jobs.exporting import export_file

PARENTS = {
    "spine": ("hips",),
    "chest": ("spine",),
    "upperChest": ("chest",),
    "neck": ("upperChest", "chest", "spine"),
    "head": ("neck", "upperChest", "chest", "spine"),
    "leftEye": ("head",),
    "rightEye": ("head",),
    "jaw": ("head",),
}
for _side in ("left", "right"):
    PARENTS |= {
        f"{_side}UpperLeg": ("hips",),
        f"{_side}LowerLeg": (f"{_side}UpperLeg",),
        f"{_side}Foot": (f"{_side}LowerLeg",),
        f"{_side}Toes": (f"{_side}Foot",),
        f"{_side}Shoulder": ("upperChest", "chest", "spine"),
        f"{_side}UpperArm": (f"{_side}Shoulder", "upperChest", "chest", "spine"),
        f"{_side}LowerArm": (f"{_side}UpperArm",),
        f"{_side}Hand": (f"{_side}LowerArm",),
        f"{_side}ThumbMetacarpal": (f"{_side}Hand",),
        f"{_side}ThumbProximal": (f"{_side}ThumbMetacarpal",),
        f"{_side}ThumbDistal": (f"{_side}ThumbProximal",),
    }
    for _finger in ("Index", "Middle", "Ring", "Little"):
        PARENTS |= {
            f"{_side}{_finger}Proximal": (f"{_side}Hand",),
            f"{_side}{_finger}Intermediate": (f"{_side}{_finger}Proximal",),
            f"{_side}{_finger}Distal": (f"{_side}{_finger}Intermediate",),
        }
REQUIRED = {"hips", "spine", "head"} | {
    f"{side}{bone}"
    for side in ("left", "right")
    for bone in ("UpperLeg", "LowerLeg", "Foot", "UpperArm", "LowerArm", "Hand")
}
"""As humanoid.md of the specification lists them."""


@pytest.fixture(scope="module")
def avatar(tmp_path_factory):
    path = tmp_path_factory.mktemp("vrm") / "a.vrm"
    export_file("female", path, skin="medium")
    return path


def extension(path: Path) -> dict:
    found = Glb(path).json
    assert found["extensionsUsed"] == ["VRMC_vrm"] and "animations" not in found
    return found["extensions"]["VRMC_vrm"]


def rests(path: Path) -> dict[str, np.ndarray]:
    """Humanoid bones at rest, in the world (4, 4)."""
    glb = Glb(path)
    world = glb._world(glb.json["nodes"])
    bones = extension(path)["humanoid"]["humanBones"]
    return {bone: world[row["node"]] for bone, row in bones.items()}


def surface(path: Path) -> np.ndarray:
    """The mesh as its skin carries it at rest (V, 3)."""
    glb = Glb(path)
    skin = glb.json["skins"][0]
    world = glb._world(glb.json["nodes"])
    bind = glb.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    whole = np.stack([world[node] for node in skin["joints"]]) @ bind
    attributes = glb.json["meshes"][0]["primitives"][0]["attributes"]
    assert "JOINTS_1" not in attributes
    points = glb.array(attributes["POSITION"])
    index, value = glb.array(attributes["JOINTS_0"]), glb.array(attributes["WEIGHTS_0"])
    moved = np.einsum("vk,vkcd->vcd", value, whole[index])
    return np.einsum("vcd,vd->vc", moved, np.c_[points, np.ones(len(points))])[:, :3]


def test_the_humanoid_has_its_bones_and_parents(avatar):
    found = Glb(avatar).json
    bones = extension(avatar)["humanoid"]["humanBones"]
    assert set(PARENTS) | {"hips"} == set(bones) >= REQUIRED
    nodes = [row["node"] for row in bones.values()]
    assert len(set(nodes)) == len(nodes) and set(nodes) <= set(found["skins"][0]["joints"])
    names = [node["name"] for node in found["nodes"]]
    assert len(set(names)) == len(names)
    above = {c: k for k, node in enumerate(found["nodes"]) for c in node.get("children", [])}
    of = {row["node"]: bone for bone, row in bones.items()}
    for bone, row in bones.items():
        node = above.get(row["node"])
        while node is not None and node not in of:
            node = above.get(node)
        assert bone == "hips" if node is None else of[node] in PARENTS[bone]
    assert all("scale" not in node for node in found["nodes"])


def test_it_rests_in_the_t_pose(avatar):
    bones = {name: rest[:3, 3] for name, rest in rests(avatar).items()}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for upper, lower in (("UpperArm", "LowerArm"), ("LowerArm", "Hand")):
            way = bones[f"{side}{lower}"] - bones[f"{side}{upper}"]
            assert sign * way[0] / np.linalg.norm(way) > np.cos(np.deg2rad(2))
        way = bones[f"{side}Toes"] - bones[f"{side}Foot"]
        assert way[2] > 0 and abs(way[0]) < 0.12 * np.linalg.norm(way)
    points = surface(avatar)
    assert abs(points[:, 1].min()) < 1e-4 and abs(points[:, 0].min() + points[:, 0].max()) < 0.01
    known = hb.load_body("female").full.rest_vertices(np.zeros(24))
    seen = np.unique((points - points.min(axis=0)).round(4), axis=0)
    assert len(seen) > 0.98 * len(known)
    assert np.abs(np.ptp(points, axis=0) - np.ptp(known, axis=0)).max() < 1e-4


def test_its_terms_name_the_licence_of_the_body(avatar, tmp_path):
    meta = extension(avatar)["meta"]
    assert (
        meta["name"] and meta["authors"] and meta["licenseUrl"] == "https://vrm.dev/licenses/1.0/"
    )
    assert "publicdomain/zero/1.0" in meta["otherLicenseUrl"]
    assert meta["allowRedistribution"] and meta["commercialUsage"] == "corporation"
    export_motion(synthetic_fit(4, body=tube_body(), rate_hz=30.0), tmp_path / "b.vrm")
    assert set(extension(tmp_path / "b.vrm")["meta"]) == {"name", "authors", "licenseUrl"}


def test_expressions_move_the_face_and_the_gaze_starts_between_the_eyes(avatar):
    found, told = Glb(avatar), extension(avatar)
    names = found.json["meshes"][0]["extras"]["targetNames"]
    presets = told["expressions"]["preset"]
    assert {"blink", "aa", "happy", "lookUp"} <= set(presets)
    assert set(told["expressions"]["custom"]) == set(names) and len(names) == 52
    mesh = next(k for k, node in enumerate(found.json["nodes"]) if "mesh" in node)
    for expression in presets.values():
        for bind in expression["morphTargetBinds"]:
            assert bind["node"] == mesh and 0 <= bind["index"] < 52 and 0 < bind["weight"] <= 1
    blink = [names[bind["index"]] for bind in presets["blink"]["morphTargetBinds"]]
    assert blink == ["eyeBlinkLeft", "eyeBlinkRight"]
    bones = rests(avatar)
    gaze = told["lookAt"]
    from_head = bones["head"] @ np.array([*gaze["offsetFromHeadBone"], 1.0])
    eyes = (bones["leftEye"][:3, 3] + bones["rightEye"][:3, 3]) / 2
    assert gaze["type"] == "bone" and np.linalg.norm(from_head[:3] - eyes) < 0.03


def test_a_person_in_motion_is_written_at_rest(tmp_path):
    body = hb.load_body("male")
    pose = np.random.default_rng(0).normal(0, 0.2, (5, body.num_joints, 3))
    betas = np.full(body.num_betas, 0.5)
    moving = BodyMotion(body, betas, pose, np.ones((5, 3)), 30.0, "+z")
    export_motion(moving, tmp_path / "a.vrm")
    points = surface(tmp_path / "a.vrm")
    known = body.full.rest_vertices(betas)
    assert np.abs(np.ptp(points, axis=0) - np.ptp(known, axis=0)).max() < 1e-4
    assert "otherLicenseUrl" in extension(tmp_path / "a.vrm")["meta"]


def test_a_body_without_the_bones_is_refused(tmp_path):
    body = random_body(joints=6)
    still = BodyMotion(body, np.zeros(5), np.zeros((2, 6, 3)), np.zeros((2, 3)), 30.0)
    with pytest.raises(HabitusError, match="has no joints for VRM's head, hips"):
        export_motion(still, tmp_path / "a.vrm")
    assert not list(tmp_path.iterdir())


def test_the_schemas_of_the_specification_agree(avatar):
    jsonschema = pytest.importorskip("jsonschema", reason="no jsonschema here")
    if not os.environ.get("VRM_SCHEMAS"):
        pytest.skip("no schemas here: set VRM_SCHEMAS")
    referencing = pytest.importorskip("referencing")
    loaded = {
        path.name: json.loads(path.read_text(encoding="utf-8"))
        for path in Path(os.environ["VRM_SCHEMAS"]).glob("*.json")
    }
    loaded |= {f"glTF{name}.schema.json": {} for name in ("Property", "id", "ChildOfRootProperty")}
    loaded["glTFid.schema.json"] = {"type": "integer", "minimum": 0}
    resources = [
        (
            name,
            referencing.Resource.from_contents(
                {**rows, "$id": name}, referencing.jsonschema.DRAFT7
            ),
        )
        for name, rows in loaded.items()
    ]
    registry = referencing.Registry().with_resources(resources)
    jsonschema.Draft7Validator({"$ref": "VRMC_vrm.schema.json"}, registry=registry).validate(
        extension(avatar)
    )


VALIDATE = """
const validator = require("gltf-validator"), data = require("fs").readFileSync(process.argv[1]);
validator.validateBytes(new Uint8Array(data)).then((report) => console.log(JSON.stringify(report.issues)));
"""


def test_khronos_validator_finds_no_error(avatar):
    node = shutil.which("node")
    if (
        node is None
        or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode
    ):
        pytest.skip("no validator here: npm install gltf-validator, NODE_PATH")
    done = subprocess.run([node, "-e", VALIDATE, avatar], capture_output=True, text=True)
    issues = json.loads(done.stdout)
    assert issues["numErrors"] == 0 and issues["numWarnings"] == 0, issues
