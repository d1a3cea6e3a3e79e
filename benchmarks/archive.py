"""How long does an archive take, do two processes halve it, and is a killed one as if it had never
been killed?

    python benchmarks/archive.py [--captures 722] [--folder DIR] [--json FILE] [--phases two one
    killed] [--minimal] [--frames N] [--spoilt .05]

The archive is made to look like CMU's: 722 captures of 39 subjects, 2 million frames at 120 Hz,
lengths as uneven as its. A third of the subjects are real captures of ../shared/mocap (without
them: none), cut, run to and fro to their length, and made a little larger or smaller; the others
are other people's bodies in fitted real motions, seen through `virtual_markers` on cmu-41 (each
marker 10 mm beside its place, noise, gaps). ``--captures N`` makes and measures the same share of
everything; what that says of the whole is an extrapolation, and labelled as such. ``--frames N`` makes
captures of N frames each. ``--spoilt SHARE`` spoils a share of the files (empty, cut, random, text,
zeros): exactly these must be listed as failed, each with a reason in one line.

Runs with two processes and with one, as users run them; then one that is killed (SIGKILL) three
times at random and goes on, whose results are held against the first's, number by number. Memory is
the largest sum over all processes that was seen twice a second. Times mean little on a busy
machine: the share of the cores that the run got stands beside them, and what CPU seconds say.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import json
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
from common import CAPTURES, in_words, machine, parser, write_json
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.motion import BodyMotion
from habitus.body.prior import shipped_prior
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture, read_capture
from habitus.observe.simulated_markers import Faults, smooth_motion

WHOLE = 722
SUBJECTS = 39
FRAMES = 2_000_000
RATE = 120.0
MOTIONS = ("85_12", "nick_freeform_001")
REAL = ("85_12", "HC042A40", "nick_freeform_001", "testsample2", "HDM_mm_01-02_03_120", "HC030A22")
FAULTS = Faults(placement=0.01, noise=5e-4, missing=0.01)
GOALS = {"minutes_on_two_cores": 60.0, "speed_up": 1.8}
RANDOM_TIMES = {"stage_seconds", "frames_per_second"}


# -- the archive -----------------------------------------------------------------------------------


def make_archive(folder: Path, captures: int, seed: int = 0, frames: int | None = None) -> int:
    """Write that many captures, a folder a subject, and tell how many frames they have."""
    rng = np.random.default_rng(seed)
    lengths = rng.lognormal(0.0, 0.9, captures)
    lengths = np.maximum(lengths / lengths.sum() * FRAMES * captures / WHOLE, 240).astype(int)
    if frames is not None:
        lengths[:] = frames
    subjects = max(2, round(SUBJECTS * captures / WHOLE))
    motions = list(_motions())
    real = [path for name in REAL if (path := CAPTURES / f"{name}.c3d").exists()]
    for subject, some in enumerate(np.array_split(lengths, subjects)):
        where = folder / f"subject{subject + 1:02d}"
        where.mkdir(parents=True, exist_ok=True)
        if real and subject % 3 == 0:
            makers = _real(
                read_capture(real[subject // 3 % len(real)]),
                1.0 - 0.05 * (subject // 3 // len(real)),
                rng,
            )
        else:
            makers = _virtual(motions[subject % len(motions)], subject, rng)
        for k, length in enumerate(some):
            write_c3d(
                makers(f"{subject + 1:02d}_{k + 1:02d}", int(length)),
                where / f"{subject + 1:02d}_{k + 1:02d}.c3d",
            )
    return int(lengths.sum())


def spoil(folder: Path, share: float, seed: int = 0) -> None:
    """Spoil a share of the files of an archive, and list them beside its folder."""
    rng = np.random.default_rng(seed)
    paths = sorted(folder.rglob("*.c3d"))
    chosen = rng.choice(len(paths), round(share * len(paths)), replace=False)
    for k, path in enumerate(paths[i] for i in sorted(chosen)):
        content = path.read_bytes()
        ways = (
            b"",
            content[: rng.integers(1, len(content) // 2)],
            rng.bytes(len(content)),
            b"These markers were not exported.\n",
            bytes(len(content)),
        )
        path.write_bytes(ways[k % len(ways)])
    names = [paths[i].relative_to(folder).as_posix() for i in sorted(chosen)]
    spoilt_names(folder).write_text(json.dumps(names), encoding="utf-8")


def spoilt_names(folder: Path) -> Path:
    """The list of an archive's spoilt files."""
    return folder.with_suffix(".spoilt.json")


