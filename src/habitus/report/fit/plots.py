"""Errors over time and of each marker, binned so that long captures stay small."""

from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.blocks import mapped
from habitus.report.fit.blob import Blob
from habitus.report.metrics import marker_means

if TYPE_CHECKING:
    from habitus.fit.mosh.result import MarkerFit

PLOT_BINS = 3000
MAP_BINS = 800
MAP_STEP_MM = 0.4  # one step of the 8-bit map: 254 steps reach 101.6 mm


def add_plots(fit: "MarkerFit", blob: Blob) -> dict[str, Any]:
    """Pack error curves (mm) and the markers-by-time map; gives what the script must know of them."""
    frames, stages = len(fit.pose), [s for s in ("pose", "soft_tissue") if fit.errors(s) is not None]
    edges = _edges(frames, PLOT_BINS)
    for stage in stages:
        mean, worst = mapped(_frame_errors, np.asarray(fit.errors(stage))).T
        blob.add(f"{stage}/meanError", _bin_means(mean, edges).astype("f4"))
        blob.add(f"{stage}/worstError", _reduce(np.fmax, worst, edges).astype("f4"))
    blob.add("visible", np.add.reduceat(fit.visible.sum(axis=1), edges).astype("f4") / _lengths(edges, frames))
    blob.add("flagged", np.maximum.reduceat(np.asarray(fit.flagged_frames, "u1"), edges))
    map_edges = _edges(frames, MAP_BINS)
    worst = 1e3 * _reduce(np.fmax, np.asarray(fit.errors(stages[-1])), map_edges)
    steps = np.clip(np.round(np.nan_to_num(worst) / MAP_STEP_MM), 0, 254)
    blob.add("errorMap", np.where(np.isfinite(worst), steps, 255).astype("u1").T)
    return {
        "plotFrames": edges.tolist() if len(edges) < frames else None,
        "mapBins": len(map_edges),
        "mapStep": MAP_STEP_MM,
        "markerMeans": {stage: _tenths(marker_means(np.asarray(fit.errors(stage)))) for stage in stages},
        "downWeighted": _down_weighted(fit),
        "missing": [round(float(share), 4) for share in 1 - fit.visible.mean(axis=0)],
    }


def _down_weighted(fit: "MarkerFit") -> list[float]:
    """Share of each marker's visible frames in which it counted for less than half."""
    visible = fit.visible
    low = mapped(lambda part: part < 0.5, np.asarray(fit.marker_weights)) & visible
    return [round(float(share), 4) for share in low.sum(axis=0) / np.maximum(visible.sum(axis=0), 1)]


def _frame_errors(metres: np.ndarray) -> np.ndarray:
    """(T, 2): mean and largest error (mm) over the visible markers of each frame, NaN where none is visible."""
    errors = 1e3 * metres
    seen = np.isfinite(errors)
    count = seen.sum(axis=1)
    mean = np.where(seen, errors, 0).sum(axis=1) / np.maximum(count, 1)
    worst = np.where(seen, errors, -1).max(axis=1, initial=-1)
    return np.where(count[:, None] > 0, np.stack([mean, worst], axis=1), np.nan)


def _edges(frames: int, bins: int) -> np.ndarray:
    """First frame of each of at most ``bins`` bins."""
    return np.unique(np.linspace(0, frames, min(frames, bins), endpoint=False).astype(np.int64))


def _lengths(edges: np.ndarray, frames: int) -> np.ndarray:
    return np.diff(np.append(edges, frames)).astype("f4")


def _bin_means(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean of the numbers in each bin, NaN where a bin holds none."""
    known = np.isfinite(values)
    count = np.add.reduceat(known.astype(np.int64), edges)
    return np.where(count > 0, np.add.reduceat(np.where(known, values, 0), edges) / np.maximum(count, 1), np.nan)


def _reduce(how: np.ufunc, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return values if len(edges) == len(values) else how.reduceat(values, edges, axis=0)


def _tenths(metres: np.ndarray) -> list[float | None]:
    return [round(1e3 * float(m), 2) if np.isfinite(m) else None for m in metres]
