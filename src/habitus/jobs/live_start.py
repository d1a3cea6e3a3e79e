"""The start of a live fit: frames of the stream are gathered, then the shape is estimated, or a
known person recognised; what kinds of sensors have in common.
"""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.cameras.result import CameraFit
from habitus.fit.markers.live import LiveFrame, Quality, Tracker
from habitus.fit.markers.result import MarkerFit
from habitus.io.captures.points import RawPoints
from habitus.io.streams.source import Frame, Source
from habitus.jobs.options import LiveOptions
from habitus.types import PathLike

MIN_POINTS = 6
"""Points that must be seen before anybody is looked for: fewer tell no layout."""
KNOWN_S = 0.5
"""Seconds of frames that tell which marker is which where the subject is known."""
MAX_MISSING = 30
"""Frames missing in a row among those that are gathered: with more, gathering begins anew."""
IDLE_S = 0.2
_SILENCE_S = 3.0

Say = Callable[[str, str], None]
"""Called with a text and a word before it, "" or "warning:"."""


LATE_S = 0.1
"""Seconds of frames that may wait; where more do, all but the newest are let go."""


@dataclass
class Counts:
    """How many frames of a stream came, were lost on the way or came too late."""

    came: int = 0
    lost: int = 0
    late: int = 0


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

    @property
    def trouble(self) -> str:
        """What went wrong, in words; empty where nothing did."""
        lost = self.counts.lost
        late = self.counts.late
        skipped = self.source.skipped
        return "; ".join(
            text
            for text, count in (
                (f"{lost} frames lost on the way", lost),
                (f"{late} frames too late", late),
                (f"skipped: {skipped}", skipped.total),
            )
            if count > 0
        )

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


@dataclass(frozen=True, eq=False)
class LivePerson:
    """A person whose shape is known, as sinks receive it. labels: of the N points that show them;
    by: what these are, in words.
    """

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    labels: tuple[str, ...]
    by: str
    up_axis: str
    rate_hz: float


Fit = MarkerFit | CameraFit
"""The result of a live fit."""


class Start(Protocol):
    """How a live fit by one kind of sensor starts and ends.

    options: those of the run; is_known: whether the person's shape is; rate_hz: of the stream,
    where it is given.
    """

    @property
    def options(self) -> LiveOptions: ...  # noqa: D102

    @property
    def is_known(self) -> bool: ...  # noqa: D102

    @property
    def rate_hz(self) -> float | None: ...  # noqa: D102

    def open(self, source: str, address: PathLike | None) -> Source:
        """The source of that name. Raises HabitusError."""
        ...

    def learn(self, name: str, gathered: "Gathered") -> "Followed":
        """Who the gathered frames show. Raises HabitusError where they do not tell it."""
        ...

    def save(self, fit: Any, folder: PathLike) -> None:
        """Write all files of the result."""
        ...


@dataclass(frozen=True)
class Gathered:
    """Frames that show somebody, (T, P, 3) in the stream's own unit, and how many a second there
    are.
    """

    frames: tuple[Frame, ...]
    rate_hz: float

    @property
    def heading(self) -> RawPoints:
        """What the stream said of them."""
        return self.frames[-1].heading


class Evidence(NamedTuple):
    """Of a frame: points in space (N, 3; m) as they are shown, and what the result keeps (N, 3)."""

    points: Float[np.ndarray, "N 3"]
    kept: Float[np.ndarray, "N 3"]


class Wired(Protocol):
    """From a stream's points to what the tracker takes."""

    def markers(self, points: Float[np.ndarray, "P 3"]) -> np.ndarray:
        """Of one frame."""
        ...


@dataclass(frozen=True, eq=False)
class Track:
    """The frames (T) of a stream that were followed: poses held where nobody was seen, costs, and
    what was observed (T, N, 3), NaN where missing.
    """

    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    costs: Float[np.ndarray, " T"]
    observed: Float[np.ndarray, "T N 3"]


@dataclass(frozen=True, eq=False)
class Followed:
    """Somebody whose shape is known: who, how the stream's points become what the tracker takes,
    the tracker with what it made of the first frames, and what they showed (T, N, 3); how good that
    is; the ``result`` of a track, with notes.
    """

    person: LivePerson
    how: str
    warnings: tuple[str, ...]
    wiring: Wired
    tracker: Tracker[Any]
    quality: Quality
    frames: tuple[LiveFrame, ...]
    kept: Float[np.ndarray, "T N 3"]
    evidence: Callable[[np.ndarray], Evidence]
    result: Callable[[Track, Sequence[str]], Fit]


def gather_frames(stream: Stream, start: Start, say: Say, over: Callable[[], bool]) -> Gathered:
    """The first frames in which somebody is seen, as many as are asked for.

    Raises HabitusError where the stream ends, or ``over`` says so, before there are any.
    """
    name = stream.source.name
    gathered = list[Frame]()
    heard = time.perf_counter()
    seconds = start.options.seconds
    needed = min(seconds, KNOWN_S) if start.is_known else seconds
    while not stream.ended and not over():
        received = stream.following(None, IDLE_S)
        if received is None:
            heard = silence(stream.source, heard, say)
            continue
        (frame, missing), heard = received, time.perf_counter()
        if gathered and (frame.heading is not gathered[-1].heading or missing > MAX_MISSING):
            gathered.clear()
        if gathered:
            gathered += [frame._replace(points=np.full_like(frame.points, np.nan))] * missing
        if gathered or np.isfinite(frame.points[:, 0]).sum() >= MIN_POINTS:
            gathered.append(frame)
        rate = _rate(gathered, start.rate_hz, stream.stride)
        if rate and len(gathered) >= max(2.0, needed * rate):
            return Gathered(tuple(gathered), rate)
    rate = _rate(gathered, start.rate_hz, stream.stride)
    if len(gathered) < 2 or not rate:
        raise HabitusError(
            f"{name}: it ended before {MIN_POINTS} or more labelled points were seen; check that "
            "markers are streamed"
        )
    return Gathered(tuple(gathered), rate)


def silence(source: Source, heard: float, say: Say) -> float:
    """Says that nothing comes; gives when that was said or something was heard last."""
    if time.perf_counter() - heard < _SILENCE_S:
        return heard
    skipped = f" Skipped: {source.skipped}." if source.skipped.total else ""
    say(
        f"no frames from {source.name} for {_SILENCE_S:.0f} s; is it streaming, and to this "
        f"machine?{skipped}",
        "warning:",
    )
    return time.perf_counter()


def _rate(gathered: Sequence[Frame], given: float | None, stride: int) -> float:
    """Frames a second: as is said, else as they come; 0 where that is not known yet."""
    if not gathered:
        return 0.0
    rate = given or gathered[-1].heading.rate_hz
    if rate:
        return rate / stride
    span = gathered[-1].arrived - gathered[0].arrived
    return (len(gathered) - 1) / span if span > 1.0 else 0.0


def learn_meanwhile(stream: Stream, gathered: Gathered, start: Start) -> Followed:
    """`Start.learn` beside a stream whose frames are kept until it is done. Raises what it
    raises.
    """
    if stream.source.patient:
        return start.learn(stream.source.name, gathered)
    done: list[Followed] = []
    failed: list[BaseException] = []

    def work() -> None:
        try:
            done.append(start.learn(stream.source.name, gathered))
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    while thread.is_alive():
        stream.listen(0.02, always=True)
        thread.join(0.0)
    if failed:
        raise failed[0]
    return done[0]
