"""Check that `pip install habitus` finds wheels on other systems:

python tools/wheels.py [--python 3.11 3.12 3.13] [--system windows …] [--extra usd …]

For each system and Python, pip resolves the dependencies of pyproject.toml from wheels alone: at
the versions of constraints.txt, else at any. Nothing is installed. Exit code 1 where some is
missing.
"""

import argparse
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SYSTEMS = {
    "windows": ("win_amd64",),
    "macos-arm": tuple(f"macosx_{major}_0_arm64" for major in range(14, 10, -1)),
    "macos-intel": tuple(
        [f"macosx_{major}_0_x86_64" for major in range(14, 10, -1)] + ["macosx_10_13_x86_64"]
    ),
    "linux": tuple(
        f"manylinux{tag}_x86_64" for tag in ("_2_28", "_2_27", "_2_24", "_2_17", "2014")
    ),
    "linux-arm": tuple(
        f"manylinux{tag}_aarch64" for tag in ("_2_28", "_2_27", "_2_24", "_2_17", "2014")
    ),
}
"""Tags of wheels that run there: Windows 10, macOS 14, glibc 2.28 (RHEL 8, Debian 10) and older."""


def main() -> None:
    """Ask pip for each system and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", nargs="*", default=["3.11", "3.12", "3.13"])
    parser.add_argument("--system", nargs="*", default=list(SYSTEMS), choices=list(SYSTEMS))
    parser.add_argument("--extra", nargs="*", default=[])
    options = parser.parse_args()
    needed = requirements(options.extra)
    missing = 0
    for system in options.system:
        for python in options.python:
            complete, found = lacking(needed, system, python)
            missing += not complete
            print(f"{system:12} {python:5} {found}", flush=True)
    sys.exit(1 if missing else 0)


def requirements(extras: list[str]) -> list[str]:
    """What pyproject.toml asks for, with extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    chosen = [project["optional-dependencies"][extra] for extra in extras]
    return [*project["dependencies"], *(line for lines in chosen for line in lines)]


def lacking(needed: list[str], system: str, python: str) -> tuple[bool, str]:
    """Whether pip finds wheels of everything, and what it finds: at the pinned versions, or else at
    any that pyproject.toml takes.
    """
    pins = ["--constraint", str(ROOT / "constraints.txt")]
    if _resolves([*pins, *needed], system, python):
        return True, "complete at the pinned versions"
    unpinned = _without_wheel(needed, pins, system, python)
    if _resolves(needed, system, python):
        return True, f"complete at other versions than the pinned ones of {unpinned}"
    return False, f"no wheels of {_without_wheel(needed, [], system, python)}"


def _without_wheel(needed: list[str], pins: list[str], system: str, python: str) -> str:
    alone = [line for line in needed if not _resolves([*pins, line], system, python)]
    return ", ".join(alone) or "what these need"


def _resolves(words: list[str], system: str, python: str) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet"]
        command += ["--ignore-installed", "--target", folder, "--only-binary", ":all:"]
        command += ["--python-version", python, "--implementation", "cp"]
        command += [f"--platform={tag}" for tag in SYSTEMS[system]]
        return subprocess.run([*command, *words], capture_output=True).returncode == 0


if __name__ == "__main__":
    main()
