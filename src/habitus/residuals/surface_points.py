"""Points on a posed body against places they should be at: normal equations for scans and depth
images (T 4.6.1, 5.4).

    f = 1/2 sum_p w_p ( (n_p . (q_p - t_p))^2 + s |q_p - t_p|^2 ),    q_p = sum_k b_pk v_k(betas, pose) + trans

A point q keeps its triangle and its weights b there; target t, normal n and weight w are held.
``s`` is the share of point to point. Derivatives are exact, those of the pose blend shapes
included. Unknowns come in the order betas (B), trans (3), pose (3 J). A point is moved by few
joints: the rows of the points of one part of the body are a small dense matrix over the joints that
move that part, and nothing as wide as the body is ever made.
"""  # noqa: E501

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.jacobians import posed_skeleton, surface_jacobian
from habitus.body.kinematics import descends
from habitus.body.local_shapes import without_zeros
from habitus.body.model import BodyModel
from habitus.residuals.surface_point_kernels import (
    mark_corners,
    move_vertices,
    place_points,
    write_rows,
)
from habitus.solve.arrow import ArrowMatrix

ROWS = 2048
"""Rows of the Jacobian at once, which a core's cache has room for."""


@dataclass(frozen=True, eq=False)
class PointMatches:
    """P points on a body's surface, by triangle and weights of its corners, and where they should
    be (m).

    ``direction`` (P, D, 3): the residuals of a point are the products of q - t with its D
    directions, whose lengths are the roots of their weights (1 / m).
    """

    face: Int[np.ndarray, " P"]
    barycentric: Float[np.ndarray, "P 3"]
    target: Float[np.ndarray, "P 3"]
    direction: Float[np.ndarray, "P D 3"]

    @staticmethod
    def to_planes(
        face: Int[np.ndarray, " P"],
        barycentric: Float[np.ndarray, "P 3"],
        target: Float[np.ndarray, "P 3"],
        normal: Float[np.ndarray, "P 3"],
        weight: Float[np.ndarray, " P"],
        slide: float = 0.0,
    ) -> "PointMatches":
        """Points drawn to the planes through their targets, and with ``slide`` times the weight to
        the targets.
        """
        root = np.sqrt(weight)[:, None]
        if slide <= 0.0:
            return PointMatches(face, barycentric, target, (root * normal)[:, None])
        across = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        along = np.cross(normal, across)
        directions = np.stack(
            [np.sqrt(1.0 + slide) * normal, np.sqrt(slide) * across, np.sqrt(slide) * along], 1
        )
        return PointMatches(face, barycentric, target, root[..., None] * directions)


class PointEquations(NamedTuple):
    """Cost f, gradient (N,) and Gauss-Newton matrix (N, N); N = B + 3 + 3 J: betas, trans, pose."""

    cost: float
    gradient: Float[np.ndarray, " N"]
    matrix: Float[np.ndarray, "N N"]


class SurfaceRig(NamedTuple):
    """A body (LBS, pose blend shapes linear in R - I) laid out for these kernels.

    Joints that move vertex i: ``joint[start[i] : start[i + 1]]``; ``shape`` is the row of
    ``value_shapes`` by which each also drives the vertex' pose blend shapes, -1 where it does not.
    """

    template: Float[np.ndarray, "V 3"]
    shapedirs: Float[np.ndarray, "V 3 B"]
    index: Int[np.ndarray, "V K"]
    value: Float[np.ndarray, "V K"]
    faces: Int[np.ndarray, "F 3"]
    start: Int[np.ndarray, " V1"]
    joint: Int[np.ndarray, " S"]
    shape: Int[np.ndarray, " S"]
    value_shapes: Float[np.ndarray, "G 27"]


