"""Over-relaxation: extrapolate the last round's update while the energy decreases.

Block coordinate descent converges slowly where blocks are coupled: pose blend shapes can compensate
for joints, weights and poses that are slightly off. The update of a round then points in a good
direction but is too short.
"""

from dataclasses import replace

import numpy as np

from habitus.learn.energy import Energy, measure_energy
from habitus.learn.estimate import Estimate, Problem
from habitus.learn.posing.rig import Rig
from habitus.parallel.workers import Workers

_FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0)  # times the change
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
    for factor in _FACTORS:
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
