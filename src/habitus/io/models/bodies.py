"""Reads and writes body models: the project's own, and SMPL, SMPL-H, SMPL-X, MANO, SMAL as their
owners ship them.

Foreign names and shapes end here. Pickles are read by `habitus.io.models.pickles`: no code in them
runs, and chumpy is not needed.
"""

import pickle
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from importlib import resources
from io import BytesIO
from pathlib import Path
from types import MappingProxyType

import numpy as np

from habitus.body.joint_layouts import SMPLH, find_layout
from habitus.body.model import BodyModel
from habitus.body.pose_features import find_pose_features, of_joints
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.io.limits import check_joints, read_file
from habitus.io.models.arrays import ModelArrays
from habitus.io.models.details import (
    DETAILS,
    add_dynamics,
    coarse_level,
    has_levels,
    has_parts,
    is_official,
    official_form,
    project_form,
    read_ages,
    read_dynamics,
    read_face,
    read_hinges,
    read_mesh,
    read_pose_joints,
)
from habitus.io.models.parts import parts_level
from habitus.mesh.template import check_parents

_EXTRAS = (
    "hands_mean",
    "hands_meanl",
    "hands_meanr",
    "hands_components",
    "hands_componentsl",
    "hands_componentsr",
    "lmk_faces_idx",
    "lmk_bary_coords",
    "dynamic_lmk_faces_idx",
    "dynamic_lmk_bary_coords",
    "license",
    "version",
    "description",
    "joint_regressor_signs",
    "vt",
    "ft",
    "uv",
    "uv_faces",
    "part_names",
    "part_index",
)
SHIPPED = {"default": "neutral", "neutral": "neutral", "female": "female", "male": "male"}
"""The bodies that come along, by the names they are asked for."""
SHIPPED_BETAS = 100
"""All shape directions of these."""


def load_body(
    path: str | Path,
    *,
    num_betas: int | None = None,
    detail: str = "coarse",
    joints: str | None = None,
) -> BodyModel:
    """The body model in a file (npz or pkl; any of the SMPL family), or one that habitus brings
    along: ``"neutral"`` (``"default"`` is the same), ``"female"``, ``"male"``.

    ``num_betas`` says how many shape directions are kept; by itself those that markers determine
    (24 of the bodies that come along, which have 100: the first ones are the same, the further ones
    serve scans), all of files without further ones. ``detail``: a file with two
    levels of detail gives the "coarse" one, which holds the other as ``body.full``, or the "full"
    one alone, or that with teeth, tongue and lashes where the file has such ("parts", also
    ``body.full.full``); other files have one level. ``joints``: "smpl", "smplh" (fingers) or
    "smplx" (jaw and eyes, too), as far as the file has them; by itself "smpl" of the bodies that
    come along, all joints of other files. Hands are full joint rotations; their mean pose and
    components go to ``extras``. Raises HabitusError, with the file named, where it is no body
    model, is damaged, has not those joints, or asks for anything but arrays.
    """
    if detail not in DETAILS:
        raise HabitusError(f"detail is {detail!r}; expected one of {', '.join(DETAILS)}")
    shipped = SHIPPED.get(str(path))
    source, name = (_shipped(shipped), str(path)) if shipped else (Path(path), Path(path).stem)
    try:
        content = read_file(source)
        joints = joints or ("smpl" if shipped else None)
        model = _read_body(content, name, detail, joints, num_betas)
    except HabitusError as error:
        raise HabitusError(f"{source}: {error}") from error
    except OSError as error:
        raise HabitusError(
            f"{source}: {error.strerror or error}; expected a body model (.npz or .pkl), or "
            f"{', '.join(SHIPPED)}"
        ) from error
    return model if num_betas is None else model.with_betas(num_betas)


