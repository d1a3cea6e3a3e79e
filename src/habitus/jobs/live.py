"""A live fit from a stream to a result: ``habitus live`` and ``habitus.live`` both call this."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export.motion import export_motion
from habitus.fit.markers.recipe import warm_up
from habitus.fit.markers.recordings import Recording
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.subject import Subject
from habitus.io.people import read_fit
from habitus.io.streams.open import open_source
from habitus.io.streams.source import Source
from habitus.jobs.bodies import loaded
from habitus.jobs.live_follow import Follower, Sink, status
from habitus.jobs.live_start import (
    IDLE_S,
    LiveStart,
    Say,
    Stream,
    gather_frames,
    learn_meanwhile,
    silence,
)
from habitus.jobs.options import LiveOptions, read_age, takes
from habitus.jobs.results import save_fit
from habitus.types import PathLike

STATUS_S = 1.0
REHEARSED = 0.7
"""Of the time from frame to frame: then a step is rehearsed, as caches forget it until the next
frame comes.
"""
MakeSink = Callable[[Subject, Recording], Sink]
"""Makes a sink for a person whose shape is known; the recording tells rate and up axis."""


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
) -> MarkerFit | None:
    """Follow one person through a live stream of markers; ``out`` receives the result.

    source: "replay" (``address`` is a capture file), "natnet" or "qtm" (the host that streams, this
    one by default, with ``:port`` where it differs), or any `habitus.io.streams.source.Source`.
    out: a file that ends in .npz or .glb, or a folder for all files of a fit. sinks: called with
    every frame. say, on_status: called with what happens, and with a line a second. It ends with
    the stream, or with Ctrl-C, which is no error once a person is followed. The fit holds all
    frames from the first that was gathered, 1 kB each; with ``keep`` false and no ``out`` none is
    kept. Raises HabitusError with one clear line on bad input.
    """
    target = None if out is None else _checked(Path(out))
    settings = replace(options.settings or MoshSettings(), causal=True, soft_tissue=False)
    start = LiveStart(options, _model(options), settings, source != "replay")
    warm_up(start.model)
    stream = Stream(
        open_source(source, address, options.fps) if isinstance(source, str) else source
    )
    try:
        fit = _session(stream, start, keep or target is not None, sinks, say, on_status)
    finally:
        stream.source.close()
    if target is not None and fit is not None:
        export_motion(fit, target) if target.suffix else save_fit(fit, target)
    return fit


def _model(options: LiveOptions) -> MarkerFit | BodyModel:
    """The earlier fit whose shape is taken, or the body that is to be fitted."""
    body = options.body
    if isinstance(options.known, str | os.PathLike):
        by_name = isinstance(body, str) and body == "default"
        return read_fit(options.known, None if by_name else body)
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
    start: LiveStart,
    keep: bool,
    sinks: Sequence[MakeSink],
    say: Say,
    on_status: Callable[[str], None],
) -> MarkerFit | None:
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
        f"{'shape' if start.fit is None else 'markers'}",
        "",
    )
    found = learn_meanwhile(stream, gathered, start)
    for text in found.recording.warnings:
        say(text, "warning:")
    made = [make(found.known, found.recording) for make in sinks]
    follower = Follower(found, gathered.heading, rate, say, made, keep)
    say(_introduced(follower, found.known, start), "")
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
    return follower.record.fit(found.known, found.recording, start.settings, notes)


def _introduced(follower: Follower, known: Subject, start: LiveStart) -> str:
    measured = known.body.measure(known.shape.betas)
    who = f"{measured['height_m']:.2f} m, {measured['mass_kg']:.0f} kg"
    how = "as saved" if start.fit is not None else f"shape in {known.seconds:.1f} s"
    return (
        f"following {who} ({how}) by {len(known.layout)} markers ({known.layout.name}): "
        f"{follower.quality.verdict}"
    )


def _follow(
    stream: Stream,
    follower: Follower,
    rate: float,
    over: Callable[[], bool],
    say: Say,
    on_status: Callable[[str], None],
) -> None:
    """Every frame until the end; a status now and then, silence said."""
    told = time.perf_counter()
    fresh = False
    heard = time.perf_counter()
    while not stream.ended and not over():
        waited = stream.behind
        found = stream.following(rate, REHEARSED / rate if fresh else IDLE_S)
        if found is not None:
            follower.take(*found, waited)
            heard = time.perf_counter()
        elif fresh:
            follower.rehearse()
        else:
            heard = silence(stream.source, heard, say)
        fresh = found is not None
        if time.perf_counter() - told > STATUS_S and not stream.behind:
            told = time.perf_counter()
            on_status(status(follower, stream.trouble))
