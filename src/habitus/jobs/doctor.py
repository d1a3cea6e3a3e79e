"""``habitus doctor``: what is installed, what is missing, and what this machine can do."""

import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from habitus import __version__
from habitus.kernels.threads import num_threads, usable_cores

PURPOSES = {
    "torch": "torch tensors in and out, custom terms with gradients",
    "images": "colour images in fits",
    "train": "learning body models: habitus train",
    "scans": "scans: habitus register",
    "rgbd": "depth cameras: habitus rgbd",
    "live": "live streams of Qualisys, the live viewer",
    "view": "habitus view",
    "video": "the body over the cameras' videos: habitus cameras --videos",
    "usd": "export as USD",
    "opensim": "a generic OpenSim model scaled and solved: habitus gait --opensim-model",
    "archive": "archives on several machines, tables in DuckDB",
    "peers": "checks of FBX files by an independent reader",
}
"""What each extra is for; extras for developers are not listed."""
PROGRAMS = {"blender": "the add-on and checks of exports", "chromium": "pictures of pages"}
GOOD, MISSING, BROKEN = "ok", "missing", "broken"
GIGABYTE = 1 << 30


@dataclass(frozen=True)
class Check:
    """One line: what, its level (ok, missing or broken), and what there is or what to do."""

    name: str
    level: str
    text: str


@dataclass(frozen=True)
class Diagnosis:
    """All checks by section."""

    sections: dict[str, tuple[Check, ...]]

    @property
    def sound(self) -> bool:
        """Whether nothing that habitus needs is broken; a missing extra is not."""
        return all(check.level != BROKEN for part in self.sections.values() for check in part)


def diagnose() -> Diagnosis:
    """Look at packages, extras, programs and the machine. Compiles one small kernel."""
    return Diagnosis(
        {
            "habitus": tuple(_own()),
            "packages": tuple(_packages()),
            "extras": tuple(_extras()),
            "programs": tuple(_programs()),
            "machine": tuple(_machine()),
        }
    )


def _own() -> Iterator[Check]:
    yield Check("habitus", GOOD, f"{__version__}, {Path(__file__).parents[1]}")
    version = platform.python_version()
    yield Check("Python", GOOD, f"{version}, {sys.executable}")
    try:
        from habitus.io.models.bodies import load_body

        body = load_body("default")
        yield Check("bundled bodies", GOOD, f"{body.num_vertices} vertices, {body.num_betas} betas")
    except Exception as error:
        yield Check("bundled bodies", BROKEN, f"{error}; install habitus again")


def _requirements() -> dict[str, list[str]]:
    """Names of distributions that habitus asks for, by extra; "" is for those always needed."""
    out: dict[str, list[str]] = {}
    try:
        texts = importlib.metadata.requires("habitus") or []
    except importlib.metadata.PackageNotFoundError:
        texts = []
    for text in texts:
        name = re.match(r"[A-Za-z0-9._-]+", text)
        extra = re.search(r"extra\s*==\s*['\"]([^'\"]+)['\"]", text)
        if name:
            out.setdefault(extra[1] if extra else "", []).append(name[0])
    return out


def _installed(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _packages() -> Iterator[Check]:
    for name in _requirements().get("", []):
        version = _installed(name)
        if version is None:
            yield Check(name, BROKEN, f"not installed; pip install {name}")
        else:
            yield Check(name, GOOD, version)


def _extras() -> Iterator[Check]:
    needed = _requirements()
    for extra, purpose in PURPOSES.items():
        absent = [name for name in needed.get(extra, []) if _installed(name) is None]
        if absent:
            text = f"{purpose}; pip install 'habitus[{extra}]' (lacks {', '.join(absent)})"
            yield Check(extra, MISSING, text)
        else:
            yield Check(extra, GOOD, purpose)


def _programs() -> Iterator[Check]:
    for name, purpose in PROGRAMS.items():
        path = shutil.which(name)
        yield Check(name, GOOD if path else MISSING, path or f"not on PATH; used for {purpose}")


def _machine() -> Iterator[Check]:
    text = f"{platform.machine()}, {usable_cores()} cores, {platform.platform()}"
    yield Check("processor", GOOD, text)
    free = shutil.disk_usage(Path.cwd()).free / GIGABYTE
    yield Check("disk", GOOD if free > 1.0 else MISSING, f"{free:.0f} GB free in {Path.cwd()}")
    yield from _memory()
    yield _kernels()
    yield _gpu()


def _memory() -> Iterator[Check]:
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        size = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / GIGABYTE
        yield Check("memory", GOOD, f"{size:.0f} GB")


def _kernels() -> Check:
    """Whether kernels compile, and whether they stay compiled."""
    import numba

    try:
        began = time.perf_counter()
        compiled = numba.njit(lambda x: x + 1.0)
        if compiled(1.0) != 2.0:
            return Check("kernels", BROKEN, "a compiled function gave a wrong result")
        seconds = time.perf_counter() - began
    except Exception as error:
        return Check("kernels", BROKEN, f"numba cannot compile: {error}")
    text = f"numba {numba.__version__}, {num_threads()} threads, {seconds:.1f} s"
    cache = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parents[1])
    try:
        with tempfile.TemporaryFile(dir=cache):
            return Check("kernels", GOOD, f"{text}; compiled kernels are kept")
    except OSError:
        return Check(
            "kernels",
            MISSING,
            f"{text}; {cache} cannot be written: each run compiles anew unless numba finds another "
            "place. Set NUMBA_CACHE_DIR to a folder of yours",
        )


def _gpu() -> Check:
    if importlib.util.find_spec("torch") is None:
        return Check("GPU", MISSING, "without torch; only torch tensors on a GPU use it")
    import torch

    if torch.cuda.is_available():
        return Check("GPU", GOOD, f"{torch.cuda.get_device_name(0)}, torch {torch.__version__}")
    return Check("GPU", MISSING, f"torch {torch.__version__} sees none; everything runs without")
