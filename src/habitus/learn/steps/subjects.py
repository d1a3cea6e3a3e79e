"""Rest surface and rest joints of one subject, given poses and rig: E_D + E_Y + E_J in closed form
(S 4.1, eq. 14).

The normal equations are block-diagonal in the vertices (pairs of vertices, with the symmetry term),
but for the joints and the joints' regressor, which couple everything through 3 J numbers each:
those are solved for first.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.learn.energy import FLIP, asymmetry, costs, data_residual, subject_terms
from habitus.learn.estimate import Anatomy, PosedTarget, weighted
from habitus.learn.options import SETTINGS, EnergyWeights
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.posing.surface import pose_feature, posed

TERMS = ("data", "symmetry", "joints")
"""Of eq. 14: what `solve_subject` minimises in closed form over one subject's rest surface and
joints.
"""


def solve_subject(
    rig: Rig,
    descriptor: Float[np.ndarray, " s"],
    targets: Iterable[PosedTarget],
    anatomy: Anatomy,
    weights: EnergyWeights,
    *,
    held: bool = False,
    around: Float[np.ndarray, "V 3"] | None = None,
    hold_below: float = SETTINGS.min_observed_weight,
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
    """The rest surface (m) and the rest joints (m) that minimise E_D + E_Y + E_J for a subject's
    registrations.

    ``held``: joints are exactly what the anatomy's regressor makes of the surface. Vertices that no
    registration shows stay near those of the surface ``around``, which is needed where there are
    such; so do those whose registrations weigh less than ``hold_below`` together (a registration
    weighs 1).
    """
    vertices = rig.num_vertices
    columns = 3 * rig.num_joints
    blocks = np.zeros((vertices, 3, 3))
    cross = np.zeros((vertices, 3, columns))
    joints = np.zeros((columns, columns))
    right = np.zeros((vertices, 3))
    right_joints = np.zeros(columns)
    posedirs = rig.posedirs_for(descriptor)
    seen = np.zeros(vertices)
    for target in targets:
        applied = posed(rig, target.pose)
        turn = applied.turn
        joint_jacobian = applied.joint_jacobian()
        left = target.vertices - target.trans
        if posedirs is not None:
            left = left - (turn @ (posedirs @ pose_feature(rig, target.pose))[..., None])[..., 0]
        back = weighted(turn.transpose(0, 2, 1), target.weight)
        flat = joint_jacobian.reshape(-1, columns)
        heavy = weighted(joint_jacobian, target.weight).reshape(-1, columns)
        blocks += back @ turn
        cross += back @ joint_jacobian
        joints += flat.T @ heavy
        right += (back @ left[..., None])[..., 0]
        right_joints += heavy.T @ left.ravel()
        seen += 1.0 if target.weight is None else target.weight
    if around is not None:
        hold = np.maximum(hold_below - seen, 0.0)
        blocks += hold[:, None, None] * np.eye(3)
        right += hold[:, None] * around
    if anatomy.joint_mirror is not None:
        joints += weights.symmetry * weights.joint_symmetry * joint_asymmetry(anatomy.joint_mirror)
    pairs = _Pairs.of(blocks, anatomy.mirror, weights.symmetry)
    return _solve(
        pairs, cross, joints, right, right_joints, anatomy, None if held else weights.joints
    )


def subject_energy(
    rig: Rig,
    person: RestPerson,
    targets: Iterable[PosedTarget],
    anatomy: Anatomy,
    weights: EnergyWeights,
) -> float:
    """The cost (m^2) of `TERMS` for one subject."""
    values = {"templates": person.template, "joints": person.joints}
    total = sum(costs(subject_terms(anatomy, weights), values).values())
    for target in targets:
        residual = data_residual(rig, person, target)
        total += float(np.vdot(residual, residual))
    return total


def joint_asymmetry(partner: Int[np.ndarray, " J"]) -> Float[np.ndarray, "C C"]:
    """The quadratic form of |J - U(J)|^2 over the flattened joints, C = 3 J."""
    difference = asymmetry(partner)
    return (difference.T @ difference).toarray()


def _solve(
    pairs: "_Pairs",
    cross: Float[np.ndarray, "V 3 C"],
    joints: Float[np.ndarray, "C C"],
    right: Float[np.ndarray, "V 3"],
    right_joints: Float[np.ndarray, " C"],
    anatomy: Anatomy,
    weight: float | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Eliminate the vertices; what is left are the joints J and how strongly the regressor pulls at
    them.

    T = A^-1 (r - C J + J_I' m) with m = ``weight`` (J - J_I T), or where that is None with the m
    for which J = J_I T.
    """
    count = len(right)
    columns = len(right_joints)
    ring = np.kron(anatomy.regressor, np.eye(3)).reshape(columns, count * 3)
    solved = pairs.solve(
        np.concatenate([right[..., None], cross, ring.T.reshape(count, 3, columns)], -1)
    ).reshape(count * 3, -1)
    by_right = solved[:, 0]
    by_cross = solved[:, 1 : 1 + columns]
    by_ring = solved[:, 1 + columns :]
    flat = cross.reshape(-1, columns)
    unit = np.eye(columns)
    scale, give = (1.0, 0.0) if weight is None else (weight, 1.0)
    matrix = np.block(
        [
            [scale * (unit + ring @ by_cross), -scale * (ring @ by_ring) - give * unit],
            [joints - flat.T @ by_cross, unit + flat.T @ by_ring],
        ]
    )
    solution = np.linalg.solve(
        matrix, np.concatenate([scale * (ring @ by_right), right_joints - flat.T @ by_right])
    )
    joint = solution[:columns]
    pull = solution[columns:]
    surface = by_right - by_cross @ joint + by_ring @ pull
    return surface.reshape(count, 3), joint.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """A symmetric matrix of 3x3 blocks on the diagonal, and between mirror partners."""

    alone: Int[np.ndarray, " n"]
    alone_blocks: Float[np.ndarray, "n 3 3"]
    left: Int[np.ndarray, " m"]
    right: Int[np.ndarray, " m"]
    pair_blocks: Float[np.ndarray, "m 6 6"]

    @staticmethod
    def of(
        blocks: Float[np.ndarray, "V 3 3"], mirror: Int[np.ndarray, " V"] | None, symmetry: float
    ) -> "_Pairs":
        """``blocks`` plus ``symmetry`` times the quadratic form of |T - U(T)|^2."""
        vertices = np.arange(len(blocks))
        partner = vertices if mirror is None else mirror
        alone = vertices[partner == vertices]
        left = vertices[partner > vertices]
        own = 0.0 if mirror is None else symmetry
        alone_blocks = blocks[alone] + own * np.diag((1 - FLIP) ** 2)
        pair = np.zeros((len(left), 6, 6))
        pair[:, :3, :3] = blocks[left] + 2 * symmetry * np.eye(3)
        pair[:, 3:, 3:] = blocks[partner[left]] + 2 * symmetry * np.eye(3)
        pair[:, :3, 3:] = pair[:, 3:, :3] = -2 * symmetry * np.diag(FLIP)
        return _Pairs(alone, alone_blocks, left, partner[left], pair)

    def solve(self, right: Float[np.ndarray, "V 3 R"]) -> Float[np.ndarray, "V 3 R"]:
        """The inverse applied to many right sides."""
        out = np.empty_like(right)
        out[self.alone] = np.linalg.solve(self.alone_blocks, right[self.alone])
        both = np.linalg.solve(
            self.pair_blocks, np.concatenate([right[self.left], right[self.right]], 1)
        )
        out[self.left], out[self.right] = both[:, :3], both[:, 3:]
        return out
