"""`habitus rgbd`, `register` and `train` killed again and again, for `power_cuts.py`.

Each program has two runs that differ in one option; what both write is known from runs that nobody
killed. A run replaces the results of the other one and gets SIGKILL: every second one after it has
begun to write results (a fifth longer than that takes), the others at a random moment. The files of a folder must then all be the
old ones, byte by byte, or all those of the new run: equal arrays, numbers (but seconds) and bytes;
of a report only the end is looked at. A kill between two renames is no fault where the next run can
see it and undoes or completes them; such kills are counted. Fits are hasty: what is written, and when, stays the same.
"""

import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import ROOT

from habitus.io.models.bodies import load_body
from habitus.io.registrations.open import write_registrations
from habitus.io.registrations.templates import body_template, save_template
from habitus.io.rgbd.write import write_views
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.planted_body import joints_near_rings, planted_truth
from habitus_lab.population.registrations import planted_registrations
from habitus_lab.population.rgbd_people import planted_rest, rgbd_scene

SCAN = ROOT.parent / "shared" / "scans" / "demo_scan.ply"
MAIN = "from habitus.cli.main import main\nmain()\n"
RGBD = """
from functools import partial
import habitus.jobs.rgbd as jobs
from habitus.fit.points.depth_settings import *
jobs.RgbdSettings = partial(
    jobs.RgbdSettings, stages=STAGES[-2:], skin_steps=1, colour_levels=(),
    search=DepthSearchSettings(arms=((45.0, 0.0, 0.0),), side_turns=(0.0,)),
    limbs=DepthLimbSettings(passes=0),
    appearance=AppearanceSettings(shift_steps=1, grey_steps=1, channel_steps=1),
)
"""
REGISTER = """
from dataclasses import replace
import habitus.fit.points.scans as fit
import habitus.jobs.register as jobs
fit.with_extremities = lambda fitter, state, cloud: state
scans = jobs.SCANS
few = {"candidates": 1, "drawn_poses": 0, "headings": 4, "checked": 8, "kept": 2, "refined": 1}
jobs.SCANS = replace(
    scans, offset_stages=(), last_stages=scans.offset_stages[:1],
    search=replace(scans.search, **few), limbs=replace(scans.limbs, rounds=0),
    surface=replace(scans.surface, points=1500, stages=scans.surface.stages[:1], stretched=1.0),
)
"""
NOTES = "notes of the user.txt"


@dataclass(frozen=True)
class Program:
    """A command with two values of an option, and the stem of the first result that it writes.

    hasty: Python code that shortens the fit. resumes: whether a killed run goes on from a
    checkpoint.
    """

    words: tuple[str, ...]
    option: str
    values: tuple[str, str]
    first: str
    hasty: str = ""
    resumes: bool = False

    def command(self, which: int, out: Path, *more: str) -> list[str]:
        """The command line with one of the two values."""
        chosen = (self.option, self.values[which], "--out", str(out))
        return [sys.executable, "-c", self.hasty + MAIN, *self.words, *chosen, "--quiet", *more]


def rgbd(folder: Path) -> Program:
    """A made person in two small views."""
    body = load_body("default")
    rng = np.random.default_rng(5)
    person = planted_rest(body, rng)
    scene = rgbd_scene(body, person, rng, sensor="azure-kinect", scale=0.35)
    write_views(scene.capture, folder / "views")
    words = ("rgbd", str(folder / "views"), "--turns", "0", "45", "--body", "neutral")
    return Program(words, "--clothes-mm", ("1", "2"), "out", RGBD)


def register(folder: Path) -> Program:
    """A real scan where there is one, else the default body's vertices."""
    scan = folder / f"scan{SCAN.suffix}" if SCAN.exists() else folder / "scan.xyz"
    if SCAN.exists():
        shutil.copyfile(SCAN, scan)
    else:
        np.savetxt(scan, load_body("default").v_template)
    words = ("register", str(scan), "--body", "neutral", "--up", "+y")
    return Program(words, "--seed", ("0", "1"), "scan", REGISTER)


