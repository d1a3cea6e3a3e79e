"""The energy of training (S 4.1, eq. 14) as a dictionary of named terms of named unknowns.

    E = E_D + lambda_Y E_Y + lambda_J E_J + lambda_P E_P + mu N E_R + lambda_W E_W

E_R, the prior of local pose blend shapes at rotations that no registration shows, is not the
paper's (`habitus.learn.posing.rotation_prior`); N is the number of registrations.

A term costs 1/2 weight |residual|^2: weights here are twice the paper's lambdas, and the costs sum
to E (m^2). Unknowns: ``templates`` (S,V,3; m) and ``joints`` (S,J,3; m), the subjects' rest
surfaces and joints; ``pose`` (N,J,3; rad) and ``trans`` (N,3; m) of the registrations;
``skinning_weights`` (V,J); ``posedirs`` (V,3,F; m), if there are any.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int

from habitus.body.pose_features import POSE_FEATURES
from habitus.learn.estimate import Anatomy, Estimate, PosedTarget, Problem, posed_targets, weighted
from habitus.learn.options import EnergyWeights
from habitus.learn.posing.rig import RestPerson, Rig, influences
from habitus.learn.posing.rotation_prior import rotation_gram
from habitus.learn.posing.surface import surface
from habitus.parallel.workers import Workers, in_blocks
from habitus.solve.terms import Term

FLIP = np.array([-1.0, 1.0, 1.0])
"""Mirrors a point or a direction across the sagittal plane x = 0."""
Unknowns = dict[str, np.ndarray]
Sparse = Any
"""A scipy.sparse.csr_array."""
Jacobians = Callable[[], dict[str, Sparse]]


def energy_terms(problem: Problem, estimate: Estimate) -> dict[str, Term]:
    """Eq. 14, every term. ``estimate`` gives what is no unknown: skinning, pose features, subjects'
    descriptors.
    """
    return {
        "data": data_term(problem, estimate),
        **regularizer_terms(problem, estimate.rig.posedirs is not None),
    }


def regularizer_terms(problem: Problem, pose_shapes: bool = True) -> dict[str, Term]:
    """Eq. 14 without E_D; without E_P where there are no pose blend shapes."""
    options = problem.options
    terms = subject_terms(problem.anatomy, options.weights)
    if pose_shapes:
        absolute = options.pose_shapes == "l1"
        weight = options.l1 if absolute else options.weights.pose_shapes
        terms["pose_shapes"] = pose_shape_term(weight, absolute=absolute)
    if pose_shapes and options.rotation_prior and options.pose_shapes == "local":
        weight = options.rotation_prior * len(problem.registrations)
        terms["rotations"] = rotation_term(
            weight, rotation_gram(POSE_FEATURES[options.pose_features])
        )
    terms["skinning"] = skinning_term(options.weights.skinning, problem.initial_weights)
    return terms


def unknowns(estimate: Estimate) -> Unknowns:
    """The unknowns' values in an estimate, by name."""
    values = {name: getattr(estimate, name) for name in ("templates", "joints", "pose", "trans")}
    values["skinning_weights"] = estimate.rig.weights
    if estimate.rig.posedirs is not None:
        values["posedirs"] = estimate.rig.posedirs
    return values


def costs(terms: Mapping[str, Term], values: Mapping[str, Any]) -> dict[str, float]:
    """The weighted cost of each term (m^2)."""
    return {name: term.weight * float(term(values).cost) for name, term in terms.items()}


# -- E_D -------------------------------------------------------------------------------------------


def data_residual(rig: Rig, person: RestPerson, target: PosedTarget) -> Float[np.ndarray, "V 3"]:
    """E_D of one registration: the posed person minus the registration (m), times the root of
    vertices' weights.
    """
    away = surface(rig, person, target.pose) + (target.trans - target.vertices)
    return away if target.weight is None else weighted(away, np.sqrt(target.weight))


def data_term(problem: Problem, estimate: Estimate) -> Term:
    """E_D over all registrations. `measure_energy` sums the same residuals a block of registrations
    at a time.
    """

    def residual(**values: np.ndarray) -> np.ndarray:
        here = _with_unknowns(estimate, **values)
        targets = posed_targets(problem, here, range(len(problem.registrations)))
        return np.stack([data_residual(here.rig, person, target) for person, target in targets])

    return Term(residual, 2.0, name="data", takes=tuple(unknowns(estimate)))


def _with_unknowns(
    estimate: Estimate,
    templates: np.ndarray,
    joints: np.ndarray,
    pose: np.ndarray,
    trans: np.ndarray,
    skinning_weights: np.ndarray,
    posedirs: np.ndarray | None = None,
) -> Estimate:
    index, value = influences(skinning_weights, estimate.rig.index.shape[1])
    rig = replace(estimate.rig, index=index, value=value, posedirs=posedirs)
    return replace(estimate, rig=rig, templates=templates, joints=joints, pose=pose, trans=trans)


# -- E_Y and E_J -----------------------------------------------------------------------------------


def subject_terms(anatomy: Anatomy, weights: EnergyWeights) -> dict[str, Term]:
    """E_Y and E_J of all subjects, or of one (``templates`` (V,3), ``joints`` (J,3))."""
    return {
        "symmetry": symmetry_term(anatomy.mirror, anatomy.joint_mirror, weights),
        "joints": joints_term(weights, regressor=anatomy.regressor),
    }


