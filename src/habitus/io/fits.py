"""Reads a fit back from the body.npz that it was written to."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.joint_layouts import SMPL, SMPLH, SMPLX
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.suspects import Suspect
from habitus.io.archives import open_archive, reason
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.observe.markers import MarkerAttachment, predict_markers

_NEEDED = (
    "poses",
    "trans",
    "betas",
    "latent_labels",
    "markers_latent",
    "markers_obs",
    "markers_sim",
    "settings",
)
_JOINT_SETS = {len(layout.joint_names): layout.name for layout in (SMPL, SMPLH, SMPLX)}
_SAME_BODY = 1e-3  # metres: files of one body in float32 and float64 agree a thousand times better


def load_fit(
    path: str | os.PathLike[str], body: BodyModel | str | os.PathLike[str] | None = None
) -> MarkerFit:
    """The `MarkerFit` of a body.npz that ``habitus mosh`` or ``fit.save`` wrote, ready to be used
    and exported.

    body: the model that was fitted, loaded or a file; needed where it is none that comes along, as
    a fit's file holds no body. What the file does not keep: held-out errors, costs and timings,
    which stand in metrics.json beside it; observed and predicted markers are kept in float32.
    Raises HabitusError, with the file named, where it holds no such fit or the body is another.
    """
    source = Path(path)
    try:
        with open_archive(source) as file:
            arrays = {name: file.read(name) for name in file.names}
    except FileNotFoundError:
        raise HabitusError(f"{source}: no such file; expected the body.npz of a fit") from None
    except (OSError, HabitusError) as error:
        raise HabitusError(
            f"{source}: cannot be read ({reason(error)}); expected the body.npz of a fit"
        ) from error
    if str(arrays.get("npz_style")) == "amass":
        raise HabitusError(
            f"{source}: is in AMASS's style, which keeps neither markers nor soft tissue; fit "
            "with npz_style 'habitus'"
        )
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise HabitusError(
            f"{source}: holds no {missing[0]}; expected the body.npz of a fit that habitus wrote"
        )
    try:
        model = _body(source, arrays, body)
        return _checked(_fit(arrays, model))
    except HabitusError:
        raise
    except Exception as error:  # what is there may be of any kind and shape
        raise HabitusError(
            f"{source}: its arrays do not fit together ({reason(error)}); fit the capture anew"
        ) from error


def _body(source: Path, arrays: dict[str, np.ndarray], body: Any) -> BodyModel:
    name = str(arrays["surface_model_type"])
    if body is None and name not in SHIPPED:
        raise HabitusError(
            f"{source}: was fitted with the body {name!r}; give it, load_fit(path, body=FILE)"
        )
    if not isinstance(body, BodyModel):
        joints = _JOINT_SETS.get(arrays["poses"].shape[1] // 3) if body is None else None
        body = load_body(name if body is None else os.fspath(body), joints=joints)
    if "age_years" in arrays and body.age is None and body.ages is not None:
        body = body.at_age(float(arrays["age_years"]))
    found = (body.num_joints, body.num_betas)
    wanted = (arrays["poses"].shape[1] // 3, len(arrays["betas"]))
    if found != wanted:
        raise HabitusError(
            f"{source}: was fitted with the body {name!r} of {wanted[0]} joints and {wanted[1]} "
            "betas; "
            f"{body.name} has {found[0]} and {found[1]}"
        )
    away = _markers_off(arrays, body)
    if away > _SAME_BODY:
        far = f"{1e3 * away:.0f} mm away" if np.isfinite(away) else "of another mesh"
        raise HabitusError(
            f"{source}: was fitted with the body {name!r}; on {body.name} the same betas are "
            "another person, whose "
            f"skin is {far} at its markers; give the body that was fitted, load_fit(path, "
            "body=FILE)"
        )
    return body


def _markers_off(arrays: dict[str, np.ndarray], body: BodyModel) -> float:
    """How far the rest surface of this body carries the markers from where the fit has them,
    metres, at the worst.
    """
    triangles = arrays["marker_triangles"]
    if not len(triangles):
        return 0.0
    if not 0 <= triangles.min() <= triangles.max() < body.num_vertices:
        return np.inf
    attachment = MarkerAttachment(triangles, arrays["marker_coefficients"])
    carried = predict_markers(body.rest_vertices(arrays["betas"]), attachment)
    return float(np.linalg.norm(carried - arrays["markers_latent"], axis=1).max())


def _checked(fit: MarkerFit) -> MarkerFit:
    """The fit as it is. Raises ValueError where its arrays do not fit together."""
    frames = len(fit.trans)
    markers = len(fit.labels)
    joints = fit.body.num_joints
    before = fit.pose_stage
    shapes = {
        "poses": (fit.pose, (frames, joints, 3)),
        "trans": (fit.trans, (frames, 3)),
        "poses_pose_stage": (before[0], (frames, joints, 3)),
        "trans_pose_stage": (before[1], (frames, 3)),
        "betas": (fit.betas, (fit.body.num_betas,)),
        "soft_tissue_betas": (fit.soft_tissue, (frames, fit.body.num_betas)),
        "soft_tissue_dynamics": (fit.dynamics, (frames, fit.body.num_dynamics)),
        "markers_latent": (fit.latent_markers, (markers, 3)),
        "markers_obs": (fit.observed_markers, (frames, markers, 3)),
        "markers_sim": (fit.predicted_soft_tissue, (frames, markers, 3)),
        "markers_sim_pose_stage": (fit.predicted_pose_stage, (frames, markers, 3)),
        "marker_weights": (fit.marker_weights, (frames, markers)),
        "marker_noise": (fit.marker_noise, (markers,)),
    }
    for name, (array, shape) in shapes.items():
        if array is not None and (array.shape != shape or array.dtype.kind != "f"):
            raise ValueError(f"{name} are {array.dtype} of shape {array.shape}; expected {shape}")
    if not 0 < fit.rate_hz < 1e6:
        raise ValueError(f"the rate is {fit.rate_hz:g} Hz")
    return fit


def _fit(arrays: dict[str, np.ndarray], body: BodyModel) -> MarkerFit:
    pose = arrays["poses"].reshape(len(arrays["poses"]), -1, 3)
    trans = arrays["trans"]
    soft = arrays.get("soft_tissue_betas")
    before = pose if soft is None else arrays["poses_pose_stage"].reshape(pose.shape)
    last = arrays["markers_sim"].astype(np.float64)
    told = [arrays[f"suspect_{what}"].tolist() for what in ("labels", "reasons", "frames")]
    corrected = arrays.get("suspect_corrected", np.zeros(len(told[0]), bool)).tolist()
    return MarkerFit(
        capture_name=str(arrays["capture"]),
        body_name=str(arrays["surface_model_type"]),
        layout_name=str(arrays["layout"]),
        body=body,
        up_axis=str(arrays["up_axis"]),
        rate_hz=float(arrays["mocap_frame_rate"]),
        labels=tuple(arrays["latent_labels"].tolist()),
        betas=arrays["betas"],
        latent_markers=arrays["markers_latent"],
        attachment=MarkerAttachment(arrays["marker_triangles"], arrays["marker_coefficients"]),
        pose=pose,
        trans=trans,
        soft_tissue=soft,
        dynamics=arrays.get("soft_tissue_dynamics"),
        pose_stage=(before, trans if soft is None else arrays["trans_pose_stage"]),
        observed_markers=arrays["markers_obs"].astype(np.float64),
        predicted_pose_stage=last
        if soft is None
        else arrays["markers_sim_pose_stage"].astype(np.float64),
        predicted_soft_tissue=None if soft is None else last,
        marker_weights=arrays["marker_weights"].astype(np.float64),
        marker_noise=arrays["marker_noise"],
        flagged_frames=arrays["flagged_frames"],
        suspects=tuple(Suspect(*one) for one in zip(*told, corrected, strict=True)),
        warnings=tuple(arrays["warnings"].tolist()),
        settings=json.loads(str(arrays["settings"])),
        status=str(arrays["status"]),
        seed=int(arrays["seed"]),
        gender=str(arrays["gender"]),
        female_probability=_known(arrays.get("female_probability")),
        **_judged(arrays),
    )


def _known(value: np.ndarray | None) -> float | None:
    return None if value is None or np.isnan(value) else float(value)


def _judged(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """What the verdict is drawn from beside the fit itself; older files lack it."""
    if "recorded" not in arrays:
        return {}
    confidence = float(arrays["layout_confidence"])
    return {
        "recorded": json.loads(str(arrays["recorded"])),
        "layout_confidence": None if np.isnan(confidence) else confidence,
        "displaced": arrays.get("displaced"),
        "tried": tuple(arrays["tried"].tolist()),
        "left_out": tuple(arrays["left_out"].tolist()),
        "doubts": tuple(arrays["doubts"].tolist()) if "doubts" in arrays else (),
    }
