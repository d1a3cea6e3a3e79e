"""Who is told of a live fit's frames: a viewer in the browser, other programs by OSC and VMC."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.export.osc import Sender
from habitus.export.posing import OSC_PORT, UNITY_BONES, VMC_PORT, OscPoses, VmcPoses
from habitus.fit.markers.live import Quality
from habitus.fit.markers.recordings import Recording
from habitus.fit.subject import Subject
from habitus.io.streams.source import host_and_port
from habitus.jobs.live import MakeSink
from habitus.jobs.live_follow import Now, Sink

STATES: Mapping[str, int] = {"tracked": 1, "started": 1, "held": 0, "nobody": -1}
_PORTS = {"vmc": VMC_PORT, "osc": OSC_PORT}


def sinks(send: Sequence[str], port: int | None, say: Callable[[str], None]) -> list[MakeSink]:
    """What ``--send`` and ``--view`` ask for; port: of the viewer's page, None for no viewer.
    Raises HabitusError.
    """
    made: list[MakeSink] = [_sending(text) for text in send]
    if port is not None:
        from habitus.jobs.live_view import viewer

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


def _sender(kind: str, sender: Sender, known: Subject, recording: Recording) -> Sink:
    body = known.body
    if kind == "osc":
        return PoseSender(OscPoses(body.joint_names), sender)
    if body.joint_names[0] not in UNITY_BONES:
        raise HabitusError(
            f"vmc sends joints of the SMPL family; {body.name} begins with "
            f"{body.joint_names[0]!r}: use osc"
        )
    rest = body(known.shape.betas, np.zeros((body.num_joints, 3)), np.zeros(3), vertices=[0]).joints
    return PoseSender(VmcPoses(body.joint_names, body.parents, rest, recording.up_axis), sender)


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
