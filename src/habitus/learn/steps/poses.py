"""The pose of a registration: by vertices for a known person (S 4.1), by edges for an unknown one
(S 4.2, eq. 15).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from habitus.body.pose_features import POSE_FEATURES
from habitus.learn.estimate import weighted
from habitus.learn.posing.kernels import (
    blend_shape_jacobian,
    dual_pose_jacobian,
    linear_pose_jacobian,
)
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.posing.surface import (
    Posed,
    pose_feature,
    posed,
    rest_surface,
    signed_value,
    world_quaternions,
)
from habitus.mesh.laplacian import eliminate_holes, fill_holes
from habitus.rotations import left_jacobian
from habitus.solve.least_squares import Levenberg, Tolerances, descend
from habitus.solve.terms import Term

_TOLERANCES = Tolerances(cost=1e-9, step=1e-8, gradient=1e-9)


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Pose (rotation vectors, rad), translation (m), and the remaining energy (m^2)."""

    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    energy: float


class SurfaceDistance(Protocol):
    """A sum of squares of a linear residual of the difference between two surfaces, whatever their
    translation.
    """

    @property
    def name(self) -> str:
        """Of the term."""
        ...

    @property
    def weight(self) -> Float[np.ndarray, " V"] | None:
        """How much vertices count, 0 to 1; None where all count alike."""
        ...

    def residual(self, difference: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "R 3"]:
        """The residual (m)."""
        ...

    def energy(self, difference: Float[np.ndarray, "V 3"]) -> float:
        """The sum of squares (m^2)."""
        ...

    def normal_equations(
        self, difference: Float[np.ndarray, "V 3"], jacobian: Float[np.ndarray, "V 3 C"]
    ) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, "C C"]]:
        """Gradient and Gauss-Newton matrix of half the energy, without forming the residual's
        Jacobian.
        """
        ...


@dataclass(frozen=True, eq=False)
class VertexDistance:
    """E_D (S 4.1), minimised over the translation: distances of vertices after the best shift, each
    times the root of its ``weight``.
    """

    weight: Float[np.ndarray, " V"] | None = None
    name = "data"

    def residual(self, difference: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """Differences of vertices without their mean."""
        away = difference - mean_of(difference, self.weight)
        return away if self.weight is None else weighted(away, np.sqrt(self.weight))

    def energy(self, difference: Float[np.ndarray, "V 3"]) -> float:
        """The sum of squared distances (m^2)."""
        return float((self.residual(difference) ** 2).sum())

    def normal_equations(
        self, difference: Float[np.ndarray, "V 3"], jacobian: Float[np.ndarray, "V 3 C"]
    ) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, "C C"]]:
        """Gradient and Gauss-Newton matrix of half of it."""
        flat = jacobian.reshape(-1, jacobian.shape[-1])
        mean = mean_of(jacobian, self.weight)
        heavy = weighted(jacobian, self.weight).reshape(flat.shape)
        gradient = heavy.T @ (difference - mean_of(difference, self.weight)).ravel()
        total = len(jacobian) if self.weight is None else self.weight.sum()
        return gradient, flat.T @ heavy - total * (mean.T @ mean)


@dataclass(frozen=True, eq=False)
class EdgeDistance:
    """E_R (eq. 15): differences between the edges of two surfaces; ``laplacian`` is the graph
    Laplacian of the mesh.

    With weights of vertices an edge counts as much as those of its ends say together. Edges that
    end in a hole count as where their ends differ least (the difference is harmonic in the hole):
    they hold together what lies around it. ``laplacian`` is then that of the vertices that are
    seen.
    """

    edges: Int[np.ndarray, "E 2"]
    laplacian: csr_array
    weight: Float[np.ndarray, " V"] | None = None
    weighted_laplacian: csr_array | None = None
    name = "edges"

    def residual(self, difference: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "E 3"]:
        """Differences of edges."""
        if self.weight is None or self.weighted_laplacian is None:
            return difference[self.edges[:, 0]] - difference[self.edges[:, 1]]
        difference = fill_holes(self.weighted_laplacian, self.weight > 0, difference)
        along = difference[self.edges[:, 0]] - difference[self.edges[:, 1]]
        return weighted(along, np.sqrt(_edge_weights(self.edges, self.weight)))

    def weighted(self, weight: Float[np.ndarray, " V"] | None) -> "EdgeDistance":
        """The same with weights of vertices."""
        if weight is None:
            return self
        whole = _laplacian(self.edges, len(weight), _edge_weights(self.edges, weight))
        return EdgeDistance(self.edges, eliminate_holes(whole, weight > 0), weight, whole)

    def energy(self, difference: Float[np.ndarray, "V 3"]) -> float:
        """The sum of squared differences of edges (m^2)."""
        return max(0.0, float((difference * (self.laplacian @ difference)).sum()))

    def normal_equations(
        self, difference: Float[np.ndarray, "V 3"], jacobian: Float[np.ndarray, "V 3 C"]
    ) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, "C C"]]:
        """Gradient and Gauss-Newton matrix of half of it."""
        count = jacobian.shape[-1]
        spread = (self.laplacian @ jacobian.reshape(len(jacobian), -1)).reshape(-1, count)
        return spread.T @ difference.ravel(), spread.T @ jacobian.reshape(-1, count)


