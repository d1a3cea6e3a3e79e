"""What a live fit is worth now: the same words as a whole fit's verdict, of the last second."""

from collections import deque

import numpy as np

from habitus.fit.markers.judge import LIMITS, SENTENCES
from habitus.fit.markers.suspects import GROSS
from habitus.fit.markers.tracking import LiveFrame
from habitus.fit.verdict import (
    DOUBTFUL,
    FAILED,
    GOOD,
    Reason,
    Verdict,
    above,
    verdict_of,
    worst,
)

FEW = 0.5
"""Share of the markers below which what is seen is too little to be sure of a body."""
_NAMED = 3


class Quality:
    """Verdict on the frames of the last second. labels: of the N markers; rate_hz: of the
    stream.
    """

    def __init__(self, labels: tuple[str, ...], rate_hz: float):
        self.labels = labels
        self._last: deque[LiveFrame] = deque(maxlen=max(1, round(rate_hz)))

    def add(self, frame: LiveFrame) -> None:
        """The next frame."""
        self._last.append(frame)

    @property
    def seen(self) -> int:
        """How many markers the last frame has."""
        return int(np.isfinite(self._last[-1].distances).sum()) if self._last else 0

    @property
    def mean_mm(self) -> float:
        """Of the distances between markers and body over the last second, NaN where there are
        none.
        """
        found = self._distances()
        return (
            1e3 * float(found[np.isfinite(found)].mean())
            if np.isfinite(found).any()
            else float("nan")
        )

    @property
    def verdict(self) -> Verdict:
        """``good``, ``doubtful`` or ``failed``, with its reasons."""
        if not self._last or self._last[-1].state == "nobody":
            return verdict_of([Reason(FAILED, "nobody")], SENTENCES)
        distances = self._distances()
        reasons = [self._errors(distances), self._missing(distances)]
        return verdict_of([reason for reason in reasons if reason.level != GOOD], SENTENCES)

    def _distances(self) -> np.ndarray:
        """(F, N) of the last second's frames that show somebody."""
        shown = [frame.distances for frame in self._last if frame.state in ("tracked", "started")]
        return np.array(shown).reshape(-1, len(self.labels))

    def _errors(self, distances: np.ndarray) -> Reason:
        seen = np.isfinite(distances)
        if not seen.any():
            return Reason(FAILED, "live few")
        mean = 1e3 * distances[seen].mean()
        p95 = 1e3 * np.percentile(distances[seen], 95)
        level = worst([above(mean, LIMITS.mean_mm), above(p95, LIMITS.p95_mm)])
        medians = _medians(distances)
        far = np.flatnonzero(medians > GROSS)
        if not len(far):
            return Reason(level, "live errors", {"mean": mean})
        named = ", ".join(f"{self.labels[k]} {1e3 * medians[k]:.0f} mm" for k in far[:_NAMED])
        more = f" and {len(far) - _NAMED} more" if len(far) > _NAMED else ""
        values = {"mean": mean, "named": named + more}
        return Reason(worst([level, DOUBTFUL]), "live outliers", values)

    def _missing(self, distances: np.ndarray) -> Reason:
        share = float(np.isfinite(distances).mean()) if distances.size else 0.0
        return Reason(DOUBTFUL if share < FEW else GOOD, "live missing", {"share": share})


def _medians(found: np.ndarray) -> np.ndarray:
    """(N,) of each marker that is seen, 0 elsewhere."""
    out = np.zeros(found.shape[1])
    seen = np.isfinite(found).any(axis=0)
    out[seen] = np.nanmedian(found[:, seen], axis=0)
    return out
