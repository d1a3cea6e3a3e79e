"""What becomes of a fit when markers fall, drift, change labels or vanish? Faults are planted in
real captures.

    python benchmarks/mosh_faults.py [CAPTURE_OR_FOLDER ...] [--captures 85_02 ...] [--kinds drift
    ...] [--frames 360]

Crops each capture, fits it clean, then spoilt in one way at a time and in four ways at once. The
clean fit is the reference: a marker that it names is not counted as named by mistake in the spoilt
one, and such markers are counted by themselves. Prints and writes as JSON, for each fit: planted
markers that are named; clean ones that are named; the rise of the clean markers' mean error; how
far the surface moved from the clean fit's; and in gaps the hidden markers' mean error against a
straight line between the places that the fit gives them on both sides, and against the error that
the clean fit has there with everything seen: nothing can be expected below that. `--resume` goes on
after the captures that the JSON holds already.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import (
    capture_files,
    capture_parser,
    compile_kernels,
    in_words,
    machine,
    write_json,
    written_rows,
)
from mosh_fault_kinds import KINDS, Scene
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.markers.recipe import fit_markers
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.read import Capture, read_captures
from habitus.jobs.subjects import person_of

FEWEST_SECONDS = 1.0
"""Shorter captures are left out."""
GOALS = {"found": 0.95, "named_clean": 0.01, "rise_mm": 1.0, "surface_mm": 5.0}
GAP_GOALS = {"gap 0.5 s": 0.5, "gap 2 s": 1.0, "limb gap 0.5 s": 0.5, "limb gap 2 s": 1.0}
"""The most that the error in a gap may be of a straight line's."""


def fitted(capture: Capture, body) -> MarkerFit:
    """The fit of one capture, its layout found from the labels."""
    someone = person_of([capture], "auto")
    return fit_markers(body, prior_of(body), someone.layout, someone.recordings, MoshSettings())[0]


