"""Hold a body's pose blend shapes beyond the ranges of its joints, with least change of simulated
and of real poses.

1. Collars are damped beyond their range. With P the blend shapes of collars and shoulders that
   move a vertex,

       tr((P - P0) H (P - P0)') + sum_j mu_j tr(P_j W_j P_j'),

   H the moments of the features of these joints together, over the simulated poses, poses drawn
   from the pose prior and standing ones, and W_j those of joint j beyond its range
   (`ranges.RANGES`) about each axis. Moments of joints together keep what collar and shoulder do
   with arms down: shoulders take over what collars lose.
2. Rotations of collars, hips, head and spine that change the volume by more than the gate allows
   are given it back along the normals.
3. Offsets of collars, hips and head beyond the range are saturated at 38.5 mm, or at the longest
   within the range in the same direction; raised collars (`SPARED`) keep those at their limit.

2 and 3 change blend shapes of the joint, and of the shoulder beside a collar, in the direction of
features that changes the poses of H least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.pose_features import ENTRIES, POSE_FEATURES
from habitus.body.prior import shipped_prior
from habitus.learn.posing.rig import Rig
from habitus.learn.posing.rotation_prior import rotation_gram
from habitus.learn.posing.surface import posed
from habitus_lab.default_body.flesh.gates import volume
from habitus_lab.default_body.flesh.poses import mirrored_pose, named
from habitus_lab.default_body.flesh.ranges import FAR, Rotation, limits, rotations, turned
from habitus_lab.default_body.flesh.symmetry import symmetric

WEIGHTS = {"collar": 0.001, "shoulder": 0.0}  # mu; simulated poses change by .3 mm RMS
SATURATED = ("collar", "hip", "head")
CORRECTED = (*SATURATED, "spine1", "spine2", "spine3")
PARTNERS = {"collar": "shoulder"}
SPARED = ("collar", 2)  # raised: simulated to 36 degrees, where skinning gains a litre
BEGINS, MOST = 0.026, 0.0385  # m: saturated offsets leave the straight line, and their limit
KEPT = 0.25  # litres that a rotation may change the volume by; beyond a range, more than skinning
GENERAL = 1e-3  # of moments about every axis, so that no direction of features is free
DRAWN = 2000  # poses drawn from the prior
STANDING = ((-68.0, -8.0), (-74.0, -12.0))  # degrees of shoulder and collar with arms down
KEEP = 10.0  # of moments with arms down, so that shoulders keep their height
PASSES = 3  # of the correction of volumes, which is linear in offsets to a few percent
ANGLES = 8  # of the moments beyond a limit
FEATURES = POSE_FEATURES["rotations"]


def entries(rotvecs: np.ndarray) -> np.ndarray:
    """(..., 9) vec(R - I) of rotation vectors (..., 3)."""
    return FEATURES.value(rotvecs)


def beyond(name: str) -> np.ndarray:
    """(9, 9) W of a joint: second moments of its features beyond each limit, summed over axes."""
    total = np.zeros((ENTRIES, ENTRIES))
    for axis, both in enumerate(limits(name)):
        for limit in both[np.abs(both) < FAR]:
            angles = np.radians(np.linspace(limit, np.copysign(FAR, limit), ANGLES))
            features = entries(angles[:, None] * np.eye(3)[axis])
            total += features.T @ features / ANGLES
    return total


@dataclass(frozen=True, eq=False)
class Moments:
    """H (9 D, 9 D) of a body's driving joints, which of them (D,) are damped together, and
    mu_j W_j (D, 9, 9).
    """

    poses: np.ndarray
    damped: np.ndarray
    penalty: np.ndarray

    def of_joints(self, drivers: list[int]) -> np.ndarray:
        """H + mu W of some joints, of full rank."""
        columns = columns_of(drivers)
        found = self.poses[np.ix_(columns, columns)]
        wide = GENERAL * rotation_gram(FEATURES)
        for k, driver in enumerate(drivers):
            own = slice(ENTRIES * k, ENTRIES * (k + 1))
            found[own, own] += self.penalty[driver] + wide
        return found


def columns_of(drivers: Sequence[int] | np.ndarray) -> np.ndarray:
    """Of the features of some driving joints."""
    return (ENTRIES * np.asarray(drivers)[:, None] + np.arange(ENTRIES)).ravel()


def moments(body: BodyModel, simulated: np.ndarray, seed: int = 0) -> Moments:
    """Of the simulated poses, as many of the prior's, and standing ones."""
    prior = shipped_prior().for_joints(body.joint_names)
    drawn = np.random.default_rng(seed).multivariate_normal(prior.mean, prior.covariance, DRAWN)
    real = np.concatenate([np.zeros((DRAWN, 1, 3)), drawn.reshape(DRAWN, -1, 3)], axis=1)
    left = np.array(
        [
            named(body.joint_names, {"left_shoulder": (0, 0, arm), "left_collar": (0, 0, collar)})
            for arm, collar in STANDING
        ]
    )
    standing = left + mirrored_pose(left, body.joint_names)
    sources = (simulated, 1.0), (real, 1.0), (standing, KEEP)
    flat = [
        np.sqrt(share / len(poses)) * entries(poses[:, body.drivers]).reshape(len(poses), -1)
        for poses, share in sources
    ]
    names = [body.joint_names[joint] for joint in body.drivers]
    kinds = [name.rpartition("_")[2] for name in names]
    penalty = [
        WEIGHTS.get(kind, 0.0) * beyond(name) for kind, name in zip(kinds, names, strict=True)
    ]
    together = sum(one.T @ one for one in flat)
    return Moments(together, np.isin(kinds, list(WEIGHTS)), np.array(penalty))