def failures(folder: Path, out: Path) -> dict:
    """Spoilt files that are not listed as failed with a reason, and sound ones that are."""
    listed = spoilt_names(folder)
    spoilt = set(json.loads(listed.read_text(encoding="utf-8"))) if listed.exists() else set()
    query = "SELECT path, reason FROM {} WHERE state = 'failed'"
    with sqlite3.connect(out / "archive.sqlite") as manifest:
        rows = [
            *manifest.execute(query.format("files")),
            *manifest.execute(query.format("captures")),
        ]
    failed = {path for path, reason in rows if reason and "\n" not in reason}
    return {
        "spoilt": len(spoilt),
        "spoilt_not_listed": sorted(spoilt - failed),
        "sound_but_failed": sorted({path for path, _ in rows} - spoilt),
    }


def _motions() -> Iterator[BodyMotion]:
    """Motions to put other bodies into: of fits of real captures, else of the pose prior."""
    paths = [path for name in MOTIONS if (path := CAPTURES / f"{name}.c3d").exists()]
    for path in paths:
        yield BodyMotion.of(habitus.Mosh(soft_tissue=False).fit(path))
    if not paths:
        body = habitus.load_body("default")
        rng = np.random.default_rng(1)
        prior = shipped_prior().for_joints(body.joint_names)
        pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), 6000, RATE, rng)
        yield BodyMotion(body, np.zeros(body.num_betas), pose, trans, RATE, "+y")


def _to_and_fro(frames: int, length: int, rng: np.random.Generator) -> np.ndarray:
    """Frame numbers of a walk through a capture and back, begun somewhere."""
    way = np.r_[0:frames, frames - 2 : 0 : -1]
    return way[(rng.integers(len(way)) + np.arange(length)) % len(way)]


def _real(capture: Capture, scale: float, rng: np.random.Generator):
    def made(name: str, length: int) -> Capture:
        chosen = _to_and_fro(len(capture), length, rng)
        markers = np.ascontiguousarray(scale * capture.markers[chosen])
        return Capture(name, capture.labels, markers, capture.rate_hz, capture.up_axis)

    return made


def _virtual(motion: BodyMotion, subject: int, rng: np.random.Generator):
    betas = np.clip(np.random.default_rng(subject).normal(size=motion.body.num_betas), -2, 2)

    def made(name: str, length: int) -> Capture:
        chosen = _to_and_fro(motion.num_frames, length, rng)
        moving = BodyMotion(
            motion.body, betas, motion.pose[chosen], motion.trans[chosen], RATE, motion.up_axis
        )
        seen = habitus.virtual_markers(moving, "cmu-41", faults=FAULTS, seed=subject)
        return Capture(name, seen.labels, seen.markers, RATE, motion.up_axis)

    return made


# -- runs ------------------------------------------------------------------------------------------


