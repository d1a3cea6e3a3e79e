"""What is left of `habitus mosh` when it is killed at any moment, when the disk is full, when two
run in one folder.

python benchmarks/power_cuts.py [--kills 50] [--frames 60] [--hasty] [--seed 0]
[--only rgbd register train] [--out power_cuts.json]

Fits of a real capture where there is one (../shared/mocap), else of a synthetic one, replace the
results of earlier fits and get SIGKILL: half of them at a random moment between start and end, half
at a random moment after they have begun to write. After each kill every folder of results that can
be seen must be whole and of one fit, old or new; what was finished before must be as it was, byte
by byte; nothing may lie outside the folder for results. A last run that is left alone must leave
nothing but results. With --hasty the shape stage takes one step on three frames: what is written,
and when, stays the same. The full disk is a tmpfs of 1 MB where mounting is allowed, else a limit
on the size of files. `habitus archive` is killed half as often; resumed, its results must be those
of a run that nobody killed. `habitus rgbd`, `register` and `train`: see `killed_programs`; with
--only these alone are measured, and the file's other numbers stay.
"""

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import CAPTURES, command, in_words, machine, parser, synthetic, write_json
from killed_programs import MAIN, NOTES, PROGRAMS, digests, kill_once, program_kills, same_arrays

from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture, read_capture
from habitus.io.models.bodies import load_body

HASTY = (
    """
from functools import partial
import habitus.jobs.mosh as jobs
jobs.MoshSettings = partial(jobs.MoshSettings, annealing=(10.0,), frames=3)
"""
    + MAIN
)
FILES = {"body.npz", "body.glb", "metrics.json", "report.html"}


@dataclass(frozen=True)
class Bench:
    """Captures called one and two in ``folder``, results in ``folder``/out."""

    folder: Path
    hasty: bool = False

    @property
    def out(self) -> Path:
        """Where results go."""
        return self.folder / "out"

    def command(self, seed: int, out: Path | None = None) -> list[str]:
        """A fit of both captures."""
        files = [str(self.folder / f"{name}.c3d") for name in ("one", "two")]
        options = ["--out", str(out or self.out), "--seed", str(seed), "--soft-tissue", "none"]
        return [
            sys.executable,
            *(("-c", HASTY) if self.hasty else ("-m", "habitus")),
            "mosh",
            *files,
            *options,
        ]

    def start(self, seed: int, out: Path | None = None, **options: object) -> subprocess.Popen:
        """The same, begun."""
        command = self.command(seed, out)
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
        )  # type: ignore


def prepare(folder: Path, frames: int, hasty: bool) -> Bench:
    """Two short captures of one subject."""
    known = CAPTURES / "testsample.c3d"
    whole = (
        read_capture(known)
        if known.exists()
        else synthetic(load_body("default"), "cmu-41", 2 * frames)
    )
    for name, part in (("one", whole[:frames]), ("two", whole[frames : 2 * frames])):
        write_c3d(
            Capture(name, part.labels, np.array(part.markers), part.rate_hz, part.up_axis),
            folder / f"{name}.c3d",
        )
    return Bench(folder, hasty)


def faults(bench: Bench, before: dict[str, dict[str, str]], seed: int) -> list[str]:
    """What is wrong in the folder for results, in words; ``before`` are the digests of each
    capture's folder.
    """
    found = []
    for name, old in before.items():
        if not (bench.out / name).is_dir():
            if not list(bench.out.glob(f".{name}.old-*")):
                found.append(f"{name} is gone")
            continue
        now = digests(bench.out / name)
        if now != old and name not in ("one", "two"):
            found.append(f"{name}, finished before, has changed")
        elif now != old:
            found += [f"{name}: {fault}" for fault in _mixed(bench.out / name, old, now, seed)]
    beside = {path.name for path in bench.folder.iterdir()} - {"one.c3d", "two.c3d", "out"}
    seen = {path.name for path in bench.out.iterdir() if not path.name.startswith(".")} - {
        *before,
        "index.html",
    }
    index = bench.out / "index.html"
    if index.exists() and not index.read_text("utf-8").rstrip().endswith("</html>"):
        found.append("index.html is not whole")
    return (
        found + [f"{name} lies outside" for name in beside] + [f"{name} is seen" for name in seen]
    )