def damped_together(posedirs: np.ndarray, given: Moments) -> np.ndarray:
    """Step 1 for blend shapes (V, 3, 9 D)."""
    count = len(given.penalty)
    moved = posedirs.reshape(len(posedirs), 3, count, ENTRIES).any((1, 3)) & given.damped
    found = posedirs.copy()
    for row in np.unique(moved, axis=0):
        joints = np.flatnonzero(row)
        if not len(joints):
            continue
        columns = columns_of(joints)
        held = given.poses[np.ix_(columns, columns)]
        wide = held + GENERAL * 1e-3 * np.eye(len(columns))
        for k, joint in enumerate(joints):
            own = slice(ENTRIES * k, ENTRIES * (k + 1))
            wide[own, own] += given.penalty[joint]
        vertices = np.flatnonzero((moved == row).all(1))
        before = found[vertices][:, :, columns]
        after = np.linalg.solve(wide, held @ before.reshape(-1, len(columns)).T).T
        found[np.ix_(vertices, range(3), columns)] = after.reshape(before.shape)
    return found


def saturated(offsets: np.ndarray, most: float) -> np.ndarray:
    """Offsets (V, 3) of lengths up to a share of ``most`` as they are, longer ones bent towards
    it.
    """
    length = np.linalg.norm(offsets, axis=1, keepdims=True)
    begins = BEGINS / MOST * most
    room = most - begins
    bent = begins + room * (1 - np.exp(-np.maximum(length - begins, 0) / room))
    return offsets * np.where(length > begins, bent / np.maximum(length, begins), 1.0)


def longest(blocks: np.ndarray, rotation: Rotation) -> float:
    """The longest offset (m) of a joint's blend shapes."""
    return float(np.linalg.norm(blocks @ entries(rotation.rotvec()), axis=1).max())


@dataclass(frozen=True, eq=False)
class Change:
    """How a joint's blend shapes change: its gate, the features of itself and its partner
    (``columns``), their metric, and whether they move a vertex (V, C).
    """

    gate: list[Rotation]
    columns: np.ndarray
    metric: np.ndarray
    moved: np.ndarray

    def features(self, some: list[Rotation]) -> np.ndarray:
        """(n, C) at rotations of the joint alone."""
        own = entries(np.array([one.rotvec() for one in some]))
        return np.pad(own, ((0, 0), (0, len(self.columns) - ENTRIES)))


def change_of(posedirs: np.ndarray, given: Moments, drivers: list[int], name: str) -> Change:
    """Of the first of some driving joints, ``name``."""
    columns = columns_of(drivers)
    blocks = posedirs[..., columns].reshape(len(posedirs), 3, len(drivers), ENTRIES)
    moved = np.repeat(blocks.any((1, 3)), ENTRIES, axis=1)
    return Change(list(rotations(name)), columns, given.of_joints(drivers), moved)


def spared(rotation: Rotation) -> bool:
    """Whether offsets at the limit are kept as they are."""
    side, _, kind = rotation.joint.rpartition("_")
    raised = rotation.degrees > 0 if side == "left" else rotation.degrees < 0
    return (kind, rotation.axis) == SPARED and raised


