"""The energy that training minimises, term by term (S 4.1, eq. 14)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from habitus.learn.estimate import Estimate, Problem, posed_targets
from habitus.learn.posing.surface import surface
from habitus.learn.steps.pose_shapes import penalty
from habitus.learn.steps.subjects import held_terms
from habitus.parallel.workers import Workers, in_blocks


@dataclass(frozen=True)
class Energy:
    """Weighted terms of eq. 14 (m^2): data E_D, symmetry E_Y, joints E_J, pose_shapes E_P, skinning E_W."""

    terms: Mapping[str, float]

    @property
    def total(self) -> float:
        """Their sum."""
        return sum(self.terms.values())


def measure_energy(problem: Problem, estimate: Estimate, workers: Workers) -> Energy:
    """Every term, computed from scratch."""
    blocks = in_blocks(len(problem.registrations), 32)
    data = sum(workers.map(_squares, (problem, estimate), blocks))
    return Energy({"data": data, **regularizers(problem, estimate)})


def regularizers(problem: Problem, estimate: Estimate) -> dict[str, float]:
    """Every term but the data's."""
    rig, weights = estimate.rig, problem.options.weights
    people = zip(estimate.templates, estimate.joints, strict=True)
    held = np.array([held_terms(*person, problem.anatomy, weights) for person in people]).sum(0)
    terms = {"symmetry": float(held[0]), "joints": float(held[1])}
    if rig.posedirs is not None:
        table = rig.posedirs.reshape(-1, rig.posedirs.shape[-1])
        terms["pose_shapes"] = penalty(problem, table.shape[1]).energy(table)
    terms["skinning"] = weights.skinning * float(((rig.weights - problem.initial_weights) ** 2).sum())
    return terms


def _squares(shared: tuple[Problem, Estimate], rows: range) -> float:
    problem, estimate = shared
    total = 0.0
    for person, target in posed_targets(problem, estimate, rows):
        left = target.vertices - target.trans - surface(estimate.rig, person, target.pose)
        total += float(np.vdot(left, left))
    return total
