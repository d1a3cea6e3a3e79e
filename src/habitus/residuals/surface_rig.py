"""A body's arrays laid out for the kernels of points, `habitus.residuals.point_kernels`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.kernels import without_zeros
from habitus.body.model import BodyModel
from habitus.body.skinning import descends


# Beside `BodyModel`, as numba takes tuples of arrays and not classes.
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


def surface_rig(body: BodyModel) -> tuple[SurfaceRig, np.ndarray]:
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
