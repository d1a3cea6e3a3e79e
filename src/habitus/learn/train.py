"""Training a body model: the recipe of S 4.3 (T 5.4.3).

Poses begin by edges (eq. 15); then rest surfaces and joints per subject, skinning weights, pose blend shapes, and poses
take turns at the energy of eq. 14, and what a round changed is gone further along while that pays. The joint regressor
comes from the subjects, the shape space from the multi-shape registrations brought to the rest pose.
"""

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Protocol

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.learn.energy import Energy, measure_energy
from habitus.learn.estimate import Estimate, Problem
from habitus.learn.options import TrainOptions
from habitus.learn.over_relaxation import go_further
from habitus.learn.posing.normalize import pose_normalized
from habitus.learn.posing.rig import Person, Rig
from habitus.learn.shape.joint_regressor import fit_joint_regressor
from habitus.learn.shape.shape_dependent import at_one_root, with_shape_features
from habitus.learn.shape.shape_space import ShapeSpace, principal_shapes
from habitus.learn.start.first_estimate import edge_pose, edge_poses, initial_estimate, state_problem
from habitus.learn.steps.alternation import STEPS
from habitus.learn.steps.poses import ByEdges, edge_metric
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import Threads, Workers, in_blocks

_BLOCK = 8


@dataclass(frozen=True)
class Record:
    """The energy after a step of a round; round 0 is the start."""

    round: int
    step: str
    energy: Energy


@dataclass(frozen=True, eq=False)
class Progress:
    """How far training has come, whole: what a checkpoint keeps. ``finished`` says that the alternation has ended."""

    estimate: Estimate
    history: tuple[Record, ...]
    finished: bool

    @property
    def rounds(self) -> int:
        """Whole rounds done."""
        return max((record.round for record in self.history), default=0)