def crop(path: Path, frames: int) -> Capture:
    """The middle of a capture."""
    whole = read_captures(path)[0]
    start = max(0, (len(whole.markers) - frames) // 2)
    return replace(whole, markers=whole.markers[start : start + frames])


def outcome(scene: Scene, spoilt: np.ndarray, planted: list[int], body) -> dict:
    """The numbers of one spoilt fit."""
    capture = scene.capture
    clean = scene.clean
    fit = fitted(replace(capture, markers=spoilt), body)
    names = {s.label for s in fit.suspects}
    before = {s.label for s in clean.suspects}
    wrong = {capture.labels[k] for k in planted}
    common = [label for label in clean.labels if label in fit.labels and label not in wrong]
    ours, theirs = ([f.labels.index(label) for label in common] for f in (fit, clean))
    truth = clean.observed_markers[:, theirs]
    last = predicted(fit)[:, ours]
    hidden = np.isnan(spoilt[..., 0]) & np.isfinite(capture.markers[..., 0])
    columns = [capture.labels.index(label) for label in common]
    seen = ~hidden[:, columns]
    error = np.linalg.norm(last - truth, axis=2)
    rows = np.flatnonzero(np.isfinite(spoilt[:, scene.columns, 0]).any(axis=1))[
        :: max(1, scene.frames // 40)
    ]
    moved = np.linalg.norm(fit.vertices(rows) - clean.vertices(rows), axis=2)
    clean_error = np.linalg.norm(predicted(clean)[:, theirs] - truth, axis=2)
    result = {
        "planted": sorted(wrong),
        "found": sorted(wrong & names),
        "corrected": sorted(s.label for s in fit.suspects if s.label in wrong and s.corrected),
        "clean_named": sorted(names - wrong - before),
        "clean_markers": len(set(clean.labels) - wrong - before),
        "reasons": {
            s.label: s.reason for s in fit.suspects if s.label in wrong or s.label not in before
        },
        "rise_mm": 1e3 * float(np.nanmean(error[seen]) - np.nanmean(clean_error[seen])),
        "surface_mm": 1e3 * float(moved.mean()),
        "seconds": sum(value for value in fit.stage_seconds.values() if value),
    }
    if hidden.any() and lasting(hidden, np.isnan(spoilt[..., 0])):
        inside = hidden[:, columns] & np.isfinite(error)
        if inside.any():
            result["gap_mm"] = 1e3 * float(error[inside].mean())
            result["own_mm"] = 1e3 * float(clean_error[inside].mean())
            result["straight_mm"] = 1e3 * float(
                np.linalg.norm(straight(last, hidden) - truth, axis=2)[inside].mean()
            )
    return result


def lasting(hidden: np.ndarray, missing: np.ndarray) -> bool:
    """Whether what was hidden is missing throughout: a gap, and no losses at random."""
    frames = np.flatnonzero(hidden.any(axis=1))
    return bool(missing[frames[0] : frames[-1] + 1, hidden.any(axis=0)].all())


def predicted(fit: MarkerFit) -> np.ndarray:
    """Markers of the last stage."""
    return (
        fit.predicted_pose_stage if fit.predicted_soft_tissue is None else fit.predicted_soft_tissue
    )


def straight(last: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Predicted markers (T, M, 3) on a straight line through the gap, between those of the frames
    on both sides.
    """
    frames = np.flatnonzero(hidden.any(axis=1))
    before = frames[0] - 1
    after = frames[-1] + 1
    share = ((np.arange(len(last)) - before) / (after - before))[:, None, None]
    return last[before] + share * (last[after] - last[before])


def spoilt_fits(scene: Scene, kinds: list[str], seeds: range, body) -> list[dict]:
    """Each kind planted with each seed."""
    rows = []
    for kind in kinds:
        for seed in seeds:
            rng = np.random.default_rng([seed, sorted(KINDS).index(kind)])
            spoilt, planted = KINDS[kind](scene, scene.capture.markers, rng, ())
            row = {"capture": scene.capture.name, "kind": kind, "seed": seed}
            try:
                rows.append(row | outcome(scene, spoilt, planted, body))
            except HabitusError as error:
                rows.append(row | {"failed": str(error)})
            print(in_line(rows[-1]), flush=True)
    return rows


def in_line(row: dict) -> str:
    """One fit in a line."""
    if "failed" in row:
        return f"{row['capture']}, {row['kind']}: {row['failed']}"
    words = (
        f"{row['capture']:28s} {row['kind']:14s} found {len(row['found'])}/{len(row['planted'])}"
    )
    words += (
        f" clean named {len(row['clean_named'])} rise {row['rise_mm']:5.2f} surface "
        f"{row['surface_mm']:5.1f} mm"
    )
    gap = (
        f" gap {row['gap_mm']:.0f} straight {row['straight_mm']:.0f} mm" if "gap_mm" in row else ""
    )
    return f"{words}{gap} {row['seconds']:.1f} s {row['reasons'] or ''}"


def summary(rows: list[dict]) -> list[dict]:
    """Each kind over all captures, and all of them."""
    table = []
    done = [row for row in rows if "failed" not in row]
    for kind in [*dict.fromkeys(row["kind"] for row in done), "all"]:
        some = [row for row in done if kind in (row["kind"], "all")]
        counts = {
            key: sum(len(row[key]) for row in some)
            for key in ("planted", "found", "corrected", "clean_named")
        }
        gaps = [row["gap_mm"] / row["straight_mm"] for row in some if "gap_mm" in row]
        over = [row["gap_mm"] - row["own_mm"] for row in some if "gap_mm" in row]
        met = [
            row["gap_mm"] <= max(GAP_GOALS[kind] * row["straight_mm"], row["own_mm"])
            for row in some
            if kind in GAP_GOALS and "gap_mm" in row
        ]
        table.append(
            {"kind": kind, "fits": len(some), **counts}
            | {"clean_markers": sum(row["clean_markers"] for row in some)}
            | {
                name: float(np.mean([row[name] for row in some]))
                for name in ("rise_mm", "surface_mm")
            }
            | {
                f"worst_{name}": max(row[name] for row in some)
                for name in ("rise_mm", "surface_mm")
            }
            | {"gap_over_straight": float(np.median(gaps)) if gaps and kind != "all" else None}
            | {"worst_gap_over_straight": max(gaps) if gaps and kind != "all" else None}
            | {"gap_over_own_mm": float(np.median(over)) if over and kind != "all" else None}
            | {"gaps_met": [sum(met), len(met)]}
        )
    return table


def shown(table: list[dict], title: str) -> Table:
    """One row a kind."""
    caption = (
        "rise, surface: mean (worst) over the fits; gap: median (worst) share of straight; over "
        "own: median mm above "
        "the clean fit's error; met: gaps within the goal or the clean fit's error"
    )
    out = Table(title=title, caption=caption)
    for head in (
        "kind fits found corrected clean|named rise|mm surface|mm gap/straight over|own met".split()
    ):
        out.add_column(head.replace("|", "\n"), justify="left" if head == "kind" else "right")
    for r in table:
        gap = r["gap_over_straight"]
        out.add_row(
            r["kind"],
            str(r["fits"]),
            f"{r['found']}/{r['planted']}" if r["planted"] else "–",
            str(r["corrected"]),
            f"{r['clean_named']}/{r['clean_markers']}",
            f"{r['rise_mm']:.2f} ({r['worst_rise_mm']:.2f})",
            f"{r['surface_mm']:.1f} ({r['worst_surface_mm']:.1f})",
            "–" if gap is None else f"{gap:.2f} ({r['worst_gap_over_straight']:.2f})",
            "–" if gap is None else f"{r['gap_over_own_mm']:.1f}",
            "–" if gap is None else "{} of {}".format(*r["gaps_met"]),
        )
    return out


def main() -> None:
    """Fit all, print tables, write JSON."""
    arguments = capture_parser(__doc__)
    arguments.add_argument(
        "--kinds", nargs="+", default=list(KINDS), choices=list(KINDS), metavar="KIND"
    )
    arguments.add_argument("--frames", type=int, default=360)
    arguments.add_argument("--seeds", type=int, default=1, help="how often each kind is planted")
    arguments.add_argument(
        "--resume", action="store_true", help="keep the captures that --out holds"
    )
    options = arguments.parse_args()
    warnings.filterwarnings("ignore", "(Mean of empty|All-NaN) slice")
    where = machine()
    body = habitus.load_body("default")
    compile_kernels(body)
    asked = {"frames": options.frames, "seeds": options.seeds}
    rows, references = (
        written_rows(options.out, key, **asked) if options.resume else []
        for key in ("rows", "clean")
    )
    for path in capture_files(options.places, options.captures):
        capture = crop(path, options.frames)
        if capture.name in {reference["capture"] for reference in references}:
            continue
        if len(capture.markers) < FEWEST_SECONDS * capture.rate_hz:
            print(f"{path.name}: {len(capture.markers)} frames, too short; left out")
            continue
        clean = fitted(capture, body)
        scene = Scene(capture, clean, [capture.labels.index(label) for label in clean.labels])
        references.append(about := reference(clean))
        print(
            f"{capture.name}: {about['mean_mm']:.1f} mm, names "
            f"{', '.join(about['wrong']) or 'nobody'}"
        )
        rows += spoilt_fits(scene, options.kinds, range(options.seeds), body)
        table = summary(rows)
        told = {
            "machine": where,
            **asked,
            "goals": GOALS,
            "summary": table,
            "clean": references,
            "rows": rows,
        }
        write_json(options.out, told)
    if not rows:
        print("no captures; give files or folders")
        return
    Console(width=150).print(shown(summary(rows), f"planted faults: {in_words(where)}"))
    wrong, count = (
        sum(values)
        for values in zip(*((len(r["wrong"]), r["markers"]) for r in references), strict=True)
    )
    print(f"clean fits name {wrong} of {count} markers as wrong")


def reference(clean: MarkerFit) -> dict:
    """What the clean fit says of its markers."""
    return {
        "capture": clean.capture_name,
        "markers": len(clean.labels),
        "mean_mm": float(clean.errors_mm[clean.visible].mean()),
        "wrong": sorted({s.label for s in clean.suspects if not s.corrected}),
        "suspects": [
            {"label": s.label, "reason": s.reason, "corrected": s.corrected} for s in clean.suspects
        ],
    }


if __name__ == "__main__":
    main()
