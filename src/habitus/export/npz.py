"""A marker fit as one .npz file with the names that AMASS and MoSh++ users know; or (`write_amass`)
in the form that scripts for AMASS slice: 156 pose columns in SMPL-H's order, z up, 16 betas, dmpls.
"""

import json
import os
import zipfile
from collections.abc import Mapping
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from habitus import __version__
from habitus.body.joint_layouts import SMPLH
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.parallel.blocks import blocks, drop_pages, is_file_backed, mapped
from habitus.rotations import up_rotation
from habitus.types import PathLike

if TYPE_CHECKING:
    from habitus.body.motion import Moving
    from habitus.fit.markers.result import MarkerFit


POSE_PARTS = {  # number of joints -> AMASS's names for ranges of joints
    24: {"pose_body": (1, 22), "pose_hand": (22, 24)},
    52: {"pose_body": (1, 22), "pose_hand": (22, 52)},
    55: {"pose_body": (1, 22), "pose_jaw": (22, 23), "pose_eye": (23, 25), "pose_hand": (25, 55)},
}


def write_npz(fit: "MarkerFit", path: PathLike) -> None:
    """Write a ``MarkerFit`` as .npz, atomically, without pickled objects: ``np.load(path)`` reads
    it.

    Everything is in metres, radians and seconds, in the capture's own world frame, whose up axis
    ``up_axis`` names; rotations are rotation vectors. T frames, J joints, B betas, M markers; NaN
    is a missing marker.

    Names of AMASS and MoSh++: ``poses`` (T,3J), ``root_orient`` (T,3), ``pose_body`` and for SMPL
    families ``pose_hand``, ``pose_jaw``, ``pose_eye``; ``trans`` (T,3), ``betas`` (B),
    ``num_betas``, ``gender`` ("neutral": the betas belong to one body for everybody),
    ``mocap_framerate`` = ``mocap_frame_rate`` (Hz), ``mocap_time_length`` (s),
    ``surface_model_type``, ``latent_labels`` (M), ``markers_latent`` (M,3; rest pose),
    ``markers_latent_vids`` (M; the nearest vertex, in the order of ``latent_labels`` where MoSh++
    pickles a dictionary), ``labels_obs`` (M), ``markers_obs`` and ``markers_sim`` (T,M,3).

    This project's own: ``soft_tissue_betas`` (T,B; added to ``betas``), and with dynamics
    ``soft_tissue_dynamics``
    (T,D; AMASS's ``dmpls`` belong to another basis), of a motion with a face ``face_weights``
    (T,U) of ``face_unit_names`` (U), ``markers_sim_pose_stage`` (T,M,3),
    ``marker_weights`` (T,M;
    0..1), ``marker_triangles`` and ``marker_coefficients`` (M,3), ``marker_noise`` (M; m),
    ``flagged_frames`` (T),
    ``suspect_labels``, ``suspect_reasons``, ``suspect_frames``, ``suspect_corrected``,
    ``poses_pose_stage`` (T,3J) and
    ``trans_pose_stage`` (T,3) where there is soft tissue, ``female_probability`` (of a neutral fit,
    where that chose
    the model; else NaN), ``age_years`` (where the body was brought to an age), ``joint_names`` (J),
    ``capture``,
    ``layout``, ``up_axis``, ``seed``, ``status``, ``warnings``, ``settings`` (JSON),
    ``habitus_version``; and what the
    verdict is drawn from beside all that: ``recorded`` (JSON; of the person),
    ``layout_confidence``, ``displaced`` (M),
    ``tried``, ``left_out``, ``doubts``. `habitus.load_fit` reads it back.
    Raises HabitusError where the file cannot be written.
    """
    write_arrays(path, npz_arrays(fit))


