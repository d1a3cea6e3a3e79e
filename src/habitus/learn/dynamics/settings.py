"""Settings of the training of dynamic blend shapes (`habitus.learn.dynamics.train`)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DynamicsSettings:
    """Tuning of the trainer's parts; these values trained the default body."""

    folds: int = 4
    """Parts into which motions are divided to choose shape features and ridge, at most."""
    pieces: int = 4
    """Parts of a sequence that is alone, which are held out in turn."""
    instrument_rounds: int = 2
    """Rounds with instruments, at most; more change nothing."""
    control_range: float = 1.5
    """Controls up to so many times the largest in the data are believed, larger ones clipped."""
    squeezed: float = 0.5
    """Share of a volume: where skinning leaves less, what it did is not undone to the full."""
    damping: float = 0.1
    """Added to the squared scale where nothing of a volume is left; it rises from 0 at
    ``squeezed``."""


DYNAMICS = DynamicsSettings()
