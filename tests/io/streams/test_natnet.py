"""NatNet: real packets of Motive read as the vendor's client read them; a server on loopback, its
faults.
"""

import re
import socket
import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from natnet_server import NatNetServer, frame, model, packet, server_info

from habitus.errors import HabitusError
from habitus.io.streams import natnet_packets as natnet
from habitus.io.streams.natnet import NatNet

REAL = Path(__file__).resolve().parents[4] / "shared" / "natnet"
VERSIONS = pytest.mark.parametrize("version", [(3, 0), (4, 0), (4, 1), (4, 2)])
LABELS = ("LFHD", "RFHD", "C7", "T10")


def real(name):
    if not REAL.exists():
        pytest.skip("no ../shared/natnet here")
    return (REAL / name).read_bytes()


def traffic():
    """UDP payloads of the recorded session, in order."""
    data = real("traffic.pcapng")
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind == 6:
            frame = data[at + 28 : at + 28 + struct.unpack_from("<I", data, at + 20)[0]]
            ip = frame[14:]
            if frame[12:14] == b"\x08\x00" and ip[9] == 17:
                header = 4 * (ip[0] & 15)
                yield ip[header + 8 : header + struct.unpack_from(">H", ip, header + 4)[0]]
        at += size


def test_a_real_server_and_its_model():
    server = natnet.read_server(real("serverinfo_packet_v3.bin"))
    assert server == ("Motive", (3, 0), 1511, "239.255.42.99")
    found = natnet.read_model(real("modeldef_packet_v3.bin"), (3, 0))
    assert found.labels == tuple(f"RaceQuad:Marker{k}" for k in range(1, 6)) and found.ids == {
        2: "RaceQuad"
    }


def test_real_frames_are_what_the_vendors_client_printed():
    found = natnet.read_model(real("modeldef_packet_v3.bin"), (3, 0))
    frames = {}
    for each in traffic():
        if natnet.kind_of(each) == natnet.FRAME:
            one = natnet.read_frame(each, (3, 0), found)
            frames[one.number] = one
    assert len(frames) > 500 and not any(one.changed for one in frames.values())
    printed = real("SampleClient_output_head.txt").decode()
    compared = 0
    for block in printed.split("FrameID : ")[1:-1]:
        one = frames.get(int(block.split()[0]))
        markers = re.findall(
            r"ModelID=2, MarkerID=(\d+), Occluded=0.*pos=([-\d.]+),([-\d.]+),([-\d.]+)\]", block
        )
        if one is not None and markers:
            compared += 1
            for id_, *place in markers:
                np.testing.assert_allclose(
                    one.points[int(id_) - 1], np.array(place, float), atol=0.0051
                )
    assert compared > 5


def test_a_real_marker_that_is_occluded_is_missing_though_the_program_fills_it_in():
    tree = natnet.Model(
        tuple(f"FakeTree:{k}" for k in range(5)), {"FakeTree": (0, 5)}, {7: "FakeTree"}
    )
    found = natnet.read_frame(real("mocapframe_packet_occluded_v3.bin"), (3, 0), tree)
    assert (
        np.isnan(found.points[:2]).all() and np.isfinite(found.points[2:]).all()
    )  # the second fills the first's id
    without = natnet.Model(tree.labels, tree.sets, {})
    assert np.isfinite(
        natnet.read_frame(real("mocapframe_packet_occluded_v3.bin"), (3, 0), without).points
    ).all()


@VERSIONS
def test_what_was_packed_is_read_behind_force_plates_too(version):
    found = natnet.read_model(model("Bob", LABELS, version), version)
    assert found.labels == tuple(f"Bob:{x}" for x in LABELS) and set(found.ids.values()) == {"Bob"}
    points = np.random.default_rng(1).normal(size=(4, 3))
    points[2] = np.nan
    read = natnet.read_frame(frame(77, points, "Bob", version, changed=True), version, found)
    np.testing.assert_allclose(read.points, points, rtol=1e-6)
    assert read.number == 77 and read.changed