def write_arrays(path: PathLike, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as .npz, atomically. Raises HabitusError where it cannot be written."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        save_arrays(file, arrays)


def save_arrays(file: IO[bytes], arrays: Mapping[str, np.ndarray]) -> None:
    """What ``np.savez`` writes, one array after another, without holding any of the large ones in
    memory.
    """
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                _write_array(member, array)


def _write_array(file: IO[bytes], array: np.ndarray) -> None:
    """``np.lib.format.write_array``; a file-backed array a block at a time."""
    if not is_file_backed(array):
        np.lib.format.write_array(file, array, allow_pickle=False)
        return
    header = np.lib.format.header_data_from_array_1_0(array)
    np.lib.format.write_array_header_1_0(file, header | {"fortran_order": False})
    for part in blocks(len(array)):
        file.write(array[part].tobytes())
        drop_pages(array)


def npz_arrays(fit: "MarkerFit") -> dict[str, np.ndarray]:
    """The named arrays of ``write_npz``."""
    return motion_arrays(fit) | _fit_arrays(fit) | _marker_arrays(fit)


def motion_arrays(moving: "Moving") -> dict[str, np.ndarray]:
    """The body in motion under AMASS's names, without the markers of a fit."""
    pose = _as(moving.pose, np.float64)
    frames, joints = pose.shape[:2]
    arrays = {
        "poses": pose.reshape(frames, 3 * joints),
        "root_orient": pose[:, 0],
        "trans": _as(moving.trans, np.float64),
        **shape_arrays(moving.body, moving.betas, moving.body_name, moving.gender),
        "mocap_framerate": np.array(float(moving.rate_hz)),
        "mocap_frame_rate": np.array(float(moving.rate_hz)),
        "mocap_time_length": np.array(frames / float(moving.rate_hz)),
        "joint_names": _texts(moving.body.joint_names),
        "capture": np.array(str(moving.capture_name)),
        "up_axis": np.array(str(moving.up_axis)),
        "habitus_version": np.array(__version__),
    }
    if moving.soft_tissue is not None:
        arrays["soft_tissue_betas"] = _as(moving.soft_tissue, np.float64)
    if moving.dynamics is not None:
        arrays["soft_tissue_dynamics"] = _as(moving.dynamics, np.float64)
    if moving.face is not None:
        arrays["face_weights"] = _as(moving.face, np.float64)
        arrays["face_unit_names"] = _texts(moving.body.face_unit_names)
    for name, (first, last) in POSE_PARTS.get(joints, {"pose_body": (1, joints)}).items():
        arrays[name] = mapped(
            lambda part, a=first, b=last: part[:, a:b].reshape(len(part), -1), pose
        )
    return arrays


def shape_arrays(
    body: BodyModel, betas: Float[np.ndarray, " B"], body_name: str, gender: str
) -> dict[str, np.ndarray]:
    """The person at rest: betas, the body that they belong to, and its age where it has one."""
    arrays = {
        "betas": np.asarray(betas, np.float64),
        "num_betas": np.array(len(betas)),
        "gender": np.array(str(gender)),
        "surface_model_type": np.array(str(body_name)),
    }
    return arrays if body.age is None else arrays | {"age_years": np.array(body.age)}


def _fit_arrays(fit: "MarkerFit") -> dict[str, np.ndarray]:
    return {
        "female_probability": np.array(
            np.nan if fit.female_probability is None else fit.female_probability
        ),
        "layout": np.array(str(fit.layout_name)),
        "seed": np.array(int(fit.seed)),
        "status": np.array(str(fit.status)),
        "warnings": _texts(fit.warnings),
        "recorded": np.array(json.dumps(dict(fit.recorded), default=str, sort_keys=True)),
        "layout_confidence": np.array(
            np.nan if fit.layout_confidence is None else fit.layout_confidence
        ),
        "tried": _texts(fit.tried),
        "left_out": _texts(fit.left_out),
        "doubts": _texts(fit.doubts),
        "settings": np.array(json.dumps(dict(fit.settings), default=str, sort_keys=True)),
    }


def _marker_arrays(fit: "MarkerFit") -> dict[str, np.ndarray]:
    soft = fit.soft_tissue is not None
    predicted = fit.predicted_soft_tissue if soft else fit.predicted_pose_stage
    labels = _texts(fit.labels)
    arrays = {
        "latent_labels": labels,
        "markers_latent": np.asarray(fit.latent_markers, np.float64),
        "markers_latent_vids": _nearest_vertices(fit),
        "labels_obs": labels,
        "markers_obs": _as(fit.observed_markers, np.float32),
        "markers_sim": _as(predicted, np.float32),
        "marker_weights": _as(fit.marker_weights, np.float32),
        "marker_triangles": np.asarray(fit.attachment.triangles, np.int64),
        "marker_coefficients": np.asarray(fit.attachment.coefficients, np.float64),
        "marker_noise": np.asarray(fit.marker_noise, np.float64),
        "flagged_frames": np.asarray(fit.flagged_frames, bool),
        "suspect_labels": _texts([suspect.label for suspect in fit.suspects]),
        "suspect_reasons": _texts([suspect.reason for suspect in fit.suspects]),
        "suspect_frames": np.array([suspect.frames for suspect in fit.suspects], np.int64),
        "suspect_corrected": np.array([suspect.corrected for suspect in fit.suspects], bool),
    }
    if fit.displaced is not None:
        arrays["displaced"] = np.asarray(fit.displaced, np.float64)
    if soft:
        pose, trans = (_as(array, np.float64) for array in fit.pose_stage)
        arrays |= {"poses_pose_stage": pose.reshape(len(pose), -1), "trans_pose_stage": trans}
        arrays["markers_sim_pose_stage"] = _as(fit.predicted_pose_stage, np.float32)
    return arrays


def _as(array: Any, dtype: Any) -> np.ndarray:
    """A long array of another type may lie over a file as well."""
    array = np.asarray(array)
    return array if array.dtype == dtype else mapped(lambda part: part.astype(dtype), array)


def _texts(words: Any) -> np.ndarray:
    """Strings as a fixed-width unicode array, also where there are none."""
    return np.array([str(word) for word in words], dtype=np.str_)


def _nearest_vertices(fit: "MarkerFit") -> np.ndarray:
    rest = fit.body.rest_vertices(np.asarray(fit.betas, np.float64))
    return np.asarray(KDTree(rest).query(np.asarray(fit.latent_markers, np.float64))[1], np.int64)


STYLES = ("habitus", "amass")
"""What a body.npz can look like: this project's own arrays under AMASS's names, or exactly what
AMASS scripts slice.
"""
BETAS = 16
DMPLS = 8
BODY_JOINTS = 22
SMPL_VERTICES = 6890


def write_amass(fit: "Moving", path: str | os.PathLike[str]) -> None:
    """Write a fit or a motion as .npz for AMASS scripts, atomically; docs/amass.md says what fits
    and what does not.

    T frames; z is up whatever the capture's axis was; metres, radians. ``poses`` (T,156): root, the
    21 joints of SMPL-H's body by their names, 30 finger joints (zero where the body has none);
    ``trans`` (T,3), ``betas`` (16), ``dmpls`` (T,8; zero: soft tissue has another basis here),
    ``gender``, ``mocap_framerate`` (Hz).

    ``betas`` are the fit's only where its body is an SMPL-H; otherwise they are zero, because
    SMPL-H would take those of another shape space and show another person. ``body`` names the body,
    ``body_betas`` are its own betas, ``age_years`` its age where it was brought to one, and
    ``root_joint`` (3) is where its root joint rests: a body whose root rests at r stands where the
    fit stands with ``trans + root_joint - r``.

    Raises HabitusError where the body has not the joints of SMPL-H's body, and where the file
    cannot be written.
    """
    write_arrays(path, amass_arrays(fit))


def check_npz_style(style: str, body: BodyModel) -> None:
    """Raises HabitusError for a style that is not known, or that this body's joints do not fit
    in.
    """
    if style not in STYLES:
        raise HabitusError(f"npz_style is {style!r}; expected one of {', '.join(STYLES)}")
    missing = [name for name in SMPLH.joint_names[:BODY_JOINTS] if name not in body.joint_names]
    if style == "amass" and missing:
        raise HabitusError(
            f"the body {body.name} has no joint {missing[0]}, which SMPL-H's poses have: AMASS's "
            "style cannot hold its "
            "motion; leave npz_style at habitus"
        )


def amass_arrays(fit: "Moving") -> dict[str, np.ndarray]:
    """The named arrays of ``write_amass``."""
    check_npz_style("amass", fit.body)
    frames = len(fit.pose)
    own = np.asarray(fit.betas, np.float64)
    root = fit.body.rest_joints(own)[0]
    pose, trans = _upright(fit, root)
    return {
        "poses": mapped(lambda part: _smplh_poses(part, fit.body.joint_names), pose),
        "trans": trans,
        "betas": _first(own, BETAS) if is_smplh(fit.body) else np.zeros(BETAS),
        "dmpls": np.zeros((frames, DMPLS)),
        "gender": np.array(str(fit.gender)),
        "mocap_framerate": np.array(float(fit.rate_hz)),
        "body": np.array(str(fit.body_name)),
        "body_betas": own,
        "root_joint": root,
        "npz_style": np.array("amass"),
        "habitus_version": np.array(__version__),
    } | ({} if fit.body.age is None else {"age_years": np.array(fit.body.age)})


def is_smplh(body: BodyModel) -> bool:
    """Whether a body's betas can be those of an SMPL-H: by its joints and its number of
    vertices.
    """
    return body.joint_names == SMPLH.joint_names and body.num_vertices == SMPL_VERTICES


def _upright(
    fit: "Moving", root: np.ndarray
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """Pose and trans in a world whose z is up; the root turns about its own rest place."""
    turn = up_rotation("+z").T @ up_rotation(fit.up_axis)
    pose = mapped(lambda part: _turned(part, Rotation.from_matrix(turn)), np.asarray(fit.pose))
    return pose, (np.asarray(fit.trans, np.float64) + root) @ turn.T - root


def _turned(pose: np.ndarray, turn: Rotation) -> np.ndarray:
    out = np.array(pose, np.float64)
    out[:, 0] = (turn * Rotation.from_rotvec(out[:, 0])).as_rotvec()
    return out


def _smplh_poses(pose: np.ndarray, names: tuple[str, ...]) -> Float[np.ndarray, "T 156"]:
    out = np.zeros((len(pose), len(SMPLH.joint_names), 3))
    for column, name in enumerate(SMPLH.joint_names):
        if name in names:
            out[:, column] = pose[:, names.index(name)]
    return out.reshape(len(pose), -1)


def _first(values: np.ndarray, count: int) -> np.ndarray:
    return np.pad(values[:count], (0, max(0, count - len(values))))
