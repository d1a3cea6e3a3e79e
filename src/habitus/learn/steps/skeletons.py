"""A subject's rest surface, joints and all its poses at once, on a sample of the vertices.

Alternating between them converges slowly, because poses compensate for a displaced joint and vice
versa. Here one Gauss-Newton step of the terms E_D, E_Y and E_J is taken over everything that
belongs to one subject. Poses and translations are eliminated one registration at a time, which
leaves the sampled rest surface and the joints. A few vertices of each part determine the skeleton;
``subjects.solve_subject`` then solves for the whole rest surface, and the result is kept only where
it lowers the energy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.linalg.blas import dsyrk  # pyright: ignore[reportAttributeAccessIssue]

from habitus.body.skinning import world_motions
from habitus.learn.energy import costs, data_residual, joints_term, normal_equations, symmetry_term
from habitus.learn.estimate import PosedTarget, Problem, weighted
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.steps.poses import surface_jacobians
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus.solve.terms import Term

_A_PART = 8


@dataclass(frozen=True, eq=False)
class Sample:
    """Sampled vertices, how many each stands for, and each one's mirror partner as a number in the
    sample (without mirror: itself).
    """

    vertices: Int[np.ndarray, " n"]
    count: Float[np.ndarray, " n"]
    partner: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class SampledSubject:
    """All of one subject on the sample: rest vertices and joints (m), poses (rad), translations
    (m).
    """

    person: RestPerson
    pose: Float[np.ndarray, "n J 3"]
    trans: Float[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class SampledTarget:
    """The sampled vertices of a registration (m), and their weights where these are not 1."""

    vertices: Float[np.ndarray, "U 3"]
    weight: Float[np.ndarray, " U"] | None = None


def sample_parts(weights: Float[np.ndarray, "V J"], mirror: Int[np.ndarray, " V"] | None) -> Sample:
    """About equally many vertices of each part, spread over it, always with their mirror
    partners.
    """
    part = weights.argmax(1)
    whole = np.arange(len(part)) if mirror is None else mirror
    chosen = np.zeros(len(part), bool)
    for joint in range(weights.shape[1]):
        rows = np.flatnonzero(part == joint)
        chosen[
            rows[np.unique(np.linspace(0, len(rows) - 1, _A_PART).astype(int))]
            if len(rows)
            else rows
        ] = True
    chosen |= chosen[whole]
    vertices = np.flatnonzero(chosen)
    size, kept = (
        np.bincount(part[rows], minlength=weights.shape[1]) for rows in (slice(None), vertices)
    )
    count = (size / np.maximum(kept, 1))[part[vertices]]
    position = np.full(len(part), -1)
    position[vertices] = np.arange(len(vertices))
    return Sample(
        vertices, (count + count[position[whole[vertices]]]) / 2, position[whole[vertices]]
    )


def subset_rig(rig: Rig, vertices: Int[np.ndarray, " n"]) -> Rig:
    """The rig of some vertices only."""
    posedirs = None if rig.posedirs is None else np.ascontiguousarray(rig.posedirs[vertices])
    return Rig(
        rig.parents, rig.skinning, rig.pose_features, rig.shape_features,
        rig.index[vertices], rig.value[vertices], posedirs,
    )  # fmt: skip


def refine(
    problem: Problem,
    rig: Rig,
    sample: Sample,
    subject: SampledSubject,
    targets: Sequence[SampledTarget],
    ring: Float[np.ndarray, "J 3"],
    steps: int | None = None,
) -> SampledSubject:
    """Better poses, joints and rest vertices together: Levenberg-Marquardt steps; ``rig`` is the
    sample's.

    ``ring`` (m) are the initial regressor's joints, taken as fixed here.
    """
    held = "joint_regressor" in problem.options.fixed
    system = _System(rig, sample, sample_terms(problem, sample, ring), targets, held)
    settings = problem.options.settings
    damping = settings.skeleton_damping
    energy = _energy(system, subject)
    for _ in range(settings.skeleton_steps if steps is None else steps):
        trial = _moved(subject, *_step(system, subject, damping))
        new = _energy(system, trial)
        if new < energy:
            subject = trial
            energy = new
            damping = damping / 5
        else:
            damping *= 20
    return subject


def remove_mean_rotation(
    parents: tuple[int, ...], before: Float[np.ndarray, "n J 3"], after: Float[np.ndarray, "n J 3"]
) -> Float[np.ndarray, "n J 3"]:
    """``after`` with the mean change of each part's world rotation since ``before`` removed
    (rotation vectors, rad).

    Rotating a part at rest while its poses rotate back costs little energy, and blend skinning
    favours a rest pose near most poses; the zero pose would drift away from the template's.
    Rotations of the rest surface act from the right of world rotations, independently for each
    part.
    """
    first, last = (_world(parents, pose) for pose in (before, after))
    common = rotvec_from_matrix(first.mT @ last).mean(0)
    turned = last @ matrix_from_rotvec(-common)
    above = np.stack(
        [np.broadcast_to(np.eye(3), (len(turned), 3, 3)), *(turned[:, p] for p in parents[1:])], 1
    )
    return rotvec_from_matrix(above.mT @ turned)


def _world(
    parents: tuple[int, ...], pose: Float[np.ndarray, "n J 3"]
) -> Float[np.ndarray, "n J 3 3"]:
    return world_motions(matrix_from_rotvec(pose), np.zeros(pose.shape), parents)[..., :3]


def _moved(
    subject: SampledSubject, rest: np.ndarray, joints: np.ndarray, poses: np.ndarray
) -> SampledSubject:
    person = subject.person
    moved = RestPerson(
        person.template + rest.reshape(-1, 3),
        person.joints + joints.reshape(-1, 3),
        person.descriptor,
    )
    turns = poses[:, :-3].reshape(subject.pose.shape)
    return SampledSubject(moved, subject.pose + turns, subject.trans + poses[:, -3:])


def sample_terms(
    problem: Problem, sample: Sample, ring: Float[np.ndarray, "J 3"]
) -> dict[str, Term]:
    """E_Y and E_J on the sample, each vertex weighted by how many it stands for, J_I T fixed at
    ``ring``.
    """
    anatomy = problem.anatomy
    weights = problem.options.weights
    mirror = None if anatomy.mirror is None else sample.partner
    return {
        "symmetry": symmetry_term(mirror, anatomy.joint_mirror, weights, sample.count),
        "joints": joints_term(weights, ring=ring),
    }


def _values(person: RestPerson) -> dict[str, np.ndarray]:
    return {"templates": person.template, "joints": person.joints}


def _energy(system: "_System", subject: SampledSubject) -> float:
    """The cost (m^2) of the sample's E_D, E_Y and E_J."""
    total = sum(costs(system.terms, _values(subject.person)).values())
    for pose, trans, target in zip(subject.pose, subject.trans, system.targets, strict=True):
        posed = PosedTarget(target.vertices, pose, trans, target.weight)
        residual = data_residual(system.rig, subject.person, posed)
        total += float(system.sample.count @ (residual**2).sum(1))
    return total


