"""Opens whatever holds a person: a fit, a motion, an npz of AMASS, a shape, a body model, a mesh.

One reader decides by the file's ending and the names of its arrays, and one function chooses the
body that its betas belong to.

========================  ==========================================  ======================
file                      recognised by                               opened as
========================  ==========================================  ======================
body.npz of a fit         ``marker_triangles``                        `MarkerFit`
motion, AMASS npz         ``poses``                                   `BodyMotion`
person of habitus body    ``betas``, and no ``shapedirs``             `BodyShape`
body model                a shipped name, .pkl, or any other npz      `BodyModel`
mesh                      .ply, .obj                                  `Mesh`
skeleton in motion        .bvh, .glb, .gltf, .fbx                     `BodyMotion`
========================  ==========================================  ======================
"""

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.body.joint_layouts import SMPL, SMPLH, SMPLX
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.recentred import recentred
from habitus.errors import HabitusError, shown
from habitus.fit.markers.result import MarkerFit
from habitus.io.archives import open_archive, reason
from habitus.io.marker_fit_arrays import (
    check_finite,
    checked_fit,
    frame_rate,
    latent_marker_distance,
    marker_fit,
)
from habitus.io.meshes import ENDINGS as MESH_ENDINGS
from habitus.io.meshes import read_mesh
from habitus.io.models.bodies import SHIPPED, SHIPPED_BETAS, load_body
from habitus.io.motions.open import ENDINGS as RIG_ENDINGS
from habitus.io.motions.open import read_foreign_motion
from habitus.mesh.normals import vertex_normals
from habitus.rotations import UP_AXES

BodyLike = BodyModel | str | os.PathLike[str] | None
FIT_FILE = "body.npz"
"""The file of a result folder that holds the person."""