def _read_body(
    content: bytes,
    name: str,
    detail: str,
    joints: str | None,
    num_betas: int | None,
    *,
    alone: bool = True,
) -> BodyModel:
    """The body in a file's bytes, with at least ``num_betas`` shape directions where it has them; a
    coarse one keeps the bytes, for its full level is read from them when asked for, and so does a
    full one that is not ``alone``, for its parts.
    """
    arrays = ModelArrays(BytesIO(content))
    if detail != "parts":
        arrays = arrays.changed({"part_names": None, "part_index": None})
    if "coarse_vertices" in arrays and detail == "coarse":
        mesh = read_mesh(arrays, len(arrays["v_template"]))
        arrays, rows = coarse_level(arrays)
        finer = partial(_read_body, content, name, "full", None, num_betas, alone=False)
        model = replace(_own_body(arrays, name, num_betas), full_vertices=rows, finer=finer)
        model = model if mesh is None else replace(model, pockets=mesh.pockets(rows))
    elif "skinning_index" not in arrays:
        model = _official_body(arrays, name)
    elif detail == "parts" and has_parts(arrays):
        model = _own_body(parts_level(arrays), name, num_betas)
    else:
        model = _own_body(arrays, name, num_betas)
        if detail == "full" and not alone and has_parts(arrays):
            finer = partial(_read_body, content, name, "parts", None, num_betas)
            model = replace(model, full_vertices=np.arange(model.num_vertices), finer=finer)
    return model if joints is None else model.with_joints(joints)


def shipped_file(path: str | Path) -> Path:
    """The file of a body that habitus brings along, by the name it is asked for; any other path as
    it is.
    """
    name = SHIPPED.get(str(path))
    return Path(path) if name is None else _shipped(name)


def load_whole_body(path: str | Path) -> BodyModel:
    """The body of `load_body` with all that the file has: all joints, its full level of detail."""
    return load_body(path, detail="full", joints="smplx" if str(path) in SHIPPED else None)


def save_dynamics(path: str | Path, body: BodyModel, target: Path) -> None:
    """Write the body of a file, by the name that `load_whole_body` took, with the dynamics that
    ``body`` has of it.
    """
    source = _shipped(SHIPPED[str(path)]) if str(path) in SHIPPED else Path(path)
    if body.dynamics is not None and has_levels(source):
        add_dynamics(source, body.dynamics, target)
    else:
        save_body(body, target)


def _shipped(name: str) -> Path:
    return Path(str(resources.files("habitus") / "assets" / "bodies" / f"{name}.npz"))


def _parents(raw: np.ndarray) -> tuple[int, ...]:
    """Parents as a tuple; the root may be marked -1 or, unsigned, 4294967295."""
    check_joints(raw.size)
    parents = (-1, *(int(parent) for parent in raw.ravel()[1:]))
    check_parents(parents)
    return parents


