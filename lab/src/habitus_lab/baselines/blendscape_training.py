"""Training of BlendSCAPE: each person's triangle deformations and one regression from pose, in
turns (S 5.1).

As published, the model is fitted to triangles, not to vertices: with the pose known, a
registration's triangles are turned back into the rest pose, and ``S_t Q_t(pose)`` shall give their
edges. Given Q, each S_t is a least-squares problem of three by three; given S, Q is a ridge
regression. Edges (with the normal, see `triangle_frames`) are compared in metres, so that slivers
do not outweigh the rest.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError
from habitus.learn.shape.shape_space import principal_shapes
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import Threads, Workers, in_blocks
from habitus_lab.baselines.blendscape import BlendScape, mixed, part_rotations
from habitus_lab.baselines.triangle_frames import triangle_frames

_ALONE = Threads(1)
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Strengths that are tried, relative to the mean square of a feature over the training poses."""
_CHUNK = 16  # registrations whose regressions are summed at once
_HOLD_OUT = 5  # one registration in so many chooses the regression's ridge and joints
_TRIANGLES = 2048  # solved for at once
_LITTLE = 0.02  # skinning weight below which a joint does not count as a triangle's

_Part = tuple[tuple[np.ndarray, ...], np.ndarray]
"""Indices into a table (P, C), and the values there."""


def train_blendscape(
    registrations: Registrations,
    template: Template,
    poses: Float[np.ndarray, "N J 3"],
    weights: Float[np.ndarray, "V J"],
    *,
    num_betas: int = 100,
    sweeps: int = 4,
    through_stitching: int = 0,
    name: str = "BlendSCAPE",
    workers: Workers = _ALONE,
) -> BlendScape:
    """BlendSCAPE from the registrations of the sets "pose" and "shape", given their poses (rotation
    vectors, rad).

    Deformations and regression come from the set "pose"; the principal components of people's
    deformations from the set "shape", or where that is empty from the people of "pose". Which
    joints' rotations a triangle listens to (those that it is skinned to and their neighbours, or
    all) and the ridge are chosen by the error on every fifth registration.

    ``sweeps`` are as published. ``through_stitching`` more of them go beyond: S 7 supposes that
    SCAPE could be trained for the error of what is stitched, at a cost. Stitching projects edges on
    those that fit together, so that adding the part that it takes away to the wanted edges makes
    the stitched error fall from sweep to sweep.

    Memory: four tables of 9 (J - 1) by 9 F numbers and 36 F bytes a person. Raises HabitusError
    where shapes do not fit together or shapes are to be learned from fewer than two people.
    """
    _check(registrations, template, poses, weights)
    model = _untrained(template, weights, name)
    posed, shaped = (_unposed(model, registrations, poses, key) for key in ("pose", "shape"))
    persons = _persons(posed, workers)
    for sweep in range(sweeps + through_stitching if len(posed) else 0):
        posed = replace(posed, persons=persons if sweep >= sweeps else None)
        model = replace(model, pose_regression=_regression(posed, persons, workers))
        posed = replace(posed, model=model)
        persons = _persons(posed, workers)
    if len(shaped):
        persons = _persons(replace(shaped, model=model), workers)
        for _ in range(through_stitching):
            persons = _persons(replace(shaped, model=model, persons=persons), workers)
    if len(persons) < 2:
        raise HabitusError(
            f"there are {len(persons)} people to learn shapes from; expected at least two"
        )
    space = principal_shapes(persons.reshape(len(persons), -1, 3), min(num_betas, len(persons) - 1))
    directions = np.ascontiguousarray(np.moveaxis(space.directions, -1, 0))
    return replace(
        model,
        mean_shape=space.mean.reshape(-1, 3, 3),
        shape_directions=directions.reshape(-1, *model.mean_shape.shape),
        shape_variances=space.variances,
    )


