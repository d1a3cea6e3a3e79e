"""A subject's rest surface, joints and all its poses at once, on a sample of the vertices.

Solving for them in turns crawls: a joint that is off is made up for by the poses, and each holds the other in place.
Here the Gauss-Newton step of eq. 14 over everything that belongs to one subject is taken together. Poses and places
are eliminated one registration at a time, which leaves the sampled rest surface and the joints. A few vertices of each
part tell the skeleton; the whole surface follows by ``subjects.solve_subject``, and the energy decides.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.linalg.blas import dsyrk

from habitus.body.kinematics import world_motions
from habitus.learn.estimate import Problem
from habitus.learn.posing.rig import Person, Rig
from habitus.learn.posing.surface import surface
from habitus.learn.steps.poses import surface_and_slopes
from habitus.learn.steps.subjects import FLIP, joint_asymmetry
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

_A_PART = 8
_FIRST_DAMPING = 1e-4


@dataclass(frozen=True, eq=False)
class Sample:
    """Some vertices, how many each stands for, and the place of each one's mirror partner (its own without mirror)."""

    vertices: Int[np.ndarray, " n"]
    count: Float[np.ndarray, " n"]
    partner: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class SampledSubject:
    """All of one subject on the sample: rest vertices and joints (m), poses (rad), places (m)."""

    person: Person
    pose: Float[np.ndarray, "n J 3"]
    trans: Float[np.ndarray, "n 3"]


def sample_parts(weights: Float[np.ndarray, "V J"], mirror: Int[np.ndarray, " V"] | None) -> Sample:
    """About as many vertices of each part, spread over it, always with their partners."""
    part = weights.argmax(1)
    whole = np.arange(len(part)) if mirror is None else mirror
    chosen = np.zeros(len(part), bool)
    for joint in range(weights.shape[1]):
        rows = np.flatnonzero(part == joint)
        chosen[rows[np.unique(np.linspace(0, len(rows) - 1, _A_PART).astype(int))] if len(rows) else rows] = True
    chosen |= chosen[whole]
    vertices = np.flatnonzero(chosen)
    size, kept = (np.bincount(part[rows], minlength=weights.shape[1]) for rows in (slice(None), vertices))
    count = (size / np.maximum(kept, 1))[part[vertices]]
    place = np.full(len(part), -1)
    place[vertices] = np.arange(len(vertices))
    return Sample(vertices, (count + count[place[whole[vertices]]]) / 2, place[whole[vertices]])


def rows_of(rig: Rig, vertices: Int[np.ndarray, " n"]) -> Rig:
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
    targets: Float[np.ndarray, "n U 3"],
    ring: Float[np.ndarray, "J 3"],
    steps: int,
) -> SampledSubject:
    """Better poses, joints and rest vertices together: Levenberg-Marquardt steps; ``rig`` is the sample's.

    ``ring`` (m) are the initial regressor's joints, taken as fixed here.
    """
    damping, energy = _FIRST_DAMPING, _energy(problem, rig, sample, subject, targets, ring)
    for _ in range(steps):
        trial = _moved(subject, *_step(problem, rig, sample, subject, targets, ring, damping))
        new = _energy(problem, rig, sample, trial, targets, ring)
        if new < energy:
            subject, energy, damping = trial, new, damping / 5
        else:
            damping *= 20
    return subject


def without_common_turn(
    parents: tuple[int, ...], before: Float[np.ndarray, "n J 3"], after: Float[np.ndarray, "n J 3"]
) -> Float[np.ndarray, "n J 3"]:
    """``after`` less what all its poses have turned alike since ``before`` (rotation vectors, rad).

    A part that turns at rest while its poses turn back costs little, and blend skinning likes to rest where most poses
    are. Then the zero pose would no longer be the template's. Rest surfaces turn from the right of rotations in the
    world, where parts do not hang on each other.
    """
    first, last = (_world(parents, pose) for pose in (before, after))
    common = rotvec_from_matrix(first.mT @ last).mean(0)
    turned = last @ matrix_from_rotvec(-common)
    above = np.stack([np.broadcast_to(np.eye(3), (len(turned), 3, 3)), *(turned[:, p] for p in parents[1:])], 1)
    return rotvec_from_matrix(above.mT @ turned)


def _world(parents: tuple[int, ...], pose: Float[np.ndarray, "n J 3"]) -> Float[np.ndarray, "n J 3 3"]:
    return world_motions(matrix_from_rotvec(pose), np.zeros(pose.shape), parents)[..., :3]


def _moved(subject: SampledSubject, rest: np.ndarray, joints: np.ndarray, poses: np.ndarray) -> SampledSubject:
    person = subject.person
    moved = Person(person.template + rest.reshape(-1, 3), person.joints + joints.reshape(-1, 3), person.descriptor)
    turns = poses[:, :-3].reshape(subject.pose.shape)
    return SampledSubject(moved, subject.pose + turns, subject.trans + poses[:, -3:])


def _energy(
    problem: Problem, rig: Rig, sample: Sample, subject: SampledSubject, targets: np.ndarray, ring: np.ndarray
) -> float:
    weights, person = problem.options.weights, subject.person
    total = weights.joints * float(((ring - person.joints) ** 2).sum())
    for pose, trans, target in zip(subject.pose, subject.trans, targets, strict=True):
        total += float(sample.count @ ((surface(rig, person, pose) + trans - target) ** 2).sum(1))
    if problem.anatomy.mirror is not None:
        apart = person.template - person.template[sample.partner] * FLIP
        total += weights.symmetry * float(sample.count @ (apart**2).sum(1))
    if problem.anatomy.joint_mirror is not None:
        flat = person.joints.ravel()
        form = joint_asymmetry(problem.anatomy.joint_mirror)
        total += weights.symmetry * weights.joint_symmetry * float(flat @ form @ flat)
    return total


