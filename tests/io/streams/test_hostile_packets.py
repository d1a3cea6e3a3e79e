"""Hostile packets: whatever arrives is counted with a reason and skipped; the stream goes on."""

import socket
import struct
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from natnet_server import FRAME, MODEL, NatNetServer, frame, model, packet, server_info
from qtm_server import DATA, EVENT, QtmServer, take
from qtm_server import frame as qtm_frame

from habitus.io.streams import natnet_packets as natnet
from habitus.io.streams.natnet import NatNet
from habitus.io.streams.source import MAX_REASONS, Skipped, heading

LABELS = ("LFHD", "RFHD", "C7", "T10")
VERSIONS = ((3, 0), (4, 0), (4, 1), (4, 2))
POINTS = np.arange(12.0).reshape(4, 3)


def backward_model() -> bytes:
    """84 bytes: a description whose size is negative, as bitstream 4.1 has one."""
    body = struct.pack("<3i", 2, 9, -100_000)
    return packet(MODEL, body.ljust(80, b"\0"))


@st.composite
def packets(draw) -> tuple[tuple[int, int], bytes]:
    """A version, and random bytes or a sound packet with some bytes or numbers exchanged."""
    version = draw(st.sampled_from(VERSIONS))
    sound = (
        frame(7, POINTS, "Bob", version),
        model("Bob", LABELS, version),
        server_info(version),
    )
    if draw(st.booleans()):
        kind = draw(st.sampled_from((1, 3, 5, 7, 100)))
        return version, packet(kind, draw(st.binary(max_size=300)))
    data = bytearray(draw(st.sampled_from(sound)))
    numbers = st.sampled_from((-1, -(2**31), 2**31 - 1, 0, 1, -100_000, 65_535, 0x7F800000))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(4, len(data) - 4))
        if draw(st.booleans()):
            data[at] = draw(st.integers(0, 255))
        else:
            struct.pack_into("<i", data, at, draw(numbers))
    return version, bytes(data[: draw(st.integers(4, len(data)))])


@settings(max_examples=1500, deadline=None)
@given(packets())
def test_a_packet_is_read_or_refused(case):
    version, data = case
    known = natnet.read_model(model("Bob", LABELS, version), version)
    for read in (
        natnet.kind_of,
        natnet.read_server,
        lambda data: natnet.read_model(data, version),
        lambda data: natnet.read_frame(data, version, known),
    ):
        try:
            found = read(data)
        except natnet.BadPacket:
            continue
        if isinstance(found, natnet.MarkerFrame):
            seen = np.isfinite(found.points)
            assert (seen.all(axis=1) | ~seen.any(axis=1)).all() and not np.isinf(found.points).any()


def test_a_description_of_negative_size_is_refused():
    assert len(backward_model()) == 84
    with pytest.raises(natnet.BadPacket):
        natnet.read_model(backward_model(), (4, 1))


def stranger() -> socket.socket:
    """A socket with another address of this machine than the servers' 127.0.0.1."""
    udp = socket.socket(type=socket.SOCK_DGRAM)
    try:
        udp.bind(("127.0.0.2", 0))
    except OSError:
        udp.close()
        pytest.skip("this machine's loopback network has one address only")
    return udp


def test_packets_of_others_are_counted_named_and_skipped():
    with NatNetServer(model("Bob", LABELS, (4, 1)), (4, 1)) as server, stranger() as other:
        source = NatNet(server.address)
        listens = server.client
        for hostile in (
            backward_model(),
            frame(900, 5.0 + POINTS, "Bob", (4, 1)),
            model("Eve", LABELS[:2], (4, 1)),
        ):
            other.sendto(hostile, listens)
        server.send(
            [
                backward_model(),
                packet(FRAME, b"\xff" * 60),
                b"",
                frame(1, POINTS, "Bob", (4, 1)),
            ]
        )
        (found,) = take(source, 1)
        source.close()
    assert found.number == 1 and found.heading.labels[0] == "Bob:LFHD"
    np.testing.assert_allclose(found.points, POINTS)
    assert source.skipped.total == 6
    assert "3 packets from 127.0.0.2, which is not the server" in str(source.skipped)
    assert "truncated" in str(source.skipped)