class _State(NamedTuple):
    betas: Float[np.ndarray, " B"]
    trans: Float[np.ndarray, " 3"]
    motions: Float[np.ndarray, "J 3 4"]
    joints: Float[np.ndarray, "J 3"]
    turns: Float[np.ndarray, "J 3 3"]
    shifts: Float[np.ndarray, "J 3 B"]
    below: Float[np.ndarray, "J J"]
    feature: Float[np.ndarray, "J 9"]
    change: Float[np.ndarray, "J 9 3"]


class _Table(NamedTuple):
    vertices: Float[np.ndarray, "V 3"]
    by_betas: Float[np.ndarray, "V 3 B"]
    by_pose: Float[np.ndarray, "S 9"]


class _Points(NamedTuple):
    face: Int[np.ndarray, " P"]
    barycentric: Float[np.ndarray, "P 3"]
    target: Float[np.ndarray, "P 3"]
    direction: Float[np.ndarray, "P D 3"]


@dataclass(frozen=True, eq=False)
class SurfacePointSolver:
    """A body made ready: `at` one state, `together` at the states of several observations of one
    person.

    A body that is no LBS body with blend shapes linear in R - I takes the slow way,
    `slow_equations`, throughout.
    """

    body: BodyModel
    rig: SurfaceRig | None
    part: Int[np.ndarray, " F"]
    part_joints: tuple[Int[np.ndarray, " j"], ...]

    @staticmethod
    def of(body: BodyModel) -> "SurfacePointSolver":
        """Lay out the arrays of a body; to be made once."""
        plain = body.posedirs is None or (
            body.pose_features == "rotations" and not body.shape_features
        )
        if body.skinning != "lbs" or not plain:
            return SurfacePointSolver(body, None, np.zeros(body.num_faces, np.int64), ())
        rig, moves = _rig(body)
        strongest = np.take_along_axis(
            body.skinning_index, body.skinning_value.argmax(1)[:, None], 1
        )[:, 0]
        named, part = np.unique(strongest[body.faces[:, 0]], return_inverse=True)
        joints = tuple(
            np.flatnonzero(moves[body.faces[part == k]].any((0, 1))) for k in range(len(named))
        )
        return SurfacePointSolver(body, rig, part, joints)

    def at(
        self,
        betas: Float[np.ndarray, " B"],
        pose: Float[np.ndarray, "J 3"],
        trans: Float[np.ndarray, " 3"],
        matches: PointMatches,
    ) -> PointEquations:
        """The normal equations at one state (rotation vectors, rad; m)."""
        if self.rig is None:
            return slow_equations(self.body, betas, pose, trans, matches)
        marked = np.zeros(self.body.num_vertices, dtype=bool)
        mark_corners(self.rig.faces, matches.face, marked)
        table = self._table(
            np.asarray(betas, float), pose, np.asarray(trans, float), np.flatnonzero(marked)
        )
        size = self.body.num_betas + 3 + 3 * self.body.num_joints
        part = self.part[matches.face]
        order = np.argsort(part, kind="stable")
        cost = 0.0
        ends = np.searchsorted(part[order], np.arange(len(self.part_joints) + 1))
        gradient = np.zeros(size)
        matrix = np.zeros((size, size))
        points = _Points(*(np.ascontiguousarray(array) for array in vars(matches).values()))
        for joints, begin, end in zip(self.part_joints, ends[:-1], ends[1:], strict=True):
            if end > begin:
                columns, *found = self._of_part(table, points, order[begin:end], joints)
                cost, gradient[columns] = cost + found[0], gradient[columns] + found[1]
                matrix[np.ix_(columns, columns)] += found[2]
        return PointEquations(cost, gradient, matrix)

    def together(
        self,
        betas: Float[np.ndarray, " B"],
        pose: Float[np.ndarray, "T J 3"],
        trans: Float[np.ndarray, "T 3"],
        matches: Sequence[PointMatches],
    ) -> tuple[float, Float[np.ndarray, " n"], ArrowMatrix]:
        """Cost, gradient and matrix of T observations that share betas: unknowns betas, then trans
        and pose of each.
        """
        each = [self.at(betas, *state) for state in zip(pose, trans, matches, strict=True)]
        head = self.body.num_betas
        shared = sum((one.matrix[:head, :head] for one in each), np.zeros((head, head)))
        top = sum((one.gradient[:head] for one in each), np.zeros(head))
        border = np.stack([one.matrix[head:, :head] for one in each])
        blocks = np.stack([one.matrix[head:, head:] for one in each])
        gradient = np.concatenate([top, *(one.gradient[head:] for one in each)])
        return sum(one.cost for one in each), gradient, ArrowMatrix(shared, border, blocks)

    def _table(
        self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray, used: np.ndarray
    ) -> _Table:
        """Vertices and their derivatives where they are ``used``, anything elsewhere."""
        assert self.rig is not None
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
        joints = np.ascontiguousarray(skeleton.world[..., 3])
        below = np.array(skeleton.below)
        moved = (
            skeleton.motions,
            joints,
            skeleton.turns,
            skeleton.shifts_betas,
            below,
            feature,
            change,
        )
        state = _State(betas, trans, *(np.ascontiguousarray(array) for array in moved))
        shapes = (body.num_vertices, 3), self.rig.shapedirs.shape, (len(self.rig.joint), 9)
        table = _Table(*(np.empty(shape) for shape in shapes))
        move_vertices(self.rig, state, used, *table, np.empty((4, 3)))
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
        directions = points.direction.shape[1]
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


