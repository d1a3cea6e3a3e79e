"""The one geometric observation: points of a posed body and where they should be (T 4.6.1, 5.4).

    f = 1/2 sum_p (q_p - t_p)' A_p (q_p - t_p),      A_p = sum_d n_pd n_pd'
    q_p = sum_k b_pk v_k(betas, pose) + trans        on a triangle (`PointObservations`)
    q_p = R_j(pose) o_p + x_j(betas, pose) + trans   rigid on joint j (`JointObservations`)

Markers, scan points, depth pixels, keypoints and registered vertices all say this, with 3x3
information A (1 / m^2) in place of a noise: a marker or registered vertex I / s^2, a scan or depth
point n n' / s^2 and a little along the surface, a keypoint the sum over cameras of G' G / s^2, G
being the derivative of its pixel. A is kept as its square roots n_pd. Matches, weights b and A are
held. Derivatives are exact, those of the pose blend shapes included. A point is moved by few
joints: the rows of one part's points are a small dense matrix over the joints that move that part.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import to_numpy
from habitus.body.jacobians import posed_skeleton, surface_jacobian
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.residuals.point_kernels import (
    mark_corners,
    move_vertices,
    place_points,
    place_vertices,
    points_cost,
    write_rows,
)
from habitus.residuals.surface_rig import SurfaceRig, surface_rig, with_hinges
from habitus.rotations import cross_matrix
from habitus.solve.arrow import ArrowMatrix
from habitus.solve.terms import Quadratic, Term
from habitus.types import Array

ROWS = 2048
"""Rows of the Jacobian at once, which a core's cache has room for."""
RECENT = 16
"""Posed skeletons that a solver keeps: two states of up to eight views."""


@dataclass(frozen=True, eq=False)
class PointObservations:
    """P points on a body's surface, by triangle and weights of its corners, and where they should
    be (m).

    ``directions`` (P, D, 3): the square root of each point's information (1 / m): its residuals are
    the products of q - t with its D directions. Zero directions do not count.
    """

    face: Int[np.ndarray, " P"]
    barycentric: Float[np.ndarray, "P 3"]
    target: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P D 3"]

    @staticmethod
    def to_planes(
        face: Int[np.ndarray, " P"],
        barycentric: Float[np.ndarray, "P 3"],
        target: Float[np.ndarray, "P 3"],
        normal: Float[np.ndarray, "P 3"],
        weight: Float[np.ndarray, " P"],
        slide: float = 0.0,
    ) -> "PointObservations":
        """Points drawn to the planes through their targets, and with ``slide`` times the weight to
        the targets: A = weight (n n' + slide I).
        """
        root = np.sqrt(weight)[:, None]
        if slide <= 0.0:
            return PointObservations(face, barycentric, target, (root * normal)[:, None])
        across = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        along = np.cross(normal, across)
        directions = np.stack(
            [np.sqrt(1.0 + slide) * normal, np.sqrt(slide) * across, np.sqrt(slide) * along], 1
        )
        return PointObservations(face, barycentric, target, root[..., None] * directions)

    @staticmethod
    def to_points(
        face: Int[np.ndarray, " P"],
        barycentric: Float[np.ndarray, "P 3"],
        target: Float[np.ndarray, "P 3"],
        weight: Float[np.ndarray, " P"],
    ) -> "PointObservations":
        """Points drawn to their targets: A = weight I, 0 where a point is missing (its target may
        then be NaN).
        """
        directions = np.sqrt(weight)[:, None, None] * np.eye(3)
        target = np.where(weight[:, None] > 0.0, target, 0.0)
        return PointObservations(face, barycentric, target, directions)


@dataclass(frozen=True, eq=False)
class JointObservations:
    """P points rigid on a joint's bone, at ``offset`` in its frame (m, zero: the joint itself), and
    where they should be; ``directions`` as in `PointObservations`.
    """

    joint: Int[np.ndarray, " P"]
    offset: Float[np.ndarray, "P 3"]
    target: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P D 3"]


Observations = PointObservations | JointObservations


