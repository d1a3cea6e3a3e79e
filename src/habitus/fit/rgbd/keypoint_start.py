"""A start from 2D keypoints: joints lie a little behind the depth that is seen at them."""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.fit.rgbd.sights import Sight
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

DEPTHS = {"shoulder": 0.06, "elbow": 0.04, "wrist": 0.03, "hip": 0.09, "knee": 0.06, "ankle": 0.05}
"""Metres that a joint lies behind the skin."""
SURE = 0.3
PIXELS = 6.0
"""How near a depth pixel must be to a keypoint, in colour pixels."""
STEPS = 15
JOINT_SD = 0.5
POINT_SD = 0.03
LONGEST = 0.6
FEWEST = 6


def pose_of_keypoints(
    body: BodyModel, sight: Sight, betas: Float[np.ndarray, " B"]
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " 3"]] | None:
    """Pose and place at which the body's joints are where a view's keypoints say; None where too
    few say so.
    """
    joints, points = seen_joints(body, sight)
    if len(joints) < FEWEST:
        return None
    found = [
        _solved(body, betas, joints, points, turn) for turn in np.deg2rad([0.0, 90.0, 180.0, 270.0])
    ]
    return min(found, key=lambda one: one[2])[:2]


def seen_joints(
    body: BodyModel, sight: Sight
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Joints that keypoints name, and where they are in the world (m), by the depth beside them."""
    joints = []
    points = []
    if sight.colour_camera is None or not sight.view.keypoints:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    own = sight.points[sight.mask]
    tree = KDTree(sight.colour_camera.project(torch.from_numpy(own))[0].numpy())
    for name, (u, v, sure) in sight.view.keypoints.items():
        part = name.partition("_")[2]
        near = tree.query_ball_point((u, v), PIXELS)
        if sure < SURE or part not in DEPTHS or name not in body.joint_names or not near:
            continue
        skin = np.median(own[near], axis=0)
        away = (skin - sight.eye) / np.linalg.norm(skin - sight.eye)
        joints.append(body.joint_names.index(name))
        points.append(skin + DEPTHS[part] * away)
    return np.array(joints, np.int64), np.array(points).reshape(-1, 3)


def _solved(
    body: BodyModel, betas: np.ndarray, joints: np.ndarray, points: np.ndarray, turn: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Gauss-Newton from a turn: pose, place and what is left."""
    pose = np.zeros((body.num_joints, 3))
    trans = points.mean(0) - body.rest_joints(betas)[joints].mean(0)
    pose[0] = rotvec_from_matrix(matrix_from_rotvec(np.array([0.0, turn, 0.0])))
    prior = np.concatenate([np.zeros(3), np.full(pose.size, JOINT_SD**-2.0)])
    prior[3:6] = 1e-6
    for _ in range(STEPS):
        found = surface_jacobian(body, betas, pose, trans, vertices=[0])
        apart = (found.surface.joints[joints] - points).ravel()
        rows = np.concatenate(
            [
                np.tile(np.eye(3), (len(joints), 1)),
                found.joints_pose[joints].reshape(-1, pose.size),
            ],
            1,
        )
        gradient = rows.T @ apart / POINT_SD**2 + prior * np.concatenate(
            [np.zeros(3), pose.ravel()]
        )
        step = -np.linalg.solve(rows.T @ rows / POINT_SD**2 + np.diag(prior + 1e-6), gradient)
        step *= min(1.0, LONGEST / max(float(np.abs(step[3:]).max()), 1e-9))
        trans = trans + step[:3]
        pose = pose + step[3:].reshape(pose.shape)
    return pose, trans, float(apart @ apart / POINT_SD**2 + (prior[3:] * pose.ravel() ** 2).sum())