def test_an_answer_of_another_host_is_not_the_servers():
    with NatNetServer(model("Bob", LABELS)) as server, stranger() as other:
        imposed = threading.Event()

        def impose():
            while not imposed.is_set():
                if server.client is not None:
                    other.sendto(model("Eve", LABELS), server.client)
                time.sleep(0.001)

        thread = threading.Thread(target=impose, daemon=True)
        thread.start()
        source = NatNet(server.address)
        imposed.set()
        thread.join()
        source.close()
    assert source._heading.labels[0].startswith("Bob:")


def test_numbers_of_a_server_that_no_system_has():
    nan = struct.pack("<f", float("nan"))
    answers = {"FrameRate": nan, "UnitsToMillimeters": struct.pack("<f", float("inf"))}
    with NatNetServer(model("B\x1b[2Job", LABELS), answers=answers) as server:
        source = NatNet(server.address)
        source.close()
    assert source._heading.rate_hz is None and source._heading.unit == "m"
    assert all(label.isprintable() for label in source._heading.labels)


@pytest.mark.parametrize("rate", [float("inf"), float("nan"), -120.0, 0.0, 1e9, None])
def test_a_rate_that_no_system_has_is_unknown(rate):
    assert heading("qtm", LABELS, rate, "mm", None, "+z").rate_hz is None


def test_the_report_of_skipped_packets_stays_short():
    skipped = Skipped()
    for k in range(1000):
        skipped.add(f"packets from 10.0.0.{k}")
    assert skipped.total == 1000 and str(skipped).count(",") == MAX_REASONS


def started(server):
    from habitus.io.streams.qtm import Qtm

    first = threading.Thread(target=server.send_frames, args=([qtm_frame(0, POINTS)],))
    first.start()
    source = Qtm(server.address)
    first.join()
    assert len(take(source, 1)) == 1
    return source


def test_qtm_goes_on_whatever_the_program_sends():
    pytest.importorskip("qtm_rt")
    hostile = [
        (77, b"of no type"),
        (5, b"a C3D file"),
        (EVENT, b"\xc8"),
        (EVENT, b""),
        (DATA, b"short"),
        (DATA, struct.pack("<qII", 1, 1, 2**32 - 1) + struct.pack("<II", 0, 1)),
        (
            DATA,
            struct.pack("<qII", 1, 1, 1) + struct.pack("<II", 16, 1) + struct.pack("<Ihh", 9, 0, 0),
        ),
        (DATA, struct.pack("<qII", 1, 1, 0)),
    ]
    with QtmServer(LABELS) as server:
        source = started(server)
        for kind, payload in hostile:
            server.send(kind, payload)
        server.send_frames([qtm_frame(5, POINTS)])
        assert take(source, 1)[0].number == 5
        assert source.skipped.total == len(hostile)
        server.client.sendall(struct.pack("<II", 0, 3))  # a packet of no size: no length is known
        while source.skipped.total == len(hostile):
            source.poll(0.01)
        server.send_frames([qtm_frame(6, POINTS)])
        assert take(source, 1)[0].number == 6 and not source.ended
        source.close()
    assert "impossible size" in str(source.skipped) and "unknown type" in str(source.skipped)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 12), st.binary(max_size=60)), max_size=8), st.data())
def test_qtms_protocol_reads_random_bytes(sent, data):
    pytest.importorskip("qtm_rt")
    from habitus.io.streams.qtm import _checked_protocol

    skipped = Skipped()
    protocol = _checked_protocol(skipped.add)(loop=object())
    stream = b"".join(struct.pack("<II", 8 + len(body), kind) + body for kind, body in sent)
    stream += data.draw(st.binary(max_size=40))
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        protocol.data_received(stream[:size])
        stream = stream[size:]
