"""Over-relaxation: what a round of the alternation changed, gone further along while the energy falls.

Blocks that take turns crawl where they are coupled: pose blend shapes can stand in for joints, weights and poses that
are a little off, and each holds the others. What a round changes then points the way, and is too short.
"""

from dataclasses import replace

import numpy as np

from habitus.learn.energy import Energy, measure_energy
from habitus.learn.estimate import Estimate, Problem
from habitus.learn.posing.rig import Rig
from habitus.parallel.workers import Workers

_REACHES = (0.5, 1.0, 2.0, 4.0, 8.0)  # times the change
_BOUND_IN_RANK = ("low_rank",)  # pose blend shapes that would leave what they are bound to along a line


def go_further(
    problem: Problem, before: Estimate, after: Estimate, energy: Energy, workers: Workers
) -> tuple[Estimate, Energy]:
    """``after``, or what lies beyond it on the way from ``before`` where the energy is lower; with that energy."""
    best = after
    for reach in _REACHES:
        trial = _beyond(problem, before, after, reach)
        reached = measure_energy(problem, trial, workers)
        if reached.total >= energy.total:
            break
        best, energy = trial, reached
    return best, energy


def _beyond(problem: Problem, before: Estimate, after: Estimate, reach: float) -> Estimate:
    def moved(name: str) -> np.ndarray:
        first, last = getattr(before, name), getattr(after, name)
        return last + reach * (last - first)

    free = problem.options.pose_shapes not in _BOUND_IN_RANK
    return replace(
        after,
        rig=_rig_beyond(before.rig, after.rig, reach, free),
        **{name: moved(name) for name in ("templates", "joints", "pose", "trans")},
    )


def _rig_beyond(before: Rig, after: Rig, reach: float, free: bool) -> Rig:
    """Weights go on among the joints that they have, and stay weights; pose blend shapes where they are ``free``."""
    first = np.take_along_axis(before.weights, after.index, 1)
    value = np.maximum(after.value + reach * (after.value - first), 0.0) * (after.value > 0)
    posedirs = after.posedirs
    if free and posedirs is not None and before.posedirs is not None:
        posedirs = posedirs + reach * (posedirs - before.posedirs)
    return replace(after, value=value / value.sum(1, keepdims=True), posedirs=posedirs)
