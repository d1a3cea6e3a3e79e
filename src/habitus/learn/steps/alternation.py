"""The blocks of eq. 14, each solved with the others held: poses, subjects, skinning weights, pose
blend shapes (S 4.3).

Every step takes an estimate to a better one; none of them can raise the energy.

Over-relaxation (`over_relax`) extrapolates the update of a whole round while the energy
decreases: block coordinate descent converges slowly where blocks are coupled (pose blend shapes can
compensate for joints, weights and poses that are slightly wrong), and the update of a round has a
good direction but is too short.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np

from habitus.learn.energy import Energy, measure_energy
from habitus.learn.estimate import Estimate, PosedTarget, Problem, posed_targets
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.steps.pose_shapes import solve_pose_shapes
from habitus.learn.steps.poses import PoseFit, VertexDistance, fit_pose
from habitus.learn.steps.skeletons import (
    Sample,
    SampledSubject,
    SampledTarget,
    refine,
    remove_mean_rotation,
    sample_parts,
    subset_rig,
)
from habitus.learn.steps.subjects import solve_subject, subject_energy
from habitus.learn.steps.weights import (
    LINEAR,
    Quadratics,
    gather_quadratics,
    midpoint_rig,
    minimize_quadratics,
    select_rigs,
    vertex_costs,
)
from habitus.parallel.workers import Workers, in_blocks


@dataclass(frozen=True)
class Step:
    """One block of the alternation: the unknowns that it moves, and the terms of eq. 14 that depend
    on them.

    The first of ``moves`` is what the step is for; the others move with it where they are free.
    ``solve`` minimises these terms, or lowers them, with all other unknowns fixed. Names are those
    of `energy_terms`.
    """

    moves: tuple[str, ...]
    terms: tuple[str, ...]
    solve: Callable[[Problem, Estimate, Workers], Estimate]

    def __call__(self, problem: Problem, estimate: Estimate, workers: Workers) -> Estimate:
        """The better estimate."""
        return self.solve(problem, estimate, workers)


_BLOCK = 32


def pose_step(problem: Problem, estimate: Estimate, workers: Workers) -> Estimate:
    """Pose and translation of every registration (E_D)."""
    blocks = in_blocks(len(problem.registrations), 8)
    fits = [fit for block in workers.map(_poses, (problem, estimate), blocks) for fit in block]
    return replace(
        estimate, pose=np.stack([f.pose for f in fits]), trans=np.stack([f.trans for f in fits])
    )


def subject_step(problem: Problem, estimate: Estimate, workers: Workers) -> Estimate:
    """Rest surface, joints, poses and translations of each subject (E_D + E_Y + E_J)."""
    sample = sample_parts(problem.initial_weights, problem.anatomy.mirror)
    shared = (problem, estimate, sample, subset_rig(estimate.rig, sample.vertices))
    solutions = list(workers.map(_subject, shared, range(problem.subjects)))
    pose = estimate.pose.copy()
    trans = estimate.trans.copy()
    for subject, (_, _, its_pose, its_trans) in enumerate(solutions):
        rows = problem.rows_of(subject)
        pose[rows], trans[rows] = its_pose, its_trans
    templates = np.stack([t for t, *_ in solutions])
    joints = np.stack([j for _, j, *_ in solutions])
    return replace(estimate, templates=templates, joints=joints, pose=pose, trans=trans)


def weight_step(problem: Problem, estimate: Estimate, workers: Workers) -> Estimate:
    """Skinning weights of every vertex (E_D + E_W)."""
    blocks = in_blocks(len(problem.registrations), _BLOCK)
    quadratics = reduce(add, workers.map(_quadratics, (problem, estimate), blocks))
    best = _minimum(problem, estimate.rig, quadratics)
    if problem.options.skinning in LINEAR:  # this is the minimum
        return replace(estimate, rig=best)
    near = _minimum(problem, estimate.rig, quadratics, allowed=estimate.rig.weights)
    rigs = [estimate.rig, best, near, midpoint_rig(estimate.rig, near)]
    return replace(estimate, rig=_lowest(problem, estimate, rigs, workers))


def _minimum(
    problem: Problem, rig: Rig, quadratics: Quadratics, allowed: np.ndarray | None = None
) -> Rig:
    """The rig with the weights that minimise the quadratics and E_W."""
    options = problem.options
    index, value = minimize_quadratics(
        quadratics,
        problem.candidates,
        problem.initial_weights,
        options.weights.skinning,
        options.influences,
        allowed,
    )
    return replace(rig, index=index, value=value)


def _lowest(problem: Problem, estimate: Estimate, rigs: list[Rig], workers: Workers) -> Rig:
    """Each vertex' weights from the rig in which its energy is lowest."""
    blocks = in_blocks(len(problem.registrations), _BLOCK)
    energies = sum(workers.map(_vertex_energies, (problem, estimate, rigs), blocks))
    away = np.stack([((rig.weights - problem.initial_weights) ** 2).sum(1) for rig in rigs])
    return select_rigs(rigs, (energies + problem.options.weights.skinning * away).argmin(0))


def pose_shape_step(problem: Problem, estimate: Estimate, workers: Workers) -> Estimate:
    """Pose blend shapes, where there are any (E_D + E_P)."""
    if estimate.rig.posedirs is None:
        return estimate
    return replace(
        estimate, rig=replace(estimate.rig, posedirs=solve_pose_shapes(problem, estimate, workers))
    )


