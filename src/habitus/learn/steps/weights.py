"""Skinning weights, given everything else: each vertex by itself, at most four joints, exactly (S
4.1, E_D + E_W).

A vertex' weights enter linear blend skinning linearly, so that its part of the energy is a
quadratic in a few weights that are not negative and sum to one. There are 162 ways to choose up to
four of eight joints: all are solved, and the best is kept. Dual quaternions are linearised first,
and a proposal is kept only where it lowers the energy.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from habitus.learn.estimate import PosedTarget, weighted
from habitus.learn.options import CANDIDATES
from habitus.learn.posing.rig import RestPerson, Rig, kinship
from habitus.learn.posing.surface import (
    Skeleton,
    rest_surface,
    signed_value,
    skeleton,
    surface,
    world_quaternions,
)
from habitus.learn.steps.weights_kernels import best_weights, dual_influences, linear_influences

_LITTLE = (
    1e-12  # m^2: keeps vertices that nobody shows at their initial weights, whatever E_W weighs
)


@dataclass(frozen=True, eq=False)
class Quadratics:
    """Per vertex the energy as a function of its candidates' weights w: w N w - 2 n w +
    constant.
    """

    matrix: Float[np.ndarray, "V C C"]
    vector: Float[np.ndarray, "V C"]

    def __add__(self, other: "Quadratics") -> "Quadratics":
        return Quadratics(self.matrix + other.matrix, self.vector + other.vector)


def candidate_joints(
    parents: tuple[int, ...], initial: Float[np.ndarray, "V J"]
) -> Int[np.ndarray, "V C"]:
    """The joints that may move a vertex: those of the initial weights, then those next to the
    strongest in the tree.
    """
    far = kinship(parents)[initial.argmax(1)]
    order = np.where(initial > 0, -1 - initial, far)
    return np.argsort(order, axis=1, kind="stable")[:, :CANDIDATES].astype(np.int64)


def gather_quadratics(
    rig: Rig, candidates: Int[np.ndarray, "V C"], items: Iterable[tuple[RestPerson, PosedTarget]]
) -> Quadratics:
    """The data term of some registrations by the weights, linearised at the rig's where it is not
    linear.
    """
    count = candidates.shape[1]
    matrix = np.zeros((rig.num_vertices, count, count))
    vector = np.zeros((rig.num_vertices, count))
    dense = np.take_along_axis(rig.weights, candidates, 1)
    for person, target in items:
        bones = skeleton(rig.parents, target.pose)
        rest = rest_surface(rig, person, target.pose)
        rows, left = _INFLUENCES[rig.skinning](rig, bones, person, rest, candidates, dense, target)
        heavy = weighted(rows, target.weight)
        matrix += heavy @ rows.transpose(0, 2, 1)
        vector += (heavy @ left[..., None])[..., 0]
    return Quadratics(matrix, vector)


def minimize_quadratics(
    quadratics: Quadratics,
    candidates: Int[np.ndarray, "V C"],
    initial: Float[np.ndarray, "V J"],
    weight: float,
    influences: int,
    allowed: Float[np.ndarray, "V J"] | None = None,
) -> tuple[Int[np.ndarray, "V K"], Float[np.ndarray, "V K"]]:
    """Joints and weights that minimise the quadratics plus ``weight`` |w - w_I|^2, among
    ``allowed`` (> 0) joints.
    """
    count = candidates.shape[1]
    near = np.take_along_axis(initial, candidates, 1)
    may = (
        np.ones(candidates.shape, bool)
        if allowed is None
        else np.take_along_axis(allowed, candidates, 1) > 0
    )
    supports = [s for size in range(1, influences + 1) for s in combinations(range(count), size)]
    table = np.array([s + (-1,) * (influences - len(s)) for s in supports], dtype=np.int64)
    weight = max(weight, _LITTLE)
    scale = quadratics.matrix.trace(axis1=1, axis2=2)[:, None] / count
    # plus scale (sum w - 1)^2, which is nothing: dual quaternions hear no scale of w, their matrix
    # alone is singular
    matrix = quadratics.matrix + weight * np.eye(count) + scale[..., None]
    value = best_weights(matrix, quadratics.vector + weight * near + scale, may, table)
    order = np.argsort(-value, axis=1, kind="stable")[:, :influences]
    return np.take_along_axis(candidates, order, 1), np.take_along_axis(value, order, 1)


def vertex_costs(
    rigs: list[Rig], items: Iterable[tuple[RestPerson, PosedTarget]]
) -> Float[np.ndarray, "R V"]:
    """Squared distance (m^2) of each vertex over some registrations, for several rigs."""
    out = np.zeros((len(rigs), rigs[0].num_vertices))
    for person, target in items:
        goal = target.vertices - target.trans
        for row, rig in zip(out, rigs, strict=True):
            row += weighted(
                ((surface(rig, person, target.pose) - goal) ** 2).sum(-1), target.weight
            )
    return out


def midpoint_rig(rig: Rig, other: Rig) -> Rig:
    """The rig with weights halfway to another that uses no joints but the rig's own."""
    value = 0.5 * (rig.value + np.take_along_axis(other.weights, rig.index, 1))
    return replace(rig, value=value)


def select_rigs(rigs: list[Rig], best: Int[np.ndarray, " V"]) -> Rig:
    """Each vertex' weights from the rig of that number."""
    rows = np.arange(rigs[0].num_vertices)
    index, value = (
        np.stack([getattr(rig, key) for rig in rigs])[best, rows] for key in ("index", "value")
    )
    return replace(rigs[0], index=index, value=value)


def _linear(
    rig: Rig,
    bones: Skeleton,
    person: RestPerson,
    rest: np.ndarray,
    candidates: np.ndarray,
    dense: np.ndarray,
    target: PosedTarget,
) -> tuple[np.ndarray, np.ndarray]:
    motions = np.concatenate([bones.world, bones.translations(person.joints)[..., None]], -1)
    return linear_influences(candidates, rest, motions), target.vertices - target.trans


def _dual(
    rig: Rig,
    bones: Skeleton,
    person: RestPerson,
    rest: np.ndarray,
    candidates: np.ndarray,
    dense: np.ndarray,
    target: PosedTarget,
) -> tuple[np.ndarray, np.ndarray]:
    quaternions = world_quaternions(bones)
    moved = surface(rig, person, target.pose)
    sides = np.where(quaternions @ quaternions.T < 0, -1.0, 1.0)[candidates, rig.strongest[:, None]]
    signed = signed_value(rig, quaternions)
    rows = dual_influences(
        rig.index,
        signed,
        candidates,
        sides,
        rest,
        moved,
        quaternions,
        bones.translations(person.joints),
    )
    return rows, target.vertices - target.trans - moved + np.einsum("vc,vca->va", dense, rows)


_INFLUENCES = {"lbs": _linear, "dqbs": _dual}
LINEAR = frozenset({"lbs"})
"""Skinning in which vertices are linear in the weights."""
