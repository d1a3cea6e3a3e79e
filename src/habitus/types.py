"""Names of types that stand in many signatures."""

import os
from collections.abc import Callable

PathLike = str | os.PathLike[str]
"""A file or folder, as text or path."""
Progress = Callable[[str, float], None]
"""Told the name of a stage and the share of the work that is done, from 0 to 1."""
