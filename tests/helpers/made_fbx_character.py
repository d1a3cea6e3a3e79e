"""A rigged FBX character made of the default body, as Mixamo's and Maya's are: joints with
PreRotation and PostRotation, rotation orders of their own, pivots, a bind pose that is not the pose
of its nodes, and an armature that is turned and scaled.
"""

from pathlib import Path

import numpy as np
from foreign_rigs import MIXAMO
from scipy.spatial.transform import Rotation

from habitus.export.fbx.nodes import Node, document
from habitus.export.fbx.scene import ROOT, Objects, prop, props, top_nodes
from habitus.io.models.bodies import load_body
from habitus.io.motions.fbx import ORDERS


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
) -> None:
    """Write it as binary .fbx. scale: of the armature. unit: UnitScaleFactor. posed: radians by
    which nodes are turned from the bind pose.
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
        order = int(rng.integers(0, 6))
        turn = before.inv() * Rotation.from_matrix(local[:3, :3]) * after
        turn = Rotation.from_rotvec(posed * rng.normal(size=3)) * turn
        axes = ["xyz".index(axis) for axis in ORDERS[order]]
        angles = np.zeros(3)
        angles[axes] = turn.as_euler(ORDERS[order], degrees=True)
        extra = [
            prop("RotationActive", "bool", "", "", 1),
            prop("RotationOrder", "enum", "", "", order),
            _triple("PreRotation", before.as_euler("xyz", degrees=True)),
            _triple("PostRotation", after.as_euler("xyz", degrees=True)),
        ]
        model = _model(
            objects,
            f"rig:{MIXAMO.get(name, 'extra ' + name)}",
            "LimbNode",
            local[:3, 3],
            angles,
            [1.0] * 3,
            extra,
        )
        objects.link(model, models[parent] if parent >= 0 else root)
        models.append(model)
    _skin(objects, body, vertices, world, models, step)
    path.write_bytes(document(_scene(objects, unit), version))


def _triple(name: str, values) -> Node:
    return prop(name, "Vector3D", "Vector", "", *map(float, values))


def _model(objects, name, form, place, angles, scaling, extra=()) -> np.int64:
    values = (("Translation", place), ("Rotation", angles), ("Scaling", scaling))
    moved = [prop(f"Lcl {n}", f"Lcl {n}", "", "A", *map(float, v)) for n, v in values]
    nodes = [Node("Version", (232,)), props(*extra, prop("InheritType", "enum", "", "", 1), *moved)]
    return objects.add("Model", name, form, nodes)


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