_BODY_NAMES = ("character_base", "body", "surface_model_type")
"""Arrays that name the body of the betas; the first one present holds."""
_SHAPE_ARRAYS = (
    *_BODY_NAMES,
    "betas",
    "body_betas",
    "age_years",
    "character_vertices",
    "gender",
    "skin_offset",
)
_FIT_ARRAYS = (
    "poses",
    "trans",
    "betas",
    "latent_labels",
    "markers_latent",
    "markers_obs",
    "markers_sim",
    "settings",
)
_LAYOUTS = {3 * len(layout.joint_names): layout for layout in (SMPL, SMPLH, SMPLX)}
_SAME_BODY = 1e-3
"""Metres between latent markers of one body: its files in float32 and float64 differ by 1e-6."""
_REST_RATE = 30.0  # Hz, of the two frames that show a person at rest


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in the file's unit: vertices (V, 3) and faces (F, 3) in the file's order."""

    name: str
    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]


@dataclass(frozen=True, eq=False)
class BodyShape:
    """One person at rest: a body and betas (B,), in metres.

    ``body_name`` is how the file names the body. ``skin_offset`` (V,) displaces the skin outwards
    along its normals, where a fit to depth views measured it.
    """

    name: str
    body: BodyModel
    betas: Float[np.ndarray, " B"]
    body_name: str
    gender: str = "neutral"
    skin_offset: Float[np.ndarray, " V"] | None = None

    def rest_vertices(self) -> Float[np.ndarray, "V 3"]:
        """The surface at rest, skin offset included."""
        rest = self.body.rest_vertices(self.betas)
        if self.skin_offset is None:
            return rest
        return rest + self.skin_offset[:, None] * vertex_normals(rest, self.body.faces)

    def standing(self) -> BodyMotion:
        """Two frames at rest with the soles on the ground, +y up."""
        floor = -float(self.body.rest_vertices(self.betas)[:, 1].min())
        return BodyMotion(
            self.body,
            self.betas,
            np.zeros((2, self.body.num_joints, 3)),
            np.tile([0.0, floor, 0.0], (2, 1)),
            _REST_RATE,
            "+y",
            capture_name=self.name,
            body_name=self.body_name,
            gender=self.gender,
            made=(f"at rest, from {self.name}",),
        )


PersonData = MarkerFit | BodyMotion | BodyShape | BodyModel | Mesh
"""What a file can hold."""


def open_person(path: str | os.PathLike[str], body: BodyLike = None) -> PersonData:
    """What the file holds, by its ending and the names inside; see the table of this module.

    path: a shipped body by name, a file, or a result folder, for its body.npz. body: the model that
    the betas belong to, loaded or a file; needed where the file names none of the shipped bodies.
    Raises HabitusError, with the file named, for a file that holds no person or a damaged one.
    """
    if _is_body(path):
        return load_body(os.fspath(path))
    source = Path(path)
    if source.suffix.lower() in MESH_ENDINGS:
        return Mesh(source.stem, *read_mesh(source))
    if source.suffix.lower() in RIG_ENDINGS:
        return _foreign(source, body)
    file = _read(person_file(source))
    if file.kind == "body":
        return load_body(file.source)
    return _OPENERS[file.kind](file, body)


def read_fit(path: str | os.PathLike[str], body: BodyLike = None) -> MarkerFit:
    """The `MarkerFit` of a body.npz that ``habitus mosh`` or ``fit.save`` wrote.

    body: the model that was fitted, loaded or a file; needed where it is none of the shipped
    bodies, as a fit's file holds no body. Not in the file: held-out errors, costs and timings,
    which metrics.json beside it has. Observed and predicted markers are kept in float32. Raises
    HabitusError, with the file named, where it holds no such fit or the body is another.
    """
    file = _read(person_file(path))
    if str(file.arrays.get("npz_style")) == "amass":
        raise HabitusError(
            f"{file.source}: an npz in AMASS's style, which has no markers and no soft tissue; "
            "write the fit with npz_style 'habitus'"
        )
    file.require(_FIT_ARRAYS, "the body.npz of a marker fit")
    return _marker_fit(file, body)


def read_motion(path: str | os.PathLike[str], body: BodyLike = None) -> BodyMotion:
    """The motion in an npz of ``habitus mosh``, ``exaggerate`` or ``retarget``, or of AMASS, or of
    any person's skeleton in a BVH, glTF or FBX (`habitus.io.motions.open`).

    AMASS: ``poses`` (T, 3J; rad), ``trans`` (T, 3; m), ``betas``, ``mocap_framerate`` (Hz), z up.
    body: as in `open_person`. Raises HabitusError, with the file named, where it holds no motion,
    or where the betas belong to another body.
    """
    if Path(path).suffix.lower() in RIG_ENDINGS:
        return _foreign(Path(path), body)
    file = _read(person_file(path))
    file.require(("poses", "trans"), "the body.npz of a fit, or an npz of AMASS")
    return BodyMotion.of(_OPENERS[file.kind](file, body))


def read_shape(
    path: str | os.PathLike[str],
    body: BodyLike = None,
    known: Mapping[str, BodyModel] | None = None,
) -> BodyShape:
    """The person at rest of a file with betas (fit, motion, person), or a body's mean person.

    body: as in `open_person`. known: loaded bodies by the names that files give them.
    Raises HabitusError, with the file named.
    """
    source = person_file(path)
    if not _is_body(path):
        file = _read(source, _SHAPE_ARRAYS)
        if body is None and file.body_name not in SHIPPED:
            body = (known or {}).get(file.body_name)
        if file.kind != "body":
            return _shape(file, body)
    model = load_body(os.fspath(path))
    return BodyShape(model.name, model, np.zeros(model.num_betas), model.name)


def _foreign(path: Path, body: BodyLike) -> BodyMotion:
    """The motion of somebody else's skeleton, on a body or on the person of a file."""
    if body is None or isinstance(body, BodyModel):
        return read_foreign_motion(path, body)
    person = read_shape(body)
    given = None if _is_body(body) or not person.betas.any() else person.betas
    return read_foreign_motion(path, person.body, given)


