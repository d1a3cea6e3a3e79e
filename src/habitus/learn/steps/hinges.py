"""Hinge channels of joints that fold deeply, given everything else (`habitus.body.pose_features`).

A joint's blend shapes P and its channels' directions D are solved for together, at the vertices
that the joint drives already, by linear least squares in posed space:

    sum |y - A (dP f + D c)|^2 + tr(dP H dP') + mu N tr((P + dP) G_w (P + dP)') + r |D|^2

with y what the body leaves of a registration, A the vertex' blended rotation, f = vec(R - I), c the
channels' weights times 1 and the first betas, H what is known of P from elsewhere, and G_w the
moments of rotations about every axis (`rotation_prior`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.pose_features import ENTRIES, POSE_FEATURES, Hinges, pose_coefficients
from habitus.errors import HabitusError
from habitus.learn.estimate import Estimate, Problem, posed_targets
from habitus.learn.options import TrainOptions
from habitus.learn.posing.hinge_rows import hinge_row
from habitus.learn.posing.rig import Rig
from habitus.learn.posing.rotation_prior import rotation_gram
from habitus.learn.posing.surface import posed
from habitus.rotations import matrix_from_rotvec

FEATURES = POSE_FEATURES["rotations"]


@dataclass(frozen=True, eq=False)
class Sample:
    """A registration without its translation (m), how far its vertices are trusted, its pose (rad),
    and its person's rest surface, joints (m) and betas.
    """

    vertices: Float[np.ndarray, "V 3"]
    weights: Float[np.ndarray, " V"]
    pose: Float[np.ndarray, "J 3"]
    rest: Float[np.ndarray, "V 3"]
    joints: Float[np.ndarray, "J 3"]
    betas: Float[np.ndarray, " B"]


@dataclass(frozen=True, eq=False)
class Channels:
    """What tells how far a joint is folded: C rows and biases; none of a joint whose blend shapes
    alone are to be learned.
    """

    joint: int
    rows: Float[np.ndarray, "C 9"]
    bias: Float[np.ndarray, " C"]

    def weights(self, rotations: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N C"]:
        """clip(x, 0, 1)^2 at some rotation vectors (rad)."""
        return np.clip(entries(rotations) @ self.rows.T - self.bias, 0.0, 1.0) ** 2


@dataclass(frozen=True, eq=False)
class Fold:
    """What was learned of a joint: at its vertices (n,) the change of its blend shapes and its
    channels' directions (m), for everybody and times the first S betas.
    """

    channels: Channels
    vertices: Int[np.ndarray, " n"]
    change: Float[np.ndarray, "n 3 9"]
    directions: Float[np.ndarray, "n 3 C S1"]
    linear: Float[np.ndarray, "C 9"]


def entries(rotations: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 9"]:
    """vec(R - I) of rotation vectors (rad)."""
    return (matrix_from_rotvec(rotations) - np.eye(3)).reshape(len(rotations), ENTRIES)


def channels_of(
    body: BodyModel, name: str, axis: Float[np.ndarray, " 3"], begins: Sequence[float]
) -> Channels:
    """Channels of a joint that folds about ``axis``, one for each bend (degrees) where it begins.

    Raises HabitusError for a joint that drives nothing, or from which not one bone leads on.
    """
    joint = body.joint_names.index(name) if name in body.joint_names else -1
    ends = [k for k, parent in enumerate(body.parents) if parent == joint]
    if joint not in body.drivers or len(ends) != 1:
        raise HabitusError(
            f"{name} cannot be a hinge of {body.name}; expected a joint with one bone that drives "
            "pose blend shapes"
        )
    bone = body.joint_template[ends[0]] - body.joint_template[joint]
    rows = [hinge_row(bone, axis, np.radians(degrees)) for degrees in begins]
    return Channels(joint, np.array([row for row, _ in rows]), np.array([b for _, b in rows]))


def hinge_axis(rotations: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " 3"]:
    """The axis about which a joint turns most (rotation vectors, rad), to the side of its mean."""
    axis = np.linalg.eigh(rotations.T @ rotations)[1][:, -1]
    return axis if axis @ rotations.mean(0) >= 0 else -axis


def residual(
    body: BodyModel, sample: Sample, vertices: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Blended rotations of some vertices, and what the body leaves of their places (m), person and
    pose known.
    """
    influences = body.skinning_index[vertices], body.skinning_value[vertices]
    applied = posed(
        Rig(body.parents, body.skinning, "rotations", 0, *influences, None), sample.pose
    )
    rest = sample.rest[vertices]
    if body.pose_directions is not None:
        driven = (FEATURES, body.hinges, 0, body.drivers)
        known = pose_coefficients(
            *driven, sample.pose, matrix_from_rotvec(sample.pose), sample.betas
        )
        rest = rest + body.pose_directions[vertices] @ known
    return applied.turn, sample.vertices[vertices] - applied.vertices(rest, sample.joints)


