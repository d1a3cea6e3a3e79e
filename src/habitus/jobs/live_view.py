"""The sink that shows a live fit in the browser."""

import multiprocessing
from collections.abc import Callable
from functools import partial

import numpy as np

from habitus.errors import check_extra
from habitus.fit.markers.live import Quality
from habitus.fit.markers.recordings import Recording
from habitus.fit.subject import Subject
from habitus.jobs.live import MakeSink
from habitus.jobs.live_follow import Now
from habitus.report.live import HOST, NEEDED, Board, Shown, serve

_TEXT_EVERY = 10
_ENDING_S = 2.0


def viewer(port: int, say: Callable[[str], None]) -> MakeSink:
    """What shows a live fit on a page of this machine. Raises HabitusError where viser is not
    installed.
    """
    check_extra("viser", "Live views", "live")
    return partial(Viewer, port, say)


class Viewer:
    """A page in the browser, served by a process of its own, which is told of every frame and draws
    the latest.
    """

    def __init__(self, port: int, say: Callable[[str], None], known: Subject, recording: Recording):
        context = multiprocessing.get_context("spawn")
        self._board = Board(context, known.body.num_joints, len(known.layout))
        self._say = say
        self._count = 0
        self._text = ""
        self._told = ""
        self._who = _who(known)
        fields = {name: getattr(known.body, name) for name in NEEDED}
        told = (self._board, fields, known.shape.betas, recording.up_axis, port)
        self._process = context.Process(target=serve, args=told, daemon=True)
        self._process.start()

    def show(self, now: Now, quality: Quality) -> None:
        """Hand the frame over."""
        if self._count % _TEXT_EVERY == 0:
            self._text = _text(self._who, now, quality)
            self._introduce()
        self._count += 1
        self._board.write(
            Shown(now.frame.pose, now.frame.trans, now.markers, now.frame.distances, self._text)
        )

    def close(self) -> None:
        """End the process."""
        self._board.stop = True
        self._process.join(_ENDING_S)
        if self._process.is_alive():
            self._process.terminate()

    def _introduce(self) -> None:
        """Says where the page is, once it is served, and when it is no more."""
        now = (
            "gone"
            if not self._process.is_alive()
            else f"http://{HOST}:{self._board.port}"
            if self._board.port
            else ""
        )
        if now and now != self._told:
            self._told = now
            self._say(
                "the viewer has ended; frames are followed without it"
                if now == "gone"
                else f"viewer: {now}"
            )


def _who(known: Subject) -> str:
    measured = known.body.measure(known.shape.betas)
    return f"{measured['height_m']:.2f} m, {measured['mass_kg']:.0f} kg, layout {known.layout.name}"


def _text(who: str, now: Now, quality: Quality) -> str:
    verdict = quality.verdict
    mean = quality.mean_mm
    said = (
        f"**{verdict.level}**\n\n{who}\n\n{now.seconds:.1f} s, {quality.seen} of "
        f"{len(quality.labels)} markers"
    )
    said += "" if np.isnan(mean) else f", {mean:.1f} mm"
    return "\n\n".join([said, *verdict.reasons])