def person_file(path: str | os.PathLike[str]) -> Path:
    """The file itself, or the body.npz of a result folder. Raises HabitusError for others."""
    source = Path(path)
    if not source.is_dir():
        return source
    if not (source / FIT_FILE).is_file():
        raise HabitusError(f"{source}: a folder without {FIT_FILE}; expected a result folder")
    return source / FIT_FILE


def _is_body(path: str | os.PathLike[str]) -> bool:
    """Whether the name alone identifies a body model."""
    return str(path) in SHIPPED or Path(path).suffix.lower() == ".pkl"


@dataclass(frozen=True, eq=False)
class _PersonFile:
    """The arrays of an npz, and its kind: fit, motion, shape or body."""

    source: Path
    kind: str
    arrays: Mapping[str, np.ndarray]

    @property
    def body_name(self) -> str:
        """How the file names the body of its betas; empty if it does not."""
        return next((str(self.arrays[key]) for key in _BODY_NAMES if key in self.arrays), "")

    @property
    def name(self) -> str:
        """The file's name without its ending, of a body.npz that of its folder."""
        at = self.source
        return at.resolve().parent.name if at.name == FIT_FILE else at.stem

    def require(self, names: Collection[str], expected: str) -> None:
        """Raises HabitusError where an array is missing."""
        missing = [name for name in names if name not in self.arrays]
        if missing:
            raise HabitusError(f"{self.source}: holds no {missing[0]}; expected {expected}")


def _read(source: Path, names: Collection[str] | None = None) -> _PersonFile:
    """All arrays of an npz, or those of these ``names``; none of a body model's."""
    expected = "a fit, a motion, a person or a body model (.npz)"
    try:
        with open_archive(source) as archive:
            kind = _kind(archive.names)
            chosen = () if kind == "body" else (names or archive.names)
            arrays = {name: archive.read(name) for name in chosen if name in archive}
    except FileNotFoundError:
        raise HabitusError(f"{source}: no such file; expected {expected}") from None
    except (OSError, HabitusError) as error:
        raise HabitusError(
            f"{source}: cannot be read ({reason(error)}); expected {expected}"
        ) from error
    return _PersonFile(source, kind, arrays)


@contextmanager
def _guarded(file: _PersonFile) -> Iterator[None]:
    """Around code that takes arrays of any kind and shape: every error becomes a HabitusError."""
    try:
        yield
    except HabitusError:
        raise
    except Exception as error:
        raise HabitusError(
            f"{file.source}: its arrays do not fit together ({reason(error)}); write it again"
        ) from error


def _kind(names: Collection[str]) -> str:
    if "marker_triangles" in names:
        return "fit"
    if "poses" in names:
        return "motion"
    return "shape" if "betas" in names and "shapedirs" not in names else "body"


def _model(file: _PersonFile, body: BodyLike) -> BodyModel:
    """The body of the betas: the given one, or the shipped one that the file names, at its age."""
    arrays = file.arrays
    name = file.body_name
    if body is None and name not in SHIPPED:
        owner = f"belong to the body {shown(name)!r}" if name else "name no body"
        raise HabitusError(
            f"{file.source}: its betas {owner}; give that body (--body FILE, or body=)"
        )
    model = body if isinstance(body, BodyModel) else _loaded(file, name if body is None else body)
    if file.kind == "motion" and model.name in SHIPPED and SHIPPED[model.name] != SHIPPED.get(name):
        raise HabitusError(
            f"{file.source}: its betas belong to {shown(name) or 'SMPL-H or a similar body'}; on "
            f"{model.name} they describe another person; give their body (--body FILE, or body=)"
        )
    if "age_years" in arrays and model.age is None and model.ages is not None:
        model = model.at_age(float(arrays["age_years"]))
    if "character_vertices" not in arrays:
        return model
    return recentred(model, arrays["character_vertices"], str(arrays["surface_model_type"]))