class PointEquations(NamedTuple):
    """Cost f, gradient (N,) and Gauss-Newton matrix (N, N); N = B + 3 + 3 J: betas, trans, pose."""

    cost: float
    gradient: Float[np.ndarray, " N"]
    matrix: Float[np.ndarray, "N N"]


class _State(NamedTuple):
    betas: Float[np.ndarray, " B"]
    trans: Float[np.ndarray, " 3"]
    motions: Float[np.ndarray, "J 3 4"]
    joints: Float[np.ndarray, "J 3"]
    turns: Float[np.ndarray, "J 3 3"]
    shifts: Float[np.ndarray, "J 3 B"]
    below: Float[np.ndarray, "J J"]
    feature: Float[np.ndarray, "F 9"]
    change: Float[np.ndarray, "F 9 3"]
    hinges_by_betas: Float[np.ndarray, "H 9 S"]


class _Table(NamedTuple):
    vertices: Float[np.ndarray, "V 3"]
    by_betas: Float[np.ndarray, "V 3 B"]
    by_pose: Float[np.ndarray, "S 9"]


class _Points(NamedTuple):
    face: Int[np.ndarray, " P"]
    barycentric: Float[np.ndarray, "P 3"]
    target: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P D 3"]


@dataclass(frozen=True, eq=False)
class PointSolver:
    """A body made ready: `at` one state, `together` at the states of several observations of one
    person.

    A body that is no LBS body with blend shapes linear in R - I takes the slow way,
    `reference_equations`, throughout.
    """

    body: BodyModel
    rig: SurfaceRig | None
    part: Int[np.ndarray, " F"]
    part_joints: tuple[Int[np.ndarray, " _"], ...]
    _recent: list[tuple[bytes, _State]] = field(default_factory=list, repr=False)

    @staticmethod
    def of(body: BodyModel) -> "PointSolver":
        """Lay out the arrays of a body; to be made once."""
        plain = body.posedirs is None or (
            body.pose_features == "rotations" and not body.shape_features
        )
        if body.skinning != "lbs" or not plain:
            return PointSolver(body, None, np.zeros(body.num_faces, np.int64), ())
        rig, moves = surface_rig(body)
        strongest = np.take_along_axis(
            body.skinning_index, body.skinning_value.argmax(1)[:, None], 1
        )[:, 0]
        named, part = np.unique(strongest[body.faces[:, 0]], return_inverse=True)
        joints = tuple(
            np.flatnonzero(moves[body.faces[part == k]].any((0, 1))) for k in range(len(named))
        )
        return PointSolver(body, rig, part, joints)

    def at(
        self,
        betas: Float[np.ndarray, " B"],
        pose: Float[np.ndarray, "J 3"],
        trans: Float[np.ndarray, " 3"],
        observations: Observations,
    ) -> PointEquations:
        """The normal equations at one state (rotation vectors, rad; m)."""
        if self.rig is None or isinstance(observations, JointObservations):
            return reference_equations(self.body, betas, pose, trans, observations)
        table = self._table(betas, pose, trans, self._corners(observations))
        size = self.body.num_betas + 3 + 3 * self.body.num_joints
        part = self.part[observations.face]
        order = np.argsort(part, kind="stable")
        cost = 0.0
        ends = np.searchsorted(part[order], np.arange(len(self.part_joints) + 1))
        gradient = np.zeros(size)
        matrix = np.zeros((size, size))
        points = _contiguous(observations)
        for joints, begin, end in zip(self.part_joints, ends[:-1], ends[1:], strict=True):
            if end > begin:
                columns, part_cost, part_gradient, part_matrix = self._of_part(
                    table, points, order[begin:end], joints
                )
                cost += part_cost
                gradient[columns] += part_gradient
                matrix[np.ix_(columns, columns)] += part_matrix
        return PointEquations(cost, gradient, matrix)

    def cost(
        self,
        betas: Float[np.ndarray, " B"],
        pose: Float[np.ndarray, "J 3"],
        trans: Float[np.ndarray, " 3"],
        observations: Observations,
    ) -> float:
        """The cost alone, without derivatives."""
        if self.rig is None or isinstance(observations, JointObservations):
            off = point_residuals(self.body, betas, pose, trans, observations)
            return 0.5 * float(np.vdot(off, off))
        vertices = np.empty((self.body.num_vertices, 3))
        state = self._state(betas, pose, trans)
        place_vertices(self.rig, state, self._corners(observations), vertices, np.empty((4, 3)))
        return float(points_cost(self.rig, vertices, _contiguous(observations)))

    def together(
        self,
        betas: Float[np.ndarray, " B"],
        pose: Float[np.ndarray, "T J 3"],
        trans: Float[np.ndarray, "T 3"],
        observations: Sequence[PointObservations],
    ) -> tuple[float, Float[np.ndarray, " n"], ArrowMatrix]:
        """Cost, gradient and matrix of T observations that share betas: unknowns betas, then trans
        and pose of each.
        """
        each = [self.at(betas, *state) for state in zip(pose, trans, observations, strict=True)]
        head = self.body.num_betas
        shared = sum((equations.matrix[:head, :head] for equations in each), np.zeros((head, head)))
        top = sum((equations.gradient[:head] for equations in each), np.zeros(head))
        border = np.stack([equations.matrix[head:, :head] for equations in each])
        blocks = np.stack([equations.matrix[head:, head:] for equations in each])
        gradient = np.concatenate([top, *(equations.gradient[head:] for equations in each)])
        return (
            sum(equations.cost for equations in each),
            gradient,
            ArrowMatrix(shared, border, blocks),
        )

    def _corners(self, observations: PointObservations) -> Int[np.ndarray, " n"]:
        """The vertices that the points lie between."""
        marked = np.zeros(self.body.num_vertices, dtype=bool)
        mark_corners(self.body.faces, np.ascontiguousarray(observations.face), marked)
        return np.flatnonzero(marked)

    def _state(
        self,
        betas: Float[np.ndarray, " B"],
        pose: Float[np.ndarray, "J 3"],
        trans: Float[np.ndarray, " 3"],
    ) -> _State:
        """The posed skeleton and pose features, as the kernels take them; the latest are kept, as
        several terms and the next step ask for the same.
        """
        key = b"".join(np.asarray(part, float).tobytes() for part in (betas, pose, trans))
        for known, state in tuple(self._recent):
            if known == key:
                return state
        state = self._new_state(betas, pose, trans)
        self._recent.insert(0, (key, state))
        del self._recent[RECENT:]
        return state

    def _new_state(
        self,
        betas: Float[np.ndarray, " B"],
        pose: Float[np.ndarray, "J 3"],
        trans: Float[np.ndarray, " 3"],
    ) -> _State:
        body = self.body
        skeleton = posed_skeleton(body, body.rest_joints(betas), pose)
        feature = np.zeros((body.num_joints, 9))
        change = np.zeros((body.num_joints, 9, 3))
        if body.posedirs is not None:
            drivers = body.drivers
            feature[drivers] = body.features.of_pose(pose, skeleton.rotations, drivers).reshape(
                -1, 9
            )
            change[drivers] = body.features.slope(pose[drivers]) @ skeleton.local_turns[drivers]
        moved = (
            skeleton.motions,
            skeleton.world[..., 3],
            skeleton.turns,
            skeleton.shifts_betas,
            np.array(skeleton.below),
            *with_hinges(body.hinges, betas, feature, change),
        )
        arrays = (np.ascontiguousarray(array) for array in moved)
        return _State(np.array(betas, float), np.array(trans, float), *arrays)

    def _table(
        self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray, used: np.ndarray
    ) -> _Table:
        """Vertices and their derivatives where they are ``used``, anything elsewhere."""
        assert self.rig is not None
        shapes = (self.body.num_vertices, 3), self.rig.shapedirs.shape, (len(self.rig.joint), 9)
        table = _Table(*(np.empty(shape) for shape in shapes))
        move_vertices(self.rig, self._state(betas, pose, trans), used, *table, np.empty((4, 3)))
        return table

    def _of_part(
        self,
        table: _Table,
        points: _Points,
        some: Int[np.ndarray, " n"],
        joints: Int[np.ndarray, " j"],
    ) -> tuple[Int[np.ndarray, " c"], float, Float[np.ndarray, " c"], Float[np.ndarray, "c c"]]:
        """Columns, cost, gradient and matrix of the points ``some``, which the ``joints`` move."""
        head = self.body.num_betas + 3
        directions = points.directions.shape[1]
        column = np.full(self.body.num_joints, -1)
        numbers = np.arange(3)
        column[joints] = head + 3 * np.arange(len(joints))
        columns = np.concatenate([np.arange(head), (head + 3 * joints[:, None] + numbers).ravel()])
        cost = 0.0
        gradient = np.zeros(len(columns))
        matrix = np.zeros((len(columns),) * 2)
        step = max(ROWS // directions, 1)
        for begin in range(0, len(some), step):
            few = some[begin : begin + step]
            rows = np.empty((len(few) * directions, len(columns)))
            residual = np.empty(len(few) * directions)
            write_rows(self.rig, table, points, few, column, rows, residual)
            cost += 0.5 * float(residual @ residual)
            gradient += rows.T @ residual
            matrix += rows.T @ rows
        return columns, cost, gradient, matrix


def _contiguous(observations: PointObservations) -> _Points:
    return _Points(*(np.ascontiguousarray(array) for array in vars(observations).values()))


def points_on_surface(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    face: Int[np.ndarray, " P"],
    barycentric: Float[np.ndarray, "P 3"],
) -> Float[np.ndarray, "P 3"]:
    """Places (m) of points by triangle and weights of its corners."""
    out = np.empty((len(face), 3))
    place_points(
        np.ascontiguousarray(faces),
        np.ascontiguousarray(vertices, dtype=float),
        face,
        barycentric,
        out,
    )
    return out


def reference_equations(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    pose: Float[np.ndarray, "J 3"],
    trans: Float[np.ndarray, " 3"],
    observations: Observations,
) -> PointEquations:
    """The same for any body by dense Jacobians: what the compiled way is held to by tests."""
    if isinstance(observations, PointObservations):
        places, by_betas, by_pose = _surface_points(body, betas, pose, trans, observations)
    else:
        places, by_betas, by_pose = _joint_points(body, betas, pose, trans, observations)
    count = len(places)
    by_trans = np.broadcast_to(np.eye(3), (count, 3, 3))
    whole = np.concatenate([by_betas, by_trans, by_pose.reshape(count, 3, -1)], axis=2)
    rows = (observations.directions @ whole).reshape(-1, whole.shape[2])
    off = (observations.directions @ (places - observations.target)[..., None]).ravel()
    return PointEquations(0.5 * float(off @ off), rows.T @ off, rows.T @ rows)


def point_residuals(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    pose: Float[np.ndarray, "J 3"],
    trans: Float[np.ndarray, " 3"],
    observations: Observations,
) -> Float[np.ndarray, "P D"]:
    """Products of q - t with the directions, by the body's own forward pass."""
    if isinstance(observations, PointObservations):
        used, corner = np.unique(body.faces[observations.face], return_inverse=True)
        vertices = body(betas, pose, trans, vertices=used).vertices[corner.reshape(-1, 3)]
        places = np.einsum("pk,pkc->pc", observations.barycentric, vertices)
    else:
        places = _joint_points(body, betas, pose, trans, observations)[0]
    return (observations.directions @ (places - observations.target)[..., None])[..., 0]


_Moved = tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3 B"], Float[np.ndarray, "P 3 J 3"]]
"""Places of points, and their derivatives by betas and pose."""


def _surface_points(
    body: BodyModel,
    betas: np.ndarray,
    pose: np.ndarray,
    trans: np.ndarray,
    observations: PointObservations,
) -> _Moved:
    used, corner = np.unique(body.faces[observations.face], return_inverse=True)
    corner = corner.reshape(-1, 3)
    jacobian = surface_jacobian(body, betas, pose, trans, vertices=used)
    share = observations.barycentric
    return (
        np.einsum("pk,pkc->pc", share, jacobian.surface.vertices[corner]),
        np.einsum("pk,pkcb->pcb", share, jacobian.vertices_betas[corner]),
        np.einsum("pk,pkcje->pcje", share, jacobian.vertices_pose[corner]),
    )


def _joint_points(
    body: BodyModel,
    betas: np.ndarray,
    pose: np.ndarray,
    trans: np.ndarray,
    observations: JointObservations,
) -> _Moved:
    skeleton = posed_skeleton(body, body.rest_joints(betas), pose)
    world = skeleton.world[observations.joint]
    place = (world[..., :3] @ observations.offset[..., None])[..., 0] + world[..., 3]
    lever = place[:, None] - skeleton.world[..., 3]
    hangs = skeleton.below[:, observations.joint].T[..., None, None]
    by_turns = -hangs * cross_matrix(lever) @ skeleton.turns
    by_betas = skeleton.joints_betas[observations.joint]
    return place + trans, by_betas, by_turns.transpose(0, 2, 1, 3)


def points_term(
    body: "BodyModel | PointSolver",
    frames: Sequence[Observations | Sequence[Observations] | None],
    weight: float = 1.0,
) -> Term:
    """A `Term` over betas (B,), pose (T, J, 3) and trans (T, 3) that gives normal equations.

    body: a body, or a `PointSolver` of it made once. frames: what is observed in each of the T
    frames: one set of points, several, or None. Takes a single pose (J, 3) and trans (3,) as well,
    for one frame. Poses are blocks: `minimize(..., blocks=("pose", "trans"))`.
    """
    solver = body if isinstance(body, PointSolver) else PointSolver.of(body)
    sets = [_as_list(each) for each in frames]

    def residual(betas: Array, pose: Array, trans: Array) -> Quadratic:
        betas = to_numpy(betas, np.float64)
        poses = to_numpy(pose, np.float64).reshape(-1, *pose.shape[-2:])
        places = to_numpy(trans, np.float64).reshape(-1, 3)
        if len(poses) != len(sets):
            raise HabitusError(
                f"a term of {len(sets)} frames of points was given a pose of {len(poses)}"
            )
        total = sum(
            solver.cost(betas, poses[k], places[k], points)
            for k, points_of_frame in enumerate(sets)
            for points in points_of_frame
        )
        return Quadratic(total, lambda: _named(solver, betas, poses, places, sets))

    return Term(residual, weight, name="points")


def _as_list(frame: Observations | Sequence[Observations] | None) -> list[Observations]:
    if frame is None:
        return []
    return [frame] if isinstance(frame, PointObservations | JointObservations) else list(frame)


def _named(
    solver: PointSolver,
    betas: np.ndarray,
    poses: np.ndarray,
    places: np.ndarray,
    sets: Sequence[Sequence[Observations]],
) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
    """Gradients and matrix blocks by unknown."""
    head = solver.body.num_betas
    size = head + 3 + 3 * solver.body.num_joints
    gradient = np.zeros((len(sets), size))
    matrix = np.zeros((len(sets), size, size))
    for k, points_of_frame in enumerate(sets):
        for points in points_of_frame:
            equations = solver.at(betas, poses[k], places[k], points)
            gradient[k] += equations.gradient
            matrix[k] += equations.matrix
    part = {"betas": slice(head), "trans": slice(head, head + 3), "pose": slice(head + 3, size)}
    pairs = [("trans", "trans"), ("trans", "pose"), ("pose", "pose")]
    pairs += [("trans", "betas"), ("pose", "betas")]
    blocks = {(a, b): matrix[:, part[a], part[b]] for a, b in pairs}
    blocks["betas", "betas"] = matrix[:, :head, :head].sum(0)
    return {
        "betas": gradient[:, :head].sum(0),
        "trans": gradient[:, part["trans"]],
        "pose": gradient[:, part["pose"]],
    }, blocks
