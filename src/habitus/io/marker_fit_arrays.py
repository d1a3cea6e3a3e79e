"""A marker fit from the arrays of its body.npz, and the checks that these fit together."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from habitus.arrays import first_not_finite
from habitus.body.model import BodyModel
from habitus.errors import shown
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.suspects import Suspect
from habitus.io.captures.read import FASTEST_HZ, SLOWEST_HZ
from habitus.observe.markers import MarkerAttachment, predict_markers
from habitus.parallel.blocks import drop_pages, mapped
from habitus.rotations import UP_AXES

MAX_NUMBER = 1e6
MAX_BETA = 100.0
"""Standard deviations from the mean person; real people are within 6."""
"""Of radians, metres and coefficients: beyond it surfaces overflow or lose their millimetres."""
_WITH_GAPS = ("markers_obs", "markers_sim", "markers_sim_pose_stage", "marker_weights")


def latent_marker_distance(arrays: Mapping[str, np.ndarray], body: BodyModel) -> float:
    """The largest distance (m) of the file's latent markers from those on this body at rest."""
    triangles = arrays["marker_triangles"]
    if not len(triangles):
        return 0.0
    if not 0 <= triangles.min() <= triangles.max() < body.num_vertices:
        return np.inf
    attachment = MarkerAttachment(triangles, arrays["marker_coefficients"])
    carried = predict_markers(body.rest_vertices(arrays["betas"]), attachment)
    return float(np.linalg.norm(carried - arrays["markers_latent"], axis=1).max())


def marker_fit(arrays: Mapping[str, np.ndarray], body: BodyModel) -> MarkerFit:
    """The fit whose arrays these are, on its body."""
    pose = arrays["poses"].reshape(len(arrays["poses"]), -1, 3)
    trans = arrays["trans"]
    predicted = _float64(arrays["markers_sim"])
    soft = arrays.get("soft_tissue_betas")
    pose_stage, predicted_pose_stage = (pose, trans), predicted
    if soft is not None:
        pose_stage = arrays["poses_pose_stage"].reshape(pose.shape), arrays["trans_pose_stage"]
        predicted_pose_stage = _float64(arrays["markers_sim_pose_stage"])
    return MarkerFit(
        capture_name=str(arrays["capture"]),
        body_name=str(arrays["surface_model_type"]),
        layout_name=str(arrays["layout"]),
        body=body,
        up_axis=str(arrays["up_axis"]),
        rate_hz=frame_rate(arrays),
        labels=tuple(arrays["latent_labels"].tolist()),
        betas=arrays["betas"],
        latent_markers=arrays["markers_latent"],
        attachment=MarkerAttachment(arrays["marker_triangles"], arrays["marker_coefficients"]),
        pose=pose,
        trans=trans,
        soft_tissue=soft,
        dynamics=arrays.get("soft_tissue_dynamics"),
        pose_stage=pose_stage,
        observed_markers=_float64(arrays["markers_obs"]),
        predicted_pose_stage=predicted_pose_stage,
        predicted_soft_tissue=None if soft is None else predicted,
        marker_weights=_float64(arrays["marker_weights"]),
        marker_noise=arrays["marker_noise"],
        flagged_frames=arrays["flagged_frames"],
        suspects=_suspects(arrays),
        warnings=tuple(arrays["warnings"].tolist()),
        settings=json.loads(str(arrays["settings"])),
        status=str(arrays["status"]),
        seed=int(arrays["seed"]),
        gender=str(arrays["gender"]),
        female_probability=_number(arrays.get("female_probability")),
        **_evidence(arrays),
    )


def _float64(array: np.ndarray) -> np.ndarray:
    return mapped(lambda part: part.astype(np.float64), array)


def _suspects(arrays: Mapping[str, np.ndarray]) -> tuple[Suspect, ...]:
    columns = [arrays[f"suspect_{name}"].tolist() for name in ("labels", "reasons", "frames")]
    corrected = arrays.get("suspect_corrected", np.zeros(len(columns[0]), bool)).tolist()
    return tuple(Suspect(*row) for row in zip(*columns, corrected, strict=True))


def _evidence(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """What the verdict needs beside the fit itself; older files lack it."""
    if "recorded" not in arrays:
        return {}
    return {
        "recorded": json.loads(str(arrays["recorded"])),
        "layout_confidence": _number(arrays["layout_confidence"]),
        "displaced": arrays.get("displaced"),
        "tried": tuple(arrays["tried"].tolist()),
        "left_out": tuple(arrays["left_out"].tolist()),
        "doubts": tuple(arrays["doubts"].tolist()) if "doubts" in arrays else (),
    }


def checked_fit(fit: MarkerFit) -> MarkerFit:
    """The fit unchanged. Raises ValueError where its arrays do not fit together."""
    frames = len(fit.trans)
    markers = len(fit.labels)
    joints = fit.body.num_joints
    shapes = {
        "poses": (fit.pose, (frames, joints, 3)),
        "trans": (fit.trans, (frames, 3)),
        "poses_pose_stage": (fit.pose_stage[0], (frames, joints, 3)),
        "trans_pose_stage": (fit.pose_stage[1], (frames, 3)),
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
        if array is not None and name not in _WITH_GAPS:
            check_finite(name, array)
    if fit.up_axis not in UP_AXES:
        raise ValueError(f"up_axis is {shown(fit.up_axis)}")
    corners = fit.attachment.triangles
    if (
        corners.shape != (markers, 3)
        or not np.isin(corners, np.arange(fit.body.num_vertices)).all()
    ):
        raise ValueError("marker_triangles name vertices that the body has not")
    return fit


def check_finite(name: str, array: np.ndarray) -> None:
    """Raises ValueError, naming the first frame (or marker, or coefficient), where numbers are not
    finite.
    """
    at = first_not_finite(array)
    if at is not None:
        row = {"betas": "value", "markers_latent": "marker", "marker_noise": "marker"}
        raise ValueError(f"{name} are not finite at {row.get(name, 'frame')} {at}, counted from 0")
    bound = MAX_BETA if name == "betas" else MAX_NUMBER
    if array.size and not max(array.max(), -array.min()) <= bound:
        largest = max(array.max(), -array.min())
        raise ValueError(f"{name} reach {largest:.3g}; expected a person's, within {bound:g}")
    drop_pages(array)


def _number(value: np.ndarray | None) -> float | None:
    return None if value is None or np.isnan(value) else float(value)


RATES = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
"""Names of the frame rate in npz files."""


def frame_rate(arrays: Mapping[str, np.ndarray]) -> float:
    """The frame rate (Hz) of a motion's arrays. Raises ValueError where there is none, where it is
    outside what captures have, or where two names give two rates.
    """
    rates = {name: float(arrays[name]) for name in RATES if name in arrays}
    for name, rate in rates.items():
        if not SLOWEST_HZ <= rate <= FASTEST_HZ:
            raise ValueError(
                f"{name} is {rate:g} Hz; expected {SLOWEST_HZ:g} to {FASTEST_HZ:g} frames a second"
            )
    if not rates:
        raise ValueError(f"no frame rate; expected {RATES[0]} in frames a second")
    if len(set(rates.values())) > 1:
        different = " and ".join(f"{name} {rate:g} Hz" for name, rate in rates.items())
        raise ValueError(f"two frame rates ({different}); expected one")
    return next(iter(rates.values()))
