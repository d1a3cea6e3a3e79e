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

from habitus.kernels.jit import jit, jit_inline
from habitus.learn.estimate import PosedTarget, weighted
from habitus.learn.options import CANDIDATES
from habitus.learn.posing.kernels import blend, conjugate, dot4, product
from habitus.learn.posing.rig import RestPerson, Rig, kinship
from habitus.learn.posing.surface import (
    Skeleton,
    rest_surface,
    signed_value,
    skeleton,
    surface,
    world_quaternions,
)


@jit
def linear_influences(candidates, rest, motions):
    """Posed positions of each vertex under each candidate joint alone (V,C,3)."""
    out = np.empty((len(rest), candidates.shape[1], 3))
    for v in range(len(rest)):
        x = rest[v, 0]
        y = rest[v, 1]
        z = rest[v, 2]
        for c in range(candidates.shape[1]):
            m = motions[candidates[v, c]]
            for a in range(3):
                out[v, c, a] = m[a, 0] * x + m[a, 1] * y + m[a, 2] * z + m[a, 3]
    return out


@jit
def dual_influences(index, signed, candidates, sides, rest, moved, quaternions, translations):
    """Derivative of each vertex by each candidate's weight with dual quaternions (V,C,3).

    dx = 2/|b|^2 [vec(b' y b*) + vec(e b'*) - x (b . b') + vec(e' b*)] with b' and e' the
    candidate's own parts.
    """
    out = np.empty((len(rest), candidates.shape[1], 3))
    for v in range(len(rest)):
        b = blend(index[v], signed[v], quaternions)
        e = (0.0, 0.0, 0.0, 0.0)
        for k in range(index.shape[1]):
            d = _dual_part(quaternions, translations, index[v, k], signed[v, k])
            e = (e[0] + d[0], e[1] + d[1], e[2] + d[2], e[3] + d[3])
        back = conjugate(b)
        turned = product((0.0, rest[v, 0], rest[v, 1], rest[v, 2]), back)
        f = 2.0 / dot4(b, b)
        for c in range(candidates.shape[1]):
            joint = candidates[v, c]
            side = sides[v, c]
            q = (
                side * quaternions[joint, 0], side * quaternions[joint, 1],
                side * quaternions[joint, 2], side * quaternions[joint, 3],
            )  # fmt: skip
            first = product(q, turned)
            second = product(e, conjugate(q))
            third = product(_dual_part(quaternions, translations, joint, side), back)
            along = dot4(b, q)
            for a in range(3):
                out[v, c, a] = f * (
                    first[a + 1] + second[a + 1] + third[a + 1] - moved[v, a] * along
                )
    return out


@jit_inline
def _dual_part(quaternions, translations, joint, factor):
    q = (
        factor * quaternions[joint, 0], factor * quaternions[joint, 1],
        factor * quaternions[joint, 2], factor * quaternions[joint, 3],
    )  # fmt: skip
    return product(
        (
            0.0,
            0.5 * translations[joint, 0],
            0.5 * translations[joint, 1],
            0.5 * translations[joint, 2],
        ),
        q,
    )


@jit
def best_weights(matrix, vector, may, supports):
    """Per vertex the w >= 0 of sum 1 that minimises w M w - 2 m w over all supports (candidates'
    numbers, -1 fills).

    On a support the minimum under sum(w) = 1 is x + t y with M x = m, M y = 1; it counts where no
    weight is negative.
    """
    vertices, count = vector.shape
    out = np.zeros((vertices, count))
    size = supports.shape[1]
    factor = np.empty((size, size))
    x = np.empty(size)
    y = np.empty(size)
    for v in range(vertices):
        best = np.inf
        for s in range(len(supports)):
            n = 0
            while n < size and supports[s, n] >= 0 and may[v, supports[s, n]]:
                n += 1
            if n == 0 or (n < size and supports[s, n] >= 0):
                continue
            if not _solve(matrix[v], vector[v], supports[s], n, factor, x, y):
                continue
            sum_x = sum_y = 0.0
            for i in range(n):
                sum_x += x[i]
                sum_y += y[i]
            t = (1.0 - sum_x) / sum_y
            energy = 0.0
            feasible = True
            for i in range(n):
                x[i] += t * y[i]
                feasible = feasible and x[i] >= 0.0
            if not feasible:
                continue
            for i in range(n):
                row = supports[s, i]
                for j in range(n):
                    energy += x[i] * matrix[v, row, supports[s, j]] * x[j]
                energy -= 2.0 * vector[v, row] * x[i]
            if energy < best:
                best = energy
                for c in range(count):
                    out[v, c] = 0.0
                for i in range(n):
                    out[v, supports[s, i]] = x[i]
    return out


@jit_inline
def _solve(matrix, vector, support, n, factor, x, y):
    """Cholesky on the support: matrix x = vector, matrix y = 1; False where it is not positive
    definite.
    """
    for i in range(n):
        for j in range(i + 1):
            total = matrix[support[i], support[j]]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if total <= 1e-14 * matrix[support[i], support[i]]:
                    return False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(n):
        a = vector[support[i]]
        b = 1.0
        for k in range(i):
            a -= factor[i, k] * x[k]
            b -= factor[i, k] * y[k]
        x[i], y[i] = a / factor[i, i], b / factor[i, i]
    for i in range(n - 1, -1, -1):
        a = x[i]
        b = y[i]
        for k in range(i + 1, n):
            a -= factor[k, i] * x[k]
            b -= factor[k, i] * y[k]
        x[i], y[i] = a / factor[i, i], b / factor[i, i]
    return True


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
