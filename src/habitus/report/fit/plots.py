"""Errors over time and of each marker, binned so that long captures stay small."""

from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.body.joint_angles import joint_angles
from habitus.parallel.blocks import mapped
from habitus.report.fit.blob import Blob
from habitus.results.metrics import marker_means

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

PLOT_BINS = 3000
MAP_BINS = 800
ANGLE_FRAMES = 1500
SEEN, PARTLY_MISSING, MISSING, DISTRUSTED = range(4)
TRUSTED = 0.5  # of a marker's full weight; a sample below it was down-weighted
MAP_STEP_MM = 0.4  # one step of the 8-bit map: 254 steps reach 101.6 mm


def add_plots(fit: "MarkerFit", blob: Blob) -> dict[str, Any]:
    """Pack error curves (mm) and the markers-by-time map; gives what the script must know of
    them.
    """
    frames = len(fit.pose)
    stages = [s for s in ("pose", "soft_tissue") if fit.errors(s) is not None]
    edges = bin_edges(frames, PLOT_BINS)
    for stage in stages:
        mean, worst = mapped(_frame_errors, np.asarray(fit.errors(stage))).T
        blob.add(f"{stage}/meanError", bin_means(mean, edges).astype("f4"))
        blob.add(f"{stage}/worstError", _reduce(np.fmax, worst, edges).astype("f4"))
    blob.add(
        "visible",
        np.add.reduceat(fit.visible.sum(axis=1), edges).astype("f4") / _lengths(edges, frames),
    )
    blob.add("flagged", np.maximum.reduceat(np.asarray(fit.flagged_frames, "u1"), edges))
    map_edges = bin_edges(frames, MAP_BINS)
    worst = 1e3 * _reduce(np.fmax, np.asarray(fit.errors(stages[-1])), map_edges)
    steps = np.clip(np.round(np.nan_to_num(worst) / MAP_STEP_MM), 0, 254)
    blob.add("errorMap", np.where(np.isfinite(worst), steps, 255).astype("u1").T)
    blob.add("gapMap", _packed(gap_states(fit, map_edges).T))
    return {
        "plotFrames": edges.tolist() if len(edges) < frames else None,
        "mapBins": len(map_edges),
        "mapStep": MAP_STEP_MM,
        "markerMeans": {
            stage: _tenths(marker_means(np.asarray(fit.errors(stage)))) for stage in stages
        },
        "downWeighted": _down_weighted(fit),
        "missing": [round(float(share), 4) for share in 1 - fit.visible.mean(axis=0)],
    }


def gap_states(fit: "MarkerFit", edges: np.ndarray) -> np.ndarray:
    """(bins, M): SEEN, PARTLY_MISSING, MISSING throughout, or DISTRUSTED in some frame, in the bins
    from ``edges``.
    """
    visible = fit.visible
    low = _distrusted(fit) & visible
    seen = np.logical_or.reduceat(visible, edges)
    doubted = np.logical_or.reduceat(low, edges)
    whole = np.logical_and.reduceat(visible, edges)
    return np.select([~seen, doubted, ~whole], [MISSING, DISTRUSTED, PARTLY_MISSING], SEEN).astype(
        "u1"
    )


def _packed(states: np.ndarray) -> np.ndarray:
    """Numbers below four, row by row, four to a byte, the first in its lowest bits."""
    flat = np.pad(states.ravel(), (0, -states.size % 4)).reshape(-1, 4)
    return (flat << np.arange(0, 8, 2, dtype="u1")).sum(axis=1).astype("u1")


def add_angles(fit: "MarkerFit", blob: Blob) -> list[dict[str, Any]]:
    """Pack joint angles of at most ANGLE_FRAMES frames, in tenths of degrees; gives the names and
    sides of their rows.

    Nothing where the body has none of the joints.
    """
    frames = bin_edges(len(fit.pose), ANGLE_FRAMES)
    angles = joint_angles(fit.body, fit.betas, fit.pose[frames])
    rows = [
        (name, side, values) for name, sides in angles.items() for side, values in sides.items()
    ]
    if rows:
        tenths = 10 * np.column_stack([values for *_, values in rows])
        blob.add("angles", np.round(np.clip(tenths, -32768, 32767)).astype("i2"), True)
        blob.add("angleFrames", frames.astype("u4"))
    return [{"name": name, "side": side} for name, side, _ in rows]


def _distrusted(fit: "MarkerFit") -> np.ndarray:
    return mapped(lambda part: part < TRUSTED, np.asarray(fit.marker_weights))


def _down_weighted(fit: "MarkerFit") -> list[float]:
    """Share of each marker's visible frames in which it counted for less than half."""
    visible = fit.visible
    low = _distrusted(fit) & visible
    return [
        round(float(share), 4) for share in low.sum(axis=0) / np.maximum(visible.sum(axis=0), 1)
    ]


def _frame_errors(metres: np.ndarray) -> np.ndarray:
    """(T, 2): mean and largest error (mm) over the visible markers of each frame, NaN where none is
    visible.
    """
    errors = 1e3 * metres
    seen = np.isfinite(errors)
    count = seen.sum(axis=1)
    mean = np.where(seen, errors, 0).sum(axis=1) / np.maximum(count, 1)
    worst = np.where(seen, errors, -1).max(axis=1, initial=-1)
    return np.where(count[:, None] > 0, np.stack([mean, worst], axis=1), np.nan)


def bin_edges(frames: int, bins: int) -> np.ndarray:
    """First frame of each of at most ``bins`` bins."""
    return np.unique(np.linspace(0, frames, min(frames, bins), endpoint=False).astype(np.int64))


def _lengths(edges: np.ndarray, frames: int) -> np.ndarray:
    return np.diff(np.append(edges, frames)).astype("f4")


def bin_means(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean of the numbers in each bin, NaN where a bin holds none."""
    known = np.isfinite(values)
    count = np.add.reduceat(known.astype(np.int64), edges)
    return np.where(
        count > 0, np.add.reduceat(np.where(known, values, 0), edges) / np.maximum(count, 1), np.nan
    )


def _reduce(how: np.ufunc, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return values if len(edges) == len(values) else how.reduceat(values, edges, axis=0)


def _tenths(metres: np.ndarray) -> list[float | None]:
    return [round(1e3 * float(m), 2) if np.isfinite(m) else None for m in metres]
