"""How long a program or a person waits before anything happens: importing habitus, and the command's help.

python benchmarks/startup.py [--repeats 7] [--out startup.json]
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

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
    return float(subprocess.run([sys.executable, "-c", IMPORT], capture_output=True, check=True).stdout)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    found = {"import habitus": statistics.median(import_alone() for _ in range(options.repeats))}
    for name, arguments in STEPS.items():
        found[name] = statistics.median(whole_process(arguments) for _ in range(options.repeats))
    for name, seconds in found.items():
        print(f"{name:26s} {1e3 * seconds:8.1f} ms")
    if options.out:
        options.out.write_text(json.dumps(found, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
