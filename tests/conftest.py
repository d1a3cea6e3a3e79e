"""Fixtures shared by all tests, and how many threads they use: each worker of the suite has one
core to itself.

Threads that wait for work by spinning, as OpenMP's and OpenBLAS' do, would keep the other worker's
from theirs.
"""

import gc
import importlib
import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # the libraries read these when they are loaded
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from dataclasses import fields
from pathlib import Path
from typing import Any

import jaxtyping
import pytest
from jaxtyping import config, install_import_hook
from shape_checks import begin_test, checked_modules, first_calls

# Shapes in signatures are checked while tests run, in every module without compiled kernels.
ROOMS = (
    *("rotations", "arrays", "mesh", "body", "markers", "observe", "render", "parallel"),
    *("residuals", "solve", "fit", "learn", "io", "jobs", "report", "evaluate", "results"),
    *("export",),
)
LAB_ROOMS = ("population", "baselines")
jaxtyping.jaxtyped = first_calls
for package in (
    *(f"habitus.{room}" for room in ROOMS),
    *(f"habitus_lab.{room}" for room in LAB_ROOMS),
):
    install_import_hook(checked_modules(package), "shape_checks.shapes_only")

# Bodies that come along are immutable: each worker reads them once.
bodies = importlib.import_module("habitus.io.models.bodies")
_read_body = bodies._read_body
_known: dict[tuple, Any] = {}


def _read_once(content: Any, name: str, *level: Any, **part: Any) -> Any:
    if name not in bodies.SHIPPED:
        return _read_body(content, name, *level, **part)
    key = (content, name, *level, *sorted(part.items()))
    body = _known[key] = _known.pop(key, None) or _read_body(content, name, *level, **part)
    for old in list(_known)[:-8]:
        del _known[old]
    return body


bodies._read_body = _read_once

MAX_RESIDENT_MB = 2000
"""Memory of a worker from which on the bodies forget what they computed: a body with all its
vertices keeps up to 0.5 GB of arrays laid out for speed, and eight bodies in several kinds took a
worker of the suite to 7 GB."""

# Begun first, so that no worker ends with one of them alone. The second compiles no kernels: the
# other worker finds those of the first on disk.
LONGEST = (
    *("fit/test_problem.py", "test_api_reference.py", "examples/test_examples.py"),
    *("fit/points/test_spoilt_surfaces.py", "jobs/test_sensors.py", "jobs/test_train.py"),
    *("learn/test_train_recipe.py", "fit/points/test_rgbd_off_model.py", "cli/test_main.py"),
    *("jobs/test_rgbd.py", "fit/points/test_bodies_of_scans.py", "test_without_torch.py"),
    *("render/jacobians/test_image_jacobians.py", "report/test_injection.py"),
)


def pytest_configure(config: pytest.Config) -> None:
    """pytest-xdist keeps the order of files: it would begin with those of the most tests."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first."""
    here = Path(__file__).parent
    rank = {here / name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """After a file that has left much in memory, bodies keep what was read alone."""
    statm = Path("/proc/self/statm")  # other systems go without
    if nextitem is None or nextitem.path == item.path or not statm.is_file():
        return
    resident = int(statm.read_text("ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    if resident > 1e6 * MAX_RESIDENT_MB:
        for body in _known.values():
            for name in set(vars(body)) - {field.name for field in fields(body)}:
                vars(body).pop(name)
        gc.collect()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    begin_test()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item):
    """A test marked ``wrong_shapes`` gives wrong shapes on purpose, to read the HabitusError."""
    config.update("jaxtyping_disable", item.get_closest_marker("wrong_shapes") is not None)
    try:
        return (yield)
    finally:
        config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of captures and data that lies beside a checkout and is never part of it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("the folder of real captures (../shared) is not beside this checkout")
    return folder
