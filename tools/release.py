"""Builds wheel and sdist and tries the wheel where nothing else is: python tools/release.py dist
--python python3.12 …

For each Python: an empty environment, the wheel from its file, all else from the package index;
then, away from the checkout, `habitus --version` and the demo, which makes a capture and fits it.
Nothing is uploaded.
"""

import argparse
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NEEDED = (
    "habitus/assets/bodies/",
    "habitus/assets/layouts/",
    "habitus/report/web/page.html",
    "habitus/py.typed",
)
"""What a wheel without which nothing works must hold."""


def main() -> None:
    """Build, look inside, try."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--python", nargs="*", default=[sys.executable])
    options = parser.parse_args()
    wheel = build(options.out)
    check(wheel)
    for python in options.python:
        try_out(wheel, python)
        print(f"{wheel.name}: fits a capture under {python}", flush=True)


def build(out: Path) -> Path:
    """Wheel and sdist in a folder, by the `build` package in an environment of its own; the wheel's
    path.
    """
    with tempfile.TemporaryDirectory() as folder:
        python = _environment(sys.executable, folder, ["build"])
        _run([python, "-m", "build", "--outdir", out.resolve(), ROOT])
    return max(out.glob("*.whl"), key=lambda path: path.stat().st_mtime)


def check(wheel: Path) -> None:
    """SystemExit where a wheel lacks what it needs, or holds what is nobody's business."""
    names = zipfile.ZipFile(wheel).namelist()
    lacking = [needed for needed in NEEDED if not any(name.startswith(needed) for name in names)]
    spare = [
        name
        for name in names
        if not name.startswith("habitus") or name.endswith((".pyc", ".nbi", ".nbc"))
    ]
    if lacking or spare:
        sys.exit(f"{wheel.name} lacks {lacking} and has {spare[:5]} too much")


def try_out(wheel: Path, python: str) -> None:
    """Install a wheel in an empty environment and fit a capture there. Raises CalledProcessError
    where that fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        inside = _environment(python, folder, [wheel.resolve()])
        _run([Path(inside).with_name("habitus"), "--version"], folder)
        _run(
            [
                inside,
                ROOT / "examples" / "demo.py",
                "--frames",
                "240",
                "--out",
                Path(folder) / "demo",
            ],
            folder,
        )


def _environment(python: str, folder: str, packages: list) -> str:
    """The Python of a new environment with these packages."""
    _run([python, "-m", "venv", Path(folder) / "env"])
    inside = str(Path(folder) / "env" / "bin" / "python")
    _run([inside, "-m", "pip", "install", "--quiet", *packages])
    return inside


def _run(command: list, folder: str | Path = ROOT) -> None:
    subprocess.run(list(map(str, command)), check=True, cwd=folder)


if __name__ == "__main__":
    main()