@dataclass(frozen=True, eq=False)
class _Unposed:
    """Registrations with their rotations taken off: triangles' frames as S and Q alone should make
    them.

    With ``persons`` (S, F, 3, 3), what stitching takes away from the frames of ``model`` is added
    to those wanted.
    """

    model: BlendScape
    registrations: Registrations
    poses: Float[np.ndarray, "N J 3"]
    persons: Float[np.ndarray, "S F 3 3"] | None = None

    def __len__(self) -> int:
        return len(self.registrations)

    def frames(self, k: int) -> tuple[Float[np.ndarray, "J 3 3"], Float[np.ndarray, "F 3 3"]]:
        """The joints' rotations of registration k, and the frames (m) that B_t shall take to those
        wanted.
        """
        model = self.model
        turns, world = part_rotations(self.poses[k], model.parents)
        blended = mixed(model.triangle_weights, world)
        wanted = triangle_frames(self.registrations.read(k), model.faces)
        if self.persons is not None:
            made = (
                blended
                @ self.persons[self.registrations.subject_index[k]]
                @ model.pose_deformations(turns)
            )
            stitched = triangle_frames(model.stitched.vertices(made), model.faces)
            wanted += made @ triangle_frames(model.template, model.faces) - stitched
        return turns, np.linalg.solve(blended, wanted)


def _untrained(template: Template, weights: Float[np.ndarray, "V J"], name: str) -> BlendScape:
    """Blended rotations only."""
    faces = np.asarray(template.faces)
    count = 9 * (template.num_joints - 1)
    return BlendScape(
        name=name,
        template=np.asarray(template.vertices, float),
        faces=faces,
        parents=template.parents,
        influence=np.asarray(weights, float),
        mean_shape=np.tile(np.eye(3), (len(faces), 1, 1)),
        shape_directions=np.zeros((0, len(faces), 3, 3)),
        pose_regression=np.zeros((count, len(faces), 3, 3)),
    )


def _unposed(
    model: BlendScape, registrations: Registrations, poses: np.ndarray, key: str
) -> _Unposed:
    rows = np.flatnonzero(np.array(registrations.set) == key)
    return _Unposed(model, registrations.take(rows), poses[rows])


def _persons(posed: _Unposed, workers: Workers) -> Float[np.ndarray, "S F 3 3"]:
    """S_t of each subject, all its registrations together; in float32, for there may be
    thousands.
    """
    people = len(posed.registrations.subjects)
    found = np.empty((people, *posed.model.mean_shape.shape), np.float32)
    for s, person in enumerate(workers.map(_person, posed, range(people))):
        found[s] = person
    return found


def _person(posed: _Unposed, subject: int) -> Float[np.ndarray, "F 3 3"]:
    """argmin |frames - S Q frames of the template|^2 over a subject's registrations: one 3 x 3
    system a triangle.
    """
    rest = triangle_frames(posed.model.template, posed.model.faces)
    both = np.zeros_like(rest)
    square = np.zeros_like(rest)
    for k in np.flatnonzero(posed.registrations.subject_index == subject).tolist():
        turns, frames = posed.frames(k)
        made = posed.model.pose_deformations(turns) @ rest
        both += frames @ made.mT
        square += made @ made.mT
    return np.linalg.solve(square, both.mT).mT.astype(np.float32)


