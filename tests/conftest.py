"""Fixtures shared by all tests."""

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# Shapes in signatures are checked while tests run. Not in modules with compiled kernels, which the hook would wrap, nor
# in those that say themselves what is wrong with a shape.
RENDER = (
    "triangles", "clipping", "shapes", "parts", "frame", "filters", "visibility", "operators", "slopes", "reference",
    "reference_faces", "reference_edges", "reference_segments",
)  # fmt: skip
install_import_hook(
    ["habitus.rotations", "habitus.body", *(f"habitus.render.{name}" for name in RENDER)], "beartype.beartype"
)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of captures and data that lies beside a checkout and is never part of it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("the folder of real captures (../shared) is not beside this checkout")
    return folder
