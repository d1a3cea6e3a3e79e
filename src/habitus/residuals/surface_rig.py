"""A body's arrays laid out for the kernels of points, `habitus.residuals.point_kernels`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.kernels import without_zeros
from habitus.body.model import BodyModel
from habitus.body.pose_features import ENTRIES, Hinges
from habitus.body.skinning import descends


# Beside `BodyModel`, as numba takes tuples of arrays and not classes.
class SurfaceRig(NamedTuple):
    """A body (LBS, pose blend shapes linear in R - I, and hinges) laid out for these kernels.

    What moves vertex i: entries ``start[i] : start[i + 1]``, each a ``joint``, and ``shape``, the
    row of ``value_shapes`` by which the row ``feature`` of the state's features drives the vertex,
    -1 where none does. Rows of features after those of the J joints are hinges'.
    """

    template: Float[np.ndarray, "V 3"]
    shapedirs: Float[np.ndarray, "V 3 B"]
    index: Int[np.ndarray, "V K"]
    value: Float[np.ndarray, "V K"]
    faces: Int[np.ndarray, "F 3"]
    start: Int[np.ndarray, " V1"]
    joint: Int[np.ndarray, " S"]
    shape: Int[np.ndarray, " S"]
    feature: Int[np.ndarray, " S"]
    value_shapes: Float[np.ndarray, "G 27"]


def surface_rig(body: BodyModel) -> tuple[SurfaceRig, np.ndarray]:
    """The arrays of a body, and which joints move which vertices (V, J)."""
    own = body.skinning_weights != 0.0
    moves = own @ (descends(body.parents).T > 0.0)
    rows = np.full(moves.shape, -1)
    shapes = np.zeros((0, 27))
    directions = body.pose_directions
    if directions is not None:
        blends = without_zeros(directions[..., : 9 * len(body.drivers)])
        vertex = np.repeat(np.arange(body.num_vertices), np.diff(blends.start))
        rows[vertex, np.array(body.drivers)[blends.driver]] = np.arange(len(blends.driver))
        shapes = blends.value
        moves = moves | (rows >= 0)
    vertex, joint = np.nonzero(moves)
    entries = [vertex, joint, rows[moves], joint]
    if body.hinges is not None:
        folds, directions = _hinge_entries(body.hinges, len(shapes), body.num_joints)
        entries = [np.concatenate(both) for both in zip(entries, folds, strict=True)]
        shapes = np.concatenate([shapes, directions])
        moves[folds[0], folds[1]] = True
    order = np.argsort(entries[0], kind="stable")
    vertex, joint, shape, feature = (each[order] for each in entries)
    start = np.searchsorted(vertex, np.arange(body.num_vertices + 1))
    arrays = (body.v_template, body.shapedirs, body.skinning_index, body.skinning_value, body.faces)
    last = (start, joint, shape, feature, shapes)
    return SurfaceRig(*(np.ascontiguousarray(a) for a in (*arrays, *last))), moves


def _hinge_entries(hinges: Hinges, first_shape: int, first_feature: int) -> tuple[list, np.ndarray]:
    """Vertex, joint, row of shapes and row of features of each vertex and each block of nine
    coefficients of a joint's channels, and the shapes (G, 27).
    """
    entries: list[list[np.ndarray]] = [[], [], [], []]
    shapes = [np.zeros((0, 27))]
    for joint, channels in _by_joint(hinges):
        flat = hinges.directions[:, :, channels].reshape(len(hinges.directions), 3, -1)
        blocks = np.pad(flat, ((0, 0), (0, 0), (0, -flat.shape[2] % ENTRIES)))
        for block in np.split(blocks, blocks.shape[2] // ENTRIES, axis=2):
            vertex = np.flatnonzero(block.any((1, 2)))
            rows = first_shape + np.arange(len(vertex))
            for each, values in zip(
                entries,
                (vertex, np.full_like(rows, joint), rows, np.full_like(rows, first_feature)),
                strict=True,
            ):
                each.append(values)
            shapes.append(block[vertex].transpose(0, 2, 1).reshape(-1, 27))
            first_shape += len(vertex)
            first_feature += 1
    return [np.concatenate(each) for each in entries], np.concatenate(shapes)


def _by_joint(hinges: Hinges) -> list[tuple[int, np.ndarray]]:
    """Joints, and their channels."""
    return [(int(j), np.flatnonzero(hinges.joint == j)) for j in np.unique(hinges.joint)]


class Features(NamedTuple):
    """vec(R - I) of all joints and behind them coefficients of hinges, nine by nine, at one state;
    their derivatives by the turns of their joint, and those of the hinges by the first betas.
    """

    feature: Float[np.ndarray, "F 9"]
    change: Float[np.ndarray, "F 9 3"]
    hinges_by_betas: Float[np.ndarray, "H 9 S"]


def with_hinges(
    hinges: Hinges | None,
    betas: Float[np.ndarray, " B"],
    feature: Float[np.ndarray, "J 9"],
    change: Float[np.ndarray, "J 9 3"],
) -> Features:
    """The features of all joints, and their derivatives, with those of the hinges."""
    if hinges is None:
        return Features(feature, change, np.zeros((0, ENTRIES, 0)))
    parts: list[list[np.ndarray]] = [[], [], []]
    factors = np.concatenate([[1.0], betas[: hinges.num_shapes]])
    for joint, channels in _by_joint(hinges):
        rows = hinges.rows[channels]
        driven = np.clip(rows @ feature[joint] - hinges.bias[channels], 0.0, 1.0)
        slope = (2 * driven * (driven < 1))[:, None] * (rows @ change[joint])
        by = np.zeros((len(channels), len(factors), hinges.num_shapes))
        by[:, 1:] = (driven**2)[:, None, None] * np.eye(hinges.num_shapes)
        values = (np.outer(driven**2, factors)[..., None], slope[:, None] * factors[:, None], by)
        for part, each in zip(parts, values, strict=True):
            flat = each.reshape(len(channels) * len(factors), each.shape[2])
            part.append(np.pad(flat, ((0, -len(flat) % ENTRIES), (0, 0))))
    first, second, third = (
        np.concatenate(part).reshape(-1, ENTRIES, part[0].shape[1]) for part in parts
    )
    return Features(
        np.concatenate([feature, first[..., 0]]), np.concatenate([change, second]), third
    )
