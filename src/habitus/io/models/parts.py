"""Teeth, tongue and lashes as further vertices of a body's full level.

A file binds each vertex of a part to vertices of the body: shapes, ages and identity of the face
move it as they move those, and its own skinning weights carry it. Face units have their own
directions for parts (`face_vertices` beyond the body's); pose blend shapes have none.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy import sparse

from habitus.io.models.arrays import ModelArrays

_FOLLOWED = ("v_template", "shapedirs", "further_shapedirs", "agedirs")
_STILL = ("posedirs", "hingedirs", "expressiondirs", "dynamicsdirs")


def parts_level(arrays: ModelArrays) -> ModelArrays:
    """The arrays of a file's full level with the vertices of its parts behind the body's.

    Reading an array raises HabitusError where the parts do not fit to the body.
    """
    count = len(arrays["v_template"])
    joints = len(arrays["parents"])
    skinning = arrays.index("part_skinning_index", joints, None, None)
    parts = len(skinning)
    arrays.allowance.take(3 * parts, 8, "the body's parts")
    values = arrays.number("part_values", None)
    rows = arrays.index("part_rows", parts, len(values))
    cols = arrays.index("part_cols", count, len(values))
    binding = sparse.csr_matrix((values, (rows, cols)), (parts, count))
    changes: dict[str, Callable[[], np.ndarray]] = {
        key: partial(_followed, arrays, key, binding) for key in _FOLLOWED if key in arrays
    }
    changes |= {key: partial(_still, arrays, key, parts) for key in _STILL if key in arrays}
    shape = len(skinning), skinning.shape[1]
    weights = arrays.number("part_skinning_value", *shape)
    changes["skinning_index"] = partial(_beside, arrays, "skinning_index", skinning)
    changes["skinning_value"] = partial(_beside, arrays, "skinning_value", weights)
    quads = arrays.index("part_quads", count + parts, None, 4)
    uv = arrays.number("part_uv", None, 2)
    corners = arrays.index("part_quad_uv", len(uv), len(quads), 4) + len(arrays["uv"])
    mirror = arrays.index("part_mirror", count + parts, parts)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    further = {"quads": quads, "uv": uv, "quad_uv": corners, "mirror": mirror, "faces": triangles}
    further["hidden_quads"] = np.zeros(len(quads), bool)
    changes |= {key: partial(_behind, arrays, key, rest) for key, rest in further.items()}
    return arrays.changed({**changes, "coarse_vertices": None, "coarse_faces": None})


def _followed(arrays: ModelArrays, key: str, binding: sparse.csr_matrix) -> np.ndarray:
    body = np.asarray(arrays[key], np.float64)
    part = (binding @ body.reshape(len(body), -1)).reshape(-1, *body.shape[1:])
    return np.concatenate([body, part])


def _still(arrays: ModelArrays, key: str, parts: int) -> np.ndarray:
    body = arrays[key]
    return np.concatenate([body, np.zeros((parts, *body.shape[1:]), body.dtype)])


def _behind(arrays: ModelArrays, key: str, rest: np.ndarray) -> np.ndarray:
    return np.concatenate([arrays[key], rest.astype(arrays[key].dtype)])


def _beside(arrays: ModelArrays, key: str, part: np.ndarray) -> np.ndarray:
    """The body's rows and the parts', with zeros up to the wider of both."""
    body = arrays[key]
    wide = max(body.shape[1], part.shape[1])
    both = [np.pad(each, ((0, 0), (0, wide - each.shape[1]))) for each in (body, part)]
    return np.concatenate(both)
