"""How fast is the marker fit? Every stage apart, frame by frame, and the whole command from start
to finish.

    python benchmarks/mosh_speed.py [CAPTURE ...] [--runs 5] [--frames 4500] [--no-command]

Without captures: ../shared/mocap/85_12.c3d (41 markers) where it is there, and synthetic captures
of 41 and 67 markers. Medians of several runs. Kernels are compiled beforehand, and how long the
first call of the process took is reported; the command is run as users run it, in a process of its
own, once with an empty kernel cache and then with a filled one, and its peak memory is what the
operating system counted.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
from common import (
    CAPTURES,
    ROOT,
    compile_kernels,
    in_words,
    machine,
    parser,
    synthetic,
    write_json,
    write_synthetic,
)
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

import habitus
from habitus.body.model import BodyModel
from habitus.body.prior import shipped_prior
from habitus.fit.markers.causal import CausalSolver
from habitus.fit.markers.recipe import fit_markers
from habitus.fit.markers.settings import MoshSettings, sequence_settings
from habitus.fit.markers.start import start_sequence
from habitus.io.captures.read import Capture
from habitus.jobs.subjects import Person, person_of
from habitus.observe.marker_rig import marker_rig

GOALS = {
    "shape_s": 10.0,
    "pose_fps": 3000.0,
    "with_soft_tissue_fps": 1500.0,
    "causal_ms": 0.5,
    "command_s": 25.0,
}
"""What the project set itself for two cores: seconds, frames a second, milliseconds a frame."""
COMMAND_GOAL_GB = 2.0


def stages(body: BodyModel, capture: Capture, runs: int) -> dict:
    """Medians of the three stages and of causal steps, in this process."""
    someone = person_of([capture], "auto")
    prior = shipped_prior()
    settings = MoshSettings()
    fits = [
        fit_markers(body, prior, someone.layout, someone.recordings, settings)[0]
        for _ in range(runs)
    ]
    seconds = {
        name: [fit.stage_seconds[name] for fit in fits] for name in ("shape", "pose", "soft_tissue")
    }
    middle = {name: median(values) for name, values in seconds.items()}
    frames = fits[0].num_frames
    return {
        "capture": capture.name,
        "frames": frames,
        "markers": len(fits[0].labels),
        "shape_s": middle["shape"],
        "pose_fps": frames / middle["pose"],
        "soft_tissue_fps": frames / middle["soft_tissue"],
        "with_soft_tissue_fps": frames / (middle["pose"] + middle["soft_tissue"]),
        **causal(body, someone, fits[0]),
        "runs": seconds,
        "status": fits[0].status,
    }


def causal(body: BodyModel, someone: Person, fit) -> dict:
    """Milliseconds of each causal step, one frame after another on one thread: median and 99th
    percentile.
    """
    prior = shipped_prior().for_joints(body.joint_names)
    observed = someone.recordings[0].observed[
        :, [someone.layout.labels.index(label) for label in fit.labels]
    ]
    observed = np.ascontiguousarray(observed)
    settings = MoshSettings()
    rig = marker_rig(body, fit.betas, fit.attachment)
    first = int(np.argmax(np.isfinite(observed[..., 0]).sum(axis=1)))
    with threadpool_limits(1):
        pose, trans = start_sequence(
            rig, fit.pose[::100], body.joint_names, observed[first : first + 1]
        )
        scales = np.full(observed.shape[1], settings.robust_scale[1])
        solver = CausalSolver(rig, prior, pose[0], trans[0], sequence_settings(settings), scales)
        seconds = np.empty(len(observed) - first)
        for k, markers in enumerate(observed[first:]):
            began = time.perf_counter()
            solver.step(markers)
            seconds[k] = time.perf_counter() - began
    return {
        "causal_ms": 1e3 * float(np.median(seconds)),
        "causal_p99_ms": 1e3 * float(np.percentile(seconds, 99)),
    }


def command(path: Path, runs: int, body: str) -> dict:
    """Start to finish of `habitus mosh`, exports and report included: seconds and peak memory, cold
    and warm cache.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(Path(folder) / "kernels")}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # users' modules are compiled once
        cold = _measured(path, Path(folder) / "out", body, environment)
        warm = [_measured(path, Path(folder) / "out", body, environment) for _ in range(runs)]
    return {
        "capture": path.stem,
        "command_s": median(seconds for seconds, _ in warm),
        "peak_gb": max(gigabytes for _, gigabytes in warm),
        "first_run_s": cold[0],
        "first_run_peak_gb": cold[1],
        "runs": [seconds for seconds, _ in warm],
    }


