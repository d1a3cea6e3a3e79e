"""Is any wrong result of `habitus register` or `rgbd` called good? Depth folders and scans spoilt as
wholes.

    python benchmarks/surface_faults.py [--depth NAME …] [--scans NAME …] [--out FILE] [--resume]

One simulated person before an Azure Kinect in two views, and one scan, spoilt in each way of
`habitus_lab.population.spoilt_surfaces`. A result is wrong where vertices are off by more than 40 mm
on average, or where there is no truth to compare with (a box, a cube). Upside-down data must be
found or fail; the mirror image of a person is a person, and right where the surface is.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import parser, run, show_table
from register_scans import errors, full, outside, registrar
from scipy.spatial import KDTree

import habitus
from habitus.errors import HabitusError
from habitus.fit.points.depth_result import RgbdFit
from habitus.fit.points.scan_result import ScanFit
from habitus_lab.population.rgbd_people import Scene, planted_rest, rgbd_scene
from habitus_lab.population.scans import Scanner, person, scanned, stance
from habitus_lab.population.spoilt_surfaces import DEPTH_FAULTS, SCAN_FAULTS, spoilt_capture

CLEAN = "nothing"
MAX_ERROR_MM = 40.0
SEEDS = (3, 4)
"""Of the person and of somebody else."""


def scene(seed: int) -> Scene:
    """A person of the neutral body with skin off it, in an A-pose."""
    body = habitus.load_body("default")
    rng = np.random.default_rng(seed)
    return rgbd_scene(body, planted_rest(body, rng), rng, sensor="azure-kinect")


def depth_error(fit: RgbdFit, true: Scene, kind: str) -> float:
    """Mean distance (mm) of vertices from the truth, of the views that were fitted; of a mirror
    image, from its surface.
    """
    names = [view.name for view in true.capture.views]
    found = []
    for sight, surface in zip(fit.prepared_views, fit.vertices(), strict=True):
        number = names.index(sight.view.name)
        truth = true.surfaces[number].copy()
        mirrored = kind == "one view mirrored" and number == len(names) - 1
        if mirrored:
            camera = sight.view.camera
            centre = camera.width - 2.0 * float(camera.principal_point[0])
            truth[:, 0] = centre / float(camera.focal_length[0]) * truth[:, 2] - truth[:, 0]
        there = truth @ sight.turn.T + sight.shift
        distances = np.linalg.norm(surface - there, axis=1)
        found.append((KDTree(there).query(surface)[0] if mirrored else distances).mean())
    return float(1e3 * np.mean(found))


def depth_row(kind: str, true: Scene, other: Scene) -> dict[str, Any]:
    """One spoilt capture, fitted as the command does."""
    capture = true.capture if kind == CLEAN else spoilt_capture(kind, true, other)

    def fitted() -> tuple[str, list[str], float]:
        fit = habitus.fit_rgbd(capture)
        known = kind != "a box" and len(fit.vertices()) and _same_names(fit, true)
        error = depth_error(fit, true, kind) if known else np.nan
        return fit.verdict.level, [*fit.verdict.reasons, *fit.warnings], error

    return row("depth", kind, fitted)


def _same_names(fit: RgbdFit, true: Scene) -> bool:
    names = {view.name for view in true.capture.views}
    return all(sight.view.name in names for sight in fit.prepared_views)


def scan_row(kind: str, seed: int) -> dict[str, Any]:
    """One spoilt scan, registered from nothing."""
    body = full("neutral")
    rng = np.random.default_rng(seed)
    truth = person(body, stance("A", body.joint_names, rng), rng)
    scan = scanned(truth, outside(len(truth)), Scanner(points=40_000), rng, kind)
    if kind != CLEAN:
        scan = SCAN_FAULTS[kind](scan, rng)

    def fitted() -> tuple[str, list[str], float]:
        (fit,) = registrar().register([scan])
        error = scan_error(fit, truth, kind)
        return fit.verdict.level, [*fit.verdict.reasons, *fit.notes], error

    return row("scan", kind, fitted)


def scan_error(fit: ScanFit, truth: np.ndarray, kind: str) -> float:
    """Mean distance (mm) of the vertices that were seen from the truth; of a mirror image, whose
    left hand is the fit's right hand, from its surface.
    """
    if kind == "mirrored":
        there = truth * [-1.0, 1.0, 1.0] @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
        apart = KDTree(there).query(fit.vertices)[0][fit.weights > 0.5]
        return float(1e3 * apart.mean())
    turned = truth * [-1.0, -1.0, 1.0] if kind == "upside down" else truth
    return errors(fit, fit.vertices, turned, seen=True)["mean"]


def row(what: str, kind: str, fitted: Callable[[], tuple[str, list[str], float]]) -> dict[str, Any]:
    """Verdict, error and reasons; "refused" with the message where there is no fit."""
    began = time.process_time()
    try:
        level, reasons, error = fitted()
    except HabitusError as refusal:
        level, reasons, error = "refused", [str(refusal)], np.nan
    right = bool(error < MAX_ERROR_MM)
    found = {
        "what": what,
        "fault": kind,
        "verdict": level,
        "error_mm": None if np.isnan(error) else round(error, 1),
        "good_and_wrong": level == "good" and not right,
        "cpu_seconds": round(time.process_time() - began, 1),
        "reasons": reasons,
    }
    print(f"{what} {kind}: {level}, {found['error_mm']} mm, {reasons[:2]}", flush=True)
    return found


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All faults asked for, and the clean ones. Each row is kept in a file beside `--out`, too, from
    which `--resume` goes on.
    """
    kept = options.out.with_suffix(".jsonl")
    if not options.resume:
        kept.unlink(missing_ok=True)
    found = list(rows(options, kept))
    return {"rows": found, "good_and_wrong": sum(row["good_and_wrong"] for row in found)}


def rows(options: argparse.Namespace, kept: Path) -> Iterator[dict[str, Any]]:
    """The rows, those that were kept first."""
    known = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    true, other = scene(SEEDS[0]), scene(SEEDS[1])
    makers = {
        "depth": partial(depth_row, true=true, other=other),
        "scan": partial(scan_row, seed=SEEDS[0]),
    }
    for what, kinds in (("depth", options.depth), ("scan", options.scans)):
        for kind in (CLEAN, *kinds) if kinds else ():
            found = next(
                (row for row in known if (row["what"], row["fault"]) == (what, kind)), None
            )
            if found is None:
                found = makers[what](kind)
                with kept.open("a") as file:
                    file.write(json.dumps(found) + "\n")
            yield found


def show(found: dict[str, Any]) -> None:
    """Print the table."""
    show_table(
        "spoilt depth folders and scans",
        [{key: value for key, value in row.items() if key != "reasons"} for row in found["rows"]],
        1,
    )
    print(f"good and wrong: {found['good_and_wrong']}")


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument(
        "--depth", nargs="*", choices=list(DEPTH_FAULTS), default=list(DEPTH_FAULTS)
    )
    arguments.add_argument(
        "--scans", nargs="*", choices=list(SCAN_FAULTS), default=list(SCAN_FAULTS)
    )
    arguments.add_argument("--resume", action="store_true", help="keep rows of a stopped run")
    run(arguments, measure, show)
