"""What the project's own body files hold besides SMPL's arrays: ages, quads and textures, two
levels of detail, dynamic blend shapes; and a body model as named arrays for a file, under official
names or under the project's own.
"""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Int

from habitus.body.body_arrays import Ages
from habitus.body.body_mesh import BodyMesh
from habitus.body.dynamics import Dynamics, DynamicsRegressor
from habitus.body.face import Face
from habitus.body.model import BodyModel
from habitus.body.pose_features import ENTRIES, Hinges
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.io.archives import NpzArchive
from habitus.io.limits import open_file
from habitus.io.models.arrays import ModelArrays

DETAILS = ("coarse", "full", "parts")


def has_parts(arrays: ModelArrays) -> bool:
    """Whether a file binds teeth, tongue and lashes to its body (`habitus.io.models.parts`)."""
    return "part_rows" in arrays


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
    spreads = np.ones(len(years))
    if "age_spread" in arrays:
        spreads = arrays.number("age_spread", len(years))
        if not (spreads > 0).all():
            raise HabitusError(
                f"array 'age_spread' is {spreads.tolist()}; expected factors above 0"
            )
    if "age_statures" in arrays:  # of a coarse level, which grows as the full one does
        return Ages(
            years,
            directions,
            arrays.number("age_statures", len(years)),
            float(arrays.number("age_adult")),
            spreads,
        )
    return Ages(years, directions, *_statures(template, directions), spreads)


def _statures(template: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, float]:
    """How tall the mean person of each age is, and the template (m)."""
    return np.ptp(template[:, 1, None] + directions[:, 1], axis=0), float(np.ptp(template[:, 1]))


def read_hinges(arrays: ModelArrays, vertices: int, joints: int) -> Hinges | None:
    """The channels of deep folds, where the file has them."""
    if "hinge_joints" not in arrays:
        return None
    joint = arrays.index("hinge_joints", joints, None)
    count = len(joint)
    return Hinges(
        joint,
        arrays.number("hinge_rows", count, ENTRIES),
        arrays.number("hinge_bias", count),
        arrays.number("hinge_linear", count, ENTRIES),
        arrays.number("hingedirs", vertices, 3, count, None),
    )


def read_face(arrays: ModelArrays, vertices: int, joints: int) -> Face | None:
    """Units and identity of the face, where the file has them; those of vertices beyond the body's
    (its parts') are left out.
    """
    if "face_vertices" not in arrays:
        return None
    ids = arrays.number("face_vertices", None, dtype=np.int64)
    names = arrays.text("face_unit_names")
    driven = np.zeros(0, np.int64)
    turns = np.zeros((len(names), 0, 3))
    if "face_unit_joints" in arrays:
        driven = arrays.index("face_unit_joints", joints, None)
        turns = arrays.number("face_unit_turns", len(names), len(driven), 3)
    own = (ids >= 0) & (ids < vertices)
    return Face(
        ids[own],
        names,
        arrays.number("face_unitdirs", len(ids), 3, len(names))[own],
        tuple(driven.tolist()),
        turns,
        arrays.number("facedirs", len(ids), 3, None)[own],
    )


def face_form(face: Face | None) -> dict[str, np.ndarray]:
    """The arrays that `read_face` reads."""
    if face is None:
        return {}
    turning = {"face_unit_joints": np.array(face.joints), "face_unit_turns": face.turns}
    return {
        "face_vertices": face.vertices,
        "face_unit_names": np.array(face.unit_names),
        "face_unitdirs": face.unit_directions.astype(np.float32),
        "facedirs": face.identity_directions.astype(np.float32),
        **(turning if face.joints else {}),
    }


def hinges_form(hinges: Hinges | None) -> dict[str, np.ndarray]:
    """The arrays that `read_hinges` reads."""
    if hinges is None:
        return {}
    return {
        "hinge_joints": hinges.joint,
        "hinge_rows": hinges.rows,
        "hinge_bias": hinges.bias,
        "hinge_linear": hinges.linear,
        "hingedirs": hinges.directions,
    }