def _mixed(folder: Path, old: dict[str, str], now: dict[str, str], seed: int) -> list[str]:
    """Faults of a folder that is not the old one: it must be whole, of this run, and hold the
    user's file.
    """
    names = {path.name for path in folder.iterdir()} - {NOTES}
    if names != FILES:
        return [f"holds {', '.join(sorted(names))}"]
    found = [
        f"{name} is the old one"
        for name in ("metrics.json", "report.html")
        if now[name] == old[name]
    ]
    with np.load(folder / "body.npz") as arrays:
        if int(arrays["seed"]) != seed or not all(
            np.asarray(arrays[name]).shape is not None for name in arrays.files
        ):
            found.append("body.npz is of another run")
    glb = (folder / "body.glb").read_bytes()
    if int.from_bytes(glb[8:12], "little") != len(glb):
        found.append("body.glb is torn")
    json.loads((folder / "metrics.json").read_text("utf-8"))
    if not (folder / "report.html").read_text("utf-8").rstrip().endswith("</html>"):
        found.append("report.html is torn")
    return found


def kills(bench: Bench, count: int, seed: int) -> dict[str, object]:
    """Fits killed one after another, each begun in what the one before has left."""
    subprocess.run(
        bench.command(9_999), check=True, capture_output=True
    )  # which may compile kernels
    began = time.monotonic()
    subprocess.run(bench.command(10_000), check=True, capture_output=True)
    seconds = time.monotonic() - began
    (bench.out / "one" / NOTES).write_text("mine")
    shutil.copytree(bench.out / "two", bench.out / "finished before")
    chance = random.Random(seed)
    states = []
    found = []
    before = {name: digests(bench.out / name) for name in ("one", "two", "finished before")}
    for k in range(count):
        delay = chance.uniform(0.0, seconds if k % 2 else 0.4)
        pattern = "" if k % 2 else ".*.partial-*"
        states.append(kill_once(bench.command(k), bench.out, pattern, delay))
        now = [f"kill {k}: {fault}" for fault in faults(bench, before, k)]
        print("".join(f"    {fault}\n" for fault in now), end="", flush=True)
        found += now
        before = {name: digests(bench.out / name) or old for name, old in before.items()}
    subprocess.run(bench.command(20_000), check=True, capture_output=True)
    found += [f"last run: {fault}" for fault in faults(bench, before, 20_000)]
    left = [path.name for path in bench.out.iterdir() if path.name.startswith(".")]
    kept = (bench.out / "one" / NOTES).exists()
    states_told = {state: states.count(state) for state in sorted(set(states))}
    return {
        "kills": count,
        "seconds_of_a_run": seconds,
        "states": states_told,
        "faults": found,
        "fault_count": len(found),
        "left_over": left,
    } | {"users_file_kept": kept}