def driven_vertices(body: BodyModel, joint: int) -> Int[np.ndarray, " n"]:
    """The vertices that a joint's blend shapes move."""
    return np.flatnonzero(_own(body, joint).any((1, 2)))


def solve_fold(
    body: BodyModel,
    channels: Channels,
    samples: Iterable[Sample],
    num_shapes: int,
    known: Float[np.ndarray, "9 9"],
    prior: float,
    ridge: float,
) -> Fold:
    """One joint's channels and the change of its blend shapes.

    ``known``: H for each sample. ``prior``: mu. ``ridge``: r, of the mean square of each of the
    coefficients c. Raises HabitusError where no sample turns the joint.
    """
    joint = channels.joint
    vertices = driven_vertices(body, joint)
    size = ENTRIES + len(channels.bias) * (1 + num_shapes)
    gram = np.zeros((len(vertices), 3, size, 3, size))
    pull = np.zeros((len(vertices), 3, size))
    rotations = []
    folds = []
    for sample in samples:
        if not sample.pose[joint].any():
            continue
        weight = channels.weights(sample.pose[joint : joint + 1])[0]
        fold = np.outer(weight, [1.0, *sample.betas[:num_shapes]]).ravel()
        row = np.concatenate([entries(sample.pose[joint : joint + 1])[0], fold])
        turn, left = residual(body, sample, vertices)
        back = turn.transpose(0, 2, 1) * sample.weights[vertices, None, None]
        gram += (back @ turn)[:, :, None, :, None] * np.outer(row, row)[:, None]
        pull += (back @ left[..., None]) * row
        rotations.append(sample.pose[joint])
        folds.append(fold)
    if not rotations:
        raise HabitusError(
            f"no registration turns {body.joint_names[joint]}; expected some that fold it"
        )
    count = len(rotations)
    wide = prior * count * rotation_gram(FEATURES)
    power = np.square(folds).sum(axis=0)
    penalty = np.zeros((size, size))
    penalty[:ENTRIES, :ENTRIES] = count * known + wide
    penalty[ENTRIES:, ENTRIES:] = np.diag(ridge * np.maximum(power, 1e-2 * power.max(initial=1.0)))
    pull[..., :ENTRIES] -= _own(body, joint)[vertices] @ wide
    matrix = gram.reshape(len(vertices), 3 * size, 3 * size) + np.kron(np.eye(3), penalty)
    solved = np.linalg.solve(matrix, pull.reshape(len(vertices), -1, 1)).reshape(-1, 3, size)
    directions = solved[..., ENTRIES:].reshape(len(vertices), 3, len(channels.bias), 1 + num_shapes)
    linear = stand_in(channels, np.array(rotations), prior)
    return Fold(channels, vertices, solved[..., :ENTRIES], directions, linear)


