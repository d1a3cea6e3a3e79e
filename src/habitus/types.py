"""Names of types that stand in many signatures."""

import os
from collections.abc import Callable
from typing import Any

PathLike = str | os.PathLike[str]
"""A file or folder, as text or path."""
Progress = Callable[[str, float], None]
"""Called with the name of a stage and the share of the work that is done, from 0 to 1."""
Array = Any
"""A NumPy array or a torch tensor. It is no union of the two so that naming it does not import
torch.
"""
ArrayLike = Any
"""A NumPy array, a torch tensor, or anything that ``numpy.asarray`` takes: sequences, numbers."""
