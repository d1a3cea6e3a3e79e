"""Training a body model: the recipe of S 4.3 (T 5.4.3).

Poses are initialised by edges (eq. 15). Rounds of block coordinate descent on eq. 14 follow: subjects, skinning
weights, pose blend shapes, poses; after each round its update is extrapolated while the energy decreases. The joint
regressor is fitted to the subjects, the shape space to the multi-shape registrations brought to the rest pose.
"""

from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.learn.callback import NoCallback, Record, TrainingCallback, TrainingState
from habitus.learn.energy import Energy, measure_energy
from habitus.learn.estimate import Estimate, Problem
from habitus.learn.options import TrainOptions
from habitus.learn.over_relaxation import over_relax
from habitus.learn.posing.normalize import pose_normalized
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.shape.joint_regressor import fit_joint_regressor
from habitus.learn.shape.shape_dependent import at_one_root, with_shape_features
from habitus.learn.shape.shape_space import ShapeSpace, principal_shapes
from habitus.learn.start.first_estimate import edge_pose, edge_poses, initial_estimate, state_problem
from habitus.learn.steps.alternation import STEPS
from habitus.learn.steps.poses import EdgeDistance, edge_distance
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import Threads, Workers, in_blocks

_BLOCK = 8
DEFAULTS, ALONE, NO_CALLBACK = TrainOptions(), Threads(1), NoCallback()


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
    callback: TrainingCallback = NO_CALLBACK,
    resume: TrainingState | None = None,
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
    state = alternate(problem, template, workers, callback, resume)
    estimate = state.estimate
    regressor = learn_regressor(problem, template, estimate)
    if len(shaped):
        surfaces = normalize_shapes(estimate, regressor, template, shaped, workers, callback)
    else:
        surfaces = at_one_root(estimate.templates, regressor, (regressor @ estimate.templates.mean(0))[0])
    shape = principal_shapes(surfaces, options.num_betas)
    if options.shape_features:
        state = depend_on_shape(replace(problem, options=options), state, shape, regressor, workers, callback)
    body = assemble(name, template, state.estimate.rig, regressor, shape)
    return TrainedBody(body, state.history, state.estimate, shape)


def alternate(
    problem: Problem,
    template: Template,
    workers: Workers,
    callback: TrainingCallback,
    resume: TrainingState | None = None,
) -> TrainingState:
    """Minimise eq. 14 by block coordinate descent until a round lowers it little (S 4.3)."""
    state = resume
    if state is None:
        state = _begin(problem, template, workers, callback)
        callback.on_round_end(state)
    while not state.finished:
        state = _round(problem, state, workers, callback)
        callback.on_round_end(state)
    return state


def depend_on_shape(
    problem: Problem,
    state: TrainingState,
    shape: ShapeSpace,
    regressor: Float[np.ndarray, "J V"],
    workers: Workers,
    callback: TrainingCallback,
) -> TrainingState:
    """Alternate on with blend shapes that depend on shape (T 5.6). A run that is stopped here begins this part anew."""
    estimate = with_shape_features(state.estimate, shape, regressor, problem.options.shape_features)
    longer = replace(problem, options=replace(problem.options, rounds=state.rounds + problem.options.rounds))
    state = TrainingState(estimate, state.history, False)
    while not state.finished:
        state = _round(longer, state, workers, callback)
    return state


def _begin(problem: Problem, template: Template, workers: Workers, callback: TrainingCallback) -> TrainingState:
    estimate = initial_estimate(problem, template, workers)
    record = Record(0, "poses by edges", measure_energy(problem, estimate, workers))
    callback.on_step_end(record)
    return TrainingState(estimate, (record,), False)


def _round(problem: Problem, state: TrainingState, workers: Workers, callback: TrainingCallback) -> TrainingState:
    estimate, history, number = state.estimate, state.history, state.rounds + 1
    before = history[-1].energy.total

    def end_step(step: str, energy: Energy) -> None:
        nonlocal history
        history = (*history, Record(number, step, energy))
        callback.on_step_end(history[-1])

    for step, improve in STEPS.items():
        if step != "pose shapes" or estimate.rig.posedirs is not None:
            estimate = improve(problem, estimate, workers)
            end_step(step, measure_energy(problem, estimate, workers))
    estimate, energy = over_relax(problem, state.estimate, estimate, history[-1].energy, workers)
    end_step("further", energy)
    decrease = before - energy.total
    finished = number >= problem.options.rounds or decrease < problem.options.tolerance * before
    return TrainingState(estimate, history, finished)


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
    callback: TrainingCallback,
) -> np.ndarray:
    """The multi-shape registrations in the rest pose (S 4.2)."""
    surface = estimate.templates.mean(0)
    general = RestPerson(surface, regressor @ surface, estimate.descriptors.mean(0))
    surfaces, done = callback.surface_store((len(registrations), *surface.shape))
    distance = edge_distance(registrations.faces, registrations.num_vertices)
    shared = (estimate.rig, regressor, general, template.part, registrations, distance)
    blocks = [range(done + b.start, done + b.stop) for b in in_blocks(len(registrations) - done, _BLOCK)]
    for rows, found in zip(blocks, workers.map(_normalized, shared, blocks), strict=True):
        surfaces[rows.start : rows.stop] = found
        callback.on_surfaces_stored(rows.stop)
    return surfaces


def _normalized(
    shared: tuple[Rig, np.ndarray, RestPerson, np.ndarray, Registrations, EdgeDistance], rows: range
) -> np.ndarray:
    rig, regressor, general, part, registrations, distance = shared
    out = []
    for row in rows:
        target = registrations.read(row)
        pose = edge_pose(rig, general, part, target, distance).pose
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
        general = RestPerson(surface, regressor @ surface, estimate.descriptors.mean(0))
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