@dataclass(frozen=True, eq=False)
class _System:
    """Constants of one subject's refinement: the sample's rig and terms, and the registrations'
    sampled vertices.

    ``held``: joints stay where they are.
    """

    rig: Rig
    sample: Sample
    terms: Mapping[str, Term]
    targets: Sequence[SampledTarget]
    held: bool


def _step(
    system: _System, subject: SampledSubject, damping: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The damped Gauss-Newton step of half the energy: of the rest vertices (3 U), of the joints (3
    J), and of each pose with its translation (n, 3 J + 3). Only the lower half of the matrix is
    kept right.
    """
    matrix, gradient = normal_equations(system.terms, _values(subject.person))
    matrix, right, eliminated = _eliminate_poses(
        system, subject, damping, 0.5 * matrix, -0.5 * gradient
    )
    size = subject.person.template.size
    if system.held:
        matrix[size:], right[size:] = 0.0, 0.0
        matrix[size:, size:] = np.eye(len(matrix) - size)
    matrix[np.diag_indices(len(matrix))] += damping * np.abs(matrix.diagonal()) + 1e-9
    step = cho_solve(cho_factor(matrix, lower=True, overwrite_a=True), right)
    turns = [
        solve_triangular(f, s[:, -1] - s[:, :-1] @ step, lower=True, trans=1) for f, s in eliminated
    ]
    return step[:size], step[size:], np.stack(turns)


def _eliminate_poses(
    system: _System, subject: SampledSubject, damping: float, matrix: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Add the data term and take its Schur complement over poses and translations, a registration
    at a time.

    Also what recovers each pose's step: the Cholesky factor of its block, and the factor solved for
    its columns.
    """
    eliminated = []
    for pose, trans, target in zip(subject.pose, subject.trans, system.targets, strict=True):
        count = weighted(system.sample.count, target.weight)
        equations = _normal_equations(
            system.rig, count, subject.person, pose, target.vertices - trans, damping
        )
        equations.add_to(matrix, right)
        columns = np.column_stack([equations.cross.T, equations.pull])
        solved = solve_triangular(equations.factor, columns, lower=True, check_finite=False)
        matrix = dsyrk(-1.0, solved[:, :-1], beta=1.0, c=matrix, trans=1, lower=1, overwrite_c=1)
        right -= solved[:, :-1].T @ solved[:, -1]
        eliminated.append((equations.factor, solved))
    return matrix, right, eliminated


@dataclass(frozen=True, eq=False)
class _Normal:
    """One registration's normal equations: its pose and translation (3 J + 3 numbers), and the rest
    person.

    ``factor`` is the Cholesky factor of the pose's own block, ``cross`` couples rest vertices and
    joints to it, and ``pull`` and ``shared_pull`` are the right sides. ``spread`` are the
    transposed slopes by rest vertices.
    """

    factor: Float[np.ndarray, "p p"]
    cross: Float[np.ndarray, "s p"]
    pull: Float[np.ndarray, " p"]
    shared_pull: Float[np.ndarray, " s"]
    spread: Float[np.ndarray, "U 3 3"]
    joint_jacobian: Float[np.ndarray, "R C"]

    def add_to(self, matrix: np.ndarray, right: np.ndarray) -> None:
        """The blocks of rest vertices and joints."""
        size = len(self.joint_jacobian)
        joint_jacobian = self.joint_jacobian
        _add_blocks(matrix, self.spread @ self.spread.transpose(0, 2, 1))
        between = (self.spread @ joint_jacobian.reshape(-1, 3, joint_jacobian.shape[1])).reshape(
            size, -1
        )
        matrix[size:, :size] += between.T
        matrix[size:, size:] += joint_jacobian.T @ joint_jacobian
        right += self.shared_pull


def _normal_equations(
    rig: Rig,
    count: Float[np.ndarray, " U"],
    person: RestPerson,
    pose: np.ndarray,
    target: np.ndarray,
    damping: float,
) -> _Normal:
    """Gauss-Newton, each vertex weighted by its ``count``; ``target`` (m) is the registration minus
    ``trans``.
    """
    size = 3 * len(count)
    root = np.sqrt(np.repeat(count, 3))
    moved, pose_jacobian, turn, joint_jacobian = surface_jacobians(rig, person, pose)
    left = root * (target - moved).ravel()
    own = root[:, None] * np.concatenate(
        [pose_jacobian.reshape(size, -1), np.tile(np.eye(3), (len(turn), 1))], 1
    )
    joint_jacobian = root[:, None] * joint_jacobian.reshape(size, -1)
    hess = own.T @ own
    factor = np.linalg.cholesky(hess + np.diag(damping * hess.diagonal() + 1e-12))
    spread = (root.reshape(-1, 3, 1) * turn).transpose(0, 2, 1)
    cross = np.concatenate(
        [(spread @ own.reshape(-1, 3, own.shape[1])).reshape(size, -1), joint_jacobian.T @ own]
    )
    shared = np.concatenate([(spread @ left.reshape(-1, 3, 1)).ravel(), joint_jacobian.T @ left])
    return _Normal(factor, cross, own.T @ left, shared, spread, joint_jacobian)


def _add_blocks(matrix: np.ndarray, blocks: Float[np.ndarray, "U 3 3"]) -> None:
    """Add to the 3x3 blocks of the diagonal."""
    rows = np.arange(3 * len(blocks)).reshape(-1, 3)
    matrix[rows[:, :, None], rows[:, None, :]] += blocks
