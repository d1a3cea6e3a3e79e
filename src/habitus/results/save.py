"""What a fit becomes on disk: its folder, written whole or not at all, and its numbers,
metrics.json.

Each kind of fit has one list of the files that it may write (depth views: `habitus.results.depth`,
which needs torch); a later fit replaces these and keeps everything else in the folder. The page,
report.html, is drawn by a function of the caller, as reports stand above this room. Lengths of
errors are in mm, measurements in m and kg, times in s; NaN and infinities become null.
"""

import csv
import io
import json
import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from habitus.body.gender import female_probability, said_of
from habitus.body.measurement_names import DEFINITIONS, Definition, si_unit
from habitus.body.motion import BodyMotion
from habitus.body.surface_files import write_surface, write_textured
from habitus.export.glb import thinning_note, write_glb
from habitus.export.npz import check_npz_style, motion_arrays, write_amass, write_arrays, write_npz
from habitus.export.obj import write_obj_sequence
from habitus.files import locked, whole_folder, write_text
from habitus.fit.markers.result import MarkerFit, betas_covariance
from habitus.fit.markers.solution import HeldOut
from habitus.fit.markers.suspects import Suspect
from habitus.kernels.threads import one_blas_thread
from habitus.parallel.blocks import blocks, columns, drop_pages, is_large
from habitus.types import PathLike

if TYPE_CHECKING:
    from habitus.fit.points.scan_result import ScanFit

STAGE_NAMES = ("read", "shape", "pose", "soft_tissue", "export", "total")


def marker_metrics(fit: MarkerFit) -> dict[str, Any]:
    """Errors (mm), timings (s), suspects, measurements and warnings of a fit, NaN where there is no
    number.

    Errors are distances between observed and predicted markers over the visible samples.
    ``stage_seconds`` leaves out imports and kernel compilation, which are its ``startup``.
    """
    frames = len(fit.pose)
    seconds = stage_seconds(fit)
    return {
        "capture": str(fit.capture_name),
        "body": str(fit.body_name),
        "age_years": fit.body.age,
        "layout": str(fit.layout_name),
        "frames": frames,
        "rate_hz": float(fit.rate_hz),
        "markers": len(fit.labels),
        "missing_fraction": float(1.0 - np.mean(fit.visible)) if fit.visible.size else 0.0,
        "marker_error_mm": {
            stage: error_summary(fit.errors(stage), fit.labels) for stage in ("pose", "soft_tissue")
        },
        "held_out_error_mm": _held_out(fit.held_out),
        "held_out_known_placement_mm": _held_out(fit.held_out_known_placement),
        "suspect_markers": [_suspect(suspect) for suspect in fit.suspects],
        "stage_seconds": seconds,
        "frames_per_second": {
            name: _rate(frames, seconds[name]) for name in ("pose", "soft_tissue")
        },
        "body_measurements": body_measurements(fit),
        "gender": gender_entry(fit_female_probability(fit), fit.gender),
        "verdict": fit.verdict.entry(),
        "unobserved_segments": _unobserved_segments(fit),
        "warnings": [str(warning) for warning in fit.warnings],
    }


def stage_seconds(fit: MarkerFit) -> dict[str, float | None]:
    """Seconds of each stage, and of the start-up before them."""
    seconds = {name: _number(fit.stage_seconds.get(name)) for name in STAGE_NAMES}
    return seconds | {"startup": float(fit.startup_seconds)}