class Watcher(Protocol):
    """Is told how training goes, and keeps what may be needed again."""

    def recorded(self, record: Record) -> None:
        """A step ended."""
        ...

    def reached(self, progress: Progress) -> None:
        """The start was found, or a round ended."""
        ...

    def room(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """Where pose-normalised surfaces (S,V,3) are kept, and how many of them are there already."""
        ...

    def normalized(self, count: int) -> None:
        """So many surfaces are in the room."""
        ...


@dataclass(frozen=True)
class Unwatched:
    """Nobody is told; surfaces are kept in memory."""

    def recorded(self, record: Record) -> None:
        """Nothing."""

    def reached(self, progress: Progress) -> None:
        """Nothing."""

    def room(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """An array of 32-bit numbers."""
        return np.empty(shape, np.float32), 0

    def normalized(self, count: int) -> None:
        """Nothing."""


DEFAULTS, ALONE, UNWATCHED = TrainOptions(), Threads(1), Unwatched()


@dataclass(frozen=True, eq=False)
class TrainedBody:
    """The model, how the energy fell, the estimate that it was made from, and the shape space."""

    body: BodyModel
    history: tuple[Record, ...]
    estimate: Estimate
    shape: ShapeSpace


def train_body(
    registrations: Registrations,
    template: Template,
    options: TrainOptions = DEFAULTS,
    *,
    workers: Workers = ALONE,
    watcher: Watcher = UNWATCHED,
    resume: Progress | None = None,
    name: str = "trained",
) -> TrainedBody:
    """Learn a body model from registrations (m) in the template's topology.

    Registrations of the set "pose" give {J, W, P}, those of the set "shape" the shape space; where there are none of
    the latter, the subjects of the former serve. Raises HabitusError where there is nothing to learn from.
    """
    posed, shaped = registrations.where(set="pose"), registrations.where(set="shape")
    if not len(posed):
        raise HabitusError("no registration belongs to the set 'pose'; expected several poses each of several subjects")
    problem = state_problem(posed, template, replace(options, shape_features=0))
    progress = alternate(problem, template, workers, watcher, resume)
    estimate = progress.estimate
    regressor = learn_regressor(problem, template, estimate)
    if len(shaped):
        surfaces = normalize_shapes(estimate, regressor, template, shaped, workers, watcher)
    else:
        surfaces = at_one_root(estimate.templates, regressor, (regressor @ estimate.templates.mean(0))[0])
    shape = principal_shapes(surfaces, options.num_betas)
    if options.shape_features:
        progress = depend_on_shape(replace(problem, options=options), progress, shape, regressor, workers, watcher)
    body = assemble(name, template, progress.estimate.rig, regressor, shape)
    return TrainedBody(body, progress.history, progress.estimate, shape)


def alternate(
    problem: Problem, template: Template, workers: Workers, watcher: Watcher, resume: Progress | None = None
) -> Progress:
    """Minimise eq. 14 block by block until a round brings little (S 4.3)."""
    progress = resume
    if progress is None:
        progress = _begin(problem, template, workers, watcher)
        watcher.reached(progress)
    while not progress.finished:
        progress = _round(problem, progress, workers, watcher)
        watcher.reached(progress)
    return progress


def depend_on_shape(
    problem: Problem,
    progress: Progress,
    shape: ShapeSpace,
    regressor: Float[np.ndarray, "J V"],
    workers: Workers,
    watcher: Watcher,
) -> Progress:
    """Alternate on with blend shapes that depend on shape (T 5.6). A run that is stopped here begins this part anew."""
    estimate = with_shape_features(progress.estimate, shape, regressor, problem.options.shape_features)
    longer = replace(problem, options=replace(problem.options, rounds=progress.rounds + problem.options.rounds))
    progress = Progress(estimate, progress.history, False)
    while not progress.finished:
        progress = _round(longer, progress, workers, watcher)
    return progress


def _begin(problem: Problem, template: Template, workers: Workers, watcher: Watcher) -> Progress:
    estimate = initial_estimate(problem, template, workers)
    record = Record(0, "poses by edges", measure_energy(problem, estimate, workers))
    watcher.recorded(record)
    return Progress(estimate, (record,), False)


def _round(problem: Problem, progress: Progress, workers: Workers, watcher: Watcher) -> Progress:
    estimate, history, number = progress.estimate, progress.history, progress.rounds + 1
    before = history[-1].energy.total

    def reached(step: str, energy: Energy) -> None:
        nonlocal history
        history = (*history, Record(number, step, energy))
        watcher.recorded(history[-1])

    for step, improve in STEPS.items():
        if step != "pose shapes" or estimate.rig.posedirs is not None:
            estimate = improve(problem, estimate, workers)
            reached(step, measure_energy(problem, estimate, workers))
    estimate, energy = go_further(problem, progress.estimate, estimate, history[-1].energy, workers)
    reached("further", energy)
    fall = before - energy.total
    finished = number >= problem.options.rounds or fall < problem.options.tolerance * before
    return Progress(estimate, history, finished)


def learn_regressor(problem: Problem, template: Template, estimate: Estimate) -> Float[np.ndarray, "J V"]:
    """Joints from surfaces, by non-negative least squares over the subjects (S 4.1)."""
    return fit_joint_regressor(
        estimate.templates,
        estimate.joints,
        candidates=near_joints(template, estimate.rig),
        mirror=template.mirror,
        joint_mirror=template.joint_mirror,
    )


def near_joints(template: Template, rig: Rig) -> np.ndarray:
    """The vertices that a joint may be regressed from: those that it or its parent moves (J,V)."""
    moved = rig.weights.T > 0
    return np.stack([moved[j] | moved[max(parent, 0)] for j, parent in enumerate(template.parents)])


def normalize_shapes(
    estimate: Estimate,
    regressor: Float[np.ndarray, "J V"],
    template: Template,
    registrations: Registrations,
    workers: Workers,
    watcher: Watcher,
) -> np.ndarray:
    """The multi-shape registrations in the rest pose (S 4.2)."""
    surface = estimate.templates.mean(0)
    general = Person(surface, regressor @ surface, estimate.descriptors.mean(0))
    room, done = watcher.room((len(registrations), *surface.shape))
    metric = edge_metric(registrations.faces, registrations.num_vertices)
    shared = (estimate.rig, regressor, general, template.part, registrations, metric)
    blocks = [range(done + b.start, done + b.stop) for b in in_blocks(len(registrations) - done, _BLOCK)]
    for rows, found in zip(blocks, workers.map(_normalized, shared, blocks), strict=True):
        room[rows.start : rows.stop] = found
        watcher.normalized(rows.stop)
    return room


def _normalized(shared: tuple[Rig, np.ndarray, Person, np.ndarray, Registrations, ByEdges], rows: range) -> np.ndarray:
    rig, regressor, general, part, registrations, metric = shared
    out = []
    for row in rows:
        target = registrations.read(row)
        pose = edge_pose(rig, general, part, target, metric).pose
        out.append(pose_normalized(rig, regressor, general, pose, target))
    return np.stack(out)


def poses_of(
    trained: TrainedBody, template: Template, registrations: Registrations, workers: Workers = ALONE
) -> Float[np.ndarray, "N J 3"]:
    """Poses (rotation vectors, rad) of the registrations trained on: of the set "pose" as found, others by edges."""
    estimate, regressor = trained.estimate, trained.body.joint_regressor
    posed = np.array(registrations.set) == "pose"
    poses = np.zeros((len(registrations), template.num_joints, 3))
    poses[posed] = estimate.pose
    if not posed.all():
        surface = estimate.templates.mean(0)
        general = Person(surface, regressor @ surface, estimate.descriptors.mean(0))
        others = registrations.take(np.flatnonzero(~posed))
        fits = edge_poses(estimate.rig, general, template.part, others, workers)
        poses[~posed] = [fit.pose for fit in fits]
    return poses


def assemble(
    name: str, template: Template, rig: Rig, regressor: Float[np.ndarray, "J V"], shape: ShapeSpace
) -> BodyModel:
    """The trained arrays as a body model."""
    return BodyModel(
        name=name,
        v_template=np.array(shape.mean, np.float64),
        shapedirs=np.array(shape.directions, np.float64),
        posedirs=None if rig.posedirs is None else rig.posedirs.copy(),
        joint_regressor=np.array(regressor),
        skinning_index=rig.index.copy(),
        skinning_value=rig.value.copy(),
        parents=template.parents,
        faces=np.array(template.faces, np.int64),
        joint_names=template.joint_names,
        skinning=rig.skinning,
        landmarks=MappingProxyType({}),
        part=np.array(template.part, np.int64),
        mirror=None if template.mirror is None else np.array(template.mirror, np.int64),
        pose_features=rig.pose_features,
        shape_features=rig.shape_features,
    )
