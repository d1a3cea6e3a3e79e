"""The numbers of a comparison, as compare.json holds them."""

from typing import Any

import numpy as np

from habitus.body.motion import Moving
from habitus.fit.markers.result import MarkerFit
from habitus.report.comparison.differences import Differences, notes
from habitus.results.metrics import error_summary

WORST = 8
_APART_S = 0.5  # between two of the worst moments
_WITHIN = 0.3  # of the worst moment: what is nearer is not worth a look


def numbers(found: Differences, names: tuple[str, str]) -> dict[str, Any]:
    """Distances in mm, angles in degrees, lengths in m, None where there is no such number."""
    pairing = found.pairing
    return {
        "a": _side(found.a, names[0]),
        "b": _side(found.b, names[1]),
        "compared": {
            "moments": len(pairing.times),
            "rate_hz": pairing.rate_hz,
            "seconds": len(pairing.times) / pairing.rate_hz,
            "skin": found.skin is not None,
            "same_moments": found.same_moments,
            "b_turned_degrees": found.place.degrees,
            "b_moved_m": found.place.translation.tolist(),
        },
        "skin_mm": _skin(found),
        "joints_mm": _each(found.joints, found.joint_names),
        "joints_root_aligned_mm": _each(found.centred, found.joint_names),
        "joint_rotations_degrees": None
        if found.turned is None
        else _each(found.turned, found.joint_names),
        "markers": _markers(found),
        "shape_at_rest_mm": None if found.at_rest is None else _summary(found.at_rest),
        "measurements": measurements(found),
        "worst_moments": worst_moments(found),
        "notes": list(notes(found)),
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
        "verdict": {"level": verdict.level, "reasons": list(verdict.reasons)},
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


def _skin(found: Differences) -> dict[str, float | None] | None:
    """Over all vertices of all moments; ``p95`` is the mean over the moments of what 95 % of the
    vertices are below.
    """
    if found.skin is None:
        return None
    mean, high, most = found.skin.T
    return {"mean": float(mean.mean()), "p95": float(high.mean()), "max": float(most.max())}


def _each(values: np.ndarray, names: tuple[str, ...]) -> dict[str, Any]:
    per = {name: _summary(column) for name, column in zip(names, values.T, strict=True)}
    return _summary(values) | {"per_joint": per}


def _markers(found: Differences) -> dict[str, Any] | None:
    markers = found.markers
    if markers is None:
        return None
    columns = zip(
        markers.labels, markers.apart.T, *(error.T for error in markers.errors), strict=True
    )
    per = {
        label: {
            "apart": _summary(apart)["mean"],
            "a": _summary(ours)["mean"],
            "b": _summary(theirs)["mean"],
        }
        for label, apart, ours, theirs in columns
    }
    return {"apart_mm": _summary(markers.apart), "errors_mm": per}


def measurements(found: Differences) -> dict[str, dict[str, float]]:
    """What both bodies measure at rest (m, kg), by name."""
    ours, theirs = (m.body.measure(m.betas) for m in (found.a, found.b))
    return {
        name: {
            "a": float(ours[name]),
            "b": float(theirs[name]),
            "difference": float(theirs[name] - ours[name]),
        }
        for name in ours
        if name in theirs
    }


def worst_moments(found: Differences) -> list[dict[str, Any]]:
    """The moments at which the bodies are furthest apart, half a second or more between two, the
    worst first.
    """
    apart = found.apart
    pairing = found.pairing
    left = np.array(apart)
    moments: list[dict[str, Any]] = []
    while len(moments) < WORST and np.isfinite(left).any():
        k = int(np.nanargmax(left))
        if moments and apart[k] < _WITHIN * moments[0]["mean_mm"]:
            break
        moments.append(_moment(found, k))
        left[np.abs(pairing.times - pairing.times[k]) < _APART_S] = np.nan
    return moments


def _moment(found: Differences, k: int) -> dict[str, Any]:
    frames = (near[k] for near in found.pairing.nearest)
    joint = int(found.joints[k].argmax())
    return {
        "time_s": float(found.pairing.times[k]),
        **{f"frame_{name}": int(frame) for name, frame in zip("ab", frames, strict=True)},
        "mean_mm": float(found.apart[k]),
        "worst_joint": found.joint_names[joint],
        "worst_joint_mm": float(found.joints[k, joint]),
        "worst_vertex": None if found.vertex is None else int(found.vertex[k]),
    }
