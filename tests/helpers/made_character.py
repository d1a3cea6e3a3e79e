"""A rigged glTF character made of the default body: other proportions, names, rest pose, joint axes
and units, with a texture, a material and an animation of its own.
"""

import json
import struct
from pathlib import Path

import numpy as np
from foreign_rigs import MIXAMO
from scipy.spatial.transform import Rotation

from habitus.io.models.bodies import load_body


def write_character(
    path: Path,
    names: dict[str, str] = MIXAMO,
    stretch: tuple[float, float, float] = (1.1, 0.8, 1.0),
    arms: float = 40.0,
    seed: int = 0,
    scale: float = 0.01,
    facing: float = 0.0,
    step: int = 1,
) -> None:
    """Write it as .glb, in an armature that is turned by -90 degrees about x and scaled; of every
    ``step``-th vertex alone.
    """
    body = load_body("default")
    pose = np.zeros((body.num_joints, 3))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pose[body.joint_names.index(f"{side}_shoulder"), 2] = sign * np.deg2rad(arms)
    surface = body(np.zeros(body.num_betas), pose, np.zeros(3))
    up = Rotation.from_rotvec([0.0, facing, 0.0]).as_matrix()
    size = np.array(stretch)
    vertices = (np.asarray(surface.vertices) * size) @ up.T
    joints = (np.asarray(surface.joints) * size) @ up.T
    floor = vertices[:, 1].min()
    vertices[:, 1] -= floor
    joints[:, 1] -= floor
    rng = np.random.default_rng(seed)
    turns = Rotation.random(body.num_joints, rng).as_matrix()
    armature = np.eye(4)
    armature[:3, :3] = scale * Rotation.from_euler("x", -90, degrees=True).as_matrix()
    world = np.tile(np.eye(4), (body.num_joints, 1, 1))
    world[:, :3, :3], world[:, :3, 3] = scale * turns, joints
    index, value = body.skinning_index, body.skinning_value
    vertices, index, value = vertices[::step], index[::step], value[::step]
    faces = body.faces if step == 1 else np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
    index = np.pad(index, ((0, 0), (0, 4 - index.shape[1]))).astype("u1")
    value = np.pad(value, ((0, 0), (0, 4 - value.shape[1]))).astype("f4")
    bind = np.linalg.inv(world).transpose(0, 2, 1).reshape(-1, 16).astype("f4")
    arrays = [
        (vertices.astype("f4"), 5126, "VEC3"),
        (index, 5121, "VEC4"),
        (value / value.sum(1, keepdims=True), 5126, "VEC4"),
        (faces.astype("u2").reshape(-1, 1), 5123, "SCALAR"),
        (bind, 5126, "MAT4"),
        (np.array([[0.0], [1.0]], "f4"), 5126, "SCALAR"),
        (np.array([[0, 0, 0, 1], [0, 0, 0, 1]], "f4"), 5126, "VEC4"),
    ]
    data, views, accessors = b"", [], []
    for array, kind, width in arrays:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": kind, "count": len(array)}
            | {"type": width}
        )
        data += array.tobytes() + b"\0" * (-array.nbytes % 4)
    accessors[0] |= {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
    accessors[5] |= {"min": [0.0], "max": [1.0]}
    nodes = [{"name": "Armature", "children": [2, 1]}]
    nodes[0] |= {"rotation": Rotation.from_matrix(armature[:3, :3] / scale).as_quat().tolist()}
    nodes[0] |= {"scale": [scale] * 3}
    nodes.append({"name": "Body", "mesh": 0, "skin": 0})
    for k, name in enumerate(body.joint_names):
        parent = body.parents[k]
        local = np.linalg.inv(world[parent] if parent >= 0 else armature) @ world[k]
        size_ = np.linalg.norm(local[:3, :3], axis=0)
        nodes.append(
            {
                "name": f"rig:{names.get(name, 'extra ' + name)}",
                "translation": local[:3, 3].tolist(),
                "rotation": Rotation.from_matrix(local[:3, :3] / size_).as_quat().tolist(),
                "children": [2 + c for c, p in enumerate(body.parents) if p == k],
            }
        )
        if not nodes[-1]["children"]:
            del nodes[-1]["children"]
    attributes = {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}
    document = {
        "asset": {"version": "2.0", "generator": "a test"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"name": "skin", "extras": {"mine": 1.25}}],
        "skins": [{"joints": [2 + k for k in range(body.num_joints)], "inverseBindMatrices": 4}],
        "animations": [
            {
                "name": "own",
                "samplers": [{"input": 5, "output": 6}],
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}],
            }
        ],
        "bufferViews": views,
        "accessors": accessors,
        "buffers": [{"byteLength": len(data)}],
        "extras": {"owner": "somebody"},
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    path.write_bytes(head + chunks + struct.pack("<I4s", len(data), b"BIN\0") + data)


def parts_of(path: Path) -> tuple[dict, bytes]:
    """The JSON and the binary chunk of a .glb."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]
