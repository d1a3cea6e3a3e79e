"""QTM's real-time protocol: a server on loopback, its labels, their change, its end."""

import sys
import threading

import numpy as np
import pytest
from qtm_server import SETTINGS_CHANGED, SHUTTING_DOWN, QtmServer, frame, take

from habitus.errors import HabitusError
from habitus.io.streams import qtm
from habitus.io.streams.qtm import Qtm

LABELS = ("LFHD", "RFHD", "C7", "T10")


def start(server):
    """The source, whose answer to the wish for frames is the first of them."""
    first = threading.Thread(target=server.send_frames, args=([frame(0, np.ones((4, 3)))],))
    first.start()
    source = Qtm(server.address)
    first.join()
    assert len(take(source, 1)) == 1
    return source


def test_frames_arrive_with_their_labels():
    pytest.importorskip("qtm_rt")
    points = np.random.default_rng(2).normal(size=(6, 4, 3)).astype("f4").astype("f8")
    points[3, 1] = np.nan
    with QtmServer(LABELS) as server:
        source = start(server)
        server.send_frames([frame(5 + k, each) for k, each in enumerate(points)])
        frames = take(source, 6)
        source.close()
        source.close()
    assert [each.number for each in frames] == list(range(5, 11))
    np.testing.assert_array_equal([each.points for each in frames], points)
    head = frames[0].heading
    assert (head.rate_hz, head.unit, head.up_claim, head.labels) == (120.0, "mm", "+z", LABELS)
    assert any(command.startswith("streamframes allframes 3d") for command in server.commands)


def test_labels_that_change_are_another_heading_and_the_end_is_the_end():
    pytest.importorskip("qtm_rt")
    with QtmServer(LABELS) as server:
        source = start(server)
        server.labels = ("C7", "NEW")
        server.event(SETTINGS_CHANGED)
        while source._heading.labels != ("C7", "NEW"):
            source.poll(0.01)
        server.send_frames([frame(2, np.ones((2, 3)))])
        (found,) = take(source, 1)
        assert found.heading.labels == ("C7", "NEW") and not source.ended
        server.labels = LABELS  # without a word: the number of markers tells it
        server.send_frames([frame(3, np.ones((4, 3)))])
        while source._heading.labels != LABELS:
            source.poll(0.01)
        server.send_frames([frame(4, np.ones((4, 3)))])
        assert take(source, 1)[0].number == 4
        server.event(SHUTTING_DOWN)
        while not source.ended:
            source.poll(0.01)
        source.close()


def test_nobody_there_no_labels_and_no_package_are_told(monkeypatch):
    pytest.importorskip("qtm_rt")
    with pytest.raises(HabitusError, match="no answer"):
        Qtm("127.0.0.1:9")
    with QtmServer(()) as server, pytest.raises(HabitusError, match="no labelled markers"):
        Qtm(server.address)
    monkeypatch.setattr(qtm, "PATIENCE_S", 0.1)
    with QtmServer(LABELS) as server:
        server._answer = lambda command: None  # says nothing
        with pytest.raises(HabitusError, match="no answer within"):
            Qtm(server.address)
    monkeypatch.setitem(sys.modules, "qtm_rt", None)
    with pytest.raises(HabitusError, match=r"pip install 'habitus\[live\]'"):
        Qtm()
