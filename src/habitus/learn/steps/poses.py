"""The pose of a registration: of a known person by vertices (S 4.1), of an unknown one by edges (S 4.2, eq. 15)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from habitus.body.pose_features import POSE_FEATURES
from habitus.learn.posing.kernels import blend_shape_turns, dual_turns, linear_turns
from habitus.learn.posing.rig import Person, Rig
from habitus.learn.posing.surface import Posed, pose_feature, posed, rest_surface, signed_value, world_quaternions
from habitus.rotations import left_jacobian
from habitus.solve.least_squares import Tolerances, descend
from habitus.solve.levenberg import Damped

_TOLERANCES = Tolerances(cost=1e-9, step=1e-8, gradient=1e-9)


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A pose (rotation vectors, rad), the place (m), and the energy that is left (m^2)."""

    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    energy: float


class Metric(Protocol):
    """What of the difference between two surfaces counts: squares of vertices, or of edges."""

    def energy(self, difference: Float[np.ndarray, "V 3"]) -> float:
        """The sum of squares."""
        ...

    def normal(
        self, difference: Float[np.ndarray, "V 3"], rows: Float[np.ndarray, "V 3 C"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (C,) and Gauss-Newton matrix (C, C) of half of it."""
        ...


@dataclass(frozen=True)
class ByVertices:
    """Squared distances of vertices after the best shift: the place is solved for, not searched (S 4.1, E_D)."""

    def energy(self, difference: Float[np.ndarray, "V 3"]) -> float:
        """The sum of squared distances (m^2)."""
        return float(((difference - difference.mean(0)) ** 2).sum())

    def normal(
        self, difference: Float[np.ndarray, "V 3"], rows: Float[np.ndarray, "V 3 C"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (C,) and Gauss-Newton matrix (C, C) of half of it."""
        flat, mean = rows.reshape(-1, rows.shape[-1]), rows.mean(0)
        gradient = flat.T @ (difference - difference.mean(0)).ravel()
        return gradient, flat.T @ flat - len(rows) * (mean.T @ mean)


@dataclass(frozen=True, eq=False)
class ByEdges:
    """Squared differences of edges, whatever the place (eq. 15); ``laplacian`` sums them over the mesh."""

    laplacian: csr_array

    def energy(self, difference: Float[np.ndarray, "V 3"]) -> float:
        """The sum of squared differences of edges (m^2)."""
        return max(0.0, float((difference * (self.laplacian @ difference)).sum()))

    def normal(
        self, difference: Float[np.ndarray, "V 3"], rows: Float[np.ndarray, "V 3 C"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (C,) and Gauss-Newton matrix (C, C) of half of it."""
        spread = (self.laplacian @ rows.reshape(len(rows), -1)).reshape(-1, rows.shape[-1])
        return spread.T @ difference.ravel(), spread.T @ rows.reshape(-1, rows.shape[-1])


def edge_metric(faces: Int[np.ndarray, "F 3"], vertices: int) -> ByEdges:
    """Every edge of the mesh counted once."""
    pairs = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    ends, ones = np.concatenate([pairs, pairs[:, ::-1]]), np.ones(2 * len(pairs))
    joined = csr_array((ones, (ends[:, 0], ends[:, 1])), shape=(vertices, vertices))
    degree = np.bincount(ends[:, 0], minlength=vertices).astype(float)
    diagonal = csr_array((degree, (np.arange(vertices), np.arange(vertices))), shape=(vertices, vertices))
    return ByEdges((diagonal - joined).tocsr())


def fit_pose(
    rig: Rig,
    person: Person,
    target: Float[np.ndarray, "V 3"],
    start: Float[np.ndarray, "J 3"],
    *,
    metric: Metric = ByVertices(),
    max_iterations: int = 3,
    tolerances: Tolerances = _TOLERANCES,
) -> PoseFit:
    """The pose that takes a person's surface to a registration (m), by Levenberg-Marquardt with exact derivatives.

    The energy never rises above that of ``start`` (rotation vectors, rad).
    """

    def problem(x: np.ndarray) -> tuple[float, Callable[[], tuple[np.ndarray, np.ndarray]]]:
        here = _Here.at(rig, person, x.reshape(-1, 3))
        difference = here.moved - target
        return 0.5 * metric.energy(difference), lambda: metric.normal(difference, here.by_pose())

    found = descend(
        problem, start.ravel(), Damped(1e-4), max_iterations=max_iterations, tolerances=tolerances, callback=None
    )
    pose = _shortest(rig, found.x.reshape(-1, 3))
    trans = (target - _Here.at(rig, person, pose).moved).mean(0)
    return PoseFit(pose, trans, 2.0 * found.cost)


@dataclass(frozen=True, eq=False)
class _Here:
    """A person in a pose, and how the surface moves as the pose changes."""

    person: Person
    pose: Float[np.ndarray, "J 3"]
    applied: Posed
    rest: Float[np.ndarray, "V 3"]
    moved: Float[np.ndarray, "V 3"]

    @staticmethod
    def at(rig: Rig, person: Person, pose: Float[np.ndarray, "J 3"]) -> "_Here":
        applied, rest = posed(rig, pose), rest_surface(rig, person, pose)
        return _Here(person, pose, applied, rest, applied.vertices(rest, person.joints))

    def by_pose(self) -> Float[np.ndarray, "V 3 C"]:
        """Derivative by the rotation vectors, C = 3 J. Nothing is left out."""
        rig, bones = self.applied.rig, self.applied.skeleton
        by_rotvec = left_jacobian(self.pose)
        rows = np.zeros((rig.num_vertices, 3, rig.num_joints, 3))
        _TURNS[rig.skinning](self, bones.above @ by_rotvec, rows)
        posedirs = rig.posedirs_for(self.person.descriptor)
        if posedirs is not None:
            slope = POSE_FEATURES[rig.pose_features].slope(self.pose) @ by_rotvec
            blend_shape_turns(self.applied.turn, posedirs, slope[1:], rows)
        return rows.reshape(rig.num_vertices, 3, -1)


def surface_and_slopes(
    rig: Rig, person: Person, pose: Float[np.ndarray, "J 3"]
) -> tuple[
    Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3 C"], Float[np.ndarray, "V 3 3"], Float[np.ndarray, "V 3 C"]
]:
    """A person's posed surface (m, without ``trans``), exact derivatives by rotation vectors (C = 3 J), by the rest
    surface (each vertex by its own), and by the rest joints (C = 3 J)."""
    here = _Here.at(rig, person, pose)
    return here.moved, here.by_pose(), here.applied.turn, here.applied.by_joints()


def _linear_turns(here: _Here, axes: Float[np.ndarray, "J 3 3"], rows: Float[np.ndarray, "V 3 J 3"]) -> None:
    rig, bones, joints = here.applied.rig, here.applied.skeleton, here.person.joints
    motions = np.concatenate([bones.world, bones.shifts(joints)[..., None]], -1)
    linear_turns(rig.index, rig.value, here.rest, motions, bones.places(joints), rig.parent_index, axes, rows)


def _dual_turns(here: _Here, axes: Float[np.ndarray, "J 3 3"], rows: Float[np.ndarray, "V 3 J 3"]) -> None:
    rig, bones, joints = here.applied.rig, here.applied.skeleton, here.person.joints
    quaternions = world_quaternions(bones)
    signed, shifts, places = signed_value(rig, quaternions), bones.shifts(joints), bones.places(joints)
    dual_turns(rig.index, signed, here.rest, here.moved, quaternions, shifts, places, rig.parent_index, axes, rows)


_TURNS = {"lbs": _linear_turns, "dqbs": _dual_turns}


def _shortest(rig: Rig, pose: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3"]:
    """The same rotations by vectors no longer than half a turn, unless blend shapes tell the vectors apart."""
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    turns = np.round(angle / (2 * np.pi))
    short = np.where(turns > 0, pose * (1 - 2 * np.pi * turns / np.where(angle > 0, angle, 1)), pose)
    if rig.posedirs is None or np.allclose(pose_feature(rig, short), pose_feature(rig, pose), atol=1e-9):
        return short
    return np.concatenate([short[:1], pose[1:]])