def _loaded(file: _PersonFile, name: str | os.PathLike[str]) -> BodyModel:
    """A body by name or file; a shipped one with the joints that the poses have, and with all its
    betas where the person has further ones.
    """
    poses = file.arrays.get("poses")
    joints = None
    if str(name) in SHIPPED and poses is not None and "body_betas" not in file.arrays:
        layout = _LAYOUTS.get(poses.shape[-1])
        joints = None if layout is None else layout.name
    model = load_body(os.fspath(name), joints=joints)
    betas = np.ravel(file.arrays.get("body_betas", file.arrays.get("betas", ())))
    if str(name) in SHIPPED and betas[model.num_betas :].any():
        return load_body(os.fspath(name), joints=joints, num_betas=SHIPPED_BETAS)
    return model


def _betas(file: _PersonFile, body: BodyModel) -> Float[np.ndarray, " B"]:
    """The betas of the person, as many as the body has; missing ones are zero."""
    arrays = file.arrays
    given = arrays.get("body_betas", arrays.get("betas", np.zeros(0)))
    betas = np.asarray(given, np.float64)
    if sum(n > 1 for n in betas.shape) > 1 or not np.isfinite(betas).all():
        raise HabitusError(
            f"{file.source}: betas of shape {betas.shape}; expected finite numbers (B,) of one "
            "person"
        )
    betas = betas.ravel()
    with _guarded(file):
        check_finite("betas", betas)
    if betas[body.num_betas :].any():
        raise HabitusError(
            f"{file.source}: {len(betas)} betas; {body.name} has {body.num_betas}; give the body "
            "that they belong to (--body FILE, or body=)"
        )
    return np.pad(betas[: body.num_betas], (0, max(body.num_betas - len(betas), 0)))


def _shape(file: _PersonFile, body: BodyLike) -> BodyShape:
    with _guarded(file):
        return _shape_data(file, _model(file, body))


def _shape_data(file: _PersonFile, model: BodyModel) -> BodyShape:
    arrays = file.arrays
    if "body_betas" not in arrays:
        file.require(("betas",), "the betas of a person")
    skin = _optional(arrays, "skin_offset")
    if skin is not None and skin.shape != (model.num_vertices,):
        raise HabitusError(
            f"{file.source.name}: skin_offset is {skin.shape}; expected ({model.num_vertices},), "
            f"one per vertex of {model.name}; give the body that was fitted (--body FILE, or body=)"
        )
    if skin is not None:
        check_finite("skin_offset", skin)
    return BodyShape(
        name=model.name if "character_vertices" in arrays else file.name,
        body=model,
        betas=_betas(file, model),
        body_name=file.body_name or model.name,
        gender=str(arrays.get("gender", "neutral")),
        skin_offset=skin,
    )


def _motion(file: _PersonFile, body: BodyLike) -> BodyMotion:
    file.require(("poses", "trans"), "the body.npz of a fit, or an npz of AMASS")
    with _guarded(file):
        return _checked_motion(_motion_data(file, _model(file, body)))


def _motion_data(file: _PersonFile, body: BodyModel) -> BodyMotion:
    arrays = file.arrays
    made = tuple(map(str, np.atleast_1d(arrays.get("made", f"read from {file.source.name}"))))
    if not {"betas", "body_betas", "character_vertices"} & set(arrays):
        made += ("its file has no betas: the mean person moves",)
    if np.any(arrays.get("dmpls", 0)):
        made += ("its dmpls, soft tissue in a basis of SMPL's, were left out",)
    return BodyMotion(
        body=body,
        betas=_betas(file, body),
        pose=_pose(file.source, np.asarray(arrays["poses"], np.float64), body),
        trans=np.asarray(arrays["trans"], np.float64),
        rate_hz=frame_rate(arrays),
        up_axis=str(arrays.get("up_axis", "+z")),
        soft_tissue=_optional(arrays, "soft_tissue_betas"),
        dynamics=_optional(arrays, "soft_tissue_dynamics"),
        face=_optional(arrays, "face_weights"),
        capture_name=str(arrays.get("capture", file.source.stem)),
        body_name=str(arrays.get("surface_model_type", arrays.get("body", body.name))),
        gender=str(arrays.get("gender", "neutral")),
        made=made,
    )