def stand_in(
    channels: Channels, rotations: Float[np.ndarray, "N 3"], prior: float
) -> Float[np.ndarray, "C 9"]:
    """The channels' best linear forms in vec(R - I) over some rotations (rad), damped as blend
    shapes are.
    """
    features = entries(rotations)
    gram = features.T @ features + prior * len(features) * rotation_gram(FEATURES)
    floor = 1e-9 * np.eye(ENTRIES) * max(float(gram.trace()), 1.0)
    return np.linalg.solve(gram + floor, features.T @ channels.weights(rotations)).T


def with_folds(body: BodyModel, folds: Sequence[Fold]) -> BodyModel:
    """The body with what was learned of some joints: ``posedirs`` hold the changes and the
    channels' linear stand-ins.
    """
    assert body.posedirs is not None
    posedirs = body.posedirs.copy()
    moved = []
    for fold in folds:
        first = ENTRIES * body.drivers.index(fold.channels.joint)
        stored = fold.change + fold.directions[..., 0] @ fold.linear
        posedirs[fold.vertices, :, first : first + ENTRIES] += stored
        table = np.zeros((body.num_vertices, *fold.directions.shape[1:]))
        table[fold.vertices] = fold.directions
        moved.append(table)
    hinges = Hinges(
        np.concatenate([np.repeat(f.channels.joint, len(f.channels.bias)) for f in folds]),
        np.concatenate([fold.channels.rows for fold in folds]),
        np.concatenate([fold.channels.bias for fold in folds]),
        np.concatenate([fold.linear for fold in folds]),
        np.concatenate(moved, axis=2),
    )
    return replace(body, posedirs=posedirs, hinges=hinges, finer=None)


def with_learned_hinges(
    body: BodyModel, problem: Problem, estimate: Estimate, options: TrainOptions
) -> BodyModel:
    """A trained body with channels of its knees and elbows, from the registrations that it was
    trained on.

    Raises HabitusError where the body has none of these joints, or no registration turns one.
    """
    settings = options.settings
    names = [name for name in settings.hinge_joints if name in body.joint_names]
    if not names:
        raise HabitusError(
            f"{body.name} has no joint called {', '.join(settings.hinge_joints)}; leave out hinges"
        )
    flat = body.shapedirs.reshape(-1, body.num_betas)
    away = (estimate.templates - body.v_template).reshape(len(estimate.templates), -1)
    people = np.linalg.lstsq(flat, away.T, rcond=None)[0].T
    folds = []
    for name in names:
        rotations = estimate.pose[:, body.joint_names.index(name)]
        channels = channels_of(body, name, hinge_axis(rotations), options.hinges)
        rows = np.flatnonzero(rotations.any(axis=1)).tolist()
        known = np.eye(ENTRIES) * options.weights.pose_shapes / max(len(rows), 1)
        samples = Samples(problem, estimate, people, rows)
        given = (min(settings.hinge_shapes, body.num_betas), known, options.rotation_prior)
        folds.append(solve_fold(body, channels, samples, *given, settings.hinge_ridge))
    return with_folds(body, folds)


@dataclass(frozen=True, eq=False)
class Samples:
    """Some registrations of a training as samples, read one by one; ``betas`` are of all people."""

    problem: Problem
    estimate: Estimate
    betas: Float[np.ndarray, "S B"]
    rows: Sequence[int]

    def __iter__(self):
        subjects = self.problem.registrations.subject_index
        targets = posed_targets(self.problem, self.estimate, self.rows)
        for row, (person, target) in zip(self.rows, targets, strict=True):
            weights = np.ones(len(target.vertices)) if target.weight is None else target.weight
            vertices = target.vertices - target.trans
            betas = self.betas[subjects[row]]
            yield Sample(vertices, weights, target.pose, person.template, person.joints, betas)


def _own(body: BodyModel, joint: int) -> Float[np.ndarray, "V 3 9"]:
    """A joint's blend shapes."""
    assert body.posedirs is not None
    first = ENTRIES * body.drivers.index(joint)
    return body.posedirs[..., first : first + ENTRIES]
