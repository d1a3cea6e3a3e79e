"""Result folders: what a fit becomes on disk, written whole or not at all.

Each kind of fit has one list of the files that it may write (depth views: `habitus.results.depth`,
which needs torch); a later fit replaces these and keeps
everything else in the folder. The page, report.html, is drawn by a function of the caller, as
reports stand above this room.
"""

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.motion import BodyMotion
from habitus.body.surface_files import write_surface, write_textured
from habitus.export.glb import thinning_note, write_glb
from habitus.export.npz import check_npz_style, motion_arrays, write_amass, write_arrays, write_npz
from habitus.export.obj import write_obj_sequence
from habitus.files import locked, whole_folder, write_text
from habitus.fit.markers.result import MarkerFit
from habitus.fit.points.scan_result import ScanFit
from habitus.kernels.threads import one_blas_thread
from habitus.results.metrics import (
    marker_metrics,
    scan_metrics,
    stage_seconds,
    write_json,
)
from habitus.types import PathLike

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
ScanPage = Callable[[ScanFit, Numbers], str]


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
    fit = replace(fit, warnings=(*fit.warnings, *thinning_note(fit)))
    with (
        one_blas_thread(),
        whole_folder(folder, MARKER_FILES) as partial,
        ThreadPoolExecutor(1) as executor,
    ):
        animation = None if minimal else executor.submit(write_glb, fit, partial / "body.glb")
        (write_amass if npz_style == "amass" else write_npz)(fit, partial / "body.npz")
        if obj:
            write_obj_sequence(fit, partial / "obj")
        if fit.found_layout:
            write_text(partial / "layout.toml", fit.found_layout)
        numbers = marker_metrics(fit)
        if page is not None and not minimal:
            written = {"body.glb", METRICS} | {path.name for path in partial.iterdir()}
            files = tuple(name for name in MARKER_FILES if name in written)
            write_text(partial / REPORT, page(fit, numbers, files))
        if animation is not None:
            animation.result()
        seconds = {**fit.stage_seconds, "export": time.perf_counter() - start}
        total = sum(value for name, value in seconds.items() if value and name != "total")
        fit = replace(fit, stage_seconds={**seconds, "total": total})
        write_json(partial / METRICS, numbers | {"stage_seconds": stage_seconds(fit)})
    return fit


def save_scan(fit: ScanFit, folder: PathLike, page: ScanPage | None = None) -> None:
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


def _scan_arrays(fit: ScanFit) -> dict[str, np.ndarray]:
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
        "to_body": fit.to_body,
    }


def _write_scan_glb(fit: ScanFit, path: Path) -> None:
    """The surface; where colours were used, subdivided to the resolution of the albedo."""
    if fit.colours is None:
        write_surface(_Vertices(fit.vertices), path, fit.body.faces)
        return
    grid = fit.colours.grid
    albedo = fit.colours.albedo
    brightest = max(float(np.percentile(albedo, MAX_ALBEDO_PERCENTILE)), 1e-6)
    write_textured(grid.placed(fit.vertices), grid.triangles, path, MAX_ALBEDO * albedo / brightest)
