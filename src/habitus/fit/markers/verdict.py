"""What a fit is worth, as a value: its level and the reasons."""

from dataclasses import dataclass

GOOD, DOUBTFUL, FAILED = LEVELS = ("good", "doubtful", "failed")


@dataclass(frozen=True)
class Verdict:
    """A fit's level, ``good``, ``doubtful`` or ``failed``, and the reasons, the gravest first, a
    sentence each.
    """

    level: str
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        """One line."""
        return f"{self.level}: {' '.join(self.reasons)}" if self.reasons else self.level


def worst(levels: tuple[str, ...] | list[str]) -> str:
    """The gravest of some levels, good where there is none."""
    return max(levels, key=LEVELS.index, default=GOOD)
