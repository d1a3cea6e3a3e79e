"""Folders of the checkout that this package is installed from (editable)."""

from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[3]
BODIES = REPOSITORY / "src/habitus/assets/bodies"