def ages_form(ages: Ages | None) -> dict[str, np.ndarray]:
    """The arrays that `read_ages` reads."""
    if ages is None:
        return {}
    named = {"age_years": ages.years, "agedirs": ages.directions, "age_statures": ages.statures}
    return {**named, "age_adult": np.array(ages.adult), "age_spread": ages.spreads}


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
    "further_shapedirs",
    "posedirs",
    "hingedirs",
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
    template = arrays["v_template"]
    arrays = arrays.changed({"v_template": lambda: template})
    count = len(template)
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
    if "face_vertices" in arrays:
        changes |= _coarse_face(arrays, rows, count)
    if "age_years" in arrays:
        directions = arrays.number(
            "agedirs", count, 3, None, dtype=np.float32
        )  # read once: it is large
        statures, adult = _statures(arrays.number("v_template", count, 3), directions)
        changes |= {"age_statures": lambda: statures, "age_adult": lambda: np.array(adult)}
        changes["agedirs"] = lambda: directions[rows]
    return arrays.changed(changes), rows


def _coarse_face(
    arrays: ModelArrays, rows: np.ndarray, count: int
) -> dict[str, Callable[[], np.ndarray]]:
    """The face of the coarse level's vertices."""
    place = np.full(count, -1)
    place[rows] = np.arange(len(rows))
    ids = arrays.number("face_vertices", None, dtype=np.int64)
    own = (ids >= 0) & (ids < count)
    kept = np.flatnonzero(own)[place[ids[own]] >= 0]
    changes = {
        key: partial(_rows_of, arrays, key, kept, len(ids)) for key in ("face_unitdirs", "facedirs")
    }
    return {**changes, "face_vertices": lambda: place[ids[kept]]}


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
    renumbered = place[given[rows] if key == "mirror" and len(given) == count else given]
    if (renumbered < 0).any():
        raise HabitusError(
            f"array {key!r} names vertices that are not among 'coarse_vertices'; expected only "
            "those"
        )
    return renumbered


def read_dynamics(arrays: ModelArrays, vertices: int) -> Dynamics | None:
    """Dynamic blend shapes and their regressor, where the file has them."""
    if "dynamicsdirs" not in arrays:
        return None
    directions = arrays.number("dynamicsdirs", vertices, 3, None)
    count = directions.shape[2]
    drive = arrays.number("dynamics_drive", None, count, None)
    blocks = len(drive)
    controls = drive.shape[2]
    reach = arrays.number("dynamics_reach", 2, blocks - 1) if blocks > 1 else np.zeros((2, 0))
    regressor = DynamicsRegressor(
        history=arrays.number("dynamics_history", blocks, 2, count, count),
        drive=drive,
        joints=arrays.text("dynamics_joints"),
        rate_hz=float(arrays.number("dynamics_rate")),
        limits=arrays.number("dynamics_limits", controls),
        reach=reach,
        controls=arrays.text("dynamics_controls")[0],
    )
    return Dynamics(directions, regressor)


def dynamics_form(dynamics: Dynamics | None) -> dict[str, np.ndarray]:
    """The arrays that `read_dynamics` reads."""
    if dynamics is None:
        return {}
    known = dynamics.regressor
    named = {
        "history": known.history,
        "drive": known.drive,
        "limits": known.limits,
        "reach": known.reach,
    }
    named |= {
        "joints": np.array(known.joints),
        "rate": np.array(known.rate_hz),
        "controls": np.array(known.controls),
    }
    return {"dynamicsdirs": dynamics.directions} | {
        f"dynamics_{name}": array for name, array in named.items()
    }


def add_dynamics(source: str | os.PathLike[str], dynamics: Dynamics, target: Path) -> None:
    """Copy a body's ``.npz`` under the project's own names with these dynamics, in the place of any
    that it has.

    All else stays as it is, both levels of detail included; the dynamics are those of the full one.
    Blend shapes are kept in float32. Raises HabitusError where the file is of another mesh.
    """
    with open_file(Path(source)) as file:
        archive = NpzArchive(file)
        arrays = {
            name: archive.read(name) for name in archive.names if not name.startswith("dynamics")
        }
    if len(arrays["v_template"]) != len(dynamics.directions):
        raise HabitusError(
            f"{source}: {len(arrays['v_template'])} vertices; expected the "
            f"{len(dynamics.directions)} of the dynamics"
        )
    arrays |= dynamics_form(dynamics) | {"dynamicsdirs": dynamics.directions.astype(np.float32)}
    with atomic_write(target) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def has_levels(source: str | os.PathLike[str]) -> bool:
    """Whether a body's file is an ``.npz`` with two levels of detail."""
    with open_file(Path(source)) as file:
        if file.read(2) != b"PK":
            return False
        file.seek(0)
        return "coarse_vertices" in NpzArchive(file)


def is_official(model: BodyModel) -> bool:
    """Whether an official file can hold it: pose blend shapes, if any, are linear in vec(R - I)
    alone.
    """
    return model.pose_features == "rotations" and not model.shape_features


