"""Face units over OSC: what python-osc sends arrives, and what nobody should send is counted."""

import socket

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.export.osc import Bundles, Message
from habitus.io.streams.faces import FaceStream, read_messages

NAMES = ("jawOpen", "eyeBlinkLeft", "mouthSmileRight")


@pytest.fixture
def stream():
    found = FaceStream(NAMES, "127.0.0.1:39871")
    yield found
    found.close()


def send(stream, *packets):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        for packet in packets:
            udp.sendto(packet, ("127.0.0.1", stream.port))


def frames_of(stream, count):
    frames = []
    for _ in range(50):
        frames += stream.poll(0.2)
        if len(frames) >= count:
            break
    return frames


def test_a_recording_replayed_over_loopback_arrives_frame_by_frame(stream):
    rng = np.random.default_rng(0)
    weights = rng.uniform(0, 1, (40, 3)).astype(np.float32)
    layout = Bundles([Message("/VMC/Ext/Blend/Val", "sf", (name,)) for name in NAMES])
    for row in weights:
        send(stream, *layout.filled(row))
    frames = frames_of(stream, len(weights))
    np.testing.assert_array_equal([frame.weights for frame in frames], weights)
    assert np.all(np.diff([frame.arrived for frame in frames]) > -0.01)
    assert not stream.skipped.total


def test_what_python_osc_sends_is_read(stream):
    builder = pytest.importorskip("pythonosc.osc_message_builder")
    bundles = pytest.importorskip("pythonosc.osc_bundle_builder")

    def message(address, *values):
        made = builder.OscMessageBuilder(address=address)
        for value in values:
            made.add_arg(value)
        return made.build()

    both = bundles.OscBundleBuilder(bundles.IMMEDIATELY)
    both.add_content(message("/face/JawOpen", 0.25))
    both.add_content(message("/blendshape", "eyeBlinkLeft", 1))
    send(stream, both.build().dgram, message("/mouthSmileRight", 7.0).dgram)
    frames = frames_of(stream, 2)
    np.testing.assert_allclose(frames[0].weights, [0.25, 1, 0])
    np.testing.assert_allclose(frames[1].weights, [0.25, 1, 1])


def test_hostile_packets_are_counted_and_change_nothing(stream):
    good = Bundles([Message("/blendshape", "sf", ("jawOpen",))])
    whole = good.filled([0.5])[0]
    nan = good.filled([np.nan])[0]
    nested = whole
    for _ in range(9):
        nested = b"#bundle\0" + bytes(8) + len(nested).to_bytes(4, "big") + nested
    rng = np.random.default_rng(1)
    noise = [rng.bytes(int(n)) for n in rng.integers(1, 400, 200)]
    cut = [whole[:k] for k in range(1, len(whole))]
    send(stream, nan, nested, b"\0" * 8, b"/x\0\0,b\0\0" + b"\xff" * 8, *cut, *noise)
    for _ in range(10):
        assert not [f for f in stream.poll(0.05) if f.weights.any()]
    assert stream.skipped.total >= 4
    assert len(str(stream.skipped)) < 500
    send(stream, whole)
    assert frames_of(stream, 1)[-1].weights[0] == 0.5


def test_messages_survive_a_round_trip():
    layout = Bundles([Message("/a", "sif", ("x",)), Message("/b/c", "f")])
    found = list(read_messages(layout.filled([1.5, -2.0], [7])[0]))
    assert found == [("/a", ["x", 7.0, 1.5]), ("/b/c", [-2.0])]


def test_no_units_and_a_taken_port_are_named(stream):
    with pytest.raises(HabitusError, match="no face units were named"):
        FaceStream(())
    with pytest.raises(HabitusError, match=r"127\.0\.0\.1:39871: cannot listen there"):
        FaceStream(NAMES, "127.0.0.1:39871")
