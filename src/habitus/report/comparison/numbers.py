"""The numbers of a comparison, as compare.json holds them."""

from typing import Any

import numpy as np

from habitus.body.motion import Moving
from habitus.fit.markers.result import MarkerFit
from habitus.report.comparison.differences import Differences, notes
from habitus.results.save import error_summary

MAX_MOMENTS = 8
"""Worst moments that are listed."""
MIN_GAP_S = 0.5
"""Seconds between two of the worst moments."""
MIN_SHARE = 0.3
"""Of the distance at the worst moment, below which a moment is not listed."""


def numbers(result: Differences, names: tuple[str, str]) -> dict[str, Any]:
    """Distances in mm, angles in degrees, lengths in m; None where there is no number."""
    pairing = result.pairing
    return {
        "a": _side(result.a, names[0]),
        "b": _side(result.b, names[1]),
        "compared": {
            "moments": len(pairing.times),
            "rate_hz": pairing.rate_hz,
            "seconds": len(pairing.times) / pairing.rate_hz,
            "skin": result.skin is not None,
            "same_moments": result.same_moments,
            "b_rotation_degrees": result.alignment.degrees,
            "b_translation_m": result.alignment.translation.tolist(),
        },
        "skin_mm": _skin(result),
        "joints_mm": _each(result.joints, result.joint_names),
        "joints_root_aligned_mm": _each(result.root_aligned, result.joint_names),
        "joint_rotations_degrees": None
        if result.rotations is None
        else _each(result.rotations, result.joint_names),
        "markers": _markers(result),
        "shape_at_rest_mm": None if result.at_rest is None else _summary(result.at_rest),
        "measurements": measurements(result),
        "worst_moments": worst_moments(result),
        "notes": list(notes(result)),
    }


def _side(moving: Moving, name: str) -> dict[str, Any]:
    about = {
        "name": name,
        "capture": str(moving.capture_name),
        "body": str(moving.body_name),
        "frames": moving.num_frames,
        "rate_hz": float(moving.rate_hz),
        "up_axis": moving.up_axis,
    }
    if not isinstance(moving, MarkerFit):
        return about | {
            "layout": None,
            "markers": None,
            "verdict": None,
            "marker_error_mm": None,
            "suspects": None,
        }
    verdict = moving.verdict
    error = error_summary(moving.errors_mm / 1e3, moving.labels)
    return about | {
        "layout": str(moving.layout_name),
        "markers": len(moving.labels),
        "verdict": verdict.entry(),
        "marker_error_mm": error,
        "suspects": sum(not suspect.corrected for suspect in moving.suspects),
    }


def _summary(values: np.ndarray) -> dict[str, float | None]:
    known = values[np.isfinite(values)]
    if not known.size:
        return dict.fromkeys(("mean", "median", "p95", "max"))
    middle, high = np.percentile(known, [50, 95])
    return {
        "mean": float(known.mean()),
        "median": float(middle),
        "p95": float(high),
        "max": float(known.max()),
    }


def _skin(result: Differences) -> dict[str, float | None] | None:
    """Over all vertices of all moments; ``p95`` is the mean over moments of the vertices' 95th
    percentile.
    """
    if result.skin is None:
        return None
    mean, high, largest = result.skin.T
    return {"mean": float(mean.mean()), "p95": float(high.mean()), "max": float(largest.max())}


def _each(values: np.ndarray, names: tuple[str, ...]) -> dict[str, Any]:
    per = {name: _summary(column) for name, column in zip(names, values.T, strict=True)}
    return _summary(values) | {"per_joint": per}


def _markers(result: Differences) -> dict[str, Any] | None:
    markers = result.markers
    if markers is None:
        return None
    columns = zip(
        markers.labels, markers.predicted.T, *(error.T for error in markers.errors), strict=True
    )
    per = {
        label: {
            "distance": _summary(distance)["mean"],
            "a": _summary(ours)["mean"],
            "b": _summary(theirs)["mean"],
        }
        for label, distance, ours, theirs in columns
    }
    return {"distance_mm": _summary(markers.predicted), "errors_mm": per}


def measurements(result: Differences) -> dict[str, dict[str, float]]:
    """Measurements of both bodies at rest (m, kg), by name."""
    ours, theirs = (m.body.measure(m.betas) for m in (result.a, result.b))
    return {
        name: {
            "a": float(ours[name]),
            "b": float(theirs[name]),
            "difference": float(theirs[name] - ours[name]),
        }
        for name in ours
        if name in theirs
    }


def worst_moments(result: Differences) -> list[dict[str, Any]]:
    """The moments with the largest distances of the bodies, MIN_GAP_S or more between two, the
    worst first.
    """
    distance = result.distance
    pairing = result.pairing
    left = np.array(distance)
    moments: list[dict[str, Any]] = []
    while len(moments) < MAX_MOMENTS and np.isfinite(left).any():
        k = int(np.nanargmax(left))
        if moments and distance[k] < MIN_SHARE * moments[0]["mean_mm"]:
            break
        moments.append(_moment(result, k))
        left[np.abs(pairing.times - pairing.times[k]) < MIN_GAP_S] = np.nan
    return moments


def _moment(result: Differences, k: int) -> dict[str, Any]:
    frames = (near[k] for near in result.pairing.nearest)
    joint = int(result.joints[k].argmax())
    return {
        "time_s": float(result.pairing.times[k]),
        **{f"frame_{name}": int(frame) for name, frame in zip("ab", frames, strict=True)},
        "mean_mm": float(result.distance[k]),
        "worst_joint": result.joint_names[joint],
        "worst_joint_mm": float(result.joints[k, joint]),
        "worst_vertex": None if result.worst_vertex is None else int(result.worst_vertex[k]),
    }