def archive_kills(folder: Path, frames: int, count: int, seed: int) -> dict[str, object]:
    """`habitus archive` of a few captures, one of them spoilt, killed again and again, and what the
    run that is left alone makes of it, against a run that nobody killed.
    """
    known = CAPTURES / "85_12.c3d"
    length = 6 * frames
    body = load_body("default")
    whole = read_capture(known) if known.exists() else synthetic(body, "cmu-41", length)
    captures = folder / "captures"
    captures.mkdir()
    out = folder / "out"
    for k in range(6):
        part = replace(whole[k * frames : (k + 1) * frames], name=f"part{k}")
        write_c3d(part, captures / f"part{k}.c3d")
    (captures / "bad.c3d").write_bytes((captures / "part0.c3d").read_bytes()[:700])
    options = ["--soft-tissue", "none", "--workers", "1", "--quiet"]
    command = [sys.executable, "-m", "habitus", "archive", str(captures), *options, "--out"]
    began = time.monotonic()
    alone = subprocess.run([*command, str(folder / "alone")], capture_output=True, text=True)
    seconds = time.monotonic() - began
    chance = random.Random(seed)
    torn = []
    for k in range(count):
        process = subprocess.Popen([*command, str(out)], stderr=subprocess.DEVNULL)
        time.sleep(chance.uniform(0.3, 0.5) * seconds)
        process.send_signal(signal.SIGKILL)
        process.wait()
        made = [path for path in out.glob("part*") if path.is_dir()]
        torn += [f"kill {k}: {path.name}" for path in made if not _names(path).issuperset(FILES)]
    last = subprocess.run([*command, str(out)], capture_output=True, text=True)
    same = all(
        same_arrays(folder / "alone" / f"part{k}/body.npz", out / f"part{k}/body.npz")
        for k in range(6)
    )
    return {
        "kills": count,
        "torn": torn,
        "torn_count": len(torn),
        "exit_codes": [alone.returncode, last.returncode],
        "same_as_alone": same,
        "left_over": [path.name for path in out.glob(".*.partial-*")],
    }


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def two_at_once(bench: Bench) -> dict[str, object]:
    """Two runs in one folder: one fits, the other is refused in one line."""
    runs = [bench.start(30_000 + k) for k in range(2)]
    said = [run.communicate()[1] for run in runs]
    return {
        "exit_codes": sorted(run.returncode for run in runs),
        "said": [line for line in said if line],
    }


def full_disk(bench: Bench) -> dict[str, object]:
    """A disk that has room for one capture's results and not for two."""
    disk = bench.folder.parent / "disk"
    disk.mkdir()
    mounted = (
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk], capture_output=True
        ).returncode
        == 0
    )
    limit = {} if mounted else {"preexec_fn": _small_files}
    run = bench.start(1, disk / "out", **limit)
    said = run.communicate()[1]
    there = sorted(str(path.relative_to(disk)) for path in disk.rglob("*"))
    if mounted:
        subprocess.run(["umount", disk], check=True)
    return {
        "kind": "tmpfs of 1 MB" if mounted else "limit",
        "exit_code": run.returncode,
        "said": said,
        "there": there,
    }


def _small_files() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))


def main() -> None:
    """Measure, print, write."""
    arguments = parser(__doc__)
    arguments.add_argument("--kills", type=int, default=50)
    arguments.add_argument("--frames", type=int, default=60)
    arguments.add_argument("--hasty", action="store_true")
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--only", nargs="+", choices=("archive", *PROGRAMS), default=())
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    where = machine()
    print(in_words(where))
    before: dict = {}
    if options.only and options.out and options.out.exists():
        before = json.loads(options.out.read_text("utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        found = {} if options.only else markers(Path(folder), options)
        found["programs"] = before.get("programs", {})
        for name in options.only or PROGRAMS:
            (Path(folder) / name).mkdir()
            if name == "archive":
                work = Path(folder) / name
                row = archive_kills(work, options.frames, options.kills, options.seed)
                found["archive"] = {"command": command(), **row}
                continue
            row = program_kills(name, Path(folder) / name, options.kills, options.seed)
            found["programs"][name] = {"command": command(), **row}
    print(json.dumps(found, indent=1))
    if options.out:
        about = {"machine": where, "frames": options.frames, "hasty": options.hasty}
        write_json(options.out, {**about, **before, **found})


def markers(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """`habitus mosh` and `archive`."""
    (folder / "bench").mkdir()
    (folder / "archive").mkdir()
    bench = prepare(folder / "bench", options.frames, options.hasty)
    return {
        "kills": kills(bench, options.kills, options.seed),
        "archive": archive_kills(
            folder / "archive", options.frames, options.kills // 2, options.seed
        ),
        "two_at_once": two_at_once(bench),
        "full_disk": full_disk(bench),
    }


if __name__ == "__main__":
    main()
