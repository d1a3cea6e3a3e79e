"""Build the wheel and the sdist and try both in empty environments:

python tools/release.py dist [--python python3.12 …] [--tag v0.1.0] [--notes notes.md]
python tools/release.py dist --built          # tries what another machine built

For each Python: an empty environment, the wheel or the sdist from its file, all else from the
package index; then, outside the checkout, `habitus --version`, `habitus doctor` and the demo,
which makes a capture and fits it. With a tag, its version has to be the package's and to have a
dated section in CHANGELOG.md, which --notes writes. Nothing is uploaded:
.github/workflows/release.yml does that.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NEEDED = (
    "habitus/assets/bodies/",
    "habitus/assets/layouts/",
    "habitus/report/web/page.html",
    "habitus/py.typed",
)
"""Files and folders that a wheel must have."""


def main() -> None:
    """Check, build, look inside, try."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--python", nargs="*", default=[sys.executable])
    parser.add_argument("--tag", default="")
    parser.add_argument("--notes", type=Path)
    parser.add_argument("--built", action="store_true")
    options = parser.parse_args()
    if options.tag:
        version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
        notes = release_notes(options.tag, version, (ROOT / "CHANGELOG.md").read_text("utf-8"))
        if options.notes:
            options.notes.write_text(notes, encoding="utf-8")
    if not options.built:
        build(options.out)
    wheel, sdist = newest(options.out, "*.whl"), newest(options.out, "*.tar.gz")
    check(wheel)
    for python in options.python:
        for package in (wheel, sdist):
            try_out(package, python)
            print(f"{package.name}: fits a capture under {python}", flush=True)


def release_notes(tag: str, version: str, changes: str) -> str:
    """The section of a release in CHANGELOG.md. SystemExit where the tag is not v and the
    package's version, or the section is missing, empty or has no date.
    """
    if tag != f"v{version}":
        sys.exit(f"tag {tag}, but pyproject.toml has version {version}; expected v{version}")
    heading = re.search(rf"^## {re.escape(version)}, (.*)$", changes, re.MULTILINE)
    if heading is None or not re.fullmatch(r"\d{4}-\d{2}-\d{2}", heading[1].strip()):
        sys.exit(f"CHANGELOG.md has no section '## {version}, YYYY-MM-DD'; date it")
    notes = re.split(r"^## ", changes[heading.end() :], flags=re.MULTILINE)[0].strip()
    if not notes:
        sys.exit(f"the section of {version} in CHANGELOG.md is empty; list its changes")
    return f"{notes}\n"


def newest(folder: Path, pattern: str) -> Path:
    """The newest of a folder's files of a kind. SystemExit where there is none."""
    files = sorted(folder.glob(pattern), key=lambda path: path.stat().st_mtime)
    return files[-1] if files else sys.exit(f"{folder} holds no {pattern}")


def build(out: Path) -> None:
    """Wheel and sdist in a folder, by the `build` package in an environment of its own; `twine`
    looks at their metadata.
    """
    with tempfile.TemporaryDirectory() as folder:
        python = _environment(sys.executable, folder, ["build", "twine"])
        _run([python, "-m", "build", "--outdir", out.resolve(), ROOT])
        files = [path.resolve() for path in (newest(out, "*.whl"), newest(out, "*.tar.gz"))]
        _run([python, "-m", "twine", "check", "--strict", *files])


def check(wheel: Path) -> None:
    """SystemExit where a wheel lacks required files or has unexpected ones."""
    names = zipfile.ZipFile(wheel).namelist()
    lacking = [needed for needed in NEEDED if not any(name.startswith(needed) for name in names)]
    spare = [
        name
        for name in names
        if not name.startswith("habitus") or name.endswith((".pyc", ".nbi", ".nbc"))
    ]
    if lacking or spare:
        sys.exit(f"{wheel.name}: missing files {lacking}, unexpected files {spare[:5]}")


def try_out(package: Path, python: str) -> None:
    """Install a wheel or an sdist in an empty environment and fit a capture there. Raises
    CalledProcessError where that fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        inside = _environment(python, folder, [package.resolve()])
        for word in ("--version", "doctor"):
            _run([inside, "-m", "habitus", word], folder)
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
    scripts = "Scripts" if os.name == "nt" else "bin"
    inside = str(Path(folder) / "env" / scripts / "python")
    _run([inside, "-m", "pip", "install", "--quiet", *packages])
    return inside


def _run(command: list, folder: str | Path = ROOT) -> None:
    subprocess.run(list(map(str, command)), check=True, cwd=folder)


if __name__ == "__main__":
    main()
