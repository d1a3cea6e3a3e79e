"""What checks of training data report."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

_MOST_NAMED = 3


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: an "error" keeps from learning, a "warning" does not. ``name``: a
    registration, a subject, a joint, several of them, or "the registrations".
    """

    kind: Literal["error", "warning"]
    name: str
    message: str

    def __str__(self) -> str:
        return f"{self.name}: {self.message}"


def named(names: Sequence[str], most: int = _MOST_NAMED) -> str:
    """Names one after the other; beyond the first few how many more."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