def edge_distance(faces: Int[np.ndarray, "F 3"], vertices: int) -> EdgeDistance:
    """Every edge of the mesh counted once."""
    pairs = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    return EdgeDistance(pairs, _laplacian(pairs, vertices, np.ones(len(pairs))))


def _edge_weights(
    edges: Int[np.ndarray, "E 2"], weight: Float[np.ndarray, " V"]
) -> Float[np.ndarray, " E"]:
    """The product of those of the ends; a hole's is taken as 1."""
    ends = np.where(weight > 0, weight, 1.0)[edges]
    return ends[:, 0] * ends[:, 1]


def _laplacian(
    edges: Int[np.ndarray, "E 2"], vertices: int, weight: Float[np.ndarray, " E"]
) -> csr_array:
    ends = np.concatenate([edges, edges[:, ::-1]])
    both = np.concatenate([weight, weight])
    joined = csr_array((both, (ends[:, 0], ends[:, 1])), shape=(vertices, vertices))
    degree = np.bincount(ends[:, 0], both, minlength=vertices)
    diagonal = csr_array(
        (degree, (np.arange(vertices), np.arange(vertices))), shape=(vertices, vertices)
    )
    return (diagonal - joined).tocsr()


def mean_of(
    rows: Float[np.ndarray, "V ..."], weight: Float[np.ndarray, " V"] | None
) -> Float[np.ndarray, "..."]:
    """The mean over vertices, each as much as it counts."""
    return (
        rows.mean(0)
        if weight is None
        else np.tensordot(weight, rows, 1) / max(float(weight.sum()), 1e-300)
    )


def pose_terms(
    rig: Rig,
    person: RestPerson,
    target: Float[np.ndarray, "V 3"],
    distance: SurfaceDistance = VertexDistance(),
) -> dict[str, Term]:
    """The objective of `fit_pose` as a term of the unknown ``pose`` (J,3): the distance's residual
    and its Jacobian.

    `SurfaceDistance.normal_equations` are those of this term, without its (R, 3 J) Jacobian being
    formed.
    """

    def residual(pose: np.ndarray) -> tuple[np.ndarray, Callable[[], dict[str, np.ndarray]]]:
        here = _PosedPerson.at(rig, person, pose)

        def jacobians() -> dict[str, np.ndarray]:
            columns = np.moveaxis(here.pose_jacobian(), -1, 0)
            return {"pose": np.stack([distance.residual(column).ravel() for column in columns], 1)}

        return distance.residual(here.moved - target).ravel(), jacobians

    return {distance.name: Term(residual, 2.0, name=distance.name)}


def fit_pose(
    rig: Rig,
    person: RestPerson,
    target: Float[np.ndarray, "V 3"],
    start: Float[np.ndarray, "J 3"],
    *,
    distance: SurfaceDistance = VertexDistance(),
    max_iterations: int = 3,
    tolerances: Tolerances = _TOLERANCES,
) -> PoseFit:
    """The pose that takes a person's surface to a registration (m), by Levenberg-Marquardt with
    exact derivatives.

    The energy never rises above that of ``start`` (rotation vectors, rad).
    """

    def problem(x: np.ndarray) -> tuple[float, Callable[[], tuple[np.ndarray, np.ndarray]]]:
        here = _PosedPerson.at(rig, person, x.reshape(-1, 3))
        difference = here.moved - target
        return 0.5 * distance.energy(difference), lambda: distance.normal_equations(
            difference, here.pose_jacobian()
        )

    solution = descend(
        problem,
        start.ravel(),
        Levenberg(1e-4),
        max_iterations=max_iterations,
        tolerances=tolerances,
        callback=None,
    )
    pose = _shortest(rig, solution.x.reshape(-1, 3))
    trans = mean_of(target - _PosedPerson.at(rig, person, pose).moved, distance.weight)
    return PoseFit(pose, trans, 2.0 * solution.cost)


