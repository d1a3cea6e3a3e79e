"""What becomes of a fit when markers fall, drift, change labels or vanish? Faults are planted in real captures.

    python benchmarks/mosh_faults.py [CAPTURE_OR_FOLDER ...] [--captures 85_02 ...] [--kinds drift ...] [--frames 360]

Crops each capture, fits it clean, then spoilt in one way at a time and in four ways at once. The clean fit is the
reference: a marker that it names is not counted as named by mistake in the spoilt one, and such markers are counted by
themselves. Prints and writes as JSON, for each fit: planted markers that are named; clean ones that are named; the rise of the clean
markers' mean error; how far the surface moved from the clean fit's; and in gaps the hidden markers' mean
error against a straight line (rotations by slerp) between the fit's states on both sides.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import CAPTURES, compile_kernels, in_words, machine, write_json
from mosh_accuracy import found
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation, Slerp

import habitus
from habitus.errors import HabitusError
from habitus.fit.mosh.recipe import fit_markers
from habitus.fit.mosh.result import MarkerFit
from habitus.fit.mosh.settings import MoshSettings
from habitus.io.captures.read import Capture, read_captures
from habitus.io.models.priors import prior_of
from habitus.jobs.subjects import person
from habitus.observe.marker_prediction import marked_body, predict
from habitus.population import marker_faults as faults

FEWEST = 75
"""Shorter captures are left out."""
GOALS = {"found": 0.95, "named_clean": 0.01, "rise_mm": 1.0, "surface_mm": 5.0}
Planter = Callable[["Scene", np.ndarray, np.random.Generator], tuple[np.ndarray, list[int]]]


@dataclass(frozen=True)
class Scene:
    """A clean capture (cropped), its fit, and the capture's columns that the layout uses."""

    capture: Capture
    clean: MarkerFit
    columns: list[int]

    @property
    def frames(self) -> int:
        return len(self.capture.markers)

    def seconds(self, length: float) -> slice:
        """So many seconds in the middle."""
        count = min(round(length * self.capture.rate_hz), self.frames // 2)
        return slice((self.frames - count) // 2, (self.frames - count) // 2 + count)

    def pick(self, rng: np.random.Generator, used: list[int]) -> int:
        """A marker that is not spoilt yet, seen for most of the time and not named in the clean fit."""
        named = {suspect.label for suspect in self.clean.suspects}
        seen = np.isfinite(self.capture.markers[..., 0]).mean(axis=0)
        free = [k for k in self.columns if k not in used and seen[k] > 0.9 and self.capture.labels[k] not in named]
        return int(rng.choice(free))

    def neighbours(self, marker: int, used: list[int]) -> list[int]:
        """Other markers from 5 to 30 cm off, nearest first."""
        apart = np.nanmedian(np.linalg.norm(self.capture.markers - self.capture.markers[:, [marker]], axis=2), axis=0)
        return [k for k in np.argsort(apart) if 0.05 < apart[k] < 0.3 and k in self.columns and k not in used]


def swap(scene: Scene, markers: np.ndarray, rng: np.random.Generator, used=(), frames=None) -> tuple:
    first, other = scene.pick(rng, used), []
    while not other:
        first = scene.pick(rng, used)
        other = [k for k in scene.neighbours(first, used) if k in {scene.pick(rng, used) for _ in range(200)}]
    if frames is None:
        start = int(rng.integers(scene.frames // 6, scene.frames // 2))
        frames = slice(start, start + scene.frames // 4)
    return faults.swapped(markers, first, other[0], frames), [first, int(other[0])]


def exchange(scene: Scene, markers: np.ndarray, rng: np.random.Generator, used=()) -> tuple:
    return swap(scene, markers, rng, used, slice(None))


def fall(scene: Scene, markers: np.ndarray, rng: np.random.Generator, used=()) -> tuple:
    marker, frame = scene.pick(rng, used), int(rng.integers(scene.frames // 4, 3 * scene.frames // 4))
    return faults.fallen(markers, marker, frame, scene.capture.rate_hz, scene.capture.up_axis), [marker]


def haunt(scene: Scene, markers: np.ndarray, rng: np.random.Generator, used=()) -> tuple:
    marker = scene.pick(rng, used)
    for _ in range(3):
        start, length = int(rng.integers(scene.frames * 9 // 10)), max(5, scene.frames // 25)
        offset = rng.normal(size=3)
        offset *= rng.uniform(0.1, 0.3) / np.linalg.norm(offset)
        markers = faults.ghost(markers, marker, slice(start, start + length), offset)
    return markers, [marker]


def mislabel(scene: Scene, markers: np.ndarray, rng: np.random.Generator, used=()) -> tuple:
    """Midway between two neighbours of a marker at least 20 cm away."""
    while True:
        marker, other = scene.pick(rng, used), scene.pick(rng, used)
        near = scene.neighbours(other, [marker])
        if not near:
            continue
        spoilt = faults.wrong_label(markers, marker, (other, near[0]))
        away = np.nanmedian(np.linalg.norm(spoilt[:, marker] - markers[:, marker], axis=1))
        if 0.2 < away < 0.8:
            return spoilt, [marker]


def slide(scene: Scene, markers: np.ndarray, rng: np.random.Generator, used=()) -> tuple:
    """6 cm along the skin, in the axes of the limb that carries the marker."""
    fit, marker = scene.clean, scene.pick(rng, used)
    k = fit.labels.index(scene.capture.labels[marker])
    corners = fit.attachment.triangles[k]
    turns, outward = limb_turns(fit, corners), outward_normal(fit, corners)
    way = rng.normal(size=3)
    way -= (way @ outward) * outward
    return faults.drifting(markers, marker, turns, 0.06 * way / np.linalg.norm(way)), [marker]


def lose(scene: Scene, markers: np.ndarray, rng: np.random.Generator, used=()) -> tuple:
    return faults.lost(markers, 0.2, rng), []


def all_gone(seconds: float) -> Planter:
    return lambda scene, markers, rng, used=(): (faults.gap(markers, slice(None), scene.seconds(seconds)), [])


def limb_gone(seconds: float) -> Planter:
    """A marker and its five nearest."""

    def planter(scene: Scene, markers: np.ndarray, rng: np.random.Generator, used=()) -> tuple:
        marker = scene.pick(rng, used)
        which = np.array([marker, *scene.neighbours(marker, used)[:5]])
        return faults.gap(markers, which, scene.seconds(seconds)), []

    return planter


def four(scene: Scene, markers: np.ndarray, rng: np.random.Generator) -> tuple:
    used: list[int] = []
    for kind in (swap, fall, haunt, slide):
        markers, planted = kind(scene, markers, rng, used)
        used += planted
    return markers, used


KINDS: dict[str, Planter] = {
    "swap": swap,
    "exchange": exchange,
    "fallen": fall,
    "ghost": haunt,
    "wrong label": mislabel,
    "drift": slide,
    "four": four,
    "lost 20 %": lose,
    "gap 0.5 s": all_gone(0.5),
    "gap 2 s": all_gone(2.0),
    "limb gap 0.5 s": limb_gone(0.5),
    "limb gap 2 s": limb_gone(2.0),
}


def limb_turns(fit: MarkerFit, corners: np.ndarray) -> np.ndarray:
    """(T, 3, 3) world rotations of the joint that moves a triangle most."""
    share = np.zeros(fit.body.num_joints)
    np.add.at(share, fit.body.skinning_index[corners].ravel(), fit.body.skinning_value[corners].ravel())
    joint, turns = int(np.argmax(share)), np.eye(3)[None]
    while joint >= 0:
        turns = Rotation.from_rotvec(fit.pose[:, joint]).as_matrix() @ turns
        joint = int(fit.body.parents[joint])
    return turns


def outward_normal(fit: MarkerFit, corners: np.ndarray) -> np.ndarray:
    a, b, c = fit.body.rest_vertices(fit.betas)[corners]
    normal = np.cross(b - a, c - a)
    return normal / np.linalg.norm(normal)


def fitted(capture: Capture, body) -> MarkerFit:
    """The fit of one capture, its layout found from the labels."""
    someone = person([capture], "auto")
    return fit_markers(body, prior_of(body), someone.layout, someone.recordings, MoshSettings())[0]


def crop(path: Path, frames: int) -> Capture:
    """The middle of a capture."""
    whole = read_captures(path)[0]
    start = max(0, (len(whole.markers) - frames) // 2)
    return replace(whole, markers=whole.markers[start : start + frames])


def outcome(scene: Scene, spoilt: np.ndarray, planted: list[int], body) -> dict:
    """The numbers of one spoilt fit."""
    capture, clean = scene.capture, scene.clean
    fit = fitted(replace(capture, markers=spoilt), body)
    names, before = {s.label for s in fit.suspects}, {s.label for s in clean.suspects}
    wrong = {capture.labels[k] for k in planted}
    common = [label for label in clean.labels if label in fit.labels and label not in wrong]
    ours, theirs = ([f.labels.index(label) for label in common] for f in (fit, clean))
    truth, last = clean.observed_markers[:, theirs], predicted(fit)[:, ours]
    hidden = np.isnan(spoilt[..., 0]) & np.isfinite(capture.markers[..., 0])
    columns = [capture.labels.index(label) for label in common]
    seen = ~hidden[:, columns]
    error = np.linalg.norm(last - truth, axis=2)
    rows = np.flatnonzero(~hidden[:, scene.columns].all(axis=1))[:: max(1, scene.frames // 40)]
    moved = np.linalg.norm(fit.vertices(rows) - clean.vertices(rows), axis=2)
    clean_error = np.linalg.norm(predicted(clean)[:, theirs] - truth, axis=2)
    result = {
        "planted": sorted(wrong),
        "found": sorted(wrong & names),
        "corrected": sorted(s.label for s in fit.suspects if s.label in wrong and s.corrected),
        "clean_named": sorted(names - wrong - before),
        "clean_markers": len(set(clean.labels) - wrong - before),
        "reasons": {s.label: s.reason for s in fit.suspects if s.label in wrong or s.label not in before},
        "rise_mm": 1e3 * float(np.nanmean(error[seen]) - np.nanmean(clean_error[seen])),
        "surface_mm": 1e3 * float(moved.mean()),
        "seconds": sum(value for value in fit.stage_seconds.values() if value),
    }
    if hidden.any() and len(blocks := gap_frames(hidden)):
        bridged, inside = straight(fit, blocks)[:, ours], hidden[:, columns]
        result["gap_mm"] = 1e3 * float(np.nanmean(error[inside]))
        result["straight_mm"] = 1e3 * float(np.nanmean(np.linalg.norm(bridged - truth, axis=2)[inside]))
    return result


def gap_frames(hidden: np.ndarray) -> np.ndarray:
    """The frames in which the same markers are hidden throughout, none for losses at random."""
    frames = np.flatnonzero(hidden.any(axis=1))
    return frames if (hidden[frames] == hidden[frames[0]]).all() else frames[:0]


def predicted(fit: MarkerFit) -> np.ndarray:
    return fit.predicted_pose_stage if fit.predicted_soft_tissue is None else fit.predicted_soft_tissue


def straight(fit: MarkerFit, gap: np.ndarray) -> np.ndarray:
    """Markers (T, M, 3) of the fit with a straight line through the gap between the states on both sides of it."""
    first, last = gap[0] - 1, gap[-1] + 1
    share = (gap - first) / (last - first)
    pose, trans = fit.pose.copy(), fit.trans.copy()
    for joint in range(pose.shape[1]):
        ends = Rotation.from_rotvec(fit.pose[[first, last], joint])
        pose[gap, joint] = Slerp([0.0, 1.0], ends)(share).as_rotvec()
    trans[gap] = trans[first] + share[:, None] * (trans[last] - trans[first])
    soft = None if fit.soft_tissue is None else fit.soft_tissue.copy()
    if soft is not None:
        soft[gap] = soft[first] + share[:, None] * (soft[last] - soft[first])
    return predict(marked_body(fit.body, fit.betas, fit.attachment), pose, trans, soft)


def spoilt_fits(scene: Scene, kinds: list[str], seeds: range, body) -> list[dict]:
    rows = []
    for kind in kinds:
        for seed in seeds:
            rng = np.random.default_rng([seed, sorted(KINDS).index(kind)])
            spoilt, planted = KINDS[kind](scene, scene.capture.markers, rng)
            row = {"capture": scene.capture.name, "kind": kind, "seed": seed}
            try:
                rows.append(row | outcome(scene, spoilt, planted, body))
            except HabitusError as error:
                rows.append(row | {"failed": str(error)})
            print(in_line(rows[-1]), flush=True)
    return rows


def in_line(row: dict) -> str:
    if "failed" in row:
        return f"{row['capture']}, {row['kind']}: {row['failed']}"
    words = f"{row['capture']:28s} {row['kind']:14s} found {len(row['found'])}/{len(row['planted'])}"
    words += f" clean named {len(row['clean_named'])} rise {row['rise_mm']:5.2f} surface {row['surface_mm']:5.1f} mm"
    gap = f" gap {row['gap_mm']:.0f} straight {row['straight_mm']:.0f} mm" if "gap_mm" in row else ""
    return f"{words}{gap} {row['seconds']:.1f} s {row['reasons'] or ''}"


def summary(rows: list[dict]) -> list[dict]:
    """Each kind over all captures, and all of them."""
    table = []
    done = [row for row in rows if "failed" not in row]
    for kind in [*dict.fromkeys(row["kind"] for row in done), "all"]:
        some = [row for row in done if kind in (row["kind"], "all")]
        counts = {key: sum(len(row[key]) for row in some) for key in ("planted", "found", "corrected", "clean_named")}
        gaps = [row["gap_mm"] / row["straight_mm"] for row in some if "gap_mm" in row]
        table.append(
            {"kind": kind, "fits": len(some), **counts}
            | {"clean_markers": sum(row["clean_markers"] for row in some)}
            | {name: float(np.mean([row[name] for row in some])) for name in ("rise_mm", "surface_mm")}
            | {f"worst_{name}": max(row[name] for row in some) for name in ("rise_mm", "surface_mm")}
            | {"gap_over_straight": float(np.median(gaps)) if gaps and kind != "all" else None}
            | {"worst_gap_over_straight": max(gaps) if gaps and kind != "all" else None}
        )
    return table


def shown(table: list[dict], title: str) -> Table:
    """One row a kind."""
    out = Table(title=title, caption="rise, surface: mean (worst) over the fits; gap: median (worst) share of straight")
    for head in "kind fits found corrected clean|named rise|mm surface|mm gap/straight".split():
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
        )
    return out


def main() -> None:
    """Fit all, print tables, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", nargs="*", type=Path, metavar="CAPTURE_OR_FOLDER", default=[CAPTURES])
    parser.add_argument("--captures", nargs="+", default=(), metavar="NAME", help="only these, by name without ending")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS), metavar="KIND")
    parser.add_argument("--frames", type=int, default=360)
    parser.add_argument("--seeds", type=int, default=1, help="how often each kind is planted")
    parser.add_argument("--out", type=Path, default=Path("mosh_faults.json"))
    options = parser.parse_args()
    warnings.filterwarnings("ignore", "(Mean of empty|All-NaN) slice")
    where, body = machine(), habitus.load_body("default")
    compile_kernels(body)
    rows, references = [], []
    for path in found(options.places, tuple(options.captures)):
        capture = crop(path, options.frames)
        if len(capture.markers) < FEWEST:
            print(f"{path.name}: {len(capture.markers)} frames, too short; left out")
            continue
        clean = fitted(capture, body)
        columns = [capture.labels.index(label) for label in clean.labels]
        scene = Scene(capture, clean, columns)
        named = [{"label": s.label, "reason": s.reason, "corrected": s.corrected} for s in clean.suspects]
        wrong = sorted({s["label"] for s in named if not s["corrected"]})
        print(f"{capture.name}: {clean.errors_mm[clean.visible].mean():.1f} mm, names {', '.join(wrong) or 'nobody'}")
        references.append({"capture": capture.name, "markers": len(columns), "suspects": named})
        rows += spoilt_fits(scene, options.kinds, range(options.seeds), body)
    table, count = summary(rows), sum(reference["markers"] for reference in references)
    wrong = sum(len({s["label"] for s in r["suspects"] if not s["corrected"]}) for r in references)
    Console(width=150).print(shown(table, f"planted faults: {in_words(where)}"))
    print(f"clean fits name {wrong} of {count} markers as wrong")
    write_json(options.out, {"machine": where, "goals": GOALS, "summary": table, "clean": references, "rows": rows})


if __name__ == "__main__":
    main()
