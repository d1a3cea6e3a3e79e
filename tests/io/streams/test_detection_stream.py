"""Lines of detectors become frames: complete ones at once, others after a while, each once and in
their order; what cannot be used is counted.
"""

import json
import socket
import time

import numpy as np
import pytest

from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError
from habitus.io.streams import detections
from habitus.io.streams.detections import MAX_PEOPLE, DetectionStream, read_line

COUNT = len(CONVENTIONS["coco17"])
CAMERAS = ("cam_01", "cam_02")


def line(camera, number, x=10.0, **other):
    table = {"camera": camera, "frame": number, "convention": "coco17"}
    return json.dumps(table | {"keypoints": [[x, 20.0, 0.5]] * COUNT} | other).encode()


@pytest.fixture
def stream():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        port = udp.getsockname()[1]
    made = DetectionStream(CAMERAS, f"127.0.0.1:{port}", 50.0)
    yield made
    made.close()


def take(stream, *lines):
    for each in lines:
        stream.take(each, time.perf_counter())
    return stream.poll(0.0)


def begin(stream):
    """Both cameras are heard."""
    take(stream, line("cam1", 0), line("cam2", 0), line("cam1", 1), line("cam2", 1))


def test_a_frame_is_there_once_all_cameras_sent_it(stream):
    begin(stream)
    assert not take(stream, line("cam1", 5))
    (frame,) = take(stream, line("cam2", 5, 30.0))
    assert frame.number == 5 and frame.heading.format == "coco17"
    points = frame.points.reshape(2, MAX_PEOPLE, COUNT, 3)
    np.testing.assert_allclose(points[0, 0], np.tile([10.5, 20.5, 0.5], (COUNT, 1)))
    np.testing.assert_allclose(points[1, 0, :, 0], 30.5)
    assert np.isnan(points[:, 1:]).all()
    assert len(frame.heading.labels) == len(frame.points)


def test_a_frame_waits_for_a_late_camera_and_not_for_ever(stream, monkeypatch):
    begin(stream)
    assert not take(stream, line("cam1", 5), line("cam1", 6))
    assert [f.number for f in take(stream, line("cam2", 6), line("cam2", 5))] == [5, 6]
    monkeypatch.setattr(detections, "PATIENCE_S", 0.01)
    assert not take(stream, line("cam1", 7))
    time.sleep(0.02)
    (frame,) = stream.poll(0.0)
    assert np.isnan(frame.points.reshape(2, -1)[1]).all()
    assert not take(stream, line("cam2", 7)) and "lines too late" in str(stream.skipped)


def test_a_camera_that_is_silent_is_not_waited_for(stream, monkeypatch):
    begin(stream)
    monkeypatch.setattr(detections, "SILENT_S", 0.01)
    time.sleep(0.02)
    (frame,) = take(stream, line("cam1", 5))
    assert frame.number == 5


def test_lines_may_share_a_datagram_and_times_take_the_place_of_numbers(stream):
    begin(stream)
    both = [line("cam1", None, time=0.2), line("cam2", None, time=0.201)]
    (frame,) = take(stream, b"\n".join(both))
    assert frame.number == 10
    assert not take(stream, b"\n" * 1000) and "too many lines" in str(stream.skipped)


def test_a_number_far_off_counts_once_another_agrees(stream):
    begin(stream)
    assert not take(stream, line("cam1", 10**9))
    (frame,) = take(stream, line("cam1", 5), line("cam2", 5))
    assert frame.number == 5 and "far from the others" in str(stream.skipped)
    take(stream, line("cam1", 5000), line("cam2", 5000), line("cam1", 5001))
    assert [f.number for f in take(stream, line("cam2", 5001))] == [5000, 5001]


def test_people_are_read_and_nobody_is_nobody():
    row = [[1.0, 2.0, 3.0]] * (COUNT + 5)
    some = read_line(line("a", 1, people=[row, [], row] * 20))
    assert some.people.shape == (MAX_PEOPLE, COUNT, 3) and some.people[..., 2].max() == 1.0
    assert read_line(line("a", 1, keypoints=[])).people.shape == (0, COUNT, 3)
    missing = read_line(line("a", 1, keypoints=[[float("nan"), 1, 1]] * COUNT))
    assert np.isnan(missing.people).all()


def test_a_port_in_use_is_refused(stream):
    with pytest.raises(HabitusError, match="cannot listen"):
        DetectionStream(CAMERAS, f"127.0.0.1:{stream.port}")
