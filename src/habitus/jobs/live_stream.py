"""The frames of a source in order: what was lost on the way or came too late is counted, never
passed over.
"""

from collections import Counter, deque
from dataclasses import dataclass

from habitus.io.streams.source import Frame, Source

LATE_S = 0.1
"""Seconds of frames that may wait; where more do, all but the newest are let go."""


@dataclass
class Counts:
    """How many frames of a stream came, were lost on the way or came too late, and packets that
    could not be read.
    """

    came: int = 0
    lost: int = 0
    late: int = 0
    bad: int = 0

    @property
    def line(self) -> str:
        """What went wrong, in words; empty where nothing did."""
        said = (
            (self.lost, "lost on the way"),
            (self.late, "too late"),
            (self.bad, "packets unreadable"),
        )
        return ", ".join(f"{count} {words}" for count, words in said if count > 0)


class Stream:
    """Frames one after another, each with how many are missing before it; for one reader."""

    def __init__(self, source: Source):
        self.source = source
        self.counts = Counts()
        self.behind = True
        self._waiting: deque[Frame] = deque()
        self._steps: Counter[int] = Counter()
        self._last: int | None = None

    @property
    def ended(self) -> bool:
        """Whether no frame will come any more."""
        return self.source.ended and not self._waiting

    @property
    def stride(self) -> int:
        """By how much the numbers of frames usually grow: more than 1 where the source sends only
        some of them.
        """
        return self._steps.most_common(1)[0][0] if self._steps else 1

    def listen(self, timeout: float, always: bool = False) -> None:
        """Take in what the source has, waiting for it where nothing else is there, or always."""
        self._waiting.extend(self.source.poll(timeout if always or not self._waiting else 0.0))
        self.counts.bad = self.source.bad

    def following(self, rate_hz: float | None, timeout: float) -> tuple[Frame, int] | None:
        """The next frame, and how many that should be before it are missing; None where none came
        in time.

        rate_hz: of the frames; where it is told and the reader is not `behind` for another reason,
        frames that wait for longer than `LATE_S` are let go but for the newest.
        """
        self.listen(timeout)
        if not self._waiting:
            self.behind = False
            return None
        hasty = not (self.behind or self.source.patient)
        if rate_hz is not None and hasty and len(self._waiting) > max(2, int(LATE_S * rate_hz)):
            self.counts.late += len(self._waiting) - 1
            self.counts.lost -= len(self._waiting) - 1  # their numbers will be missing
            self._waiting = deque([self._waiting[-1]])
        return self._next()

    def _next(self) -> tuple[Frame, int]:
        frame = self._waiting.popleft()
        step = 0 if self._last is None else frame.number - self._last
        self._last = frame.number
        missing = 0
        if step > 0:  # not at the first, nor where a stream begins its count anew
            self._steps[step] += 1
            missing = max(0, round(step / self.stride) - 1)
        self.counts.came += 1
        self.counts.lost += missing
        self.behind = self.behind and len(self._waiting) > 1
        return frame, missing
