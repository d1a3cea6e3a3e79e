"""habitus: the state of the human body (shape, pose, soft tissue), estimated by inverting forward models.

import habitus
fits = habitus.mosh("walk.c3d", "results")     # the same as: habitus mosh walk.c3d --out results
body = habitus.load_body("default")
"""

from importlib import import_module
from typing import Any

from habitus.errors import HabitusError

__version__ = "0.1.0"
__all__ = ["HabitusError", "evaluate", "load_body", "load_layout", "mosh", "read_capture", "train"]

_WHERE = {
    "evaluate": "habitus.jobs.evaluate",
    "load_body": "habitus.io.models.bodies",
    "load_layout": "habitus.io.layouts.files",
    "mosh": "habitus.jobs.mosh",
    "read_capture": "habitus.io.captures.read",
    "train": "habitus.jobs.train",
}


def __getattr__(name: str) -> Any:
    """Load what is asked for when it is asked for: ``import habitus`` alone costs nothing."""
    if name not in _WHERE:
        raise AttributeError(f"module 'habitus' has no attribute {name!r}")
    return getattr(import_module(_WHERE[name]), name)
