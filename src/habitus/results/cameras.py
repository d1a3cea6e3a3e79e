"""The result folder of a fit to keypoints of cameras."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from habitus.export.glb import write_glb
from habitus.export.npz import motion_arrays, write_arrays
from habitus.files import whole_folder, write_text
from habitus.fit.cameras.determined import determined
from habitus.fit.cameras.result import CameraFit
from habitus.results.save import METRICS, REPORT, measurements_csv, write_json
from habitus.types import PathLike

CAMERA_FILES = ("body.npz", "body.glb", "measurements.csv", METRICS, REPORT)
KNOWN = ("height_m", "inseam_m", "arm_length_m")
"""Measurements that keypoints tell of; girths and the mass are the shape prior's."""

CameraPage = Callable[[CameraFit, Mapping[str, Any]], str]


def save_cameras(fit: CameraFit, folder: PathLike, page: CameraPage | None = None) -> None:
    """Write body.npz, body.glb, measurements.csv, metrics.json and report.html.

    Raises HabitusError where the folder cannot be written.
    """
    with whole_folder(folder, CAMERA_FILES) as partial:
        write_arrays(partial / "body.npz", camera_arrays(fit))
        write_glb(fit, partial / "body.glb")
        write_text(partial / "measurements.csv", measurements_csv(fit.measurements))
        numbers = camera_metrics(fit)
        write_json(partial / METRICS, numbers)
        if page is not None:
            write_text(partial / REPORT, page(fit, numbers))


def camera_arrays(fit: CameraFit) -> dict[str, np.ndarray]:
    """Arrays of body.npz: the motion under AMASS's names; keypoints (T, C, K, 2; px without
    distortion) as detected and of the body, in space (T, K, 3; m); cameras as corrected.
    """
    cameras = fit.cameras
    assert cameras is not None
    return motion_arrays(fit) | {
        "made": np.array(list(fit.made)),
        "keypoint_names": np.array(fit.keypoint_names),
        "convention": np.array(fit.convention),
        "keypoints_observed": fit.observed.astype(np.float32),
        "keypoints_confidence": fit.confidence.astype(np.float32),
        "keypoints_predicted": fit.predicted.astype(np.float32),
        "keypoints": fit.keypoints.astype(np.float32),
        "keypoint_places": fit.keypoint_places,
        "camera_names": np.array(cameras.names),
        "camera_focal": cameras.focal,
        "camera_centre": cameras.centre,
        "camera_rotation": cameras.rotation,
        "camera_translation": cameras.translation,
        "camera_corrections": fit.corrections,
        "camera_late_s": fit.late,
        "first_frame": np.array(fit.first_frame),
    }


def camera_metrics(fit: CameraFit) -> dict[str, Any]:
    """Errors (px), corrections of cameras, measurements, what no keypoint determines, verdict and
    warnings.
    """
    cameras = fit.cameras
    assert cameras is not None
    return {
        "capture": fit.capture_name,
        "body": fit.body_name,
        "age_years": fit.body.age,
        "convention": fit.convention,
        "frames": len(fit.pose),
        "first_frame": fit.first_frame,
        "rate_hz": fit.rate_hz,
        "keypoint_error_px": _spread(fit.errors_px),
        "cameras": [
            {
                "name": name,
                "keypoint_error_px": _spread(fit.errors_px[:, c]),
                "detected_fraction": float((fit.confidence[:, c] > 0.0).mean()),
                "corrected_degrees": float(np.degrees(np.linalg.norm(fit.corrections[c, :3]))),
                "corrected_m": float(np.linalg.norm(fit.corrections[c, 3:])),
                "late_frames": float(fit.late[c] * fit.rate_hz),
                "frames_with_sides_exchanged": int(fit.exchanged[:, c].sum()),
            }
            for c, name in enumerate(cameras.names)
        ],
        "acceleration_m_s2": fit.acceleration,
        "status": fit.status,
        "costs": dict(fit.costs),
        "stage_seconds": {**fit.stage_seconds, "total": sum(fit.stage_seconds.values())},
        "body_measurements": dict(fit.measurements),
        "undetermined_joints": {
            kind: [fit.body.joint_names[k] for k in np.flatnonzero(bones)]
            for kind, bones in determined(fit).open._asdict().items()
        },
        "guessed_measurements": [name for name in fit.measurements if name not in KNOWN],
        "verdict": fit.verdict.entry(),
        "warnings": list(fit.warnings),
    }


def _spread(errors: np.ndarray) -> dict[str, float] | None:
    seen = errors[np.isfinite(errors)]
    if not seen.size:
        return None
    shares = np.percentile(seen, (50, 95))
    return {"median": float(shares[0]), "mean": float(seen.mean()), "p95": float(shares[1])}