def train(folder: Path) -> Program:
    """Four made people of 320 vertices in seven poses, eleven in one."""
    base = coarse_body(load_body("default"), 320)
    template = body_template(base)
    truth = planted_truth(base, joint_regressor=joints_near_rings(template))
    few = {"subjects": 4, "poses_per_subject": 7, "shape_people": 11}
    planted = planted_registrations(truth, **few, test_subjects=1, test_poses=2, seed=2)
    write_registrations(planted.registrations, folder / "people.npz")
    save_template(template, folder / "template.npz")
    files = ("train", str(folder / "people.npz"), "--template", str(folder / "template.npz"))
    options = "--rounds 2 --tolerance 0 --num-betas 4 --weights.pose-shapes 1 --workers 1".split()
    return Program((*files, *options), "--weights.joints", ("5", "6"), "files", resumes=True)


PROGRAMS = {"rgbd": rgbd, "register": register, "train": train}


def digests(folder: Path) -> dict[str, str]:
    """Of every file below a folder."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def same_arrays(first: Path, second: Path) -> bool:
    """Whether two archives hold the same arrays, byte by byte."""
    with np.load(first) as one, np.load(second) as two:
        return one.files == two.files and all(
            one[key].tobytes() == two[key].tobytes() for key in one.files
        )


def kill_once(command: Sequence[str], folder: Path, pattern: str, delay: float) -> str:
    """Start a run and kill it after ``delay`` seconds, counted from the moment at which something
    new in ``folder`` has a name of the ``pattern`` where there is one; says in which state it was.
    """
    known = set(folder.rglob(".*"))
    began = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if pattern:
        wait_for(process, folder, pattern)
    with suppress(subprocess.TimeoutExpired):
        process.wait(delay)
    code = process.poll()
    process.send_signal(signal.SIGKILL)
    process.wait()
    new = {path.name for path in set(folder.rglob(".*")) - known} - {".lock"}
    state = "writing" if new else "working"
    if code is not None:
        state = f"ended with code {code}" if code else "ended"
    print(f"  killed after {time.monotonic() - began:6.2f} s, {state}", flush=True)
    return state


def wait_for(process: subprocess.Popen, folder: Path, pattern: str) -> None:
    """Until something new in ``folder`` has a name of the pattern, or the process has ended."""
    known = set(folder.rglob(pattern))
    while process.poll() is None and not set(folder.rglob(pattern)) - known:
        time.sleep(0.001)


@dataclass(frozen=True)
class Bench:
    """A program in ``folder``/work/out, and what undisturbed runs left in ``folder``/alone0 and
    alone1.
    """

    program: Program
    folder: Path

    @property
    def out(self) -> Path:
        """Where results go."""
        return self.folder / "work" / "out"

    def alone(self, which: int) -> Path:
        """The results of a run that nobody killed."""
        return self.folder / f"alone{which}" / "out"

    def results(self) -> list[str]:
        """Names of all results."""
        return [name for name in digests(self.alone(0)) if not name.startswith("checkpoint")]

    def timed(self, which: int) -> tuple[float, float]:
        """Seconds of an undisturbed run, and those from the first result's beginning to the last
        one's end.
        """
        out = self.alone(which)
        out.parent.mkdir()
        began = time.time()
        process = subprocess.Popen(self.program.command(which, out), stderr=subprocess.DEVNULL)
        wait_for(process, out.parent, f".{self.program.first}.partial-*")
        writes = time.time()
        if process.wait():
            raise RuntimeError(f"{' '.join(self.program.words)}: ended with {process.returncode}")
        last = max((out / name).stat().st_mtime for name in self.results())
        return time.time() - began, last - writes

    def command(self, which: int) -> list[str]:
        """The run in ``out``; another training's checkpoint there is discarded."""
        of_run = "checkpoint/model/run.json"
        other = self.program.resumes and not (
            (self.out / of_run).exists()
            and (self.out / of_run).read_bytes() == (self.alone(which) / of_run).read_bytes()
        )
        return self.program.command(which, self.out, *(["--restart"] if other else []))

    def is_new(self, name: str, which: int, before: dict[str, str], now: dict[str, str]) -> bool:
        """Whether a result is that of one of the two runs."""
        there, here = self.alone(which) / name, self.out / name
        if name.endswith(".html"):
            whole = here.read_text("utf-8").rstrip().endswith("</html>")
            return whole and now[name] != before.get(name)
        if name.endswith(".npz"):
            return same_arrays(there, here)
        if name.endswith(".json"):
            return _numbers(json.loads(there.read_text())) == _numbers(json.loads(here.read_text()))
        return there.read_bytes() == here.read_bytes()

    def states(self, which: int, before: dict[str, str]) -> dict[Path, set[str]]:
        """Of the results in each folder after a run over results with these digests: old, new, gone,
        torn; "unfinished" where the run was killed between two renames, which the next one undoes
        or completes.
        """
        now = digests(self.out)
        states: dict[Path, set[str]] = {}
        for name in self.results():
            if name not in now:
                state = "gone"
            elif now[name] == before.get(name):
                state = "old"
            else:
                state = "new" if self.is_new(name, which, before, now) else "torn"
            states.setdefault(self.out / Path(name).parent, set()).add(state)
        for place, kinds in states.items():
            aside, ready = place.parent.glob(f".{place.name}.old-*"), place.glob(".files.ready-*")
            if (kinds == {"gone"} and any(aside)) or (kinds == {"new", "old"} and any(ready)):
                states[place] = {"unfinished"}
        return states

    def strangers(self) -> list[str]:
        """Visible files that are no results."""
        known = {"checkpoint", NOTES, *(Path(name).parts[0] for name in self.results())}
        visible = {path.name for path in self.out.glob("[!.]*")} - known
        beside = {path.name for path in self.out.parent.glob("[!.]*")} - {"out"}
        return [f"{name} is not a result" for name in sorted(visible | beside)]


