"""A rigged FBX character made of the default body, as Mixamo's and Maya's are: joints with
PreRotation and PostRotation, rotation orders of their own, pivots, a bind pose that is not the pose
of its nodes, and an armature that is turned and scaled.
"""

from pathlib import Path

import numpy as np
from foreign_rigs import MIXAMO
from scipy.spatial.transform import Rotation

from habitus.export.fbx.motion import Curves
from habitus.export.fbx.nodes import Node, document
from habitus.export.fbx.scene import ROOT, Objects, prop, props, top_nodes
from habitus.io.models.bodies import load_body
from habitus.io.motions.fbx import ORDERS
from habitus.io.motions.fbx_nodes import read_document


def write_fbx_character(
    path: Path,
    scale: float = 100.0,
    unit: float = 1.0,
    arms: float = 40.0,
    stretch: tuple[float, float, float] = (1.1, 0.8, 1.0),
    seed: int = 0,
    version: int = 7400,
    posed: float = 0.3,
    step: int = 1,
    frames: int = 0,
    skinned: bool = True,
    pivots: bool = True,
    plain: bool = False,
) -> None:
    """Write it as binary .fbx. scale: of the armature. unit: UnitScaleFactor. posed: radians by
    which nodes are turned from the bind pose. frames: of a motion of both shoulders. plain:
    PreRotation alone turns joints at rest.
    """
    body, rng = load_body("default"), np.random.default_rng(seed)
    pose = np.zeros((body.num_joints, 3))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pose[body.joint_names.index(f"{side}_shoulder"), 2] = sign * np.deg2rad(arms)
    surface = body(np.zeros(body.num_betas), pose, np.zeros(3))
    size = np.array(stretch) * 100.0 / unit
    vertices = (np.asarray(surface.vertices) * size)[::step]
    joints = np.asarray(surface.joints) * size
    floor = vertices[:, 1].min()
    vertices[:, 1] -= floor
    joints[:, 1] -= floor
    armature = np.eye(4)
    armature[:3, :3] = scale * Rotation.from_euler("x", -90, degrees=True).as_matrix()
    turns = Rotation.random(body.num_joints, rng).as_matrix()
    world = np.tile(np.eye(4), (body.num_joints, 1, 1))
    world[:, :3, :3], world[:, :3, 3] = scale * turns, joints
    objects = Objects()
    root = _model(objects, "Armature", "Null", np.zeros(3), [-90.0, 0.0, 0.0], [scale] * 3)
    objects.link(root, ROOT)
    models: list[np.int64] = []
    for k, name in enumerate(body.joint_names):
        parent = body.parents[k]
        local = np.linalg.inv(world[parent] if parent >= 0 else armature) @ world[k]
        before, after = Rotation.random(2, rng)
        if plain:
            before, after = Rotation.from_matrix(local[:3, :3]), Rotation.identity()
        order = int(rng.integers(0, 6))
        turn = before.inv() * Rotation.from_matrix(local[:3, :3]) * after
        turn = Rotation.from_rotvec(posed * rng.normal(size=3)) * turn
        axes = ["xyz".index(axis) for axis in ORDERS[order]]
        angles = np.zeros(3)
        angles[axes] = turn.as_euler(ORDERS[order], degrees=True)
        offset, pivot, shift = 0.1 * pivots * 100.0 / (unit * scale) * rng.normal(size=(3, 3))
        angled = (before * turn * after.inv()).as_matrix()
        place = local[:3, 3] - offset - pivot - angled @ (shift - pivot)
        extra = [
            _triple("RotationOffset", offset),
            _triple("RotationPivot", pivot),
            _triple("ScalingOffset", shift),
            prop("RotationActive", "bool", "", "", 1),
            prop("RotationOrder", "enum", "", "", order),
            _triple("PreRotation", before.as_euler("xyz", degrees=True)),
            _triple("PostRotation", after.as_euler("xyz", degrees=True)),
        ]
        model = _model(
            objects,
            f"rig:{MIXAMO.get(name, 'extra ' + name)}",
            "LimbNode",
            place,
            angles,
            [1.0] * 3,
            extra,
        )
        objects.link(model, models[parent] if parent >= 0 else root)
        models.append(model)
    if skinned:
        _skin(objects, body, vertices, world, models, step)
    if frames:
        curves = Curves(objects, "none", frames, 30.0)
        wave = 40.0 * np.sin(np.arange(frames)[:, None] / 5.0) * [1.0, 0.5, 0.2]
        for side in ("left", "right"):
            joint = models[body.joint_names.index(f"{side}_shoulder")]
            curves.add(joint, "Lcl Rotation", "R", "XYZ", wave, np.full(3, 1e3))
    path.write_bytes(document(_scene(objects, unit), version))


