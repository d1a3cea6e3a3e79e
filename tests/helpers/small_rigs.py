"""A small symmetric body with random numbers, people of its form, and training problems planted on
it.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from habitus.body.model import BodyModel
from habitus.body.pose_features import POSE_FEATURES, extended
from habitus.body.skinning import Influences, skin, skinning_motions, world_motions
from habitus.learn.estimate import Anatomy, Estimate, Problem
from habitus.learn.options import TrainOptions
from habitus.learn.posing.rig import RestPerson, Rig, influences
from habitus.learn.posing.surface import surface
from habitus.learn.steps.weights import candidate_joints
from habitus.mesh.registrations import Registrations
from habitus.rotations import matrix_from_rotvec

PARENTS = (-1, 0, 1, 1, 2, 3)
JOINT_MIRROR = np.array([0, 1, 3, 2, 5, 4])
FLIP = np.array([-1.0, 1.0, 1.0])
_JOINTS = np.array(
    [[0, 0.9, 0], [0, 1.2, 0], [0.2, 1.4, 0], [-0.2, 1.4, 0], [0.5, 1.4, 0], [-0.5, 1.4, 0]]
)
_MIDDLES = np.array(
    [[0, 1, 0], [0, 1.35, 0], [0.35, 1.4, 0], [-0.35, 1.4, 0], [0.65, 1.4, 0], [-0.65, 1.4, 0]]
)


@dataclass(frozen=True)
class Small:
    """The body's parts that do not change; ``part`` (V,) is each vertex' joint."""

    vertices: np.ndarray
    faces: np.ndarray
    part: np.ndarray
    mirror: np.ndarray
    weights: np.ndarray
    regressor: np.ndarray


def small_body(seed=0, pairs=8, middle=3) -> Small:
    """V = 6 (2 pairs) / 2 + 2 middle: a cloud about each bone, exactly symmetric."""
    rng = np.random.default_rng(seed)
    left = []
    part = []
    for joint in (0, 1, 2, 4):
        own = _MIDDLES[joint] + 0.09 * rng.normal(size=(pairs, 3))
        if joint < 2:
            own[:, 0] = np.abs(own[:, 0]) + 0.02
        left.append(own)
        part += [joint] * pairs
    left = np.concatenate(left)
    part = np.array(part)
    central = [
        _MIDDLES[joint] * [0, 1, 1] + 0.09 * rng.normal(size=(middle, 3)) * [0, 1, 1]
        for joint in (0, 1)
    ]
    vertices = np.concatenate([left, left * FLIP, *central])
    part = np.concatenate([part, JOINT_MIRROR[part], np.repeat([0, 1], middle)])
    n = len(left)
    mirror = np.concatenate([np.arange(n, 2 * n), np.arange(n), np.arange(2 * n, len(vertices))])
    weights = _near(vertices, _MIDDLES, 0.15)
    index, value = influences(weights, 3)
    weights = np.zeros_like(weights)
    np.put_along_axis(weights, index, value, 1)
    weights = (weights + weights[mirror][:, JOINT_MIRROR]) / 2
    regressor = _near(_JOINTS, vertices, 0.08)
    regressor = (regressor + regressor[JOINT_MIRROR][:, mirror]) / 2
    order = np.argsort(np.linalg.norm(vertices[:, None] - vertices[None], axis=-1), axis=1)
    faces = np.concatenate([order[:, [0, 1, 2]], order[:, [0, 2, 3]]])
    return Small(vertices, faces, part, mirror, weights, regressor)


def _near(points, others, width):
    squared = ((points[:, None] - others[None]) ** 2).sum(-1) / width**2
    raised = np.exp(-0.5 * (squared - squared.min(1, keepdims=True)))
    return raised / raised.sum(1, keepdims=True)


def small_rig(
    small, seed=0, skinning="lbs", features="rotations", shape_features=0, size=0.01, count=4
) -> Rig:
    """Pose blend shapes are random, of ``size`` (m); none where that is None."""
    rng = np.random.default_rng([seed, 1])
    index, value = influences(small.weights, count)
    numbers = POSE_FEATURES[features].count(len(PARENTS), shape_features)
    posedirs = None if size is None else size * rng.normal(size=(len(index), 3, numbers))
    return Rig(PARENTS, skinning, features, shape_features, index, value, posedirs)


def people(
    small, count, seed=0, shape_features=0, symmetric=True, variation=0.03
) -> list[RestPerson]:
    """Smoothly different people whose joints are where the regressor says."""
    rng = np.random.default_rng([seed, 2])
    found = []
    for _ in range(count):
        waves = rng.normal(size=(3, 3)) * 2
        moved = small.vertices + variation * np.sin(small.vertices @ waves + rng.normal(size=3))
        if symmetric:
            moved = (moved + moved[small.mirror] * FLIP) / 2
        found.append(RestPerson(moved, small.regressor @ moved, rng.normal(size=shape_features)))
    return found


def poses(count, seed=0, largest=1.2):
    """Rotation vectors (count, J, 3) of random axes, up to ``largest`` (rad)."""
    rng = np.random.default_rng([seed, 3])
    axes = rng.normal(size=(count, len(PARENTS), 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    return axes * rng.uniform(0.1, largest, (count, len(PARENTS), 1))


def planted(
    options=None,
    *,
    small=None,
    seed=0,
    subjects=2,
    each=6,
    noise=0.0,
    size=0.01,
    descriptors=True,
    **changes,
):
    """A training problem and the estimate that made its registrations; what is started from is W_I
    itself.
    """
    options = TrainOptions(**changes) if options is None else options
    small = small_body(seed) if small is None else small
    rng = np.random.default_rng([seed, 4])
    wanted = None if options.pose_shapes == "none" else size
    rig = small_rig(
        small, seed, options.skinning, options.pose_features, options.shape_features, wanted
    )
    persons = people(small, subjects, seed, options.shape_features)
    if not descriptors:
        persons = [
            replace(person, descriptor=np.zeros(options.shape_features)) for person in persons
        ]
    turns = poses(subjects * each, seed)
    trans = 0.3 * rng.normal(size=(subjects * each, 3))
    who = np.repeat(np.arange(subjects), each)
    vertices = np.stack(
        [surface(rig, persons[i], pose) + t for i, pose, t in zip(who, turns, trans, strict=True)]
    )
    vertices += noise * rng.normal(size=vertices.shape)
    names = tuple(f"{k}" for k in range(len(who)))
    sets = ("pose",) * len(who)
    registrations = Registrations(
        vertices, small.faces, tuple(f"s{i}" for i in who), ("",) * len(who), sets, names
    )
    anatomy = Anatomy(small.mirror, JOINT_MIRROR, small.regressor)
    problem = Problem(
        registrations, anatomy, small.weights, candidate_joints(PARENTS, small.weights), options
    )
    truth = Estimate(
        rig,
        np.stack([person.template for person in persons]),
        np.stack([person.joints for person in persons]),
        np.stack([person.descriptor for person in persons]),
        turns,
        trans,
    )
    return problem, truth


def disturbed(estimate, seed=0, amount=1.0) -> Estimate:
    """Everything a little off (but the weights), and no pose blend shapes yet."""
    rng = np.random.default_rng([seed, 5])

    def off(values, size):
        return values + amount * size * rng.normal(size=values.shape)

    rig = estimate.rig
    if rig.posedirs is not None:
        rig = replace(rig, posedirs=np.zeros_like(rig.posedirs))
    return replace(
        estimate,
        rig=rig,
        templates=off(estimate.templates, 0.01),
        joints=off(estimate.joints, 0.01),
        pose=off(estimate.pose, 0.1),
        trans=off(estimate.trans, 0.02),
    )


def as_body(rig, small, shapedirs, template=None) -> BodyModel:
    """The body model of a rig with the small body's joints."""
    return BodyModel(
        name="small",
        v_template=small.vertices if template is None else template,
        shapedirs=shapedirs,
        posedirs=None if rig.posedirs is None else rig.posedirs,
        joint_regressor=small.regressor,
        skinning_index=rig.index,
        skinning_value=rig.value,
        parents=rig.parents,
        faces=small.faces,
        joint_names=tuple(f"joint_{k}" for k in range(len(rig.parents))),
        skinning=rig.skinning,
        pose_features=rig.pose_features,
        shape_features=rig.shape_features,
    )


def torch_surface(rig, template, joints, descriptor, pose, weights=None, posedirs=None):
    """The posed surface by the body's own functions, differentiable; weights (V,J) and posedirs may
    be given.
    """
    tensor = torch.as_tensor
    template = tensor(template)
    joints = tensor(joints)
    pose = tensor(pose)
    weights = tensor(rig.weights) if weights is None else weights
    rotations = matrix_from_rotvec(pose)
    rest = template
    if rig.posedirs is not None:
        feature = POSE_FEATURES[rig.pose_features].of_pose(pose, rotations)
        feature = extended(feature, tensor(descriptor), rig.shape_features)
        rest = rest + (tensor(rig.posedirs) if posedirs is None else posedirs) @ feature
    motions = skinning_motions(world_motions(rotations, joints, rig.parents), joints)
    dense = Influences(weights.T, tensor(rig.index), tensor(rig.value))
    return skin(rig.skinning, rest.T, motions, torch.zeros(3, dtype=torch.float64), dense)
