"""Training a body model: the recipe of S 4.3 (T 5.4.3).

Poses are initialised by edges (eq. 15). Rounds of block coordinate descent on eq. 14 follow:
subjects, skinning weights, pose blend shapes, poses; after each round its update is extrapolated
while the energy decreases. The joint regressor is fitted to the subjects, the shape space to the
multi-shape registrations brought to the rest pose.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.learn.assembly import assemble
from habitus.learn.callback import NoCallback, Record, TrainingCallback, TrainingState
from habitus.learn.energy import Energy, measure_energy
from habitus.learn.estimate import Estimate, Problem
from habitus.learn.options import TrainOptions
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.posing.surface import pose_normalized
from habitus.learn.shape.joint_regressor import fit_joint_regressor
from habitus.learn.shape.shape_space import (
    ShapeSpace,
    at_one_root,
    principal_shapes,
    shape_space_of,
    shapes_with_holes,
    with_shape_features,
)
from habitus.learn.start.first_estimate import (
    edge_pose,
    edge_poses,
    initial_estimate,
    known_poses,
    state_problem,
)
from habitus.learn.steps.alternation import STEPS, Step, over_relax
from habitus.learn.steps.hinges import with_learned_hinges
from habitus.learn.steps.pose_shapes import let_go
from habitus.learn.steps.poses import EdgeDistance, edge_distance
from habitus.mesh.laplacian import fill_holes
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import Threads, Workers, in_blocks

_BLOCK = 8
DEFAULTS = TrainOptions()
ALONE = Threads(1)
NO_CALLBACK = NoCallback()


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
    body: BodyModel | None = None,
    workers: Workers = ALONE,
    callback: TrainingCallback = NO_CALLBACK,
    resume: TrainingState | None = None,
    name: str = "trained",
) -> TrainedBody:
    """Learn a body model from registrations (m) in the template's topology.

    Registrations of the set "pose" give {J, W, P}, those of the set "shape" the shape space; where
    there are none of the latter, the subjects of the former serve. ``body`` is the model that the
    template is of, if it is of any: its pose prior and sex direction are carried over, and with
    ``options.start`` "body" training starts from its {J, W, P}. Raises HabitusError where there is
    nothing to learn from.
    """
    posed = registrations.where(set="pose")
    shaped = registrations.where(set="shape")
    if not len(posed):
        raise HabitusError(
            "no registration belongs to the set 'pose'; expected several poses each of several "
            "subjects"
        )
    problem = state_problem(posed, template, replace(options, shape_features=0), body)
    state = alternate(problem, template, workers, callback, resume, body)
    state = replace(state, estimate=with_holes_filled(problem, state.estimate, template))
    estimate = state.estimate
    regressor = learn_regressor(problem, template, estimate)
    if body is not None and "shapedirs" in options.fixed:
        shape = shape_space_of(body)
    elif len(shaped):
        surfaces = normalize_shapes(estimate, regressor, template, shaped, workers, callback)
        shape = shapes_of(surfaces, shaped, options)
    else:
        surfaces = at_one_root(
            estimate.templates, regressor, (regressor @ estimate.templates.mean(0))[0]
        )
        shape = principal_shapes(surfaces, options.num_betas)
    if options.shape_features:
        state = depend_on_shape(
            replace(problem, options=options), state, shape, regressor, workers, callback
        )
    state = _settled(replace(problem, options=options), state, workers, callback)
    trained = assemble(name, template, state.estimate.rig, regressor, shape, body)
    if options.hinges:
        trained = with_learned_hinges(trained, problem, state.estimate, options)
    return TrainedBody(trained, state.history, state.estimate, shape)


def alternate(
    problem: Problem,
    template: Template,
    workers: Workers,
    callback: TrainingCallback,
    resume: TrainingState | None = None,
    body: BodyModel | None = None,
) -> TrainingState:
    """Minimise eq. 14 by block coordinate descent until a round lowers it little (S 4.3)."""
    if resume is None:
        state = _begin(problem, template, workers, callback, body)
        callback.on_round_end(state)
    else:
        state = _judged(problem, resume)
        if state.finished:
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
    """Alternate on with blend shapes that depend on shape (T 5.6). A run that is stopped here
    begins this part anew.
    """
    estimate = with_shape_features(state.estimate, shape, regressor, problem.options.shape_features)
    longer = replace(
        problem, options=replace(problem.options, rounds=state.rounds + problem.options.rounds)
    )
    state = TrainingState(estimate, state.history, False)
    while not state.finished:
        state = _round(longer, state, workers, callback, keep=False)
    return state


def _settled(
    problem: Problem, state: TrainingState, workers: Workers, callback: TrainingCallback
) -> TrainingState:
    """Local pose blend shapes without the joints that matter little; what was learned before is in
    the checkpoint.
    """
    estimate = let_go(problem, state.estimate, workers)
    if estimate is state.estimate:
        return state
    record = Record(state.rounds, "letting go", measure_energy(problem, estimate, workers))
    callback.on_step_end(record)
    return replace(state, estimate=estimate, history=(*state.history, record))


def _begin(
    problem: Problem,
    template: Template,
    workers: Workers,
    callback: TrainingCallback,
    body: BodyModel | None,
) -> TrainingState:
    estimate = initial_estimate(problem, template, workers, body)
    known = known_poses(problem).all()
    record = Record(
        0,
        "poses as known" if known else "poses by edges",
        measure_energy(problem, estimate, workers),
    )
    callback.on_step_end(record)
    return TrainingState(estimate, (record,), False)


def _round(
    problem: Problem,
    state: TrainingState,
    workers: Workers,
    callback: TrainingCallback,
    keep: bool = True,
) -> TrainingState:
    """One round, or what is left of one; with ``keep`` the callback is given the state after each
    of its steps.
    """
    number = state.rounds + 1
    began = state.estimate if state.before is None else state.before

    def stepped(step: str, estimate: Estimate, energy: Energy) -> TrainingState:
        record = Record(number, step, energy)
        callback.on_step_end(record)
        return TrainingState(estimate, (*state.history, record), False, began)

    for step, improve in steps_of(problem, state.estimate.rig).items():
        if step not in state.steps_done:
            estimate = improve(problem, state.estimate, workers)
            state = stepped(step, estimate, measure_energy(problem, estimate, workers))
            if keep:
                callback.on_state(state)
    state = stepped(
        "further", *over_relax(problem, began, state.estimate, state.history[-1].energy, workers)
    )
    return _judged(problem, replace(state, before=None))


def steps_of(problem: Problem, rig: Rig) -> dict[str, Step]:
    """The steps of a round: those of `STEPS` whose unknowns there are, and are not held fixed."""
    held = problem.held | (set() if rig.posedirs is not None else {"posedirs"})
    return {name: step for name, step in STEPS.items() if step.moves[0] not in held}


def _judged(problem: Problem, state: TrainingState) -> TrainingState:
    """Whether the state is the last one, by the present options: ``rounds`` and ``tolerance`` may
    be others by now.
    """
    if state.before is not None or state.rounds == 0:
        return replace(state, finished=False)
    before, after = (
        [r for r in state.history if r.round == state.rounds - k][-1].energy.total for k in (1, 0)
    )
    brings_little = before - after < problem.options.tolerance * before
    return replace(state, finished=state.rounds >= problem.options.rounds or brings_little)


def learn_regressor(
    problem: Problem, template: Template, estimate: Estimate
) -> Float[np.ndarray, "J V"]:
    """Joints from surfaces, by least squares over the subjects (S 4.1); the one started from, where
    that is fixed.
    """
    if "joint_regressor" in problem.options.fixed:
        return problem.anatomy.regressor
    return fit_joint_regressor(
        estimate.templates,
        estimate.joints,
        signs=problem.options.regressor,
        candidates=near_joints(template, estimate.rig),
        mirror=template.mirror,
        joint_mirror=template.joint_mirror,
        settings=problem.options.settings,
    )


def with_holes_filled(problem: Problem, estimate: Estimate, template: Template) -> Estimate:
    """What a person's rest surface differs by from the template, carried on to where no
    registration shows it.
    """
    if not problem.weighted:
        return estimate
    seen = np.zeros(estimate.templates.shape[:2])
    for row, subject in enumerate(problem.registrations.subject_index):
        weight = problem.registrations.read_seen(row)[1]
        seen[subject] += 1.0 if weight is None else weight
    laplacian = edge_distance(template.faces, template.num_vertices).laplacian
    away = estimate.templates - template.vertices
    filled = [
        fill_holes(laplacian, weights >= problem.options.settings.min_observed_weight, values)
        for weights, values in zip(seen, away, strict=True)
    ]
    templates = template.vertices + np.stack(filled)
    held = "joint_regressor" in problem.options.fixed
    return replace(
        estimate,
        templates=templates,
        joints=problem.anatomy.regressor @ templates if held else estimate.joints,
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
    blocks = [
        range(done + b.start, done + b.stop) for b in in_blocks(len(registrations) - done, _BLOCK)
    ]
    for rows, normalised in zip(blocks, workers.map(_normalized, shared, blocks), strict=True):
        surfaces[rows.start : rows.stop] = normalised
        callback.on_surfaces_stored(rows.stop)
    return surfaces


def shapes_of(
    surfaces: np.ndarray, registrations: Registrations, options: TrainOptions
) -> ShapeSpace:
    """The shape space of pose-normalised registrations, with or without holes."""
    if not registrations.weighted:
        return principal_shapes(surfaces, options.num_betas)
    weights = (registrations.read_seen(k)[1] for k in range(len(registrations)))
    seen = np.stack(
        [np.full(surfaces.shape[1], True) if weight is None else weight > 0 for weight in weights]
    )
    steps = options.settings.imputation_steps
    return shapes_with_holes(surfaces, seen, options.num_betas, steps)[1]


def _normalized(
    shared: tuple[Rig, np.ndarray, RestPerson, np.ndarray, Registrations, EdgeDistance], rows: range
) -> np.ndarray:
    rig, regressor, general, part, registrations, distance = shared
    out = []
    for row in rows:
        target, weight = registrations.read_seen(row)
        pose = edge_pose(rig, general, part, target, weight, distance).pose
        seen = None if weight is None else weight > 0
        out.append(pose_normalized(rig, regressor, general, pose, target, seen, distance.laplacian))
    return np.stack(out)


def poses_of(
    trained: TrainedBody, template: Template, registrations: Registrations, workers: Workers = ALONE
) -> Float[np.ndarray, "N J 3"]:
    """Poses (rotation vectors, rad) of the registrations trained on: of the set "pose" as found,
    others by edges.
    """
    estimate = trained.estimate
    regressor = trained.body.joint_regressor
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