def _triple(name: str, values) -> Node:
    return prop(name, "Vector3D", "Vector", "", *map(float, values))


def _model(objects, name, form, place, angles, scaling, extra=()) -> np.int64:
    values = (("Translation", place), ("Rotation", angles), ("Scaling", scaling))
    moved = [prop(f"Lcl {n}", f"Lcl {n}", "", "A", *map(float, v)) for n, v in values]
    nodes = [Node("Version", (232,)), props(*extra, prop("InheritType", "enum", "", "", 1), *moved)]
    model = objects.add("Model", name, form, nodes)
    if form == "LimbNode":
        kind = [Node("TypeFlags", ("Skeleton",))]
        objects.link(objects.add("NodeAttribute", name, form, kind), model)
    return model


def _skin(objects, body, vertices, world, models, step) -> None:
    faces = body.faces if step == 1 else np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
    corners = faces.astype(np.int32).copy()
    corners[:, -1] = ~corners[:, -1]
    shape = [Node("Vertices", (vertices.ravel(),)), Node("PolygonVertexIndex", (corners.ravel(),))]
    geometry = objects.add("Geometry", "Body", "Mesh", shape)
    mesh = _model(objects, "Body", "Mesh", np.zeros(3), np.zeros(3), [1.0] * 3)
    skin = objects.add("Deformer", "Body", "Skin", [Node("Version", (101,))])
    material = objects.add("Material", "cloth", "", [Node("ShadingModel", ("phong",))])
    for child, parent in ((mesh, ROOT), (geometry, mesh), (skin, geometry), (material, mesh)):
        objects.link(child, parent)
    index, value = body.skinning_index[::step], body.skinning_value[::step]
    for k, model in enumerate(models):
        rows, columns = np.nonzero((index == k) & (value > 0))
        nodes = [
            Node("Indexes", (rows.astype(np.int32),)),
            Node("Weights", (value[rows, columns].astype(np.float64),)),
            Node("Transform", (np.linalg.inv(world[k]).T.ravel(),)),
            Node("TransformLink", (world[k].T.ravel(),)),
        ]
        cluster = objects.add("Deformer", f"joint {k}", "Cluster", nodes, "SubDeformer")
        objects.link(cluster, skin)
        objects.link(model, cluster)


def _scene(objects: Objects, unit: float) -> list[Node]:
    nodes = top_nodes(objects, "none", 1, 30.0)
    for k, node in enumerate(nodes):
        if node.name == "GlobalSettings":
            old = node.nodes[1].nodes
            kept = [each for each in old if each.values[0] != "UnitScaleFactor"]
            scale = prop("UnitScaleFactor", "double", "Number", "", unit)
            nodes[k] = Node(node.name, (), [node.nodes[0], props(*kept, scale)])
    return nodes


def as_text(content: bytes) -> str:
    """A binary file's nodes as a text FBX."""

    def lines(node, depth: int):
        space = "\t" * depth
        words, block = [], []
        for value in node.values:
            if isinstance(value, np.ndarray):
                words.append(f"*{len(value)} {{")
                block = [f"{space}\ta: {','.join(map(str, value.tolist()))}", space + "}"]
            elif isinstance(value, str):
                name, mark, kind = value.partition("\0\1")
                words.append(f'"{kind}::{name}"' if mark else f'"{value}"')
            elif isinstance(value, bytes):
                words.append('""')
            else:
                words.append("TF"[not value] if isinstance(value, bool) else str(value))
        head = f"{space}{node.name}: {', '.join(words)}"
        if node.scope or node.nodes:
            block = [line for each in node.nodes for line in lines(each, depth + 1)]
            head, block = head + " {", [*block, space + "}"]
        return [head, *block]

    nodes = read_document(content).nodes
    made = [line for node in nodes for line in lines(node, 0)]
    return "; FBX 7.4.0 project file\n; a comment: { }\n" + "\n".join(made) + "\n"