def _pose(
    source: Path, poses: Float[np.ndarray, "T N"], body: BodyModel
) -> Float[np.ndarray, "T J 3"]:
    """Rotation vectors of the body's joints, matched by name for files of another skeleton."""
    given = poses.reshape(len(poses), -1, 3)
    if given.shape[1] == body.num_joints:
        return given
    layout = _LAYOUTS.get(3 * given.shape[1])
    if layout is None:
        raise HabitusError(
            f"{source}: poses of {given.shape[1]} joints; {body.name} has {body.num_joints}; "
            "expected those of the body, or of SMPL, SMPL-H or SMPL-X"
        )
    pose = np.zeros((len(given), body.num_joints, 3))
    for joint, name in enumerate(body.joint_names):
        if name in layout.joint_names:
            pose[:, joint] = given[:, layout.joint_names.index(name)]
    return pose


def _checked_motion(motion: BodyMotion) -> BodyMotion:
    """The motion unchanged. Raises ValueError where its arrays do not fit together."""
    frames = len(motion.trans)
    body = motion.body
    shapes: dict[str, tuple[Any, tuple[int, ...]]] = {
        "poses": (motion.pose, (frames, body.num_joints, 3)),
        "trans": (motion.trans, (frames, 3)),
        "soft_tissue_betas": (motion.soft_tissue, (frames, body.num_betas)),
        "soft_tissue_dynamics": (motion.dynamics, (frames, body.num_dynamics)),
        "face_weights": (motion.face, (frames, len(body.face_unit_names))),
    }
    for name, (array, shape) in shapes.items():
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} of shape {array.shape}; expected {shape}")
        if array is not None:
            check_finite(name, array)
    if not frames:
        raise ValueError("no frames")
    if motion.up_axis not in UP_AXES:
        raise ValueError(f"up_axis is {shown(motion.up_axis)}")
    return motion


def _marker_fit(file: _PersonFile, body: BodyLike) -> MarkerFit:
    file.require(_FIT_ARRAYS, "the body.npz of a marker fit")
    with _guarded(file):
        return checked_fit(marker_fit(file.arrays, _fitted_model(file, body)))


def _fitted_model(file: _PersonFile, body: BodyLike) -> BodyModel:
    """The body that was fitted: its rest surface carries the markers to their latent places."""
    arrays = file.arrays
    model = _model(file, body)
    counts = (model.num_joints, model.num_betas)
    expected = (arrays["poses"].shape[1] // 3, len(arrays["betas"]))
    if counts != expected:
        raise HabitusError(
            f"{file.source}: was fitted with the body {file.body_name!r} of {expected[0]} joints "
            f"and {expected[1]} betas; {model.name} has {counts[0]} and {counts[1]}"
        )
    check_finite("betas", np.asarray(arrays["betas"], np.float64))
    distance = latent_marker_distance(arrays, model)
    if distance > _SAME_BODY:
        where = f"{1e3 * distance:.0f} mm away" if np.isfinite(distance) else "of another mesh"
        raise HabitusError(
            f"{file.source}: was fitted with the body {file.body_name!r}; on {model.name} the same "
            f"betas describe another person, whose skin is {where} at the markers; give the body "
            "that was fitted, load_fit(path, body=FILE)"
        )
    return model


def _optional(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    return np.asarray(arrays[name], np.float64) if name in arrays else None


_OPENERS: Mapping[str, Callable[[_PersonFile, BodyLike], Any]] = {
    "fit": _marker_fit,
    "motion": _motion,
    "shape": _shape,
}
