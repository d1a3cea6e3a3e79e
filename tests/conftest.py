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
from jaxtyping import install_import_hook

# Shapes in signatures are checked while tests run. Not in modules with compiled kernels, which the
# hook would wrap, nor in those that say themselves what is wrong with a shape.
RENDER = (
    "triangles",
    "clipping",
    "edge_fragments",
    "frame",
    "filters",
    "visibility",
    "rasterize",
    "operators",
    "derivatives",
    "reference",
)
BODY = (
    "ages",
    "blend_shapes",
    "body_arrays",
    "detail",
    "fast",
    "inputs",
    "jacobians",
    "joint_sets",
    "keypoints",
    "kinematics",
    "measured",
    "measurements",
    "mesh",
    "model",
    "pose_features",
    "pose_shapes",
    "prepared",
    "prior",
    "rings",
    "skinning",
    "standing",
    "state",
    "views",
)
CHECKED = (
    "rotations", "mesh.normals", "mesh.shapes",
    *(f"body.{name}" for name in BODY), *(f"render.{name}" for name in RENDER),
)  # fmt: skip
install_import_hook([f"habitus.{name}" for name in CHECKED], "beartype.beartype")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of captures and data that lies beside a checkout and is never part of it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("the folder of real captures (../shared) is not beside this checkout")
    return folder
