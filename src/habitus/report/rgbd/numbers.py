"""The numbers of a fit to depth views, as metrics.json holds them."""

from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.body.gender import female_probability, said_of

if TYPE_CHECKING:
    from habitus.fit.points.depth_result import RgbdFit


def rgbd_metrics(fit: "RgbdFit") -> dict[str, Any]:
    """Errors of depth (mm), shares explained, light, timings (s), measurements, verdict and
    warnings.
    """
    seconds = {name: float(value) for name, value in fit.stage_seconds.items()}
    return {
        "capture": fit.capture_name,
        "body": fit.body_name,
        "age_years": fit.body.age,
        "views": [vars(view) for view in fit.evidence.views],
        "depth_error_mm": {
            "median": float(np.median([view.median_mm for view in fit.evidence.views])),
            "p95": float(np.max([view.p95_mm for view in fit.evidence.views])),
        },
        "parted_by": fit.evidence.way,
        "appearance": _appearance(fit),
        "costs": dict(fit.costs),
        "stage_seconds": {**seconds, "total": sum(seconds.values())},
        "body_measurements": dict(fit.measurements),
        "gender": _gender(fit),
        "verdict": {"level": fit.verdict.level, "reasons": list(fit.verdict.reasons)},
        "warnings": list(fit.warnings),
    }


def _appearance(fit: "RgbdFit") -> dict[str, Any] | None:
    found = fit.appearance
    if found is None:
        return None
    return {
        "colour_residual": found.residual,
        "seen_share": float((found.seen > 0).mean()),
        "colour_camera_shift_mm": (1e3 * found.shift.shift).tolist(),
        "outline_overlap": found.shift.overlap,
        "light": found.light.tolist(),
    }


def _gender(fit: "RgbdFit") -> dict[str, Any] | None:
    """P(female) of the neutral shape, as if it were known exactly, and the model fitted."""
    if fit.body.female_direction is None:
        return (
            None
            if fit.gender == "neutral"
            else {"female_probability": None, "says": None, "model": fit.gender}
        )
    probability = female_probability(fit.body, fit.betas)
    return {"female_probability": probability, "says": said_of(probability), "model": fit.gender}
