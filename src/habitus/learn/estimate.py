"""Data and unknowns of training (S 4.1)."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.learn.options import HELD, TrainOptions
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.mesh.registrations import Registrations


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Fixed: mirror partners (or None) and the initial joint regressor J_I (J,V)."""

    mirror: Int[np.ndarray, " V"] | None
    joint_mirror: Int[np.ndarray, " J"] | None
    regressor: Float[np.ndarray, "J V"]


@dataclass(frozen=True, eq=False)
class PosedTarget:
    """A registration (m), its pose (rotation vectors, rad), its translation (m), and its vertices'
    weights, 0 to 1.

    Without ``weight`` all are 1. Where it is 0, ``vertices`` are any numbers.
    """

    vertices: Float[np.ndarray, "V 3"]
    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    weight: Float[np.ndarray, " V"] | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """Data of training: multi-pose registrations, the template's anatomy, initial skinning weights,
    options.

    ``initial_weights`` (V,J) is W_I of eq. 14; ``candidates`` (V,C) are the joints that may move
    each vertex. ``weighted`` is False where all vertices of all registrations are known to count
    alike.
    """

    registrations: Registrations
    anatomy: Anatomy
    initial_weights: Float[np.ndarray, "V J"]
    candidates: Int[np.ndarray, "V C"]
    options: TrainOptions
    weighted: bool = True

    @property
    def subjects(self) -> int:
        """S."""
        return len(self.registrations.subjects)

    @property
    def held(self) -> frozenset[str]:
        """The unknowns that the options hold fixed, by their names in `habitus.learn.energy`."""
        return frozenset(name for word in self.options.fixed for name in HELD.get(word, (word,)))

    def rows_of(self, subject: int) -> Int[np.ndarray, " n"]:
        """The registrations of a subject."""
        return np.flatnonzero(self.registrations.subject_index == subject)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Every unknown of eq. 14: the rig {W, P}, the subjects' rest surfaces and joints (m), poses
    (rad) and translations (m).

    ``descriptors`` (S,s) hold what shape-dependent blend shapes go by, none for the paper's model.
    """

    rig: Rig
    templates: Float[np.ndarray, "S V 3"]
    joints: Float[np.ndarray, "S J 3"]
    descriptors: Float[np.ndarray, "S s"]
    pose: Float[np.ndarray, "N J 3"]
    trans: Float[np.ndarray, "N 3"]

    def person(self, subject: int) -> RestPerson:
        """A subject's rest surface, joints and descriptor."""
        return RestPerson(self.templates[subject], self.joints[subject], self.descriptors[subject])


def posed_targets(
    problem: Problem, estimate: Estimate, rows: Iterable[int]
) -> Iterator[tuple[RestPerson, PosedTarget]]:
    """Registrations read one by one, each with its rest person, pose and translation."""
    for row in rows:
        person = estimate.person(int(problem.registrations.subject_index[row]))
        vertices, weight = problem.registrations.read_seen(row)
        yield person, PosedTarget(vertices, estimate.pose[row], estimate.trans[row], weight)


def weighted(
    rows: Float[np.ndarray, "V ..."], weight: Float[np.ndarray, " V"] | None
) -> Float[np.ndarray, "V ..."]:
    """Rows of vertices times their weights; the rows themselves where there are none."""
    return rows if weight is None else weight.reshape(-1, *(1,) * (rows.ndim - 1)) * rows
