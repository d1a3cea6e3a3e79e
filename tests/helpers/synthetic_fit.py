"""A made-up marker fit: a small tube body that walks with made-up markers. Known in every digit,
needs no file.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from habitus.arrays import to_numpy
from habitus.body.model import BodyModel
from habitus.fit.markers.suspects import Suspect
from habitus.jobs.results import MarkerResult
from habitus.mesh.normals import vertex_normals
from habitus.observe.markers import MarkerAttachment, attach, predict_markers

JOINTS = {  # name: (parent, rest place in metres, T-pose, body space)
    "pelvis": (-1, (0, 0.95, 0)),
    "left_hip": (0, (0.09, 0.88, 0)),
    "right_hip": (0, (-0.09, 0.88, 0)),
    "spine1": (0, (0, 1.05, 0)),
    "left_knee": (1, (0.1, 0.48, 0)),
    "right_knee": (2, (-0.1, 0.48, 0)),
    "spine2": (3, (0, 1.18, 0)),
    "left_ankle": (4, (0.1, 0.08, -0.02)),
    "right_ankle": (5, (-0.1, 0.08, -0.02)),
    "spine3": (6, (0, 1.25, 0)),
    "left_foot": (7, (0.1, 0.03, 0.12)),
    "right_foot": (8, (-0.1, 0.03, 0.12)),
    "neck": (9, (0, 1.45, 0)),
    "left_collar": (9, (0.07, 1.4, 0)),
    "right_collar": (9, (-0.07, 1.4, 0)),
    "head": (12, (0, 1.6, 0.02)),
    "left_shoulder": (13, (0.18, 1.4, 0)),
    "right_shoulder": (14, (-0.18, 1.4, 0)),
    "left_elbow": (16, (0.45, 1.4, 0)),
    "right_elbow": (17, (-0.45, 1.4, 0)),
    "left_wrist": (18, (0.7, 1.4, 0)),
    "right_wrist": (19, (-0.7, 1.4, 0)),
    "left_hand": (20, (0.8, 1.4, 0)),
    "right_hand": (21, (-0.8, 1.4, 0)),
}
BETAS = 6


def tube_body(betas: int = BETAS, posedirs: bool = False, seed: int = 0) -> Any:
    """A body of tubes around 24 bones, with smooth made-up blend shapes."""
    rng = np.random.default_rng(seed)
    parents = tuple(parent for parent, _ in JOINTS.values())
    places = np.array([place for _, place in JOINTS.values()], float)
    vertices, faces, index, value = _tubes(parents, places)
    modes = rng.normal(size=(3, 3, betas))
    shapedirs = 0.02 * np.sin(
        np.einsum("vc,cdb->vdb", vertices, 3 * modes) + rng.uniform(0, 6, (1, 3, betas))
    )
    features = 9 * (len(parents) - 1)
    smooth = np.sin(vertices @ rng.normal(size=(3, 5)) * 4)
    pose_shapes = 0.004 * np.einsum("vk,kcp->vcp", smooth, rng.normal(size=(5, 3, features)))
    near = np.exp(-((np.linalg.norm(places[:, None] - vertices, axis=-1) / 0.12) ** 2)) + 1e-9
    return BodyModel(
        name="tubes",
        v_template=vertices,
        shapedirs=shapedirs,
        posedirs=pose_shapes if posedirs else None,
        joint_regressor=near / near.sum(1, keepdims=True),
        skinning_index=index,
        skinning_value=value,
        parents=parents,
        faces=faces,
        joint_names=tuple(JOINTS),
    )


def _tubes(
    parents: tuple[int, ...], places: np.ndarray, around: int = 8, along: int = 6
) -> tuple[np.ndarray, ...]:
    vertices = []
    faces = []
    index = []
    value = []
    for joint in range(1, len(parents)):
        start = places[parents[joint]]
        end = places[joint]
        axis = (end - start) / np.linalg.norm(end - start)
        side = np.cross(axis, [0.3, 0.5, 0.81])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        base = around * along * (joint - 1)
        for k in range(along):
            s = k / (along - 1)
            angle = 2 * np.pi * np.arange(around) / around
            ring = (
                start
                + s * (end - start)
                + 0.05 * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
            )
            vertices.append(ring)
            grand = parents[parents[joint]] if parents[parents[joint]] >= 0 else parents[joint]
            index.append(np.tile([parents[joint], joint, grand, 0], (around, 1)))
            value.append(np.tile([0.7, 0.3 * s, 0.3 * (1 - s), 0.0], (around, 1)))
        for k in range(along - 1):
            a = base + k * around + np.arange(around)
            b = base + k * around + (np.arange(around) + 1) % around
            faces += [np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)]
    return (
        np.concatenate(vertices),
        np.concatenate(faces),
        np.concatenate(index),
        np.concatenate(value),
    )


def reference_vertices(
    body: Any,
    betas: np.ndarray,
    pose: np.ndarray,
    trans: np.ndarray,
    vertices: np.ndarray | None = None,
) -> np.ndarray:
    """SMPL's function (S 3) written a second time, in NumPy: betas (T,B), pose (T,J,3), trans (T,3)
    -> (T,N,3).
    """
    get = lambda a: to_numpy(a).astype(np.float64)  # noqa: E731
    rows = np.arange(len(body.v_template)) if vertices is None else vertices
    template = get(body.v_template)
    shapedirs = get(body.shapedirs)
    regressor = get(body.joint_regressor)
    joints = regressor @ template + np.einsum(
        "jcb,tb->tjc", np.tensordot(regressor, shapedirs, 1), betas
    )
    rotation = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(*pose.shape[:2], 3, 3)
    rest = template[rows] + np.einsum("vcb,tb->tvc", shapedirs[rows], betas)
    if body.posedirs is not None:
        features = (
            rotation[:, list(body.pose_joints or range(1, len(body.parents)))] - np.eye(3)
        ).reshape(len(pose), -1)
        rest = rest + np.einsum("vcp,tp->tvc", get(body.posedirs)[rows], features)
    whole = rotation.copy()
    place = joints.copy()
    for j, parent in enumerate(body.parents):
        if parent >= 0:
            whole[:, j] = whole[:, parent] @ rotation[:, j]
            place[:, j] = place[:, parent] + np.einsum(
                "tcd,td->tc", whole[:, parent], joints[:, j] - joints[:, parent]
            )
    shift = place - np.einsum("tjcd,tjd->tjc", whole, joints)
    index = np.asarray(body.skinning_index)[rows]
    value = get(body.skinning_value)[rows]
    posed = np.zeros_like(rest)
    for k in range(index.shape[1]):
        moved = np.einsum("tvcd,tvd->tvc", whole[:, index[:, k]], rest) + shift[:, index[:, k]]
        posed += value[:, k, None] * moved
    return posed + trans[:, None]


def walking_pose(
    frames: int, rate_hz: float, names: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """A stylised walk along a circle in a z-up world: pose (T,J,3), trans (T,3)."""
    time = np.arange(frames) / rate_hz
    phase = 2 * np.pi * 0.9 * time
    joint = {name: k for k, name in enumerate(names)}
    turn = lambda axis, angle: Rotation.from_rotvec(np.outer(angle, axis))  # noqa: E731
    x, y, z = np.eye(3)
    pose = np.zeros((frames, len(names), 3))
    heading = 2 * np.pi * time / 12
    pose[:, 0] = (
        turn(z, heading) * turn(x, np.full(frames, np.pi / 2)) * turn(y, 0.06 * np.sin(phase))
    ).as_rotvec()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * np.sin(phase)
        pose[:, joint[f"{side}_hip"]] = np.outer(-0.45 * swing - 0.1, x)
        pose[:, joint[f"{side}_knee"]] = np.outer(
            0.15 + 0.55 * np.maximum(0, sign * np.cos(phase)) ** 2, x
        )
        pose[:, joint[f"{side}_ankle"]] = np.outer(0.2 * swing - 0.1, x)
        arm = turn(x, 0.4 * swing) * turn(z, np.full(frames, -sign * 1.2))
        pose[:, joint[f"{side}_shoulder"]] = arm.as_rotvec()
        pose[:, joint[f"{side}_elbow"]] = np.outer(-sign * (0.35 + 0.2 * swing), y)
    pose[:, joint["spine2"]] = np.outer(0.08 * np.sin(phase), y)
    radius = 1.1 * 12 / (2 * np.pi)
    path = np.stack(
        [radius * np.cos(heading), radius * np.sin(heading), 0.02 * np.cos(2 * phase)], 1
    )
    return pose, path


def _carried(
    body: Any, attachment: MarkerAttachment, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray
) -> np.ndarray:
    corners = reference_vertices(body, betas, pose, trans, attachment.triangles.ravel())
    own = MarkerAttachment(
        np.arange(attachment.triangles.size).reshape(-1, 3), attachment.coefficients
    )
    return predict_markers(corners, own)


def synthetic_fit(
    frames: int = 90,
    markers: int = 12,
    *,
    body: Any = None,
    vertices: np.ndarray | None = None,
    labels: tuple[str, ...] | None = None,
    soft: bool = True,
    rate_hz: float = 120.0,
    seed: int = 0,
    **changes: Any,
) -> MarkerResult:
    """A ``MarkerResult``. Missing samples, a swapped and a shaky marker are built in."""
    rng = np.random.default_rng(seed)
    body = tube_body() if body is None else body
    count = int(body.shapedirs.shape[-1])
    if vertices is None:
        vertices = np.sort(rng.choice(len(body.v_template), markers, replace=False))
    markers = len(vertices)
    betas = rng.normal(size=count) * 0.8
    pose, trans = walking_pose(frames, rate_hz, body.joint_names)
    root = to_numpy(body.joint_regressor)[0] @ to_numpy(body.v_template)
    trans = trans - root + [0, 0, 0.95]
    wobble = np.sin(
        2 * np.pi * 1.8 * np.arange(frames)[:, None] / rate_hz + rng.uniform(0, 6, count)
    )
    soft_tissue = wobble * rng.normal(size=count) * 0.15 if soft else None
    rest = to_numpy(body.v_template) + to_numpy(body.shapedirs) @ betas
    latent = rest[vertices] + 0.0095 * vertex_normals(rest, to_numpy(body.faces))[vertices]
    attachment = attach(latent, rest, body.faces)
    still = np.tile(betas, (frames, 1))
    rigid = _carried(body, attachment, still, pose, trans)
    loose = _carried(body, attachment, betas + soft_tissue, pose, trans) if soft else rigid
    observed = (
        loose + rng.normal(size=loose.shape) * 0.003 + rng.normal(size=(1, markers, 3)) * 0.003
    )
    observed[rng.uniform(size=observed.shape[:2]) < 0.02] = np.nan
    observed[frames // 3 : frames // 2, 1] = np.nan
    swapped = slice(frames // 2, frames // 2 + frames // 10)
    observed[swapped, [2, 3]] = observed[swapped, [3, 2]]
    flagged = np.zeros(frames, bool)
    flagged[swapped] = True
    weights = np.where(np.linalg.norm(observed - loose, axis=-1) > 0.04, 0.05, 0.95)
    labels = tuple(f"M{k:02d}" for k in range(markers)) if labels is None else labels
    values = {
        "capture_name": "walk",
        "body_name": body.name,
        "layout_name": "made-up",
        "body": body,
        "up_axis": "+z",
        "rate_hz": rate_hz,
        "labels": labels,
        "betas": betas,
        "latent_markers": latent,
        "attachment": attachment,
        "pose_stage": (pose, trans),
        "marker_noise": np.full(markers, 0.004),
        "pose": pose,
        "trans": trans,
        "soft_tissue": soft_tissue,
        "observed_markers": observed,
        "predicted_pose_stage": rigid,
        "predicted_soft_tissue": loose if soft else None,
        "marker_weights": weights,
        "held_out": None,
        "flagged_frames": flagged,
        "suspects": (Suspect(labels[2], "swapped with " + labels[3], frames // 10),),
        "costs": {"data": 1.25, "pose_prior": 0.4},
        "stage_seconds": {
            "read": 0.2,
            "shape": 1.4,
            "pose": 0.8,
            "soft_tissue": 0.9 if soft else None,
            "export": 0.3,
            "total": 3.6,
        },
        "startup_seconds": 2.1,
        "warnings": (
            "The file says metres; the data look like millimetres: millimetres were used.",
        ),
        "settings": {"weights": {"data": 1.0, "pose": 0.25}, "frames": 12},
        "status": "converged",
        "seed": 3,
    }
    return MarkerResult(**(values | changes))
