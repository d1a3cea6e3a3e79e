"""Settings of a discovery (`habitus.fit.discover.recipe`). Lengths are metres.

Tuned on captures whose labels were replaced by numbers (`benchmarks/discover.py`).
"""

from dataclasses import dataclass, field

from habitus.fit.markers.settings import MoshSettings

Schedule = tuple[tuple[float, float], ...]
"""Rounds of (sigma in metres, weight of the pose prior)."""


def _together() -> Schedule:
    sigmas = (0.12, 0.10, 0.08, 0.06, 0.05, 0.04)
    weights = ((20.0, 10.0), (6.0, 6.0), (4.0, 4.0), (3.0, 3.0), (2.0, 2.0), (2.0, 2.0))
    return tuple((s, w) for s, each in zip(sigmas, weights, strict=True) for w in each)


@dataclass(frozen=True)
class DiscoverSettings:
    """Settings of a discovery, step by step."""

    min_labels: int = 12
    """Fewer do not distinguish a body from a turned one."""
    frames: int = 12
    """Spread poses that all steps use."""
    heights: tuple[float, ...] = (0.91, 1.04)
    """Bodies that are tried, as shares of the mean person's height."""
    coarse: int = 150
    fine: int = 1200
    """Places on the skin in steps 1 and 2, and in step 3."""
    start_frames: int = 3
    """Frames in which single bodies are sought: those in which the markers extend furthest."""
    single: Schedule = (
        (0.15, 100.0),
        (0.12, 50.0),
        (0.12, 20.0),
        (0.12, 6.0),
        (0.09, 4.0),
        (0.07, 3.0),
        (0.06, 2.0),
    )
    """Annealing in single frames."""
    together: Schedule = field(default_factory=_together)
    """Annealing in all frames together."""
    kept: int = 8
    distinct: float = 0.04
    """Bodies of single frames that go on; they place labels further apart than this on average."""
    other_reading: float = 0.15
    """Mean distance of places from which on a candidate is another reading of the capture."""
    alike: int = 3
    """Candidates of the same reading that go through a first round of step 3."""
    close: float = 0.6
    """Cost a label, in step 2, within which another reading is pursued."""
    decided: float = 0.3
    """Share of its cost by which every other reading must cost more."""
    place_spreads: tuple[float, ...] = (0.06, 0.06, 0.04, 0.04)
    """Uncertainty of places in step 3, round by round."""
    off_body: float = 0.08
    """A label further from the body than this is no marker on its skin."""
    fit: MoshSettings = field(default_factory=lambda: MoshSettings(annealing=(4.0, 2.0, 1.0)))
    """Of the shape stage; starts are good, so the annealing is short."""


DISCOVER = DiscoverSettings()