def symmetry_term(
    mirror: Int[np.ndarray, " V"] | None,
    joint_mirror: Int[np.ndarray, " J"] | None,
    weights: EnergyWeights,
    count: Float[np.ndarray, " V"] | None = None,
) -> Term:
    """E_Y: |T - U(T)|^2 + lambda_U |J - U(J)|^2; each vertex counts ``count`` times; zero without
    mirrors.
    """
    parts: dict[str, tuple[np.ndarray, np.ndarray | float]] = {}
    if mirror is not None:
        parts["templates"] = mirror, 1.0 if count is None else np.sqrt(count)[:, None]
    if joint_mirror is not None:
        parts["joints"] = joint_mirror, np.sqrt(weights.joint_symmetry)

    def residual(**points: np.ndarray) -> tuple[np.ndarray, Jacobians]:
        rows = [
            (scale * (points[name] - points[name][..., partner, :] * FLIP)).ravel()
            for name, (partner, scale) in parts.items()
        ]
        return np.concatenate([*rows, np.zeros(int(not rows))]), lambda: _stacked(
            {name: _repeated(asymmetry(*part), points[name]) for name, part in parts.items()}
        )

    return Term(residual, 2.0 * weights.symmetry, name="symmetry", takes=tuple(parts))


def joints_term(
    weights: EnergyWeights,
    *,
    regressor: Float[np.ndarray, "J V"] | None = None,
    ring: Float[np.ndarray, "J 3"] | None = None,
) -> Term:
    """E_J: |J_I T - J|^2; a given ``ring`` stands for J_I T."""

    def of_regressor(templates: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, Jacobians]:
        assert regressor is not None
        by_template = sparse.csr_array(np.kron(regressor, np.eye(3)))
        return (regressor @ templates - joints).ravel(), lambda: {
            "templates": _repeated(by_template, templates),
            "joints": -sparse.eye_array(joints.size, format="csr"),
        }

    def of_ring(joints: np.ndarray) -> tuple[np.ndarray, Jacobians]:
        return (ring - joints).ravel(), lambda: {
            "joints": -sparse.eye_array(joints.size, format="csr")
        }

    if ring is not None:
        return Term(of_ring, 2.0 * weights.joints, name="joints")
    return Term(of_regressor, 2.0 * weights.joints, name="joints")


def asymmetry(partner: Int[np.ndarray, " n"], scale: np.ndarray | float = 1.0) -> Sparse:
    """The matrix (3n, 3n) that takes flattened points X to scale (X - U(X))."""
    count = len(partner)
    swap = sparse.csr_array((np.ones(count), (np.arange(count), partner)), shape=(count, count))
    difference: Sparse = sparse.eye_array(3 * count) - sparse.kron(swap, sparse.diags_array(FLIP))
    scales: Sparse = sparse.diags_array(np.broadcast_to(scale, (count, 3)).ravel())
    return (scales @ difference).tocsr()


def _repeated(matrix: Sparse, points: Float[np.ndarray, "*S n 3"]) -> Sparse:
    """The block-diagonal matrix for all subjects."""
    subjects = points.size // matrix.shape[1]
    return (
        matrix if subjects == 1 else sparse.kron(sparse.eye_array(subjects), matrix, format="csr")
    )


def _stacked(parts: dict[str, Sparse]) -> dict[str, Sparse]:
    """Jacobians of residuals that follow each other, each of one unknown."""
    rows = [part.shape[0] for part in parts.values()]
    stacked = {}
    for k, (name, part) in enumerate(parts.items()):
        blocks = [
            part if i == k else sparse.csr_array((n, part.shape[1])) for i, n in enumerate(rows)
        ]
        stacked[name] = sparse.vstack(blocks, format="csr")
    return stacked


# -- E_P and E_W -----------------------------------------------------------------------------------


def pose_shape_term(weight: float, *, absolute: bool = False) -> Term:
    """E_P: |P|^2, or with ``absolute`` the sum of absolute values |P|_1 = |sqrt|P||^2 (S 4.1's
    remark).
    """

    def residual(posedirs: np.ndarray) -> np.ndarray:
        return np.sqrt(np.abs(posedirs)) if absolute else posedirs

    return Term(residual, 2.0 * weight, name="pose_shapes")


def rotation_term(weight: float, gram: Float[np.ndarray, "k k"]) -> Term:
    """E_R: sum of tr(P_j G_w P_j') over the joints, G_w a ``gram`` of their features."""
    factor = np.linalg.cholesky(gram)

    def residual(posedirs: np.ndarray) -> np.ndarray:
        return posedirs.reshape(-1, len(factor)) @ factor

    return Term(residual, 2.0 * weight, name="rotations")


def skinning_term(weight: float, initial: Float[np.ndarray, "V J"]) -> Term:
    """E_W: |W - W_I|^2."""
    return Term(lambda skinning_weights: skinning_weights - initial, 2.0 * weight, name="skinning")


# -- normal equations ------------------------------------------------------------------------------


def normal_equations(
    terms: Mapping[str, Term], values: Mapping[str, Any]
) -> tuple[Float[np.ndarray, "C C"], Float[np.ndarray, " C"]]:
    """Gauss-Newton matrix and gradient of the costs over all ``values``, one after the other, from
    sparse Jacobians.
    """
    ends = np.cumsum([value.size for value in values.values()])
    columns = {
        name: slice(end - value.size, end)
        for end, (name, value) in zip(ends, values.items(), strict=True)
    }
    matrix = np.zeros((ends[-1], ends[-1]), order="F")
    gradient = np.zeros(ends[-1])
    for term in terms.values():
        outcome = term(values)
        assert callable(outcome.jacobians)
        jacobians = outcome.jacobians()
        residual = np.asarray(outcome.value)
        for name, jacobian in jacobians.items():
            gradient[columns[name]] += term.weight * (jacobian.T @ residual)
            for other, two in jacobians.items():
                matrix[columns[name], columns[other]] += term.weight * (jacobian.T @ two).toarray()
    return matrix, gradient


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
