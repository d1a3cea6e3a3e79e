"""The runner of all benchmarks (arguments, the machine's name, tables, JSON), and what those of the
marker fit share: captures to run on, and kernels compiled beforehand.

A benchmark is a function from options to numbers, and one that prints the numbers:

    if __name__ == "__main__":
        arguments = parser(__doc__)
        arguments.add_argument("--people", type=int, default=12)
        run(arguments, measure, show)
"""

import argparse
import json
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.model import BodyModel
from habitus.body.prior import shipped_prior
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

ROOT = Path(__file__).resolve().parents[1]
ENDINGS = (".c3d", ".trc", ".csv", ".tsv", ".npz")
CAPTURES = ROOT.parent / "shared" / "mocap"
"""Real captures that lie beside a checkout and are never part of it."""


def parser(doc: str | None, out: bool = False) -> argparse.ArgumentParser:
    """A parser of arguments whose help is the benchmark's docstring; with ``out`` the JSON goes to
    the benchmark's name unless `--out` says otherwise.
    """
    arguments = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if out:
        name = Path(sys.argv[0]).with_suffix(".json").name
        arguments.add_argument("--out", type=Path, default=Path(name), help="JSON of the numbers")
    return arguments


def capture_parser(doc: str | None) -> argparse.ArgumentParser:
    """A parser with the arguments of benchmarks on real captures: files and folders, names, --out."""
    arguments = parser(doc, out=True)
    arguments.add_argument(
        "places", nargs="*", type=Path, metavar="CAPTURE_OR_FOLDER", default=[CAPTURES]
    )
    arguments.add_argument(
        "--captures",
        nargs="+",
        default=(),
        metavar="NAME",
        help="only these, by name without ending",
    )
    return arguments


def capture_files(places: Iterable[Path], names: Sequence[str] = ()) -> list[Path]:
    """Capture files among some files and folders, only those with these names where there are
    names.
    """
    files: list[Path] = []
    for place in places:
        if place.is_dir():
            files += sorted(path for path in place.iterdir() if path.suffix.lower() in ENDINGS)
        elif place.is_file():
            files.append(place)
        else:
            print(f"{place}: not there; left out")
    for name in set(names) - {path.stem for path in files}:
        print(f"{name}: not there; left out")
    return [path for path in files if not names or path.stem in names]


def run(
    arguments: argparse.ArgumentParser,
    measure: Callable[[argparse.Namespace], Mapping[str, object] | None],
    show: Callable[[dict], None],
) -> None:
    """Measure with the options of the command line, print, name the machine, and write the JSON to
    `--out` where there is one. ``measure`` gives None where there is nothing to measure.
    """
    options = arguments.parse_args()
    where = machine()
    numbers = measure(options)
    if numbers is None:
        return
    found = {"machine": where, **numbers}
    show(found)
    print(in_words(where))
    if getattr(options, "out", None) is not None:
        write_json(options.out, found)


def show_table(title: str, rows: Iterable[Mapping[str, object]], digits: int = 2) -> None:
    """Print rows as a table; columns are the keys of the first row, numbers are aligned right."""
    rows = list(rows)
    table = Table(title=title, title_justify="left", box=None)
    for key, value in (rows[0] if rows else {}).items():
        table.add_column(key, justify="left" if isinstance(value, str) else "right")
    for row in rows:
        table.add_row(*(_cell(value, digits) for value in row.values()))
    Console(width=170).print(table)


def _cell(value: object, digits: int) -> str:
    if isinstance(value, float):
        return f"{value:,.{digits}f}"
    return f"{value:,}" if isinstance(value, int) else "–" if value is None else str(value)


def machine() -> dict[str, object]:
    """Processor, cores and versions, to stand beside every number."""
    import numba

    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text().splitlines()
            if line.startswith("model name")
        ]
        processor = names[0] if names else processor
    return {
        "processor": processor,
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "kernel_threads": numba.config.NUMBA_NUM_THREADS,
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
        "habitus": habitus.__version__,
    }


def in_words(machine: dict[str, object]) -> str:
    """The machine in one line."""
    return (
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load_before']:.1f} "
        "before"
    )


def synthetic(body: BodyModel, layout_name: str, frames: int, seed: int = 1) -> Capture:
    """A synthetic capture at 120 Hz with the markers that a layout asks for: placement errors,
    noise, gaps.
    """
    rng = np.random.default_rng(seed)
    layout = load_layout(layout_name)
    prior = shipped_prior().for_joints(body.joint_names)
    layout = layout.restricted_to(
        tuple(marker.label for marker in layout.markers if not marker.optional)
    )
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), frames, 120.0, rng)
    betas = np.clip(rng.normal(size=body.num_betas), -2, 2)
    truth = simulate_capture(
        body, betas, pose, trans, layout.vertices(body), layout.distances(), Faults(), rng
    )
    return Capture(f"synthetic-{layout_name}", layout.labels, truth.observed, 120.0, "+y")


def write_synthetic(body: BodyModel, layout_name: str, frames: int, folder: Path) -> Path:
    """The same as a C3D file."""
    capture = synthetic(body, layout_name, frames)
    path = folder / f"{capture.name}.c3d"
    write_c3d(capture, path)
    return path


def compile_kernels(body: BodyModel) -> float:
    """Run a tiny fit, so that imports and compilation are over before anything is timed; gives the
    seconds it took.
    """
    began = time.perf_counter()
    from habitus.fit.markers.recipe import fit_markers
    from habitus.fit.markers.settings import MoshSettings
    from habitus.jobs.subjects import person_of

    someone = person_of([synthetic(body, "cmu-41", 48)], "auto")
    for causal in (False, True):
        settings = MoshSettings(annealing=(10.0,), frames=3, causal=causal, soft_tissue=not causal)
        fit_markers(body, shipped_prior(), someone.layout, someone.recordings, settings)
    return time.perf_counter() - began


def write_json(path: Path, content: dict) -> None:
    """The numbers behind a table, and the command that measured them."""
    text = json.dumps({"command": command(), **content}, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
    print(f"wrote {path}")


def command() -> str:
    """The command line of this benchmark, without the folders of this machine."""
    paths = ("/" in word.replace(" / ", "") for word in sys.argv[1:])
    words = (Path(w).name if path else w for w, path in zip(sys.argv[1:], paths, strict=True))
    return shlex.join(("benchmarks/" + Path(sys.argv[0]).name, *words))


def written_rows(path: Path, key: str, **settings: object) -> list[dict]:
    """The rows under a key that a run with these settings has left in a file; none where there is
    no such file.
    """
    if not path.exists():
        return []
    before = json.loads(path.read_text(encoding="utf-8"))
    return before[key] if all(before.get(name) == value for name, value in settings.items()) else []