def run(folder: Path, out: Path, jobs: int, minimal: bool, kill_after: float | None = None) -> dict:
    """One run of the command: seconds, CPU seconds of all its processes, largest memory; killed
    after some seconds.
    """
    command = [
        sys.executable,
        "-m",
        "habitus",
        "archive",
        str(folder),
        "--out",
        str(out),
        "--workers",
        str(jobs),
    ]
    command += ["--minimal"] * minimal
    began = time.perf_counter()
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    most = 0
    each = 0
    cpu = {}
    while process.poll() is None:
        sizes = []
        for one in _tree(process.pid):
            try:
                sizes.append(one.memory_info().rss)
                cpu[one.pid] = sum(one.cpu_times()[:2])
            except psutil.Error:
                continue
        most = max(most, sum(sizes))
        each = max(each, *sizes, 0)
        if kill_after is not None and time.perf_counter() - began > kill_after:
            children = _tree(process.pid)[1:]
            process.send_signal(signal.SIGKILL)
            process.wait()
            _, alive = psutil.wait_procs(children, timeout=20)
            return {"left_behind": len(alive)}
        time.sleep(0.5)
    if process.returncode not in (0, 1 if spoilt_names(folder).exists() else 0):
        raise SystemExit(
            f"habitus archive ended with {process.returncode}: {process.stderr.read()}"
        )
    seconds = time.perf_counter() - began
    row = {
        "seconds": seconds,
        "cpu_s": sum(cpu.values()),
        "cpu_s_of_each": sorted(cpu.values(), reverse=True),
    }
    return row | {"memory_gb": most / 1e9, "largest_process_gb": each / 1e9}


def _tree(pid: int) -> list[psutil.Process]:
    try:
        top = psutil.Process(pid)
        return [top, *top.children(recursive=True)]
    except psutil.Error:
        return []


def differences(one: Path, other: Path) -> list[str]:
    """What differs between two archives, but for times."""
    found = []
    for path in sorted(one.rglob("metrics.json")):
        name = path.parent.relative_to(one)
        twin = other / name
        if not (twin / "metrics.json").exists():
            found.append(f"{name} is missing")
            continue
        a, b = (json.loads((folder / "metrics.json").read_text()) for folder in (path.parent, twin))
        found += [f"{name}: {key}" for key in a if key not in RANDOM_TIMES and a[key] != b[key]]
        with np.load(path.parent / "body.npz") as p, np.load(twin / "body.npz") as q:
            for key in p.files:
                if not np.array_equal(p[key], q[key], equal_nan=p[key].dtype.kind == "f"):
                    found.append(f"{name}: {key}")
    return found


def costs(out: Path) -> dict:
    """What the manifest says: CPU seconds of captures and shapes, verdicts."""
    with sqlite3.connect(out / "archive.sqlite") as manifest:
        rows = manifest.execute(
            "SELECT frames, seconds, numbers FROM captures WHERE state = 'done'"
        ).fetchall()
        shapes = [seconds for (seconds,) in manifest.execute("SELECT seconds FROM subjects")]
    frames, seconds = np.array([row[:2] for row in rows], float).T
    slope, base = np.polyfit(frames, seconds, 1)
    levels = [json.loads(row[2])["verdict"]["level"] for row in rows]
    return {
        "captures": len(rows),
        "frames": int(frames.sum()),
        "capture_cpu_s": float(seconds.sum()),
        "shape_cpu_s": float(np.sum(shapes)),
        "shapes": len(shapes),
        "ms_a_frame": 1e3 * float(slope),
        "s_a_capture": float(base),
        "verdicts": {level: levels.count(level) for level in sorted(set(levels))},
        "bytes_a_frame": sum(path.stat().st_size for path in out.rglob("*/*/*"))
        / float(frames.sum()),
    }


def measure(folder: Path, work: Path, phases: list[str], minimal: bool, seed: int) -> dict:
    """All runs that are asked for."""
    found: dict = {}
    if "two" in phases:
        found["two"] = (
            run(folder, work / "two", 2, minimal)
            | costs(work / "two")
            | failures(folder, work / "two")
        )
    if "one" in phases:
        found["one"] = run(folder, work / "one", 1, minimal) | {
            "differences": differences(work / "two", work / "one")
        }
        found["speed_up"] = found["one"]["seconds"] / found["two"]["seconds"]
        busiest = max(found["two"]["cpu_s_of_each"][0], found["two"]["cpu_s"] / 2)
        found["speed_up_by_cpu"] = found["one"]["cpu_s"] / busiest
    if "killed" in phases:
        rng = np.random.default_rng(seed)
        usual = found["two"]["seconds"]
        moments = [float(usual * share) for share in rng.uniform(0.15, 0.45, 3)]
        left = [
            run(folder, work / "killed", 2, minimal, moment)["left_behind"] for moment in moments
        ]
        ended = run(folder, work / "killed", 2, minimal)
        different = differences(work / "two", work / "killed")
        found["killed"] = ended | {
            "killed_after_s": moments,
            "processes_left": left,
            "differences": different,
        }
    return found