def slow_equations(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    pose: Float[np.ndarray, "J 3"],
    trans: Float[np.ndarray, " 3"],
    matches: PointMatches,
) -> PointEquations:
    """The same for any body by the dense Jacobian of all corners: what the fast way is tested
    against.
    """
    used, corner = np.unique(body.faces[matches.face], return_inverse=True)
    corner = corner.reshape(-1, 3)
    found = surface_jacobian(body, betas, pose, trans, vertices=used)
    size = body.num_betas + 3 + 3 * body.num_joints
    whole = np.zeros((len(used), 3, size))
    whole[..., : body.num_betas] = found.vertices_betas
    whole[..., body.num_betas : body.num_betas + 3] = np.eye(3)
    whole[..., body.num_betas + 3 :] = found.vertices_pose.reshape(len(used), 3, -1)
    moved = np.einsum("pk,pkcn->pcn", matches.barycentric, whole[corner])
    apart = (
        np.einsum("pk,pkc->pc", matches.barycentric, found.surface.vertices[corner])
        - matches.target
    )
    rows = (matches.direction @ moved).reshape(-1, size)
    residual = np.einsum("pdc,pc->pd", matches.direction, apart).ravel()
    return PointEquations(0.5 * float(residual @ residual), rows.T @ residual, rows.T @ rows)


def _rig(body: BodyModel) -> tuple[SurfaceRig, np.ndarray]:
    """The arrays of a body, and which joints move which vertices (V, J)."""
    own = body.skinning_weights != 0.0
    moves = own @ (descends(body.parents).T > 0.0)
    rows = np.full(moves.shape, -1)
    shapes = np.zeros((0, 27))
    if body.posedirs is not None:
        found = without_zeros(body.posedirs)
        vertex = np.repeat(np.arange(body.num_vertices), np.diff(found.start))
        rows[vertex, np.array(body.drivers)[found.driver]] = np.arange(len(found.driver))
        shapes = found.value
        moves = moves | (rows >= 0)
    start = np.concatenate([[0], np.cumsum(moves.sum(1))])
    arrays = (
        body.v_template,
        body.shapedirs,
        body.skinning_index,
        body.skinning_value,
        body.faces,
        start,
    )
    rig = SurfaceRig(
        *(np.ascontiguousarray(a) for a in (*arrays, np.nonzero(moves)[1], rows[moves], shapes))
    )
    return rig, moves