def write_json(path: PathLike, values: Mapping[str, Any]) -> None:
    """Write nested values as JSON, atomically; numbers that are not finite become null."""
    text = json.dumps(finite(dict(values)), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def finite(value: Any) -> Any:
    """The same nested value as JSON can hold it: plain types, and null for NaN and infinities."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def error_summary(
    errors: Float[np.ndarray, "T M"] | None, labels: tuple[str, ...]
) -> dict[str, Any] | None:
    """Mean, median, 95th percentile, maximum, and mean of each marker, in mm, of errors (m; NaN:
    not visible).

    All are exact, of long captures too: the visible errors are held in memory once, 8 bytes each.
    """
    if errors is None:
        return None
    seen = _visible_mm(errors)
    values = [math.nan] * 4
    if seen.size:
        values = [np.mean(seen), math.nan, math.nan, np.max(seen)]
        values[1:3] = (
            np.median(seen, overwrite_input=True),
            np.percentile(seen, 95, overwrite_input=True),
        )
    summary: dict[str, Any] = {
        k: float(v) for k, v in zip(("mean", "median", "p95", "max"), values, strict=True)
    }
    means = 1e3 * marker_means(errors)
    return summary | {
        "per_marker": {label: float(mean) for label, mean in zip(labels, means, strict=True)}
    }


def _visible_mm(errors: np.ndarray) -> np.ndarray:
    """Errors (N,) of the visible samples in mm, frame by frame."""
    seen = np.empty(sum(int(np.isfinite(errors[part]).sum()) for part in blocks(len(errors))))
    count = 0
    for part in blocks(len(errors)):
        some = errors[part]
        some = some[np.isfinite(some)]
        seen[count : count + len(some)] = 1e3 * some
        count += len(some)
        drop_pages(errors)
    return seen


def marker_means(errors: Float[np.ndarray, "T M"]) -> Float[np.ndarray, " M"]:
    """Mean over the visible frames, NaN for a marker that is never seen."""
    if errors.shape[1] > 1 and is_large(errors):
        return np.concatenate([marker_means(column[:, None]) for column in columns(errors)])
    seen = np.isfinite(errors)
    count = seen.sum(axis=0)
    total = np.where(seen, errors, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def body_measurements(fit: MarkerFit) -> dict[str, float]:
    """Height (m), mass (kg), and what else the body knows how to measure on its rest surface."""
    return fit.body.measure(fit.betas)


def _suspect(suspect: Suspect) -> dict[str, Any]:
    """Label, reason, number of frames, and whether the marker was put right: its errors are then a
    good one's.
    """
    return {
        "label": suspect.label,
        "reason": suspect.reason,
        "frames": int(suspect.frames),
        "corrected": bool(suspect.corrected),
    }


def _unobserved_segments(fit: MarkerFit) -> list[dict[str, Any]]:
    """Joints whose segments no marker observes in half of the capture or more, and the standard
    deviation of their skin.
    """
    typical = 1e3 * np.median(fit.guessed.spread, axis=0)
    joints = np.flatnonzero(fit.guessed.joints())
    return [{"joint": fit.body.joint_names[k], "sd_mm": float(typical[k])} for k in joints]


def _held_out(held: HeldOut | None) -> dict[str, Any] | None:
    if held is None:
        return None
    return {
        stage: error_summary(getattr(held, stage), held.labels) for stage in ("pose", "soft_tissue")
    }


def fit_female_probability(fit: MarkerFit) -> float | None:
    """P(female) of the neutral shape, as sure as the markers know it; None for a body without a
    classifier of sex.
    """
    if fit.female_probability is not None or fit.body.female_direction is None:
        return fit.female_probability
    return female_probability(fit.body, fit.betas, betas_covariance(fit))


def gender_entry(probability: float | None, model: str) -> dict[str, Any] | None:
    """P(female) of the neutral shape, the decision that it allows ("female", "male", "cannot
    tell"), and the model fitted; None where neither a probability nor a model of a sex is known.
    """
    if probability is None and model == "neutral":
        return None
    decision = None if probability is None else said_of(probability)
    return {"female_probability": probability, "decision": decision, "model": model}


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def _rate(frames: int, seconds: float | None) -> float | None:
    return frames / seconds if seconds else None


def scan_metrics(fit: "ScanFit") -> dict[str, Any]:
    """The numbers of a registered scan, as metrics.json holds them; lengths of errors in mm."""
    return {
        "scan": fit.scan_name,
        "body": fit.body_name,
        "age_years": fit.body.age,
        "points": len(fit.cloud.points),
        "scan_to_surface_mm": _spread(fit.to_surface),
        "scan_to_model_mm": _spread(fit.to_model),
        "status": fit.status,
        "costs": dict(fit.costs),
        "matched_fraction": fit.matched,
        "unexplained_fraction": fit.lost,
        "self_intersections": dict(fit.cuts),
        "observed_fraction": fit.seen,
        "cloth_to_skin_mm": {region: 1e3 * each for region, each in fit.cloth.items()},
        "hair_mm": 0.0 if fit.hair is None else float(1e3 * fit.hair.max()),
        "betas": fit.betas.tolist(),
        "pose_distance": fit.pose_distance,
        "up_axis": fit.up_axis,
        "to_body": fit.to_body.tolist(),
        "body_measurements": dict(fit.measurements),
        "model_measurements": fit.body.measure(fit.betas),
        "colours": None
        if fit.colours is None
        else {
            "difference_before": fit.colours.before,
            "difference_after": fit.colours.after,
            "surface_shift_mm": 1e3 * fit.colours.slid,
        },
        "verdict": fit.verdict.entry(),
        "stage_seconds": dict(fit.stage_seconds),
        "warnings": list(fit.notes),
    }


def _spread(distances: np.ndarray) -> dict[str, float]:
    shares = zip(
        ("median", "p95", "max"), np.percentile(1e3 * distances, (50, 95, 100)), strict=True
    )
    return {"mean": float(1e3 * distances.mean())} | {name: float(value) for name, value in shares}


def measurements_csv(
    values: Mapping[str, float], definitions: Mapping[str, Definition] = DEFINITIONS
) -> str:
    """Measurements (m, kg) as CSV text: name, value, unit, definition and ISO numbers."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("name", "value", "unit", "what", "ISO 8559-1, 7250-1"))
    for name, value in values.items():
        definition = definitions[name]
        rows.writerow((name, f"{value:.6g}", si_unit(name), definition.says, definition.iso))
    return text.getvalue()


METRICS = "metrics.json"
REPORT = "report.html"
MARKER_FILES = ("body.npz", "body.glb", METRICS, REPORT, "obj", "layout.toml")
SCAN_FILES = ("body.npz", "surface.ply", "surface.glb", "model.ply", "rest.ply", METRICS, REPORT)
MAX_ALBEDO = 0.9
"""The albedo of a scan's brightest points: its scale is unobservable."""
MAX_ALBEDO_PERCENTILE = 99.5

Numbers = Mapping[str, Any]
MarkerPage = Callable[[MarkerFit, Numbers, Sequence[str]], str]
"""The report of a fit, its numbers, and the names of the files beside it."""
ScanPage = Callable[["ScanFit", Numbers], str]


@contextmanager
def result_lock(folder: PathLike | None, files: Collection[str]) -> Iterator[None]:
    """Keep other runs out of a folder of results, which may hold ``files``; None needs no lock.

    Raises HabitusError where another run is at work in it, or it cannot be written.
    """
    with nullcontext() if folder is None else locked(Path(folder), files):
        yield


def save_markers(
    fit: MarkerFit,
    folder: PathLike,
    page: MarkerPage | None = None,
    *,
    obj: bool = False,
    npz_style: str = "habitus",
    minimal: bool = False,
) -> MarkerFit:
    """Write body.npz, body.glb, metrics.json and, with a ``page``, report.html.

    layout.toml is written where the layout was estimated, obj/ with a mesh per frame on request.
    npz_style: "habitus", or "amass" for AMASS scripts; minimal: only body.npz and metrics.json.
    Returns the fit with its export time. Raises HabitusError where the folder cannot be written.
    """
    check_npz_style(npz_style, fit.body)
    start = time.perf_counter()
    fit = fit.annotated(warnings=(*fit.warnings, *thinning_note(fit)))
    with (
        one_blas_thread(),
        whole_folder(folder, MARKER_FILES) as partial,
        ThreadPoolExecutor(1) as executor,
    ):
        animation = None if minimal else executor.submit(write_glb, fit, partial / "body.glb")
        (write_amass if npz_style == "amass" else write_npz)(fit, partial / "body.npz")
        if obj:
            write_obj_sequence(fit, partial / "obj")
        if fit.discovered_layout:
            write_text(partial / "layout.toml", fit.discovered_layout)
        numbers = marker_metrics(fit)
        if page is not None and not minimal:
            written = {"body.glb", METRICS} | {path.name for path in partial.iterdir()}
            files = tuple(name for name in MARKER_FILES if name in written)
            write_text(partial / REPORT, page(fit, numbers, files))
        if animation is not None:
            animation.result()
        seconds = {**fit.stage_seconds, "export": time.perf_counter() - start}
        total = sum(value for name, value in seconds.items() if value and name != "total")
        fit = fit.annotated(stage_seconds={**seconds, "total": total})
        write_json(partial / METRICS, numbers | {"stage_seconds": stage_seconds(fit)})
    return fit


def save_scan(fit: "ScanFit", folder: PathLike, page: ScanPage | None = None) -> None:
    """Write body.npz, surface.ply and .glb, model.ply, rest.ply, metrics.json and report.html.

    body.npz has AMASS's names for the model's state (one frame), ``vertices``, ``vertex_weights``
    and ``to_body``. Raises HabitusError where the folder cannot be written.
    """
    surfaces = {
        "surface": fit.vertices,
        "model": fit.model_vertices,
        "rest": fit.rest_vertices,
    }
    with whole_folder(folder, SCAN_FILES) as partial:
        write_arrays(partial / "body.npz", _scan_arrays(fit))
        for name, vertices in surfaces.items():
            write_surface(_Vertices(vertices), partial / f"{name}.ply", fit.body.faces)
        _write_scan_glb(fit, partial / "surface.glb")
        start = time.perf_counter()
        numbers = scan_metrics(fit)
        if page is not None:
            write_text(partial / REPORT, page(fit, numbers))
        numbers["stage_seconds"]["export"] = time.perf_counter() - start
        write_json(partial / METRICS, numbers)


@dataclass(frozen=True, eq=False)
class _Vertices:
    """Vertices (V, 3) that `write_surface` takes."""

    vertices: Float[np.ndarray, "V 3"]


def _scan_arrays(fit: "ScanFit") -> dict[str, np.ndarray]:
    """One frame: at 1 Hz, in the body's axes."""
    gender = fit.body_name if fit.body_name in ("female", "male") else "neutral"
    motion = BodyMotion(
        fit.body,
        fit.betas,
        fit.pose[None],
        fit.trans[None],
        rate_hz=1.0,
        up_axis="+y",
        capture_name=fit.scan_name,
        body_name=fit.body_name,
        gender=gender,
    )
    return motion_arrays(motion) | {
        "vertices": fit.vertices,
        "vertex_weights": fit.weights,
        "skin_offset": fit.skin_offset.astype(np.float32),
        "to_body": fit.to_body,
    }


def _write_scan_glb(fit: "ScanFit", path: Path) -> None:
    """The surface; where colours were used, subdivided to the resolution of the albedo."""
    if fit.colours is None:
        write_surface(_Vertices(fit.vertices), path, fit.body.faces)
        return
    grid = fit.colours.grid
    albedo = fit.colours.albedo
    brightest = max(float(np.percentile(albedo, MAX_ALBEDO_PERCENTILE)), 1e-6)
    write_textured(grid.placed(fit.vertices), grid.triangles, path, MAX_ALBEDO * albedo / brightest)