def show(found: dict, console: Console) -> None:
    """The table."""
    table = Table(
        title=f"{found['captures']} captures, {found['frames']} frames; "
        f"{in_words(found['machine'])}"
    )
    for head in ("run", "minutes", "CPU minutes", "cores got", "memory GB", "same numbers"):
        table.add_column(head, justify="left" if head == "run" else "right")
    for name in ("two", "one", "killed"):
        if name in found:
            one = found[name]
            same = (
                ""
                if "differences" not in one
                else "yes"
                if not one["differences"]
                else f"{len(one['differences'])} differ"
            )
            values = (
                one["seconds"] / 60,
                one["cpu_s"] / 60,
                one["cpu_s"] / one["seconds"],
                one["memory_gb"],
            )
            table.add_row(name, *(f"{value:.2f}" for value in values), same)
    console.print(table)
    if "speed_up" in found:
        console.print(
            f"two processes are {found['speed_up']:.2f} times as fast as one (goal "
            f"{GOALS['speed_up']}); on cores "
            f"of their own {found['speed_up_by_cpu']:.2f} times, by the CPU seconds of the busiest"
        )
    if "two" in found:
        two = found["two"]
        share = found["captures"] / WHOLE
        words = "measured" if share == 1 else f"extrapolated from {share:.3f} of it"
        whole = two["cpu_s"] / share / 60
        console.print(
            f"{WHOLE} captures: {whole:.0f} CPU minutes, {whole / 2:.0f} minutes on two cores "
            f"({words}; "
            f"goal {GOALS['minutes_on_two_cores']:.0f}); {two['s_a_capture']:.2f} s a capture, "
            f"{two['ms_a_frame']:.2f} ms a frame, {two['shape_cpu_s'] / two['shapes']:.1f} s a "
            "subject; "
            f"verdicts {two['verdicts']}; {two['spoilt']} spoilt files, not listed: "
            f"{two['spoilt_not_listed'] or 'none'}, sound but failed: "
            f"{two['sound_but_failed'] or 'none'}"
        )


def main() -> None:
    """Make the archive, run, show, write."""
    arguments = parser(__doc__)
    arguments.add_argument("--captures", type=int, default=WHOLE)
    arguments.add_argument("--frames", type=int, help="of each capture")
    arguments.add_argument("--spoilt", type=float, default=0.0, metavar="SHARE")
    arguments.add_argument(
        "--folder",
        type=Path,
        help="keep captures and results here; captures that are there are used",
    )
    arguments.add_argument(
        "--phases", nargs="+", choices=("two", "one", "killed"), default=["two", "one", "killed"]
    )
    arguments.add_argument(
        "--minimal", action="store_true", help="of each capture only body.npz and metrics.json"
    )
    arguments.add_argument("--seed", type=int, default=0, help="of the kills")
    arguments.add_argument("--json", type=Path)
    options = arguments.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.folder or Path(temporary)
        captures = work / "captures"
        if not captures.exists():
            make_archive(captures, options.captures, frames=options.frames)
            if options.spoilt:
                spoil(captures, options.spoilt)
        known = {"machine": machine(), "captures": options.captures, "minimal": options.minimal}
        found = known | measure(captures, work, options.phases, options.minimal, options.seed)
        found["frames"] = found["two"]["frames"]
        show(found, Console(width=140))
        if options.json:
            write_json(options.json, found)


if __name__ == "__main__":
    main()
