"""What a live fit is worth now: the same words as a whole fit's verdict, of the last second."""

from collections import deque

import numpy as np

from habitus.fit.markers.judge import above
from habitus.fit.markers.limits import LIMITS
from habitus.fit.markers.suspects import GROSS
from habitus.fit.markers.tracking import LiveFrame
from habitus.fit.markers.verdict import DOUBTFUL, FAILED, GOOD, Verdict, worst

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
            return Verdict(FAILED, ("Nobody is seen.",))
        found = self._distances()
        reasons = [*self._errors(found), *self._missing(found)]
        told = tuple(f"{text}." for level, text in reasons if level != GOOD)
        return Verdict(worst([level for level, _ in reasons]), told)

    def _distances(self) -> np.ndarray:
        """(F, N) of the last second's frames that show somebody."""
        shown = [frame.distances for frame in self._last if frame.state in ("tracked", "started")]
        return np.array(shown).reshape(-1, len(self.labels))

    def _errors(self, found: np.ndarray) -> list[tuple[str, str]]:
        seen = np.isfinite(found)
        if not seen.any():
            return [(FAILED, "Too few markers are seen to place a body")]
        mean = 1e3 * found[seen].mean()
        p95 = 1e3 * np.percentile(found[seen], 95)
        level = worst([above(mean, LIMITS.mean_mm), above(p95, LIMITS.p95_mm)])
        far = np.flatnonzero(1e3 * _medians(found) > 1e3 * GROSS)
        named = ", ".join(
            f"{self.labels[k]} {1e3 * _medians(found)[k]:.0f} mm" for k in far[:_NAMED]
        )
        level = worst([level, DOUBTFUL if len(far) else GOOD])
        text = f"Markers lie {mean:.0f} mm from the body" + (
            f"; far off: {named}" if len(far) else ""
        )
        return [(level, text + (f" and {len(far) - _NAMED} more" if len(far) > _NAMED else ""))]

    def _missing(self, found: np.ndarray) -> list[tuple[str, str]]:
        share = float(np.isfinite(found).mean()) if found.size else 0.0
        level = DOUBTFUL if share < FEW else GOOD
        return [(level, f"Only {share:.0%} of the markers are seen")]


def _medians(found: np.ndarray) -> np.ndarray:
    """(N,) of each marker that is seen, 0 elsewhere."""
    out = np.zeros(found.shape[1])
    seen = np.isfinite(found).any(axis=0)
    out[seen] = np.nanmedian(found[:, seen], axis=0)
    return out
