"""Fixtures shared by all tests, and how many threads they use: each worker of the suite has one
core to itself.

Threads that wait for work by spinning, as OpenMP's and OpenBLAS' do, would keep the other worker's
from theirs.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # the libraries read these when they are loaded
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pathlib import Path

import pytest
from jaxtyping import config, install_import_hook
from shape_checks import checked_modules

# Shapes in signatures are checked while tests run, in every module without compiled kernels.
ROOMS = (
    *("rotations", "arrays", "mesh", "body", "markers", "observe", "render", "parallel"),
    *("residuals", "solve", "learn", "io", "report", "evaluate", "results", "export"),
)
LAB_ROOMS = ("population", "baselines")
for package in (
    *(f"habitus.{room}" for room in ROOMS),
    *(f"habitus_lab.{room}" for room in LAB_ROOMS),
):
    install_import_hook(checked_modules(package), "shape_checks.shapes_only")


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