def _step(
    problem: Problem,
    rig: Rig,
    sample: Sample,
    subject: SampledSubject,
    targets: np.ndarray,
    ring: np.ndarray,
    damping: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps of the rest vertices (3 U), of the joints (3 J), and of each pose with its place (n, 3 J + 3).

    Only the lower half of the matrix is kept right.
    """
    size = 3 * len(sample.vertices)
    matrix, right = _held(problem, sample, subject.person, ring)
    kept = []
    for pose, trans, target in zip(subject.pose, subject.trans, targets, strict=True):
        one = _normal_equations(rig, sample, subject.person, pose, target - trans, damping)
        one.add_to(matrix, right)
        solved = solve_triangular(one.factor, np.column_stack([one.cross.T, one.pull]), lower=True, check_finite=False)
        matrix = dsyrk(-1.0, solved[:, :-1], beta=1.0, c=matrix, trans=1, lower=1, overwrite_c=1)
        right -= solved[:, :-1].T @ solved[:, -1]
        kept.append((one.factor, solved))
    matrix[np.diag_indices(len(matrix))] += damping * np.abs(matrix.diagonal()) + 1e-9
    found = cho_solve(cho_factor(matrix, lower=True, overwrite_a=True), right)
    turns = [solve_triangular(f, s[:, -1] - s[:, :-1] @ found, lower=True, trans=1) for f, s in kept]
    return found[:size], found[size:], np.stack(turns)


@dataclass(frozen=True, eq=False)
class _Normal:
    """One registration's normal equations: its pose and place (3 J + 3 numbers), and what it shares with the others.

    ``factor`` is the Cholesky factor of the pose's own block, ``cross`` couples rest vertices and joints to it, and
    ``pull`` and ``shared_pull`` are the right sides. ``spread`` are the transposed slopes by rest vertices.
    """

    factor: Float[np.ndarray, "p p"]
    cross: Float[np.ndarray, "s p"]
    pull: Float[np.ndarray, " p"]
    shared_pull: Float[np.ndarray, " s"]
    spread: Float[np.ndarray, "U 3 3"]
    by_joints: Float[np.ndarray, "R C"]

    def add_to(self, matrix: np.ndarray, right: np.ndarray) -> None:
        """The blocks of rest vertices and joints."""
        size, by_joints = len(self.by_joints), self.by_joints
        _add_blocks(matrix, self.spread @ self.spread.transpose(0, 2, 1))
        between = (self.spread @ by_joints.reshape(-1, 3, by_joints.shape[1])).reshape(size, -1)
        matrix[size:, :size] += between.T
        matrix[size:, size:] += by_joints.T @ by_joints
        right += self.shared_pull


def _normal_equations(
    rig: Rig, sample: Sample, person: Person, pose: np.ndarray, target: np.ndarray, damping: float
) -> _Normal:
    """Gauss-Newton, each vertex weighed by how many it stands for; ``target`` (m) is the registration less place."""
    size = 3 * len(sample.vertices)
    root = np.sqrt(np.repeat(sample.count, 3))
    moved, by_pose, turn, by_joints = surface_and_slopes(rig, person, pose)
    left = root * (target - moved).ravel()
    own = root[:, None] * np.concatenate([by_pose.reshape(size, -1), np.tile(np.eye(3), (len(turn), 1))], 1)
    by_joints = root[:, None] * by_joints.reshape(size, -1)
    hess = own.T @ own
    factor = np.linalg.cholesky(hess + np.diag(damping * hess.diagonal() + 1e-12))
    spread = (root.reshape(-1, 3, 1) * turn).transpose(0, 2, 1)
    cross = np.concatenate([(spread @ own.reshape(-1, 3, own.shape[1])).reshape(size, -1), by_joints.T @ own])
    shared = np.concatenate([(spread @ left.reshape(-1, 3, 1)).ravel(), by_joints.T @ left])
    return _Normal(factor, cross, own.T @ left, shared, spread, by_joints)


def _add_blocks(matrix: np.ndarray, blocks: Float[np.ndarray, "U 3 3"]) -> None:
    """Add to the 3x3 blocks of the diagonal."""
    rows = np.arange(3 * len(blocks)).reshape(-1, 3)
    matrix[rows[:, :, None], rows[:, None, :]] += blocks


def _held(problem: Problem, sample: Sample, person: Person, ring: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half the second derivative of E_Y and E_J over the sample, and half their negative gradient."""
    weights, count = problem.options.weights, len(sample.vertices)
    size, columns = 3 * count, person.joints.size
    matrix, right = np.zeros((size + columns, size + columns), order="F"), np.zeros(size + columns)
    if problem.anatomy.mirror is not None:
        rows, other = np.arange(count), sample.partner
        scale = 2 * weights.symmetry * sample.count
        for axis, flip in enumerate(FLIP):
            matrix[3 * rows + axis, 3 * rows + axis] += scale
            matrix[3 * rows + axis, 3 * other + axis] -= scale * flip
    matrix[size:, size:] += weights.joints * np.eye(columns)
    if problem.anatomy.joint_mirror is not None:
        form = joint_asymmetry(problem.anatomy.joint_mirror)
        matrix[size:, size:] += weights.symmetry * weights.joint_symmetry * form
    right -= matrix @ np.concatenate([person.template.ravel(), person.joints.ravel()])
    right[size:] += weights.joints * ring.ravel()
    return matrix, right
