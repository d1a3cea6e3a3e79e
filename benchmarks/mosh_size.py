"""How long may a capture be? Peak memory and time a frame of `habitus mosh`, and windows against
one solve.

    python benchmarks/mosh_size.py [--frames 10000 100000 1000000] [--capture 85_12.c3d]
    [--no-agreement] [--exports glb bvh]

A real capture is played forward and backward until it is long enough, so that its motion never
jumps, and written as a C3D file; the command is run on it as users run it, in a process of its own.
Peak memory is what the operating system counted of that process, files that it had mapped included.
With --exports, `habitus export` then writes the result in each of these formats, measured alike.
Then real captures are solved in windows of 1,000 frames and of 2,000, and in one: the largest angle
between any joint's rotations of the two, and between any two roots' places.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import json
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import CAPTURES, ROOT, in_words, machine, parser, write_json
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

import habitus
from habitus.body.prior import shipped_prior
from habitus.fit.markers.recipe import fit_markers
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.read import Capture
from habitus.jobs.subjects import person_of

GOALS = {"peak_gb": 3.0, "slower_than_10000_frames": 1.2, "degrees": 0.01}
PORTION = 8192


def frames_of(length: int, wanted: int) -> np.ndarray:
    """Frame numbers (wanted,) of a capture played forward and backward."""
    there_and_back = np.concatenate([np.arange(length), np.arange(length - 2, 0, -1)])
    return there_and_back[np.arange(wanted) % len(there_and_back)]


def write_tiled(capture: Capture, frames: int, path: Path) -> None:
    """The capture, tiled, as a C3D file of millimetres, a portion at a time."""
    labels = "".join(label.ljust(32)[:32] for label in capture.labels).encode()
    count = len(capture.labels)
    parameters = b"".join(
        [
            _group(1, "POINT"),
            _parameter(1, "USED", 2, (), struct.pack("<H", count)),
            _parameter(1, "FRAMES", 2, (), struct.pack("<H", min(frames, 65535))),
            _parameter(1, "LONG_FRAMES", 4, (), struct.pack("<f", frames)),
            _parameter(1, "SCALE", 4, (), struct.pack("<f", -0.1)),
            _parameter(1, "RATE", 4, (), struct.pack("<f", capture.rate_hz)),
            _parameter(1, "UNITS", -1, (2, 1), b"mm"),
            _parameter(1, "LABELS", -1, (32, count), labels),
            b"\0\0",
        ]
    )
    blocks = -(-(len(parameters) + 4) // 512)
    header = struct.pack(
        "<BBHHHHHfHHf",
        2,
        80,
        count,
        0,
        1,
        min(frames, 65535),
        0,
        -0.1,
        2 + blocks,
        1,
        capture.rate_hz,
    )
    order = frames_of(len(capture), frames)
    with path.open("wb") as file:
        file.write(
            header.ljust(512, b"\0")
            + bytes([1, 80, blocks, 84])
            + parameters.ljust(512 * blocks - 4, b"\0")
        )
        for first in range(0, frames, PORTION):
            points = 1e3 * capture.markers[order[first : first + PORTION]]
            missing = ~np.isfinite(points).all(axis=2, keepdims=True)
            file.write(
                np.concatenate([np.nan_to_num(points), np.where(missing, -1, 0)], axis=2)
                .astype("<f4")
                .tobytes()
            )


def _group(number: int, name: str) -> bytes:
    return struct.pack("<bb", len(name), -number) + name.encode() + struct.pack("<hB", 3, 0)


def _parameter(group: int, name: str, kind: int, shape: tuple[int, ...], data: bytes) -> bytes:
    content = struct.pack("<bB", kind, len(shape)) + bytes(shape) + data + b"\0"
    return (
        struct.pack("<bb", len(name), group)
        + name.encode()
        + struct.pack("<h", 2 + len(content))
        + content
    )


def measured(*words: str) -> dict:
    """One run of habitus: seconds, CPU seconds, peak memory."""
    line = [sys.executable, "-m", "habitus", *words]
    began = time.perf_counter()
    process = subprocess.Popen(line, cwd=ROOT, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(line)} ended with {process.returncode}")
    return {
        "seconds": seconds,
        "cpu_seconds": usage.ru_utime + usage.ru_stime,
        "peak_gb": usage.ru_maxrss * (1024 if sys.platform != "darwin" else 1) / 1e9,
    }


def command(capture: Capture, frames: int, folder: Path, exports: list[str]) -> dict:
    """One run of `habitus mosh` on so many frames: seconds, peak memory, sizes of what it wrote;
    the same of exports of its result.
    """
    path = folder / f"tiled_{frames}.c3d"
    out = folder / "out"
    write_tiled(capture, frames, path)
    run = measured("mosh", str(path), "--out", str(out), "--quiet")
    path.unlink()
    written = out / path.stem
    numbers = json.loads((written / "metrics.json").read_text(encoding="utf-8"))
    return {
        "frames": frames,
        "markers": numbers["markers"],
        "peak_gb": run["peak_gb"],
        "seconds": run["seconds"],
        "ms_a_frame": 1e3 * run["seconds"] / frames,
        "cpu_ms_a_frame": 1e3 * run["cpu_seconds"] / frames,
        "stage_seconds": numbers["stage_seconds"],
        "mean_error_mm": numbers["marker_error_mm"]["soft_tissue"]["mean"],
        "megabytes": {
            file.name: file.stat().st_size / 1e6
            for file in sorted(written.iterdir())
            if file.is_file()
        },
        "exports": {ending: export(written, folder / f"exported.{ending}") for ending in exports},
    }


def export(written: Path, to: Path) -> dict:
    """The result of a fit as another file: seconds, peak memory, size."""
    run = measured("export", str(written), "--out", str(to))
    return run | {"megabytes": to.stat().st_size / 1e6}


def agreement(capture: Capture) -> list[dict]:
    """Windows against one solve of all frames."""
    someone = person_of([capture], "auto")
    prior = shipped_prior()
    body = habitus.load_body("default")
    settings = MoshSettings(longest=1_000_000)
    whole = fit_markers(body, prior, someone.layout, someone.recordings, settings)[0]
    rows = []
    for longest in (1000, 2000):
        cut = fit_markers(
            body, prior, someone.layout, someone.recordings, replace(settings, longest=longest)
        )[0]
        pairs = {"pose": (whole.pose_stage, cut.pose_stage)}
        pairs["soft_tissue"] = ((whole.pose, whole.trans), (cut.pose, cut.trans))
        row = {"capture": capture.name, "frames": len(capture), "window": longest}
        for stage, (one, other) in pairs.items():
            turned = Rotation.from_rotvec(one[0].reshape(-1, 3)).inv() * Rotation.from_rotvec(
                other[0].reshape(-1, 3)
            )
            row[f"{stage}_degrees"] = float(np.degrees(turned.magnitude().max()))
            row[f"{stage}_mm"] = 1e3 * float(np.linalg.norm(one[1] - other[1], axis=1).max())
        rows.append(row)
    return rows


def tables(runs: list[dict], rows: list[dict], title: str) -> list[Table]:
    """Memory and time, then agreement."""
    by_length = Table(title=title, caption=f"goals: {GOALS}")
    for head in (
        "frames",
        "peak GB",
        "s",
        "ms a frame",
        "CPU ms a frame",
        "mean mm",
        "npz MB",
        "glb MB",
        "page MB",
    ):
        by_length.add_column(head, justify="right")
    for r in runs:
        sizes = [f"{r['megabytes'][name]:,.1f}" for name in ("body.npz", "body.glb", "report.html")]
        numbers = (
            f"{r['peak_gb']:.2f}",
            f"{r['seconds']:.0f}",
            f"{r['ms_a_frame']:.2f}",
            f"{r['cpu_ms_a_frame']:.2f}",
        )
        by_length.add_row(f"{r['frames']:,}", *numbers, f"{r['mean_error_mm']:.2f}", *sizes)
    apart = Table(title="windows against one solve: largest difference of any frame")
    for head in (
        "capture",
        "frames",
        "window",
        "pose °",
        "pose mm",
        "soft tissue °",
        "soft tissue mm",
    ):
        apart.add_column(head, justify="left" if head == "capture" else "right")
    for r in rows:
        numbers = (r["pose_degrees"], r["pose_mm"], r["soft_tissue_degrees"], r["soft_tissue_mm"])
        apart.add_row(
            r["capture"], str(r["frames"]), str(r["window"]), *(f"{x:.1e}" for x in numbers)
        )
    return [by_length, apart]


def main() -> None:
    """Measure, print tables, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--frames", nargs="*", type=int, default=[10_000, 100_000, 1_000_000])
    arguments.add_argument("--capture", type=Path, default=CAPTURES / "85_12.c3d")
    arguments.add_argument(
        "--no-agreement", action="store_true", help="leave out windows against one solve"
    )
    arguments.add_argument(
        "--folder", type=Path, default=None, help="where captures and results are put; kept then"
    )
    arguments.add_argument("--exports", nargs="*", default=[], help="endings, such as glb")
    options = arguments.parse_args()
    where = machine()
    capture = habitus.read_capture(options.capture)
    runs = []
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for frames in options.frames:
            runs.append(
                command(capture, frames, options.folder or Path(temporary), options.exports)
            )
            print(
                f"{frames:,} frames: {runs[-1]['seconds']:.0f} s, {runs[-1]['peak_gb']:.2f} GB",
                *(
                    f"{ending}: {each['seconds']:.0f} s, {each['peak_gb']:.2f} GB"
                    for ending, each in runs[-1]["exports"].items()
                ),
                sep="; ",
                flush=True,
            )
    if not options.no_agreement:
        for path in (options.capture, CAPTURES / "HDM_mm_01-02_03_120.c3d"):
            if path.is_file():
                rows += agreement(habitus.read_capture(path))
    for table in tables(runs, rows, f"long captures: {in_words(where)}"):
        Console(width=150).print(table)
    write_json(options.out, {"machine": where, "goals": GOALS, "runs": runs, "agreement": rows})


if __name__ == "__main__":
    main()