def _numbers(value: Any) -> Any:
    """JSON without seconds."""
    if isinstance(value, dict):
        return {key: _numbers(each) for key, each in value.items() if "seconds" not in key}
    return [_numbers(each) for each in value] if isinstance(value, list) else value


def program_kills(name: str, folder: Path, count: int, seed: int) -> dict[str, Any]:
    """A program killed again and again, and what a last run that is left alone makes of it."""
    bench = Bench(PROGRAMS[name](folder), folder)
    bench.timed(0)  # which may compile kernels
    seconds, writing = bench.timed(1)
    shutil.copytree(bench.alone(0), bench.out)
    notes = next(path for path in (bench.out / "scan", bench.out) if path.is_dir()) / NOTES
    notes.write_text("mine")
    chance = random.Random(seed)
    states, found, before, which, between = [], [], digests(bench.out), 1, 0

    def check(what: str, *allowed: str) -> bool:
        """Note faults; whether the run was killed between two renames."""
        kinds = bench.states(which, before)
        wrong = {
            place: kind for place, kind in kinds.items() if kind not in [{each} for each in allowed]
        }
        new = [f"{place.name}: {' and '.join(sorted(kind))}" for place, kind in wrong.items()]
        found.extend(f"{what}: {fault}" for fault in new + bench.strangers())
        return {"unfinished"} in kinds.values()

    def finish(what: str) -> None:
        subprocess.run(bench.command(which), check=True, capture_output=True)
        check(what, "new")

    for k in range(count):
        late = k % 2
        pattern = f".{bench.program.first}.partial-*" if late else ""
        delay = chance.uniform(0.0, 1.2 * writing if late else seconds)
        states.append(kill_once(bench.command(which), bench.out.parent, pattern, delay))
        killed = states[-1] in ("writing", "working")
        allowed = ("old", "new", "unfinished") if killed else ("new",)
        between += check(f"kill {k}", *allowed)
        if bench.program.resumes and late:
            finish(f"resumed after kill {k}")
        now = digests(bench.out)
        if all(now.get(each) not in (None, before[each]) for each in bench.results()):
            before, which = now, 1 - which
    finish("last run")
    left = [path.name for path in bench.out.parent.rglob(".*")]
    row = {
        "kills": count,
        "seconds_of_a_run": seconds,
        "states": {state: states.count(state) for state in sorted(set(states))},
        "between_renames": between,
        "faults": found,
        "fault_count": len(found),
        "left_over": left,
        "users_file_kept": notes.exists(),
    }
    resumed = [fault for fault in found if fault.startswith(("resumed", "last"))]
    return row | ({"same_as_alone": not resumed} if bench.program.resumes else {})
