"""Outputs of a live fit: joint rotations over OSC and VMC, and a viewer in the browser."""

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from habitus.errors import HabitusError, check_extra, shown
from habitus.export.osc import Sender
from habitus.export.posing import OSC_PORT, UNITY_BONES, VMC_PORT, OscPoses, VmcPoses
from habitus.fit.markers.live import Quality
from habitus.io.streams.source import host_and_port
from habitus.jobs.live import MakeSink, Now, Sink
from habitus.jobs.live_start import LivePerson
from habitus.report.live import NEEDED, Board, Shown, serve
from habitus.report.page_server import markdown_text, new_token, page_address

STATES: Mapping[str, int] = {"tracked": 1, "started": 1, "held": 0, "nobody": -1}
_PORTS = {"vmc": VMC_PORT, "osc": OSC_PORT}


def sinks(send: Sequence[str], port: int | None, say: Callable[[str], None]) -> list[MakeSink]:
    """What ``--send`` and ``--view`` ask for; port: of the viewer's page, None for no viewer.
    Raises HabitusError.
    """
    made: list[MakeSink] = [_sending(text) for text in send]
    if port is not None:
        from habitus.jobs.live_sinks import viewer

        made.append(viewer(port, say))
    return made


def _sending(text: str) -> MakeSink:
    """``vmc``, ``osc=192.168.1.7`` or ``vmc=studio:39540``. Raises HabitusError."""
    kind, _, address = text.partition("=")
    if kind.lower() not in _PORTS:
        raise HabitusError(
            f"cannot send {shown(text)!r}; expected osc or vmc, with =HOST or =HOST:PORT where "
            "not here"
        )
    return partial(_sender, kind.lower(), Sender(*host_and_port(address, _PORTS[kind.lower()])))


def _sender(kind: str, sender: Sender, person: LivePerson) -> Sink:
    body = person.body
    if kind == "osc":
        return PoseSender(OscPoses(body.joint_names), sender)
    if body.joint_names[0] not in UNITY_BONES:
        raise HabitusError(
            f"vmc sends joints of the SMPL family; {body.name} begins with "
            f"{body.joint_names[0]!r}: use osc"
        )
    rest = body(person.betas, np.zeros((body.num_joints, 3)), np.zeros(3), vertices=[0]).joints
    return PoseSender(VmcPoses(body.joint_names, body.parents, rest, person.up_axis), sender)


class PoseSender:
    """Sends each frame on as soon as it is solved."""

    def __init__(self, poses: VmcPoses | OscPoses, sender: Sender):
        self._poses = poses
        self._sender = sender

    def show(self, now: Now, quality: Quality) -> None:
        """Send a frame."""
        frame = now.frame
        self._sender.send(
            self._poses.packets(
                now.number, now.seconds, frame.pose, frame.trans, STATES[frame.state]
            )
        )

    def close(self) -> None:
        """Close the socket."""
        self._sender.close()


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

    def __init__(self, port: int, say: Callable[[str], None], person: LivePerson):
        context = multiprocessing.get_context("spawn")
        self._board = Board(context, person.body.num_joints, len(person.labels))
        self._say = say
        self._count = 0
        self._text = ""
        self._last_state = ""
        self._who = _who(person)
        fields = {name: getattr(person.body, name) for name in NEEDED}
        self._token = new_token()
        arguments = (
            self._board,
            fields,
            person.betas,
            person.up_axis,
            port,
            self._token,
        )
        self._process = context.Process(target=serve, args=arguments, daemon=True)
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
            else page_address(self._board.port, self._token)
            if self._board.port
            else ""
        )
        if now and now != self._last_state:
            self._last_state = now
            self._say(
                "the viewer has ended; frames are followed without it"
                if now == "gone"
                else f"viewer: {now}"
            )


def _who(person: LivePerson) -> str:
    measured = person.body.measure(person.betas)
    return f"{measured['height_m']:.2f} m, {measured['mass_kg']:.0f} kg, {person.by}"


def _text(who: str, now: Now, quality: Quality) -> str:
    verdict = quality.verdict
    mean = quality.mean_mm
    text = (
        f"**{verdict.level}**\n\n{markdown_text(who)}\n\n{now.seconds:.1f} s, {quality.seen} of "
        f"{len(quality.labels)} {quality.what}"
    )
    text += "" if np.isnan(mean) else f", {mean:.1f} mm"
    return "\n\n".join([text, *map(markdown_text, verdict.reasons)])