@dataclass(frozen=True, eq=False)
class _PosedPerson:
    """A person in a pose, and how the surface moves as the pose changes."""

    person: RestPerson
    pose: Float[np.ndarray, "J 3"]
    applied: Posed
    rest: Float[np.ndarray, "V 3"]
    moved: Float[np.ndarray, "V 3"]

    @staticmethod
    def at(rig: Rig, person: RestPerson, pose: Float[np.ndarray, "J 3"]) -> "_PosedPerson":
        applied = posed(rig, pose)
        rest = rest_surface(rig, person, pose)
        return _PosedPerson(person, pose, applied, rest, applied.vertices(rest, person.joints))

    def pose_jacobian(self) -> Float[np.ndarray, "V 3 C"]:
        """Exact derivative by the rotation vectors, C = 3 J, pose blend shapes included."""
        rig = self.applied.rig
        bones = self.applied.skeleton
        by_rotvec = left_jacobian(self.pose)
        rows = np.zeros((rig.num_vertices, 3, rig.num_joints, 3))
        _POSE_JACOBIANS[rig.skinning](self, bones.above @ by_rotvec, rows)
        posedirs = rig.posedirs_for(self.person.descriptor)
        if posedirs is not None:
            pose_feature_jacobian = POSE_FEATURES[rig.pose_features].slope(self.pose) @ by_rotvec
            blend_shape_jacobian(self.applied.turn, posedirs, pose_feature_jacobian[1:], rows)
        return rows.reshape(rig.num_vertices, 3, -1)


def surface_jacobians(
    rig: Rig, person: RestPerson, pose: Float[np.ndarray, "J 3"]
) -> tuple[
    Float[np.ndarray, "V 3"],
    Float[np.ndarray, "V 3 C"],
    Float[np.ndarray, "V 3 3"],
    Float[np.ndarray, "V 3 C"],
]:
    """A person's posed surface (m, without ``trans``), exact derivatives by rotation vectors (C = 3
    J), by the rest surface (each vertex by its own), and by the rest joints (C = 3 J).
    """
    here = _PosedPerson.at(rig, person, pose)
    return here.moved, here.pose_jacobian(), here.applied.turn, here.applied.joint_jacobian()


def _linear_jacobian(
    here: _PosedPerson, axes: Float[np.ndarray, "J 3 3"], rows: Float[np.ndarray, "V 3 J 3"]
) -> None:
    rig = here.applied.rig
    bones = here.applied.skeleton
    joints = here.person.joints
    motions = np.concatenate([bones.world, bones.translations(joints)[..., None]], -1)
    linear_pose_jacobian(
        rig.index,
        rig.value,
        here.rest,
        motions,
        bones.positions(joints),
        rig.parent_index,
        axes,
        rows,
    )


def _dual_jacobian(
    here: _PosedPerson, axes: Float[np.ndarray, "J 3 3"], rows: Float[np.ndarray, "V 3 J 3"]
) -> None:
    rig = here.applied.rig
    bones = here.applied.skeleton
    joints = here.person.joints
    quaternions = world_quaternions(bones)
    signed = signed_value(rig, quaternions)
    translations = bones.translations(joints)
    positions = bones.positions(joints)
    dual_pose_jacobian(
        rig.index,
        signed,
        here.rest,
        here.moved,
        quaternions,
        translations,
        positions,
        rig.parent_index,
        axes,
        rows,
    )


_POSE_JACOBIANS = {"lbs": _linear_jacobian, "dqbs": _dual_jacobian}


def _shortest(rig: Rig, pose: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3"]:
    """The same rotations by vectors no longer than half a turn, unless blend shapes tell the
    vectors apart.
    """
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    turns = np.round(angle / (2 * np.pi))
    short = np.where(
        turns > 0, pose * (1 - 2 * np.pi * turns / np.where(angle > 0, angle, 1)), pose
    )
    if rig.posedirs is None or np.allclose(
        pose_feature(rig, short), pose_feature(rig, pose), atol=1e-9
    ):
        return short
    return np.concatenate([short[:1], pose[1:]])
