"""How long a person waits: importing habitus, the command's help, a first fit (which compiles) and
the second.

python benchmarks/startup.py [--repeats 5] [--frames 400] [--out startup.json]

The fit is `habitus mosh` from its call to its end on a synthetic capture of 41 markers. The first
run finds an empty NUMBA_CACHE_DIR, the second what the first left there. CPU seconds count all
threads; they say more on a busy machine.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import in_words, machine, parser, write_synthetic

from habitus.io.models.bodies import load_body

IMPORT = "import time; t = time.perf_counter(); import habitus; print(time.perf_counter() - t)"
STEPS = {
    "python, nothing imported": ["-c", "pass"],
    "habitus --version": ["-m", "habitus", "--version"],
    "habitus --help": ["-m", "habitus", "--help"],
    "habitus mosh --help": ["-m", "habitus", "mosh", "--help"],
    "habitus layout --help": ["-m", "habitus", "layout", "--help"],
    "habitus train --help": ["-m", "habitus", "train", "--help"],
    "habitus evaluate --help": ["-m", "habitus", "evaluate", "--help"],
}


def whole_process(arguments: list[str]) -> float:
    """Seconds from start to end of Python with these arguments."""
    began = time.perf_counter()
    subprocess.run([sys.executable, *arguments], capture_output=True, check=True)
    return time.perf_counter() - began


def import_alone() -> float:
    """Seconds of ``import habitus`` inside a fresh Python."""
    return float(
        subprocess.run([sys.executable, "-c", IMPORT], capture_output=True, check=True).stdout
    )


def first_and_second_fit(frames: int, repeats: int) -> dict[str, dict[str, float]]:
    """Wall and CPU seconds of a fit that has to compile its kernels, and medians of those after
    it.
    """
    with tempfile.TemporaryDirectory() as folder:
        capture = write_synthetic(load_body("default"), "cmu-41", frames, Path(folder))
        environment = os.environ | {"NUMBA_CACHE_DIR": f"{folder}/kernels"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        command = [sys.executable, "-m", "habitus", "mosh", str(capture), "--out", f"{folder}/out"]
        runs = [_timed(command, environment) for _ in range(1 + repeats)]
    walls, cpus = zip(*runs[1:], strict=True)
    second = {"wall": statistics.median(walls), "cpu": statistics.median(cpus)}
    return {"first": dict(zip(("wall", "cpu"), runs[0], strict=True)), "second": second}


def _timed(command: list[str], environment: dict[str, str]) -> tuple[float, float]:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.perf_counter()
    subprocess.run(command, env=environment, capture_output=True, check=True)
    wall = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure, print, write."""
    arguments = parser(__doc__)
    arguments.add_argument("--repeats", type=int, default=5)
    arguments.add_argument("--frames", type=int, default=400)
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    where = machine()
    print(in_words(where))
    found = {"import habitus": statistics.median(import_alone() for _ in range(options.repeats))}
    for name, arguments in STEPS.items():
        found[name] = statistics.median(whole_process(arguments) for _ in range(options.repeats))
    for name, seconds in found.items():
        print(f"{name:26s} {1e3 * seconds:8.1f} ms")
    fits = first_and_second_fit(options.frames, options.repeats)
    for name, seconds in fits.items():
        print(
            f"habitus mosh, {name + ' run':12s} {seconds['wall']:8.2f} s wall "
            f"{seconds['cpu']:8.2f} s CPU"
        )
    if options.out:
        content = {
            "machine": where,
            "seconds": found,
            "frames": options.frames,
            "mosh_seconds": fits,
        }
        options.out.write_text(json.dumps(content, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
