"""Fixtures shared by all tests."""

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# Shapes in signatures are checked while tests run; not in modules with compiled kernels, which the hook would wrap.
install_import_hook(["habitus.rotations", "habitus.body"], "beartype.beartype")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of captures and data that lies beside a checkout and is never part of it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("the folder of real captures (../shared) is not beside this checkout")
    return folder
