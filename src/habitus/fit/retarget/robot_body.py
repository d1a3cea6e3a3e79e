"""A robot as a body in motion: its capsules and soles as a mesh that its links carry, so that all
that draws or exports a body draws and exports a robot.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int
from trimesh.creation import capsule as trimesh_capsule
from trimesh.geometry import align_vectors

from habitus.body.body_arrays import affine_regressor
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.robot import TO_ROBOT, Robot
from habitus.fit.retarget.robot_pairs import RobotPairs
from habitus.fit.retarget.robots import RobotMotion
from habitus.rotations import rotvec_from_matrix

RINGS, SIDES = 16, 16
"""Facets of a capsule: along it, and around it."""
ROD = 0.018
"""Radius (m) of the rods that are drawn between links."""
LEAST = 0.02
"""Links nearer than this (m) get no rod."""
SOLE = 0.012
"""Half the thickness (m) of a sole as drawn."""

Mesh = tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]


def robot_motion(motion: RobotMotion, pairs: RobotPairs) -> BodyMotion:
    """The robot's motion as a body's, +y up, each link a joint."""
    robot = motion.robot
    body = robot_body(robot, pairs)
    links = motion.links()
    turns = links.rotations @ np.swapaxes(robot.zero.rotations, -1, -2)
    local = turns.copy()
    for link, parent in enumerate(robot.parents):
        if parent >= 0:
            local[:, link] = np.swapaxes(turns[:, parent], -1, -2) @ turns[:, link]
    local = TO_ROBOT.T @ local @ TO_ROBOT
    return BodyMotion(
        body=body,
        betas=np.zeros(1),
        pose=rotvec_from_matrix(local),
        trans=motion.root @ TO_ROBOT,
        rate_hz=motion.rate_hz,
        up_axis="+y",
        capture_name=robot.name,
        body_name=robot.name,
        made=(f"retargeted to the robot {robot.name}",),
    )


def robot_body(robot: Robot, pairs: RobotPairs) -> BodyModel:
    """A rigid body model: a joint for each link where it turns, at rest with
    all joints of the robot at zero."""
    meshes = list(_meshes(robot, pairs))
    vertices = np.concatenate([mesh[0] for _, mesh in meshes]) @ TO_ROBOT
    starts = np.cumsum([0, *(len(mesh[0]) for _, mesh in meshes)])
    faces = np.concatenate([mesh[1] + k for (_, mesh), k in zip(meshes, starts, strict=False)])
    owners = np.concatenate([np.full(len(mesh[0]), link) for link, mesh in meshes])
    pivots = robot.zero.origins.copy()
    turned = robot.zero.rotations[robot.joint_links] @ robot.anchors[..., None]
    pivots[robot.joint_links] += turned[..., 0]
    pivots = pivots @ TO_ROBOT
    return BodyModel(
        name=robot.name,
        v_template=vertices,
        shapedirs=np.zeros((len(vertices), 3, 1)),
        posedirs=None,
        joint_regressor=affine_regressor(vertices, pivots),
        skinning_index=owners[:, None],
        skinning_value=np.ones((len(vertices), 1)),
        parents=robot.parents,
        faces=faces,
        joint_names=robot.link_names,
    )


def _meshes(robot: Robot, pairs: RobotPairs) -> Iterator[tuple[int, Mesh]]:
    """Meshes and the links that carry them: capsules, rods from link to link, soles."""
    origins = robot.zero.origins
    for part in pairs.capsules.values():
        link = robot.link(part.link)
        yield link, capsule(origins[link] + part.ends, part.radius)
    for link, parent in enumerate(robot.parents):
        if parent >= 0 and np.linalg.norm(origins[link] - origins[parent]) > LEAST:
            yield parent, capsule(origins[[parent, link]], ROD)
    for sole in pairs.soles:
        link = robot.link(sole.link)
        corners = np.concatenate([sole.heel, sole.toes])
        for first, second in ((sole.heel[0], sole.toes[0]), (sole.heel[-1], sole.toes[-1])):
            yield link, capsule(origins[link] + [first, second] + [0, 0, SOLE], SOLE)
        yield link, capsule(origins[link] + [np.zeros(3), corners.mean(axis=0)], ROD)


def capsule(ends: Float[np.ndarray, "2 3"], radius: float) -> Mesh:
    """A closed mesh of the points within ``radius`` of a segment, as nearly as facets allow."""
    axis = ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    upright = np.array([0.0, 0.0, 1.0])
    place = np.array(align_vectors(upright, axis if length > 0.0 else upright), dtype=float)
    place[:3, 3] = ends.mean(axis=0)
    mesh = trimesh_capsule(length, radius, count=[RINGS, SIDES], transform=place)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
