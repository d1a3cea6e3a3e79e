"""What the project's own body files hold besides SMPL's arrays: ages, quads and textures, two
levels of detail.
"""

from functools import partial

import numpy as np
from jaxtyping import Int

from habitus.body.body_arrays import Ages, BodyMesh
from habitus.errors import HabitusError
from habitus.io.models.arrays import ModelArrays

DETAILS = ("coarse", "full")


def read_pose_joints(arrays: ModelArrays, joints: int) -> tuple[int, ...] | None:
    """The joints that drive the pose blend shapes, where a file names some."""
    if "posedirs_joints" not in arrays:
        return None
    return tuple(arrays.index("posedirs_joints", joints, None).tolist())


def read_mesh(arrays: ModelArrays, vertices: int) -> BodyMesh | None:
    """Quads and a texture's coordinates, where the file has them."""
    if "quads" not in arrays:
        return None
    uv = arrays.number("uv", None, 2)
    quads = arrays.index("quads", vertices, None, 4)
    hidden = arrays.index("hidden_quads", 2, len(quads)) != 0
    return BodyMesh(quads, uv, arrays.index("quad_uv", len(uv), len(quads), 4), hidden)


def read_ages(arrays: ModelArrays, template: np.ndarray) -> Ages | None:
    """The ages that the file knows. Raises HabitusError where they do not rise."""
    if "age_years" not in arrays:
        return None
    years = arrays.number("age_years", None)
    if len(years) < 2 or not (np.diff(years) > 0).all():
        raise HabitusError(f"array 'age_years' is {years.tolist()}; expected ages that rise")
    directions = arrays.number("agedirs", *template.shape, len(years), dtype=np.float32)
    if "age_statures" in arrays:  # of a coarse level, which grows as the full one does
        return Ages(
            years,
            directions,
            arrays.number("age_statures", len(years)),
            float(arrays.number("age_adult")),
        )
    return Ages(years, directions, *_statures(template, directions))


def _statures(template: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, float]:
    """How tall the mean person of each age is, and the template (m)."""
    return np.ptp(template[:, 1, None] + directions[:, 1], axis=0), float(np.ptp(template[:, 1]))


def ages_form(ages: Ages | None) -> dict[str, np.ndarray]:
    """The arrays that `read_ages` reads."""
    if ages is None:
        return {}
    named = {"age_years": ages.years, "agedirs": ages.directions, "age_statures": ages.statures}
    return {**named, "age_adult": np.array(ages.adult)}


def mesh_form(mesh: BodyMesh | None) -> dict[str, np.ndarray]:
    """The arrays that `read_mesh` reads."""
    if mesh is None:
        return {}
    return {
        "quads": mesh.quads,
        "uv": mesh.uv,
        "quad_uv": mesh.quad_uv,
        "hidden_quads": mesh.hidden,
    }


_ROWS = (
    "v_template",
    "shapedirs",
    "posedirs",
    "expressiondirs",
    "agedirs",
    "dynamicsdirs",
    "skinning_index",
    "skinning_value",
    "part",
)
_VERTICES = ("mirror", "landmark_vertices", "joint_regressor_cols")
_OF_THE_FULL = ("quads", "uv", "quad_uv", "hidden_quads", "base_vertices")


def coarse_level(arrays: ModelArrays) -> tuple[ModelArrays, Int[np.ndarray, " V"]]:
    """The arrays of a file's coarse level, read when asked for, and which of the full level's
    vertices are its own.

    Reading an array raises HabitusError where those vertices do not suffice for it.
    """
    count = len(arrays["v_template"])
    rows = arrays.index("coarse_vertices", count, None)
    if not (np.diff(rows) > 0).all():
        raise HabitusError("array 'coarse_vertices' does not rise; expected sorted vertex numbers")
    changes = {key: partial(_rows_of, arrays, key, rows, count) for key in _ROWS if key in arrays}
    changes |= {
        key: partial(_renumbered, arrays, key, rows, count) for key in _VERTICES if key in arrays
    }
    changes |= {
        "faces": partial(arrays.index, "coarse_faces", len(rows), None, 3),
        **dict.fromkeys(_OF_THE_FULL),
    }
    if "age_years" in arrays:
        directions = arrays.number(
            "agedirs", count, 3, None, dtype=np.float32
        )  # read once: it is large
        statures, adult = _statures(arrays.number("v_template", count, 3), directions)
        changes |= {"age_statures": lambda: statures, "age_adult": lambda: np.array(adult)}
        changes["agedirs"] = lambda: directions[rows]
    return arrays.changed(changes), rows


def _rows_of(arrays: ModelArrays, key: str, rows: np.ndarray, count: int) -> np.ndarray:
    array = arrays[key]
    if not array.ndim or len(array) != count:
        raise HabitusError(f"array {key!r} has shape {array.shape}; expected ({count}, *)")
    return array[rows]


def _renumbered(arrays: ModelArrays, key: str, rows: np.ndarray, count: int) -> np.ndarray:
    """Vertex numbers of the full level as those of the coarse one."""
    place = np.full(count, -1)
    place[rows] = np.arange(len(rows))
    given = arrays.index(key, count, None)
    found = place[given[rows] if key == "mirror" and len(given) == count else given]
    if (found < 0).any():
        raise HabitusError(
            f"array {key!r} names vertices that are not among 'coarse_vertices'; expected only "
            "those"
        )
    return found