def _measured(path: Path, out: Path, body: str, environment: dict[str, str]) -> tuple[float, float]:
    """Wall seconds and peak resident memory (GB) of one run of the command."""
    line = [
        sys.executable,
        "-m",
        "habitus",
        "mosh",
        str(path),
        "--out",
        str(out),
        "--body",
        body,
        "--quiet",
    ]
    began = time.perf_counter()
    process = subprocess.Popen(line, cwd=ROOT, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(line)} ended with {process.returncode}")
    return seconds, usage.ru_maxrss * (1024 if sys.platform != "darwin" else 1) / 1e9


def tables(rows: list[dict], commands: list[dict], title: str) -> list[Table]:
    """Stages, then the command."""
    by_stage = Table(title=title, caption=f"goals: {GOALS}; medians")
    for head in (
        "capture",
        "frames",
        "markers",
        "shape s",
        "pose f/s",
        "soft tissue f/s",
        "both f/s",
        "causal ms",
        "p99",
    ):
        by_stage.add_column(head, justify="left" if head == "capture" else "right")
    for r in rows:
        speeds = (r["pose_fps"], r["soft_tissue_fps"], r["with_soft_tissue_fps"])
        by_stage.add_row(
            r["capture"],
            str(r["frames"]),
            str(r["markers"]),
            f"{r['shape_s']:.1f}",
            *(f"{x:,.0f}" for x in speeds),
            f"{r['causal_ms']:.2f}",
            f"{r['causal_p99_ms']:.2f}",
        )
    whole = Table(
        title=f"start to finish, goal {GOALS['command_s']:g} s and {COMMAND_GOAL_GB:g} GB"
    )
    for head in ("capture", "seconds", "peak GB", "first run ever s", "its peak GB"):
        whole.add_column(head, justify="left" if head == "capture" else "right")
    for r in commands:
        numbers = (r["command_s"], r["peak_gb"], r["first_run_s"], r["first_run_peak_gb"])
        whole.add_row(
            r["capture"], *(f"{x:.1f}" if k % 2 == 0 else f"{x:.2f}" for k, x in enumerate(numbers))
        )
    return [by_stage, whole]


def main() -> None:
    """Time all, print tables, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("captures", nargs="*", type=Path, metavar="CAPTURE")
    arguments.add_argument("--runs", type=int, default=5)
    arguments.add_argument("--frames", type=int, default=4500, help="of the synthetic captures")
    arguments.add_argument("--no-command", action="store_true", help="leave out start to finish")
    arguments.add_argument("--body", default="default")
    options = arguments.parse_args()
    where = machine()
    body = habitus.load_body(options.body)
    first = compile_kernels(body)
    print(
        f"first call in this process (imports, kernels compiled or loaded): {first:.1f} s",
        flush=True,
    )
    real = options.captures or [path for path in (CAPTURES / "85_12.c3d",) if path.is_file()]
    if not real:
        print(f"no real capture in {CAPTURES}; synthetic ones only")
    captures = [habitus.read_capture(path) for path in real]
    captures += [
        synthetic(body, name, options.frames)
        for name in ("cmu-41", "mosh-67")
        if not options.captures
    ]
    rows = []
    for capture in captures:
        rows.append(stages(body, capture, options.runs))
        print(f"{capture.name}: done", flush=True)
    commands = []
    if not options.no_command:
        with tempfile.TemporaryDirectory() as folder:
            paths = real or [write_synthetic(body, "cmu-41", options.frames, Path(folder))]
            commands = [command(path, options.runs, options.body) for path in paths]
    for table in tables(rows, commands, f"marker fit: {in_words(where)}"):
        Console(width=150).print(table)
    content = {
        "machine": where,
        "goals": GOALS,
        "first_call_s": first,
        "stages": rows,
        "whole_command": commands,
    }
    write_json(options.out, content)


if __name__ == "__main__":
    main()
