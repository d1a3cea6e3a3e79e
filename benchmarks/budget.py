"""What the main jobs may cost, in counts that are the same on every machine, against a recorded
reference: fails where one has grown by more than a tenth.

    python benchmarks/budget.py [--jobs mosh label] [--record] [--out budget.json]

Seconds of a shared machine differ by half from run to run; these counts do not:

    modules   modules that are loaded, of habitus and of others: what a start costs
    calls     calls of Python functions and of compiled ones that Python calls (cProfile)
    kernels   calls of compiled kernels among them: steps of solvers times the blocks of frames
    peak_mb   most memory that is allocated at once (tracemalloc), in MB
    file_mb   size of the files that are written, in MB

Comprehensions and generators are left out, as other versions of Python call them in other numbers.
Each job runs in a process of its own with one thread, once to load and compile what it needs and
once counted. Two runs differ by less than 1 % (iterations of a solver may end a step earlier on
another processor): a tenth is beyond that, and below what a superfluous evaluation in a loop costs. Work inside a kernel is not
counted: `mosh_speed.py` and `body_forward.py` time it. Where a count falls by more than a tenth,
record the reference anew, so that what was saved stays saved.
"""

import argparse
import cProfile
import json
import os
import pstats
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path

REFERENCE = Path(__file__).with_name("budget_reference.json")
TOLERANCE = 0.10
"""Share by which a count may grow."""
FEW = 5
"""Counts that grow by no more than so many are no failure: a module or a call here and there."""
ALONE = {"PYTHONHASHSEED": "0"} | dict.fromkeys(
    ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
)

Counts = dict[str, float]


def imported(names: tuple[str, ...]) -> Counts:
    """Modules that importing these loads into a fresh process."""
    from importlib import import_module

    for name in names:
        import_module(name)
    loaded = list(sys.modules)
    own = sum(name.partition(".")[0] == "habitus" for name in loaded)
    return {"modules_of_habitus": own, "other_modules": len(loaded) - own}


def start_help() -> Counts:
    """``habitus --help``."""
    return imported(("habitus.cli.main",))


def start_mosh() -> Counts:
    """``habitus mosh`` before it reads a file."""
    from habitus.cli.mosh import NEEDS

    return imported(("habitus.cli.main", "tyro", "habitus.cli.mosh", *NEEDS))


def counted(work: Callable[[], object]) -> Counts:
    """Calls and peak memory of ``work``, which has been done once before."""
    work()
    profile = cProfile.Profile()
    tracemalloc.start()
    profile.enable()
    work()
    profile.disable()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {**calls(pstats.Stats(profile)), "peak_mb": peak / 1e6}


def calls(stats: pstats.Stats) -> Counts:
    """Calls of all functions, and those of compiled kernels among them."""
    import habitus
    from habitus.kernels.jit import FILES

    folder = Path(habitus.__file__).parent
    kernels = {str(folder / name) for name in FILES}
    numbers = [
        (file, count)
        for (file, _, name), (_, count, *_) in stats.stats.items()  # type: ignore[attr-defined]
        if not name.endswith(("comp>", "<genexpr>")) and "builtins.next" not in name
    ]
    return {
        "calls": sum(count for _, count in numbers),
        "kernels": sum(count for file, count in numbers if file in kernels),
    }


def mosh() -> Counts:
    """A fit of 400 frames with 41 markers: shape, pose, soft tissue, verdict."""
    from common import synthetic

    import habitus

    body = habitus.load_body("default")
    capture = synthetic(body, "cmu-41", 400)

    def work() -> object:
        fit = habitus.Mosh().fit(capture, habitus.load_body("default"))
        return fit.verdict

    return counted(work)


def mosh_files() -> Counts:
    """body.npz, body.glb, the numbers and the page of such a fit."""
    from common import synthetic

    import habitus
    from habitus.export.glb import write_glb
    from habitus.export.npz import write_npz
    from habitus.report import write_report

    body = habitus.load_body("default")
    fit = habitus.Mosh().fit(synthetic(body, "cmu-41", 400), body)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)

        def work() -> object:
            write_npz(fit, place / "body.npz")
            write_glb(fit, place / "body.glb")
            return write_report(fit, place / "report.html")

        found = counted(work)
        size = sum(path.stat().st_size for path in place.iterdir())
    return {**found, "file_mb": size / 1e6}


def live() -> Counts:
    """A causal fit of 200 frames."""
    from common import synthetic

    import habitus

    body = habitus.load_body("default")
    capture = synthetic(body, "cmu-41", 200)
    return counted(lambda: habitus.Mosh(causal=True).fit(capture, body))


