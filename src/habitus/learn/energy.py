"""The value of eq. 14 (S 4.1), term by term; the terms are defined in `habitus.learn.terms`."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from habitus.learn.estimate import Estimate, Problem, posed_targets
from habitus.learn.terms import costs, data_residual, regularizer_terms, unknowns
from habitus.parallel.workers import Workers, in_blocks


@dataclass(frozen=True)
class Energy:
    """Weighted terms of eq. 14 (m^2): data E_D, symmetry E_Y, joints E_J, pose_shapes E_P, skinning
    E_W.
    """

    terms: Mapping[str, float]

    @property
    def total(self) -> float:
        """Their sum."""
        return sum(self.terms.values())


def measure_energy(problem: Problem, estimate: Estimate, workers: Workers) -> Energy:
    """The cost of each of `energy_terms`, the data term a block of registrations at a time."""
    blocks = in_blocks(len(problem.registrations), 32)
    data = sum(workers.map(_squares, (problem, estimate), blocks))
    return Energy({"data": data, **regularizers(problem, estimate)})


def regularizers(problem: Problem, estimate: Estimate) -> dict[str, float]:
    """The cost of each term but the data term."""
    return costs(regularizer_terms(problem, estimate.rig.posedirs is not None), unknowns(estimate))


def _squares(shared: tuple[Problem, Estimate], rows: range) -> float:
    problem, estimate = shared
    total = 0.0
    for person, target in posed_targets(problem, estimate, rows):
        residual = data_residual(estimate.rig, person, target)
        total += float(np.vdot(residual, residual))
    return total