STEPS: Mapping[str, Step] = {
    "subjects": Step(
        ("templates", "joints", "pose", "trans"), ("data", "symmetry", "joints"), subject_step
    ),
    "weights": Step(("skinning_weights",), ("data", "skinning"), weight_step),
    "pose shapes": Step(("posedirs",), ("data", "pose_shapes"), pose_shape_step),
    "poses": Step(("pose", "trans"), ("data",), pose_step),
}
"""In their order within a round; the initial poses by edges (eq. 15) precede the first round."""


def _poses(shared: tuple[Problem, Estimate], rows: range) -> list[PoseFit]:
    problem, estimate = shared
    return [
        fit_pose(
            estimate.rig,
            person,
            target.vertices,
            target.pose,
            distance=VertexDistance(target.weight),
            max_iterations=problem.options.settings.pose_iterations,
        )
        for person, target in posed_targets(problem, estimate, rows)
    ]


_SubjectStep = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _subject(shared: tuple[Problem, Estimate, Sample, Rig], subject: int) -> _SubjectStep:
    """Rest surface, joints, poses, translations: with refined poses if that lowers the energy."""
    problem, estimate, sample, _ = shared
    rows = problem.rows_of(subject)
    person = estimate.person(subject)
    surfaces, weights = zip(*(problem.registrations.read_seen(row) for row in rows), strict=True)
    tries = [(estimate.pose[rows], estimate.trans[rows])]
    poses = []
    if "pose" not in problem.held:
        targets = [
            SampledTarget(
                surface[sample.vertices], None if weight is None else weight[sample.vertices]
            )
            for surface, weight in zip(surfaces, weights, strict=True)
        ]
        tries.insert(0, _refined(shared, person, tries[0], targets))
    for pose, trans in tries:
        posed = [PosedTarget(*each) for each in zip(surfaces, pose, trans, weights, strict=True)]
        terms = posed, problem.anatomy, problem.options.weights
        held = "joint_regressor" in problem.options.fixed
        rest = solve_subject(
            estimate.rig,
            person.descriptor,
            *terms,
            held=held,
            around=person.template,
            hold_below=problem.options.settings.min_observed_weight,
        )
        person_energy = subject_energy(estimate.rig, RestPerson(*rest, person.descriptor), *terms)
        poses.append((person_energy, (*rest, pose, trans)))
    return min(poses, key=lambda pair: pair[0])[1]


def _refined(
    shared: tuple[Problem, Estimate, Sample, Rig],
    person: RestPerson,
    given: tuple[np.ndarray, np.ndarray],
    targets: list[SampledTarget],
) -> tuple[np.ndarray, np.ndarray]:
    """Better poses and translations of a subject's registrations, found on a sample of the
    vertices.
    """
    problem, estimate, sample, few = shared
    ring = problem.anatomy.regressor @ person.template
    few_rest = RestPerson(person.template[sample.vertices], person.joints, person.descriptor)
    better = refine(problem, few, sample, SampledSubject(few_rest, *given), targets, ring)
    return remove_mean_rotation(estimate.rig.parents, given[0], better.pose), better.trans


def _quadratics(shared: tuple[Problem, Estimate], rows: range) -> Quadratics:
    problem, estimate = shared
    return gather_quadratics(
        estimate.rig, problem.candidates, posed_targets(problem, estimate, rows)
    )


def _vertex_energies(shared: tuple[Problem, Estimate, list], rows: range) -> np.ndarray:
    problem, estimate, rigs = shared
    return vertex_costs(rigs, posed_targets(problem, estimate, rows))


_BOUND_IN_RANK = (
    "low_rank",
)  # pose blend shapes that would leave what they are bound to along a line


def over_relax(
    problem: Problem, before: Estimate, after: Estimate, energy: Energy, workers: Workers
) -> tuple[Estimate, Energy]:
    """The estimate of lowest energy on the line from ``before`` through ``after`` and beyond, and
    its energy.
    """
    best = after
    for factor in problem.options.settings.relaxation_factors:
        trial = _beyond(problem, before, after, factor)
        trial_energy = measure_energy(problem, trial, workers)
        if trial_energy.total >= energy.total:
            break
        best = trial
        energy = trial_energy
    return best, energy


def _beyond(problem: Problem, before: Estimate, after: Estimate, factor: float) -> Estimate:
    def moved(name: str) -> np.ndarray:
        first = getattr(before, name)
        last = getattr(after, name)
        return last + factor * (last - first)

    free = problem.options.pose_shapes not in _BOUND_IN_RANK
    moves = "skinning_weights" not in problem.options.fixed
    return replace(
        after,
        rig=_rig_beyond(before.rig, after.rig, factor, free, moves),
        **{name: moved(name) for name in ("templates", "joints", "pose", "trans")},
    )


def _rig_beyond(before: Rig, after: Rig, factor: float, free: bool, moves: bool) -> Rig:
    """Weights that move are extrapolated on their joints and kept convex; pose blend shapes where
    they are ``free``.
    """
    value = after.value
    if moves:
        first = np.take_along_axis(before.weights, after.index, 1)
        value = np.maximum(after.value + factor * (after.value - first), 0.0) * (after.value > 0)
        value = value / value.sum(1, keepdims=True)
    posedirs = after.posedirs
    if free and posedirs is not None and before.posedirs is not None:
        posedirs = posedirs + factor * (posedirs - before.posedirs)
    return replace(after, value=value, posedirs=posedirs)