def label() -> Counts:
    """Labels of 120 frames of 41 points without any."""
    from common import synthetic

    import habitus

    capture = synthetic(habitus.load_body("default"), "cmu-41", 120)
    return counted(lambda: habitus.label(capture, layout="cmu-41"))


def scan() -> Counts:
    """Registration of a scan of 3,000 points: it takes as long as all other jobs."""
    import numpy as np

    import habitus
    from habitus.fit.points.scan import Scan

    body = habitus.load_body("default")
    rng = np.random.default_rng(0)
    pose = {"left_shoulder": (0, 0, -0.9), "right_shoulder": (0, 0, 0.9)}
    surface = body(rng.normal(size=10), pose)
    corners = surface.vertices[body.faces[rng.integers(0, body.num_faces, 3000)]]
    points = np.einsum("nk,nkc->nc", rng.dirichlet(np.ones(3), 3000), corners)
    return counted(lambda: habitus.register_scans(Scan("person", points), body))


def body() -> Counts:
    """Two hundred evaluations of the body, single and in a batch, and its measurements."""
    import numpy as np

    import habitus

    model = habitus.load_body("default")
    rng = np.random.default_rng(0)
    poses = 0.3 * rng.normal(size=(32, model.num_joints, 3))
    betas = rng.normal(size=(32, model.num_betas))

    def work() -> object:
        for _ in range(100):
            model(betas[0], poses[0])
            model(betas, poses)
        return model.measure(betas[0])

    return counted(work)


def export() -> Counts:
    """A fit of 200 frames as FBX, with the blend shapes that joints drive."""
    from common import synthetic

    import habitus

    model = habitus.load_body("default")
    fit = habitus.Mosh(soft_tissue=False).fit(synthetic(model, "cmu-41", 200), model)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.fbx"
        found = counted(lambda: fit.export(path))
        return {**found, "file_mb": path.stat().st_size / 1e6}


JOBS: dict[str, Callable[[], Counts]] = {
    "help": start_help,
    "start": start_mosh,
    "mosh": mosh,
    "files": mosh_files,
    "live": live,
    "label": label,
    "scan": scan,
    "body": body,
    "export": export,
}


def measured(name: str) -> Counts:
    """The counts of a job, in a process of its own."""
    line = [sys.executable, __file__, "--count", name]
    done = subprocess.run(line, env={**os.environ, **ALONE}, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout.decode().splitlines()[-1])


def compared(job: str, found: Counts, reference: Counts) -> tuple[list[tuple], list[str]]:
    """A row for each count, and what exceeds the reference."""
    rows, over = [], []
    for name, number in found.items():
        known = reference.get(name)
        if known is None:
            over.append(f"{job}: {name} has no reference")
        elif number > (1 + TOLERANCE) * known and number > known + FEW:
            over.append(f"{job}: {name} {known:,.0f} -> {number:,.0f}")
        rows.append((job, name, known, number))
    return rows, over


def main() -> int:
    """Count, compare, print; 1 where a count has grown too much."""
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--jobs", nargs="+", choices=JOBS, default=list(JOBS))
    arguments.add_argument("--record", action="store_true", help="make these the reference")
    arguments.add_argument("--out", type=Path, help="JSON of the counts")
    arguments.add_argument("--count", choices=JOBS, help=argparse.SUPPRESS)
    options = arguments.parse_args()
    if options.count:
        print(json.dumps(JOBS[options.count]()))
        return 0
    reference = json.loads(REFERENCE.read_text("utf-8")) if REFERENCE.is_file() else {}
    found: dict[str, Counts] = {}
    failures: list[str] = []
    print(f"{'job':8} {'count':20} {'reference':>12} {'now':>12} {'ratio':>6}")
    for job in options.jobs:
        found[job] = measured(job)
        rows, over = compared(job, found[job], reference.get(job, {}))
        failures += over
        for _, name, known, number in rows:
            before = "" if known is None else f"{known:,.1f}"
            ratio = f"{number / known:.3f}" if known else ""
            print(f"{job:8} {name:20} {before:>12} {number:>12,.1f} {ratio:>6}", flush=True)
    for path in ([options.out] if options.out else []) + ([REFERENCE] if options.record else []):
        kept = {**reference, **found} if path == REFERENCE else found
        path.write_text(json.dumps(kept, indent=1) + "\n", "utf-8")
    if options.record:
        return 0
    for line in failures:
        print(f"over budget: {line}", file=sys.stderr)
    if failures:
        print(
            "Find what is done more often (python -m cProfile), or, where it is meant, record the "
            "reference anew: python benchmarks/budget.py --record",
            file=sys.stderr,
        )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
