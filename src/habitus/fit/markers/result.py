"""The result of a marker fit: its solution with the verdict and the uncertainty of each segment."""

from dataclasses import dataclass
from functools import cached_property

from habitus.body.prior import prior_of
from habitus.fit.markers.judge import judge
from habitus.fit.markers.solution import Guessed, MarkerSolution
from habitus.fit.markers.uncertainty import guess
from habitus.fit.verdict import Verdict


@dataclass(frozen=True)
class MarkerFit(MarkerSolution):
    """A body in motion, estimated from the markers of one capture, and how good the estimate is."""

    @cached_property
    def verdict(self) -> Verdict:
        """``level`` (good, doubtful or failed) and ``reasons``, a sentence each."""
        return judge(self)

    @cached_property
    def guessed(self) -> Guessed:
        """How well each joint's segment is known, over spans of time."""
        return guess(self, prior_of(self.body))
