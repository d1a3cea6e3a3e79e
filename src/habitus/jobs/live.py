"""A live fit from a stream to a result: the tracker's frames, what outputs receive, the record.
``habitus live`` and ``habitus.live`` both call this.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, listed
from habitus.export.motion import export_motion
from habitus.fit.cameras.result import CameraFit
from habitus.fit.markers.live import LiveFrame, Quality
from habitus.fit.markers.recipe import warm_up
from habitus.fit.markers.recordings import MIN_MARKERS
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.points import RawPoints
from habitus.io.people import read_fit
from habitus.io.streams.source import Frame, Source
from habitus.io.streams.wiring import Wiring, rewired
from habitus.jobs.bodies import loaded
from habitus.jobs.live_cameras import DETECTIONS, DetectionStart
from habitus.jobs.live_markers import MarkerStart
from habitus.jobs.live_start import (
    IDLE_S,
    Evidence,
    Fit,
    Followed,
    LivePerson,
    Say,
    Start,
    Stream,
    Track,
    gather_frames,
    learn_meanwhile,
    silence,
)
from habitus.jobs.options import LiveOptions, read_age, takes
from habitus.types import PathLike

MAX_LOST_S = 60.0
"""Frames that are missing for longer are not filled in: the result has no time for them."""
_MAX_NOTES = 40


class Now(NamedTuple):
    """A frame as it is shown and sent on: its number, seconds since the first, the markers (N, 3),
    what was found.
    """

    number: int
    seconds: float
    markers: Float[np.ndarray, "N 3"]
    frame: LiveFrame


class Sink(Protocol):
    """A receiver of every frame: a viewer, other programs."""

    def show(self, now: Now, quality: Quality) -> None:
        """Tell of a frame, quickly."""
        ...

    def close(self) -> None:
        """No more frames will come."""
        ...


class Follower:
    """Takes the frames after those of the shape stage. For one stream and one thread.

    notes: what happened, a sentence each. latencies: seconds from a frame's arrival to its pose, of
    the last minute or so, those left out that waited until the shape was found.
    """

    def __init__(
        self,
        followed: Followed,
        heading: RawPoints,
        say: Say,
        sinks: Sequence[Sink],
        keep: bool = True,
    ):
        self._followed = followed
        self._wiring = followed.wiring
        self._heading = heading
        self._rate = followed.person.rate_hz
        self._say = say
        self._known = heading.labels
        self.quality = followed.quality
        self.record = Record() if keep else None
        self.notes = list[str]()
        self.latencies = deque[float](maxlen=10_000)
        self.count = 0
        self._sinks = list(sinks)
        self._state = "nobody"
        self._met = False
        for frame, kept in zip(followed.frames, followed.kept, strict=True):
            self._add(frame, kept)

    @property
    def seconds(self) -> float:
        """Of the stream, since the first frame that was gathered."""
        return self.count / self._rate

    def take(self, frame: Frame, missing: int, waited: bool = False) -> Now:
        """Fit the next frame, before which so many are missing; whether it ``waited`` until the
        shape was found.
        """
        if frame.heading is not self._heading:
            self._relabelled(frame.heading)
        for _ in range(self._bridged(missing)):
            live, evidence = self._step(np.full_like(frame.points, np.nan))
            self._add(live, evidence.kept)
        live, evidence = self._step(frame.points)
        if not waited:
            self.latencies.append(time.perf_counter() - frame.arrived)
        now = Now(frame.number, self.seconds, evidence.points, live)
        self._add(live, evidence.kept)
        for sink in self._sinks:
            sink.show(now, self.quality)
        return now

    def _step(self, points: Float[np.ndarray, "P 3"]) -> tuple[LiveFrame, Evidence]:
        observed = self._wiring.markers(points)
        live = self._followed.tracker.step(observed)
        return live, self._followed.evidence(observed)

    def rehearse(self) -> None:
        """To be called shortly before a frame is due."""
        self._wiring.markers(np.zeros((len(self._heading.labels), 3)))
        self._followed.tracker.rehearse()

    def _add(self, live: LiveFrame, kept: np.ndarray) -> None:
        self._report_state(live)
        self.quality.add(live)
        self.count += 1
        if self.record is not None:
            self.record.add(live, kept)

    def _bridged(self, missing: int) -> int:
        """How many missing frames are filled in."""
        most = int(MAX_LOST_S * self._rate)
        if missing > 0.1 * self._rate:
            self._note(f"{missing} frames were lost at {self.seconds:.1f} s", "warning:")
        if missing > most:
            self._note(
                f"of these {missing - most} are left out of the time that follows", "warning:"
            )
        return min(missing, most)

    def _report_state(self, live: LiveFrame) -> None:
        """Notes when the person leaves, returns, or is initialised again."""
        before = self._state
        self._state = live.state
        if live.state == "nobody" and before != "nobody":
            self._note(f"the subject left at {self.seconds:.1f} s", "warning:")
        elif live.state == "started" and self._met:
            what = (
                "the subject is seen again"
                if before == "nobody"
                else "tracking was lost; the body is initialised again"
            )
            self._note(f"{what} at {self.seconds:.1f} s", "")
        self._met = self._met or live.state != "nobody"

    def _relabelled(self, heading: RawPoints) -> None:
        """The stream calls its points something else: markers are found by their labels, and what
        changed is said.
        """
        assert isinstance(self._followed.wiring, Wiring)  # keypoints keep their convention
        self._heading = heading
        wiring, gone, new = rewired(self._followed.wiring, self._known, heading.labels)
        self._wiring = wiring
        labels = self._followed.person.labels
        left = int((wiring.columns >= 0).sum())
        text = (
            f"the marker set changed at {self.seconds:.1f} s: {left} of {len(labels)} markers "
            "are left"
        )
        text += f"; gone: {listed(labels[k] for k in gone)}" if gone else ""
        text += f"; not used, as their places are not known: {listed(new)}" if new else ""
        text += "; too few to follow a person: start again" if left < MIN_MARKERS else ""
        self._note(text, "warning:")

    def _note(self, text: str, mark: str) -> None:
        self._say(text, mark)
        if len(self.notes) < _MAX_NOTES:
            self.notes.append(text)

    def close(self) -> None:
        """Let go of viewers and other programs."""
        for sink in self._sinks:
            sink.close()


def status(follower: Follower, trouble: str) -> str:
    """One line on how it goes; ``trouble``: what was wrong with the stream."""
    quality = follower.quality
    verdict = follower.quality.verdict
    took = 1e3 * np.percentile(follower.latencies, [50, 99]) if follower.latencies else np.zeros(2)
    text = (
        f"{follower.seconds:7.1f} s  {quality.seen}/{len(quality.labels)} {quality.what}  "
        f"{quality.mean_mm:.1f} mm"
    )
    text += f"  {took[0]:.1f} ms (99 %: {took[1]:.1f})  {verdict}"
    return f"{text}  {trouble}" if trouble else text


class Record:
    """Keeps the frames of a stream; about 1 kB each."""

    def __init__(self) -> None:
        self._poses: list[np.ndarray] = []
        self._trans: list[np.ndarray] = []
        self._costs: list[float] = []
        self._observed: list[np.ndarray] = []

    def __len__(self) -> int:
        """How many frames there are."""
        return len(self._poses)

    def add(self, frame: LiveFrame, observed: np.ndarray) -> None:
        """The next frame, with what it showed (N, 3), which of nobody is not kept."""
        self._poses.append(frame.pose)
        self._trans.append(frame.trans)
        self._costs.append(frame.cost)
        self._observed.append(
            (observed if frame.state != "nobody" else np.full_like(observed, np.nan)).astype("f4")
        )

    def track(self) -> Track:
        """All frames; where nobody was seen the body stands as it was last."""
        standing = _held(np.isfinite(np.array(self._trans)[:, 0]))
        return Track(
            np.array(self._poses)[standing],
            np.array(self._trans)[standing],
            np.array(self._costs),
            np.array(self._observed, dtype=np.float64),
        )


def _held(valid: np.ndarray) -> np.ndarray:
    """For each frame the last valid one up to it; of those before the first, the first."""
    rows = np.where(valid, np.arange(len(valid)), -1)
    rows = np.maximum.accumulate(rows)
    return np.where(rows < 0, int(np.argmax(valid)), rows)


STATUS_S = 1.0
"""Seconds between lines about the state of the stream."""
REHEARSED = 0.7
"""Of the time from frame to frame: then a step is rehearsed, as caches forget it until the next
frame comes.
"""
CATCH_UP_S = 10.0
"""Seconds in which frames that came while the shape was found are worked off; of those that wait
longer only the newest is kept.
"""
MakeSink = Callable[[LivePerson], Sink]
"""Makes a sink for a person whose shape is known."""


@takes(LiveOptions)
def live(
    source: str | Source,
    address: PathLike | None = None,
    out: PathLike | None = None,
    *,
    options: LiveOptions,
    keep: bool = True,
    sinks: Sequence[MakeSink] = (),
    say: Say = lambda text, mark: None,
    on_status: Callable[[str], None] = lambda line: None,
) -> Fit | None:
    """Follow one person through a live stream of markers, or of keypoints in the calibrated
    ``cameras``; ``out`` receives the result.

    source: "replay" (``address`` is a capture file), "natnet" or "qtm" (the host that streams, this
    one by default, with ``:port`` where it differs), "detections" (the interface that is listened
    on, with ``cameras``), or any `habitus.io.streams.source.Source`.
    out: a file that ends in .npz or .glb, or a folder for all files of a fit. sinks: called with
    every frame. say, on_status: called with what happens, and with a line a second. It ends with
    the stream, or with Ctrl-C, which is no error once a person is followed. The fit holds all
    frames from the first that was gathered, 1 kB each; with ``keep`` false and no ``out`` none is
    kept. Raises HabitusError with one clear line on bad input.
    """
    target = None if out is None else _checked(Path(out))
    start = _start(source, options)
    stream = Stream(start.open(source, address) if isinstance(source, str) else source)
    try:
        fit = _session(stream, start, keep or target is not None, sinks, say, on_status)
    finally:
        stream.source.close()
    if target is not None and fit is not None:
        export_motion(fit, target) if target.suffix else start.save(fit, target)
    return fit


def _start(source: str | Source, options: LiveOptions) -> Start:
    """By keypoints where there are cameras, else by markers."""
    if isinstance(source, str) and (source == DETECTIONS) != (options.cameras is not None):
        raise HabitusError(
            f"source {source} {'without' if source == DETECTIONS else 'with'} cameras; expected "
            f"a calibration (--cameras FILE) with source {DETECTIONS}, and with no other"
        )
    if options.cameras is not None:
        return DetectionStart.of(options)
    settings = replace(options.settings or MoshSettings(), causal=True, soft_tissue=False)
    start = MarkerStart(options, _model(options), settings, source != "replay")
    warm_up(start.model)
    return start


def _model(options: LiveOptions) -> MarkerFit | BodyModel:
    """The earlier fit whose shape is taken, or the body that is to be fitted."""
    body = options.body
    if isinstance(options.known, str | os.PathLike):
        by_name = isinstance(body, str) and body == "default"
        return read_fit(options.known, None if by_name else body)
    if isinstance(options.known, CameraFit):
        raise HabitusError(
            "known is a fit to cameras; expected one to markers, or cameras beside it"
        )
    return options.known or loaded(body, options.joints, read_age(options.age))


def _checked(out: Path) -> Path:
    if out.suffix.lower() not in ("", ".npz", ".glb"):
        raise HabitusError(
            f"cannot write a live fit to {out}: expected a name that ends in .npz or .glb, or a "
            "folder"
        )
    return out


def _session(
    stream: Stream,
    start: Start,
    keep: bool,
    sinks: Sequence[MakeSink],
    say: Say,
    on_status: Callable[[str], None],
) -> Fit | None:
    """Gather, learn, follow; the fit of it all."""
    stop_after = start.options.stop_after
    until = np.inf if stop_after is None else time.perf_counter() + stop_after
    over = lambda: time.perf_counter() > until  # noqa: E731
    say(f"listening to {stream.source.name}", "")
    gathered = gather_frames(stream, start, say, over)
    rate = gathered.rate_hz
    stream.behind = True
    say(
        f"{len(gathered.frames) / rate:.1f} s of somebody: finding the "
        f"{'person' if start.is_known else 'shape'}",
        "",
    )
    followed = learn_meanwhile(stream, gathered, start)
    for text in followed.warnings:
        say(text, "warning:")
    made = [make(followed.person) for make in sinks]
    follower = Follower(followed, gathered.heading, say, made, keep)
    say(_introduced(follower, followed), "")
    try:
        _follow(stream, follower, rate, over, say, on_status)
    except KeyboardInterrupt:
        pass  # the usual end
    finally:
        follower.close()
    trouble = stream.trouble
    say(
        f"followed {follower.count} frames, {follower.seconds:.1f} "
        f"s{'; ' if trouble else ''}{trouble}",
        "",
    )
    notes = [*follower.notes, *([f"of the stream: {trouble}"] if trouble else [])]
    if follower.record is None:
        return None
    return followed.result(follower.record.track(), notes)


def _introduced(follower: Follower, followed: Followed) -> str:
    person = followed.person
    measured = person.body.measure(person.betas)
    who = f"{measured['height_m']:.2f} m, {measured['mass_kg']:.0f} kg"
    return f"following {who} ({followed.how}) by {person.by}: {follower.quality.verdict}"


def _follow(
    stream: Stream,
    follower: Follower,
    rate: float,
    over: Callable[[], bool],
    say: Say,
    on_status: Callable[[str], None],
) -> None:
    """Every frame until the end; a status now and then, silence said."""
    began = printed = time.perf_counter()
    fresh = False
    heard = time.perf_counter()
    while not stream.ended and not over():
        stream.behind = stream.behind and time.perf_counter() - began < CATCH_UP_S
        waited = stream.behind
        received = stream.following(rate, REHEARSED / rate if fresh else IDLE_S)
        if received is not None:
            follower.take(*received, waited)
            heard = time.perf_counter()
        elif fresh:
            follower.rehearse()
        else:
            heard = silence(stream.source, heard, say)
        fresh = received is not None
        if time.perf_counter() - printed > STATUS_S and not stream.behind:
            printed = time.perf_counter()
            on_status(status(follower, stream.trouble))
