"""The start of a live fit: frames of the stream are gathered, then the shape is estimated, or a
known person recognised.
"""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError, listed
from habitus.fit.markers.live import LiveFrame, Tracker, saved_subject, subject_of
from habitus.fit.markers.recipe import warm_up
from habitus.fit.markers.recordings import MIN_MARKERS, Recording
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.shape import Subject
from habitus.io.captures.points import RawPoints
from habitus.io.captures.read import Capture, captures_of
from habitus.io.layouts.files import list_layouts
from habitus.io.streams.source import Frame, Source
from habitus.io.streams.wiring import Wiring, find_wiring
from habitus.io.units import METRES
from habitus.jobs.bodies import aged_body, of_sex, with_fingers
from habitus.jobs.options import LiveOptions, MoshOptions
from habitus.jobs.subjects import LayoutChoice, Person, gather
from habitus.kernels.threads import one_blas_thread
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


@dataclass(frozen=True)
class LiveStart:
    """How a live fit starts: the options, the body to fit or the earlier fit whose shape is taken,
    the recipe's settings, and whether ``options.fps`` is the stream's own rate.
    """

    options: LiveOptions
    source: MarkerFit | BodyModel
    settings: MoshSettings
    fps_is_rate: bool = True

    @property
    def fit(self) -> MarkerFit | None:
        """The earlier fit."""
        return self.source if isinstance(self.source, MarkerFit) else None

    @property
    def model(self) -> BodyModel:
        """The body."""
        return self.source.body if isinstance(self.source, MarkerFit) else self.source

    @property
    def rate_hz(self) -> float | None:
        """Rate of the stream, where it is given."""
        return self.options.fps if self.fps_is_rate else None


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


@dataclass(frozen=True)
class Followed:
    """Somebody whose shape is known: who, what the first frames were told as, (T, N, 3) markers in
    metres and what the tracker made of them, and how the stream's points become markers; the
    settings of the fit.
    """

    known: Subject
    recording: Recording
    wiring: Wiring
    tracker: Tracker
    markers: Float[np.ndarray, "T N 3"]
    frames: tuple[LiveFrame, ...]
    settings: MoshSettings


def gather_frames(stream: Stream, start: LiveStart, say: Say, over: Callable[[], bool]) -> Gathered:
    """The first frames in which somebody is seen, as many as are asked for.

    Raises HabitusError where the stream ends, or ``over`` says so, before there are any.
    """
    name = stream.source.name
    gathered = list[Frame]()
    heard = time.perf_counter()
    seconds = start.options.seconds
    needed = seconds if start.fit is None else min(seconds, KNOWN_S)
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


def learn_meanwhile(stream: Stream, gathered: Gathered, start: LiveStart) -> Followed:
    """`learn` beside a stream whose frames are kept until it is done. Raises what it raises."""
    if stream.source.patient:
        return learn(stream.source.name, gathered, start)
    done: list[Followed] = []
    failed: list[BaseException] = []

    def work() -> None:
        try:
            done.append(learn(stream.source.name, gathered, start))
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


def learn(name: str, gathered: Gathered, start: LiveStart) -> Followed:
    """Who the gathered frames show. Raises HabitusError where they do not tell it."""
    heading = gathered.heading
    rate = gathered.rate_hz
    points = np.stack([frame.points for frame in gathered.frames])
    if not np.isfinite(points).any():
        raise HabitusError(f"{name}: no labelled point is seen")
    captures = captures_of(replace(heading, points=points, rate_hz=rate), rate, name, name)
    options = start.options
    if start.fit is None:
        known, recording, capture = learn_subject(
            captures, start.model, options.body, options, start.settings
        )
    else:
        known, recording, capture = known_subject(captures, start.fit, options, start.settings)
    wiring = find_wiring(points, recording.observed, METRES[capture.unit])
    lost = [label for label, k in zip(known.layout.labels, wiring.columns, strict=True) if k < 0]
    if lost:
        raise HabitusError(
            f"{name}: which of its points are {listed(lost)} is not clear; check for labels that "
            "repeat"
        )
    markers = np.stack([wiring.markers(each) for each in points])
    tracker = Tracker(known, start.settings, rate)
    frames = tuple(tracker.step(each) for each in markers)
    return Followed(known, recording, wiring, tracker, markers, frames, start.settings)


def learn_subject(
    captures: Sequence[Capture],
    model: BodyModel,
    given: PathLike | BodyModel,
    options: MoshOptions | LiveOptions,
    settings: MoshSettings,
) -> tuple[Subject, Recording, Capture]:
    """The person of some frames, shape and placements estimated from them; the frames on the
    markers in use, and as they were captured. ``given``: the body as it was asked for.

    Raises HabitusError where they hold several people, or too few known markers.
    """
    people = gather([captures], options.layout, options.subject, model)
    people, model = with_fingers(people, model, given, options.joints)
    model = aged_body(model, options.age, people[0])[0]
    model = of_sex(model, "neutral" if options.sex == "auto" else options.sex)
    if len(people) > 1 or len(people[0].captures) > 1:
        raise HabitusError("the capture holds several people; name one with subject")
    warm_up(model)
    person = people[0]
    with one_blas_thread():  # the matrices are small: more threads only wait for each other
        known = subject_of(model, prior_of(model), person.layout, person.recordings[0], settings)
    return known, _of(person.recordings[0], person, known), person.captures[0]


def known_subject(
    captures: Sequence[Capture], fit: MarkerFit, options: LiveOptions, settings: MoshSettings
) -> tuple[Subject, Recording, Capture]:
    """A person known from an earlier fit; the frames on the markers that both have, and as
    captured.

    Raises HabitusError where fewer than four labels of the stream were in that fit.
    """
    chosen = _chosen(captures, options.subject)
    shared = [label for label in fit.labels if label in chosen.labels]
    if len(shared) < MIN_MARKERS:
        raise HabitusError(
            f"of the saved subject's markers ({listed(fit.labels, 6)}) the stream has "
            f"{len(shared)}; it has "
            f"{listed(chosen.labels, 6)}; expected at least {MIN_MARKERS}: the same labels as "
            f"in {fit.capture_name}"
        )
    people = gather([[chosen]], _layout_of(fit, options), None, fit.body)
    layout = people[0].layout
    layout = layout.restricted_to(tuple(label for label in layout.labels if label in fit.labels))
    warm_up(fit.body)
    known = saved_subject(fit, prior_of(fit.body), layout, settings)
    return known, _of(people[0].recordings[0], people[0], known), chosen


def _layout_of(fit: MarkerFit, options: LiveOptions) -> LayoutChoice:
    """The fit's, where it is a shipped one and no other is asked for."""
    return (
        fit.layout_name
        if str(options.layout) == "auto" and fit.layout_name in list_layouts()
        else options.layout
    )


def _chosen(captures: Sequence[Capture], name: str | None) -> Capture:
    if name is None:
        return captures[0]
    for capture in captures:
        if (capture.subject or "").lower() == name.lower():
            return capture
    raise HabitusError(
        f"the stream has no person called {name!r}; it holds "
        f"{listed(c.subject or '(unnamed)' for c in captures)}"
    )


def _of(recording: Recording, person: Person, known: Subject) -> Recording:
    """The recording on the known subject's markers."""
    columns = [person.layout.labels.index(label) for label in known.layout.labels]
    return replace(recording, observed=np.ascontiguousarray(recording.observed[:, columns]))