@VERSIONS
def test_what_is_cut_off_is_told_and_nothing_else_happens(version):
    whole = [
        frame(1, np.ones((4, 3)), "Bob", version),
        model("Bob", LABELS, version),
        server_info(version),
    ]
    known = natnet.read_model(whole[1], version)
    readers = (
        lambda data: natnet.read_frame(data, version, known),
        lambda data: natnet.read_model(data, version),
        natnet.read_server,
    )
    rng = np.random.default_rng(0)
    for data, read in zip(whole, readers, strict=True):
        for size in range(4, len(data) - 6, 7):
            with pytest.raises(natnet.BadPacket):
                natnet.kind_of(data[:size])
            with pytest.raises(natnet.BadPacket):
                read(data[:size])
        for _ in range(100):
            spoilt = bytearray(data)
            spoilt[rng.integers(4, len(data))] = rng.integers(256)
            with suppress(natnet.BadPacket):
                read(bytes(spoilt))


def take(source, count):
    frames = []
    for _ in range(200):
        frames += source.poll(0.1)
        if len(frames) >= count:
            break
    return frames


def test_frames_arrive_from_a_server():
    points = np.random.default_rng(2).normal(size=(6, 4, 3))
    with NatNetServer(model("Bob", LABELS)) as server:
        source = NatNet(server.address)
        server.send([frame(10 + k, each, "Bob") for k, each in enumerate(points)])
        frames = take(source, 6)
        source.close()
    assert [each.number for each in frames] == list(range(10, 16))
    np.testing.assert_allclose([each.points for each in frames], points, rtol=1e-6)
    head = frames[0].heading
    assert (head.rate_hz, head.unit, head.up_claim, head.labels[0]) == (
        120.0,
        "m",
        "+y",
        "Bob:LFHD",
    )
    assert (
        10 in server.asked and np.diff([each.arrived for each in frames]).min() > 0
    )  # it is kept alive


def test_frames_arrive_by_multicast():
    group = "239.255.42.99"
    points = np.random.default_rng(2).normal(size=(4, 3))
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    with NatNetServer(model("Bob", LABELS), info=server_info((3, 0), port, group)) as server:
        server.socket.setsockopt(
            socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1")
        )
        source = NatNet(server.address)
        server.client = (group, port)
        try:
            server.send([frame(5, points, "Bob")])
        except OSError:
            pytest.skip("no multicast on this machine's loopback")
        found = take(source, 1)
        source.close()
    np.testing.assert_allclose(found[0].points, points, rtol=1e-6)
    assert 10 not in server.asked  # nobody need be kept alive


def test_a_model_that_changes_is_another_heading_and_bad_packets_are_counted():
    with NatNetServer(
        model("Bob", LABELS), answers={"UnitsToMillimeters": struct.pack("<f", 1.0)}
    ) as server:
        source = NatNet(server.address)
        one = frame(1, np.ones((4, 3)), "Bob")
        server.send([one, one[:40], packet(7, b"rubbish"), b"x"])
        before = take(source, 1)
        server.model = model("Ann", LABELS[::-1])
        server.send([frame(2, np.ones((4, 3)), "Bob", changed=True)])
        before += take(source, 1)
        assert np.isnan(
            before[1].points
        ).all()  # which marker is which nobody knows until the answer
        while source.poll(0.05):
            pass
        server.send([frame(3, np.arange(12.0).reshape(4, 3), "Ann")])
        (after,) = take(source, 1)
        source.close()
    assert before[0].heading is before[1].heading is not after.heading and source.skipped.total == 3
    assert (
        after.heading.labels == tuple(f"Ann:{x}" for x in LABELS[::-1])
        and after.heading.unit == "mm"
    )
    np.testing.assert_allclose(after.points, np.arange(12.0).reshape(4, 3))


def test_nobody_there_and_servers_that_will_not_do_are_told(monkeypatch):
    monkeypatch.setattr("habitus.io.streams.natnet.PATIENCE_S", 0.05)
    monkeypatch.setattr(NatNet._asked, "__defaults__", (0.2,))
    with pytest.raises(HabitusError, match="no answer within"):
        NatNet("127.0.0.1:9")
    with pytest.raises(HabitusError, match="no port after its colon"):
        NatNet("127.0.0.1:Motive")
    for version, labels, told in (
        ((2, 9), LABELS, r"speaks NatNet 2\.9"),
        ((3, 0), (), "describes no markers"),
    ):
        with (
            NatNetServer(model("Bob", labels), version) as server,
            pytest.raises(HabitusError, match=told),
        ):
            NatNet(server.address)
