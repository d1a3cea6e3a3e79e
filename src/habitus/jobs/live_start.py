"""How a live fit begins: frames of somebody are gathered, then the shape is found, or a saved
person recognised.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, listed
from habitus.fit.markers.live import LiveFrame, Tracker
from habitus.fit.markers.recordings import Recording
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.subject import Subject
from habitus.io.captures.points import RawPoints
from habitus.io.captures.read import captures_of
from habitus.io.streams.source import Frame
from habitus.io.streams.wiring import Wiring, find_wiring
from habitus.io.units import METRES
from habitus.jobs.live_stream import Stream
from habitus.jobs.live_subject import Wanted, learnt, saved

FEWEST = 6
"""Points that must be seen before anybody is looked for: fewer tell no layout."""
SAVED_S = 0.5
"""Seconds of frames that tell which marker is which where the subject is known."""
MOST_MISSING = 30
"""Frames missing in a row among those that are gathered: with more, gathering begins anew."""
IDLE_S = 0.2
_SILENCE_S = 3.0

Say = Callable[[str, str], None]
"""Told a text and a word before it, "" or "warning:"."""


@dataclass(frozen=True)
class Asked:
    """What a live fit is asked for: who, with which body (model) and settings; ``fit``: of a person
    fitted before.

    seconds: of frames that tell the shape. rate_hz: of the stream, where it does not say or says it
    wrong.
    """

    wanted: Wanted
    model: BodyModel
    settings: MoshSettings
    fit: MarkerFit | None = None
    seconds: float = 5.0
    rate_hz: float | None = None


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
    metres and what the tracker made of them, and how the stream's points become markers.
    """

    known: Subject
    recording: Recording
    wiring: Wiring
    tracker: Tracker
    markers: Float[np.ndarray, "T N 3"]
    frames: tuple[LiveFrame, ...]


def gather(stream: Stream, asked: Asked, say: Say, over: Callable[[], bool]) -> Gathered:
    """The first frames in which somebody is seen, as many as are asked for.

    Raises HabitusError where the stream ends, or ``over`` says so, before there are any.
    """
    name = stream.source.name
    gathered = list[Frame]()
    heard = time.perf_counter()
    wanted = asked.seconds if asked.fit is None else min(asked.seconds, SAVED_S)
    while not stream.ended and not over():
        found = stream.following(None, IDLE_S)
        if found is None:
            heard = silence(name, heard, say)
            continue
        (frame, missing), heard = found, time.perf_counter()
        if gathered and (frame.heading is not gathered[-1].heading or missing > MOST_MISSING):
            gathered.clear()
        if gathered:
            gathered += [frame._replace(points=np.full_like(frame.points, np.nan))] * missing
        if gathered or np.isfinite(frame.points[:, 0]).sum() >= FEWEST:
            gathered.append(frame)
        rate = _rate(gathered, asked.rate_hz, stream.stride)
        if rate and len(gathered) >= max(2.0, wanted * rate):
            return Gathered(tuple(gathered), rate)
    rate = _rate(gathered, asked.rate_hz, stream.stride)
    if len(gathered) < 2 or not rate:
        raise HabitusError(
            f"{name}: it ended before {FEWEST} or more labelled points were seen; check that "
            "markers are streamed"
        )
    return Gathered(tuple(gathered), rate)


def silence(name: str, heard: float, say: Say) -> float:
    """Says that nothing comes; gives when that was said or something was heard last."""
    if time.perf_counter() - heard < _SILENCE_S:
        return heard
    say(
        f"no frames from {name} for {_SILENCE_S:.0f} s; is it streaming, and to this machine?",
        "warning:",
    )
    return time.perf_counter()


def _rate(gathered: Sequence[Frame], told: float | None, stride: int) -> float:
    """Frames a second: as is said, else as they come; 0 where that is not known yet."""
    if not gathered:
        return 0.0
    said = told or gathered[-1].heading.rate_hz
    if said:
        return said / stride
    span = gathered[-1].arrived - gathered[0].arrived
    return (len(gathered) - 1) / span if span > 1.0 else 0.0


def learn_meanwhile(stream: Stream, gathered: Gathered, asked: Asked) -> Followed:
    """`learn` beside a stream whose frames are kept until it is done. Raises what it raises."""
    if stream.source.patient:
        return learn(stream.source.name, gathered, asked)
    done: list[Followed] = []
    failed: list[BaseException] = []

    def work() -> None:
        try:
            done.append(learn(stream.source.name, gathered, asked))
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


def learn(name: str, gathered: Gathered, asked: Asked) -> Followed:
    """Who the gathered frames show. Raises HabitusError where they do not tell it."""
    heading = gathered.heading
    rate = gathered.rate_hz
    points = np.stack([frame.points for frame in gathered.frames])
    if not np.isfinite(points).any():
        raise HabitusError(f"{name}: no labelled point is seen")
    captures = captures_of(replace(heading, points=points, rate_hz=rate), rate, name, name)
    if asked.fit is None:
        known, recording, capture = learnt(captures, asked.model, asked.wanted, asked.settings)
    else:
        known, recording, capture = saved(captures, asked.fit, asked.wanted, asked.settings)
    wiring = find_wiring(points, recording.observed, METRES[capture.unit])
    lost = [label for label, k in zip(known.layout.labels, wiring.columns, strict=True) if k < 0]
    if lost:
        raise HabitusError(
            f"{name}: which of its points are {listed(lost)} is not clear; check for labels that "
            "repeat"
        )
    markers = np.stack([wiring.markers(each) for each in points])
    tracker = Tracker(known, asked.settings, rate)
    return Followed(
        known, recording, wiring, tracker, markers, tuple(tracker.step(each) for each in markers)
    )