def official_form(model: BodyModel) -> dict[str, np.ndarray]:
    """The arrays under the names and in the shapes of the SMPL family's own files, and what only
    our files hold.
    """
    return _official_arrays(model) | _own_arrays(model) | _smplx_fillers(model)


def project_form(model: BodyModel) -> dict[str, np.ndarray]:
    """The arrays under the project's own names: regressor and skinning weights without their
    zeros.
    """
    regressor = model.joint_regressor
    rows, columns = np.nonzero(regressor)
    keys = (
        "v_template",
        "shapedirs",
        "posedirs",
        "expressiondirs",
        "skinning_index",
        "skinning_value",
        "faces",
    )
    arrays = {key: value for key in keys if (value := getattr(model, key)) is not None}
    arrays |= {
        "joint_regressor_rows": rows,
        "joint_regressor_cols": columns,
        "joint_regressor_values": regressor[rows, columns],
        "parents": np.array(model.parents),
        "skinning": np.array(model.skinning),
        "pose_features": np.array(model.pose_features),
        "shape_features": np.array(model.shape_features),
    }
    return arrays | _own_arrays(model) | dict(model.extras)


def _official_arrays(model: BodyModel) -> dict[str, np.ndarray]:
    """What ``smplx`` reads, too."""
    v = model.num_vertices
    j = model.num_joints
    posedirs = model.smpl_posedirs()
    shapedirs = model.shapedirs
    expression = model.expressiondirs
    if expression is not None:  # smplx looks for expressions at a fixed place
        gap = max(0, (300 if expression.shape[-1] == 100 else 10) - model.num_betas)
        shapedirs = np.concatenate([shapedirs, np.zeros((v, 3, gap)), expression], -1)
    return {
        "v_template": model.v_template,
        "shapedirs": shapedirs,
        "num_betas": np.array(model.num_betas),
        "num_expressions": np.array(0 if expression is None else expression.shape[-1]),
        "posedirs": np.zeros((v, 3, 9 * (j - 1)), np.float32) if posedirs is None else posedirs,
        "J_regressor": model.joint_regressor,
        "weights": model.skinning_weights,
        "kintree_table": np.array([model.parents, range(j)]).astype(np.uint32),
        "f": model.faces.astype(np.uint32),
        "bs_style": np.array(model.skinning),
        "bs_type": np.array("lrotmin"),
    }


def _own_arrays(model: BodyModel) -> dict[str, np.ndarray]:
    """What only this project's files hold."""
    arrays = {"joint_names": np.array(model.joint_names)}
    arrays |= {
        key: value
        for key in ("part", "mirror", "people_mean", "people_skew")
        if (value := getattr(model, key)) is not None
    }
    arrays |= ages_form(model.ages) | mesh_form(model.mesh) | dynamics_form(model.dynamics)
    arrays |= hinges_form(model.hinges) | face_form(model.face)
    if model.pose_joints is not None:
        arrays["posedirs_joints"] = np.array(model.pose_joints, np.int64)
    if model.landmarks:
        arrays["landmark_names"] = np.array(list(model.landmarks))
        arrays["landmark_vertices"] = np.array(list(model.landmarks.values()))
    if model.pose_prior is not None:
        arrays["pose_mean"] = model.pose_prior.mean
        arrays["pose_precision"] = model.pose_prior.precision
    if model.female_rows is not None:
        arrays["gender_weights"], arrays["gender_bias"] = model.female_rows
    elif model.female_direction is not None:
        arrays["female_weights"] = model.female_direction[0]
        arrays["female_bias"] = np.array(model.female_direction[1])
    return arrays


def _smplx_fillers(model: BodyModel) -> dict[str, np.ndarray]:
    """The file's own extras, over neutral ones that ``smplx`` insists on: flat hands, landmarks at
    the first face.
    """
    mean = np.zeros(45)
    components = np.eye(45)
    fillers: dict[str, np.ndarray] = {}
    if model.num_joints == 16:
        fillers = {"hands_mean": mean, "hands_components": components}
    if model.num_joints in (52, 55):
        fillers = {f"hands_mean{side}": mean for side in "lr"} | {
            f"hands_components{side}": components for side in "lr"
        }
    if model.num_joints == 55:
        fillers |= {
            "lmk_faces_idx": np.zeros(51, np.int64),
            "lmk_bary_coords": np.eye(3)[np.zeros(51, np.int64)],
        }
    return fillers | dict(model.extras)