def _regression(
    posed: _Unposed, persons: Float[np.ndarray, "S F 3 3"], workers: Workers
) -> Float[np.ndarray, "P F 3 3"]:
    """Q's regression given S: ridge and joints by the error on held-out registrations, then from
    all of them.
    """
    rows = np.arange(len(posed))
    held = rows % _HOLD_OUT == _HOLD_OUT - 1
    training, testing = (_sums(posed, persons, rows[use], workers) for use in (~held, held))
    near = _near_joints(posed.model)
    choices = [(joints, ridge) for joints in (near, np.ones_like(near)) for ridge in RIDGES]
    errors = [testing.error(training.parts(*choice)) for choice in choices]
    best = choices[int(np.argmin(errors))]
    rest = triangle_frames(posed.model.template, posed.model.faces)
    frames = np.zeros_like(training.cross)
    for where, found in (training + testing).parts(*best):
        frames[where] = found
    return frames.reshape(-1, *rest.shape) @ np.linalg.inv(rest)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sufficient statistics of the regression of triangles' frames on pose features."""

    gram: Float[np.ndarray, "P P"]
    cross: Float[np.ndarray, "P C"]

    def __add__(self, other: "_Sums") -> "_Sums":
        return _Sums(self.gram + other.gram, self.cross + other.cross)

    def parts(self, joints: Bool[np.ndarray, "F J"], ridge: float) -> Iterator[_Part]:
        """Coefficients of triangles that hear the same ``joints``, some at a time."""
        damping = max(ridge * np.trace(self.gram) / len(self.gram), 1e-12)
        patterns, which = np.unique(joints[:, 1:], axis=0, return_inverse=True)
        for k, pattern in enumerate(patterns):
            features = np.flatnonzero(pattern.repeat(9))
            triangles = np.flatnonzero(which.ravel() == k)
            if len(features) == 0:
                continue
            matrix = self.gram[np.ix_(features, features)] + damping * np.eye(len(features))
            factor = scipy.linalg.cho_factor(matrix)
            for first in range(0, len(triangles), _TRIANGLES):
                where = np.ix_(
                    features,
                    (9 * triangles[first : first + _TRIANGLES, None] + np.arange(9)).ravel(),
                )
                yield where, scipy.linalg.cho_solve(factor, self.cross[where])

    def error(self, parts: Iterable[_Part]) -> float:
        """The sum of squares that these coefficients leave, up to a constant of the data (m^2)."""
        left = 0.0
        for where, found in parts:
            gram = self.gram[np.ix_(where[0].ravel(), where[0].ravel())]
            left += float(np.vdot(found, gram @ found) - 2.0 * np.vdot(found, self.cross[where]))
        return left


def _sums(
    posed: _Unposed,
    persons: Float[np.ndarray, "S F 3 3"],
    rows: Int[np.ndarray, " n"],
    workers: Workers,
) -> _Sums:
    """Sums over registrations, some at a time, of pose features and what Q adds to the template's
    frames.
    """
    count = len(posed.model.pose_regression)
    size = persons[0].size
    gram = np.zeros((count, count))
    cross = np.zeros((count, size))
    for block in in_blocks(len(rows), _CHUNK):
        some = rows[block.start : block.stop].tolist()
        pairs = list(workers.map(_feature_and_change, (posed, persons), some))
        features, changes = (np.array([pair[k] for pair in pairs]) for k in range(2))
        gram += features.T @ features
        cross += features.T @ changes
    return _Sums(gram, cross)


def _feature_and_change(
    shared: tuple[_Unposed, Float[np.ndarray, "S F 3 3"]], k: int
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " C"]]:
    """vec(R - I), and S^-1 frames - frames of the template."""
    posed, persons = shared
    turns, frames = posed.frames(k)
    person = persons[posed.registrations.subject_index[k]].astype(float)
    change = np.linalg.solve(person, frames) - triangle_frames(
        posed.model.template, posed.model.faces
    )
    return (turns[1:] - np.eye(3)).ravel(), change.ravel()


def _near_joints(model: BlendScape) -> Bool[np.ndarray, "F J"]:
    """The joints that a triangle is skinned to, their parents and their children."""
    joints = model.triangle_weights > _LITTLE
    near = joints.copy()
    for j, parent in enumerate(model.parents[1:], 1):
        near[:, parent] |= joints[:, j]
        near[:, j] |= joints[:, parent]
    return near


def _check(
    registrations: Registrations, template: Template, poses: np.ndarray, weights: np.ndarray
) -> None:
    joints = template.num_joints
    vertices = template.num_vertices
    if registrations.num_vertices != vertices or not np.array_equal(
        registrations.faces, template.faces
    ):
        raise HabitusError(
            "the registrations have other triangles than the template; expected the same topology"
        )
    if poses.shape != (len(registrations), joints, 3):
        raise HabitusError(
            f"poses have shape {poses.shape}; expected a pose for each registration, "
            f"{(len(registrations), joints, 3)}"
        )
    if weights.shape != (vertices, joints):
        raise HabitusError(
            f"skinning weights have shape {weights.shape}; expected {(vertices, joints)}"
        )