def with_short_offsets(posedirs: np.ndarray, change: Change) -> np.ndarray:
    """Blend shapes with saturated offsets at rotations of one joint beyond its range."""
    own = posedirs[..., change.columns[:ENTRIES]]
    late: list[Rotation] = []
    wrong: list[np.ndarray] = []
    for inner, outer in pairwise(change.gate):
        most = max(MOST, longest(own, inner))
        if outer.within or (longest(own, outer) <= most and not spared(outer)):
            continue
        kept = inner if spared(outer) else outer
        offsets = own @ entries(kept.rotvec())
        late.append(kept)
        wrong.append(saturated(offsets, most) - offsets if kept is outer else 0 * offsets)
    if not late:
        return posedirs
    features = change.features(late)
    across = np.linalg.solve(change.metric, features.T)
    step = np.stack(wrong, axis=-1) @ np.linalg.solve(features @ across, across.T)
    found = posedirs.copy()
    found[..., change.columns] += step * change.moved[:, None]
    return found


def with_volumes(body: BodyModel, change: Change) -> BodyModel:
    """The body with changes of volume at a joint's rotations within `KEPT`, beyond its range more
    than skinning's.
    """
    faces = np.asarray(body.faces)
    plain = replace(body, posedirs=None, hinges=None, pose_joints=None, finer=None)
    rest = np.asarray(body().vertices, float)
    own = volume(rest, faces)
    rig = Rig(
        tuple(body.parents), "lbs", "rotations", 0, body.skinning_index, body.skinning_value, None
    )
    assert body.posedirs is not None
    size = np.linalg.norm(body.posedirs[..., change.columns[:ENTRIES]], axis=(1, 2))
    share = size / (size + size[size > 0].mean())
    area = np.linalg.norm(normals(rest, faces), axis=1)
    scale = (share / np.maximum(area, 1e-9))[:, None]

    def excess(one: BodyModel, rotation: Rotation) -> float:
        pose = turned(one, rotation)
        vertices = np.asarray(one(pose=pose).vertices, float)
        litres = 1e3 * (volume(vertices, faces) - own)
        most = KEPT
        if not rotation.within:
            skinned = np.asarray(plain(pose=pose).vertices, float)
            most += abs(1e3 * (volume(skinned, faces) - own))
        return litres - float(np.clip(litres, -most, most))

    turns = {one: turned(body, one) for one in change.gate}
    found = body
    bound: list[Rotation] = []
    for _ in range(PASSES):
        wrong = {one: excess(found, one) for one in change.gate}
        bound += [one for one in change.gate if abs(wrong[one]) > 1e-3 and one not in bound]
        if not bound:
            return found
        slopes = []
        for one in bound:
            vertices = np.asarray(found(pose=turns[one]).vertices, float)
            turn = posed(rig, turns[one]).turn
            slopes.append(np.einsum("vba,vb->va", turn, normals(vertices, faces)) * (1e3 / 3))
        features = change.features(bound)
        across = np.linalg.solve(change.metric, features.T)
        gram = np.array([[(a * scale * b).sum() for b in slopes] for a in slopes])
        gram *= features @ across
        pull = np.linalg.lstsq(gram, -np.array([wrong[one] for one in bound]), rcond=1e-6)[0]
        posedirs = found.posedirs.copy()
        for k, slope in enumerate(slopes):
            step = pull[k] * (scale * slope)[..., None] * across[:, k]
            posedirs[..., change.columns] += step * change.moved[:, None]
        found = replace(found, posedirs=posedirs, finer=None)
    return found


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) sums of the area vectors of a vertex' triangles: three times the slope of the
    volume.
    """
    a, b, c = vertices[faces].transpose(1, 0, 2)
    vectors = np.cross(b - a, c - a) / 2
    found = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(found, faces[:, k], vectors)
    return found


def limited_body(body: BodyModel, simulated: np.ndarray) -> BodyModel:
    """A body at full detail with blend shapes held beyond the ranges of its joints; the simulated
    poses (N, J, 3) rad.
    """
    given = moments(body, simulated)
    assert body.posedirs is not None
    found = replace(body, posedirs=damped_together(body.posedirs, given), finer=None)
    names = [body.joint_names[joint] for joint in body.drivers]
    for driver, name in enumerate(names):
        side, _, kind = name.rpartition("_")
        if kind not in CORRECTED:
            continue
        partners = [names.index(f"{side}_{PARTNERS[kind]}")] if kind in PARTNERS else []
        change = change_of(found.posedirs, given, [driver, *partners], name)
        found = with_volumes(found, change)
        if kind in SATURATED:
            posedirs = with_short_offsets(found.posedirs, change)
            found = replace(found, posedirs=posedirs, finer=None)
    drivers = np.array(found.drivers)
    return replace(found, posedirs=symmetric(found.posedirs, drivers, found.mirror), finer=None)