def _influences(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights of each vertex, strongest first; as many as any vertex of the file needs:
    nothing is cut.
    """
    count = max(1, int((weights != 0).sum(1).max()))
    index = np.argsort(-np.abs(weights), axis=1, kind="stable")[:, :count]
    return index, np.take_along_axis(weights, index, 1)


def _check_weights(value: np.ndarray) -> None:
    off = np.abs(value.sum(1) - 1)
    if off.max() > 0.05:
        raise HabitusError(
            f"skinning weights of vertex {off.argmax()} sum to {value[off.argmax()].sum():.3g}; "
            "expected 1"
        )


def _shape_and_expression(
    arrays: ModelArrays, vertices: int, joints: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """SMPL-X keeps expression directions behind the shape's: 300 + 100, or 10 + 10 in its first
    files.
    """
    shapedirs = arrays.number("shapedirs", vertices, 3, None)
    count = shapedirs.shape[-1]
    if "num_expressions" in arrays:  # written by save_body, which may have to fill up in between
        shape = int(arrays.number("num_betas"))
        expressions = int(arrays.number("num_expressions"))
    else:
        expressions = {400: 100, 20: 10}.get(count, 0) if joints == 55 else 0
        shape = count - expressions
    if not (0 < shape <= count and 0 <= expressions <= count - shape):
        raise HabitusError(
            f"{shape} shape and {expressions} expression directions of {count}; expected parts of "
            "the whole"
        )
    return np.ascontiguousarray(shapedirs[..., :shape]), shapedirs[
        ..., count - expressions :
    ] if expressions else None


def _official_body(arrays: ModelArrays, name: str) -> BodyModel:
    for key in ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f"):
        arrays[key]
    style, kind = (
        arrays.text(key)[0] if key in arrays else None for key in ("bs_style", "bs_type")
    )
    if style not in (None, "lbs", "dqbs") or kind not in (None, "lrotmin"):
        raise HabitusError(
            f"blend skinning {style!r} with {kind!r}; expected lbs or dqbs with lrotmin pose "
            "features"
        )
    v = len(arrays.number("v_template", None, 3))
    parents = _parents(arrays.number("kintree_table", 2, None, dtype=np.int64)[0])
    index, value = _influences(arrays.number("weights", v, len(parents)))
    _check_weights(value)
    shapedirs, expression = _shape_and_expression(arrays, v, len(parents))
    extras = {key: arrays[key] for key in _EXTRAS if key in arrays}
    regressor = arrays.number("J_regressor", len(parents), v)
    names = arrays.text("joint_names") if "joint_names" in arrays else _joint_names(parents)
    numbers = {"shapedirs": shapedirs, "joint_regressor": regressor, "skinning_value": value}
    own = {"parents": parents, "joint_names": names, "skinning": style or "lbs", "extras": extras}
    own["expressiondirs"] = expression
    return _build(
        arrays,
        name,
        numbers,
        {"skinning_index": index, "faces": arrays.index("f", v, None, 3)},
        own,
    )


def _joint_names(parents: tuple[int, ...]) -> tuple[str, ...]:
    layout = find_layout(parents)
    return layout.joint_names if layout else tuple(f"joint_{k}" for k in range(len(parents)))


def _own_body(arrays: ModelArrays, name: str, num_betas: int | None) -> BodyModel:
    v = len(arrays.number("v_template", None, 3))
    parents = _parents(arrays.number("parents", None, dtype=np.int64))
    j = len(parents)
    index = arrays.index("skinning_index", j, v, None)
    value = arrays.number("skinning_value", *index.shape)
    _check_weights(value)
    sums = value.sum(1, keepdims=True)
    value /= np.where(np.abs(sums - 1) < 1e-12, 1, sums)  # the file may keep them rounded
    arrays.allowance.take(2 * j * v, 8, "joint regressor and skinning weights")
    regressor = np.zeros((j, v))
    values = arrays.number("joint_regressor_values", None)
    rows, columns = (
        arrays.index(f"joint_regressor_{k}", n, len(values)) for k, n in (("rows", j), ("cols", v))
    )
    np.add.at(regressor, (rows, columns), values)
    numbers = {
        "shapedirs": _own_shapes(arrays, v, num_betas),
        "joint_regressor": regressor,
        "skinning_value": value,
    }
    mesh = read_mesh(arrays, v)
    extras = {key: arrays[key] for key in _EXTRAS if key in arrays and not (mesh and key == "uv")}
    skinning = arrays.text("skinning")[0] if "skinning" in arrays else "lbs"
    own = {
        "parents": parents,
        "joint_names": arrays.text("joint_names"),
        "skinning": skinning,
        "extras": extras,
    }
    own["mesh"] = mesh
    if "expressiondirs" in arrays:
        own["expressiondirs"] = arrays.number("expressiondirs", v, 3, None)
    own["pose_features"] = (
        arrays.text("pose_features")[0] if "pose_features" in arrays else "rotations"
    )
    most = numbers["shapedirs"].shape[-1]
    own["shape_features"] = (
        int(arrays.index("shape_features", most + 1)) if "shape_features" in arrays else 0
    )
    return _build(
        arrays,
        name,
        numbers,
        {"skinning_index": index, "faces": arrays.index("faces", v, None, 3)},
        own,
    )


def _own_shapes(arrays: ModelArrays, v: int, num_betas: int | None) -> np.ndarray:
    """Shape directions (V, 3, B); further ones are read only where more are asked for than come
    first.
    """
    first = arrays.number("shapedirs", v, 3, None)
    if (num_betas or 0) <= first.shape[-1] or "further_shapedirs" not in arrays:
        return first
    return np.concatenate([first, arrays.number("further_shapedirs", v, 3, None)], -1)


def _build(arrays: ModelArrays, name: str, numbers: dict, indices: dict, own: dict) -> BodyModel:
    """A model from checked arrays and what both kinds of file may hold besides."""
    v = len(numbers["shapedirs"])
    j = len(own["parents"])
    b = numbers["shapedirs"].shape[-1]
    numbers["v_template"] = arrays.number("v_template", v, 3)
    if "posedirs" in arrays:
        numbers |= _pose_shapes(arrays, v, j, own)
    if len(own["joint_names"]) != j:
        raise HabitusError(
            f"{len(own['joint_names'])} joint names for {j} joints; expected one each"
        )
    if "mirror" in arrays:
        indices["mirror"] = arrays.index("mirror", v, v)
    if "part" in arrays:
        indices["part"] = _part(arrays, own["joint_names"], v)
    own |= {"landmarks": named_vertices(arrays, v), "extras": MappingProxyType(own["extras"])}
    own |= {"ages": read_ages(arrays, numbers["v_template"]), "dynamics": read_dynamics(arrays, v)}
    own |= {"hinges": read_hinges(arrays, v, j), "face": read_face(arrays, v, j)}
    if "pose_mean" in arrays and "pose_precision" in arrays:
        n = 3 * (j - 1)
        covariance = np.linalg.inv(arrays.number("pose_precision", n, n))
        own["pose_prior"] = PosePrior(
            own["joint_names"][1:], arrays.number("pose_mean", n), covariance
        )
    if "gender_weights" in arrays:
        rows = _sex_rows(arrays, b)
        own |= {"female_rows": rows, "female_direction": (rows[0][-1], float(rows[1][-1]))}
    elif "female_weights" in arrays:
        own["female_direction"] = (
            arrays.number("female_weights", b),
            float(arrays.number("female_bias")),
        )
    for key in ("people_mean", "people_skew"):
        if key in arrays:
            known = arrays.number(key, None)[:b]
            own[key] = np.pad(known, (0, b - len(known)))
    return BodyModel(name=name, **{"posedirs": None, **numbers, **indices, **own})


def _sex_rows(arrays: ModelArrays, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Classifiers (B, B) and their bias (B,) of each number of betas; further betas count for
    nothing.
    """
    bias = arrays.number("gender_bias", None)[:b]
    weights = arrays.number("gender_weights", None, None)[: len(bias), : len(bias)]
    more = b - len(bias)
    if len(weights) != len(bias) or weights.shape[0] != weights.shape[1]:
        raise HabitusError(
            f"gender_weights of shape {weights.shape} and gender_bias of {len(bias)}; expected a "
            "row and a bias for each number of betas"
        )
    return np.pad(np.pad(weights, ((0, 0), (0, more))), ((0, more), (0, 0)), "edge"), np.pad(
        bias, (0, more), "edge"
    )


def _pose_shapes(arrays: ModelArrays, v: int, j: int, own: dict) -> dict:
    """Pose blend shapes, and the joints that drive them where these are some; nothing where all are
    zero.

    A file under official names has columns for all joints, whoever drives.
    """
    features = find_pose_features(own.get("pose_features", "rotations"))
    shapes = own.get("shape_features", 0)
    drivers = read_pose_joints(arrays, j)
    everyone = tuple(range(1, j))
    official = "weights" in arrays
    count = features.count(j if drivers is None or official else 1 + len(drivers), shapes)
    posedirs = arrays.number("posedirs", v, 3, count)
    if official and drivers is not None:
        posedirs = of_joints(posedirs, features.per_joint, everyone, drivers, shapes)
    return (
        {"posedirs": posedirs, "pose_joints": drivers}
        if posedirs.any()
        else {"pose_joints": drivers}
    )


def _part(arrays: ModelArrays, joint_names: tuple[str, ...], v: int) -> np.ndarray:
    """The joint that each vertex belongs to, written as a number or as the joint's name."""
    if arrays["part"].dtype.kind in "iu":
        return arrays.index("part", len(joint_names), v)
    names, rows = np.unique(arrays["part"], return_inverse=True)
    unknown = [name for name in names if name not in joint_names]
    if unknown or len(rows) != v:
        raise HabitusError(
            f"array 'part' names {unknown or len(rows)}; expected a joint for each of {v} vertices"
        )
    return np.array([joint_names.index(name) for name in names])[rows]


def named_vertices(arrays: ModelArrays, v: int) -> Mapping[str, int]:
    """The landmarks of a file, numbers below ``v`` by name; none where it holds none."""
    if "landmark_names" not in arrays:
        return MappingProxyType({})
    names = arrays.text("landmark_names")
    vertices = arrays.index("landmark_vertices", v, len(names))
    return MappingProxyType(dict(zip(names, (int(vertex) for vertex in vertices), strict=True)))


def save_body(model: BodyModel, path: str | Path, *, shape_directions: int = 0) -> None:
    """Write a body model, whole or not at all, with the official names, so that other tools read it
    too.

    ``.npz`` is read by `load_body` and by ``smplx`` for SMPL-H, SMPL-X and MANO; ``.pkl`` (plain
    arrays, no foreign classes) also by ``smplx`` for SMPL. What only habitus knows (landmarks,
    parts, mirror, pose prior, skinning function, ages, quads, hinges) travels along, but not
    ``body.full``: save that by itself. A ``.pkl`` has no hinges; its ``posedirs`` stand in for
    them. Official files have no word for pose blend shapes that are driven by anything but SMPL's
    rotations: such a body goes to a ``.npz`` under the project's own names, which nothing else
    reads. shape_directions: zero directions are appended up to this number; the package ``smplx``
    silently reads only 10 of an SMPL or SMPL-H file with fewer than 300.

    Raises HabitusError for such a body's ``.pkl``, for another ending, for added directions of a
    body with more joints than SMPL-H's, or where nothing can be written.
    """
    target = Path(path)
    if target.suffix not in (".npz", ".pkl"):
        raise HabitusError(f"{target}: ending {target.suffix!r}; expected .npz or .pkl")
    official = is_official(model)
    if target.suffix == ".pkl" and not official:
        raise HabitusError(
            f"{target}: pose features {model.pose_features!r} with {model.shape_features} "
            "shape_features; official "
            "files hold 'rotations' with 0: save the body as .npz"
        )
    if target.suffix == ".pkl":
        model = replace(model, hinges=None)
    arrays = official_form(model) if official else project_form(model)
    if shape_directions > model.num_betas:
        if not official or model.num_joints > len(SMPLH.joint_names):
            raise HabitusError(
                f"shape_directions={shape_directions} for a body with {model.num_joints} joints; "
                "expected one of SMPL's or SMPL-H's: load_body(..., joints='smplh')"
            )
        ours, others = np.split(arrays["shapedirs"], [model.num_betas], axis=2)
        zeros = np.zeros((*ours.shape[:2], shape_directions - model.num_betas))
        arrays["shapedirs"] = np.concatenate([ours, zeros, others], axis=2)
    with atomic_write(target) as temporary, temporary.open("wb") as file:
        if target.suffix == ".npz":
            np.savez(file, allow_pickle=False, **arrays)
        else:
            plain = {
                key: value.tolist() if value.dtype.kind == "U" else value
                for key, value in arrays.items()
            }
            pickle.dump(plain, file, protocol=2)
