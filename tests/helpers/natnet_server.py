"""A server that speaks NatNet on loopback, and packets as Motive makes them (bitstream 3.0 and
4.1).
"""

import socket
import struct
import threading
import time

import numpy as np

CONNECT = 0
SERVER_INFO = 1
REQUEST = 2
RESPONSE = 3
REQUEST_MODEL = 4
MODEL = 5
FRAME = 7
MODEL_ID = 3


def packet(kind, payload=b""):
    return struct.pack("<HH", kind, len(payload)) + payload


def server_info(version=(3, 0), port=1511, group=None):
    tail = struct.pack(
        "<QHB4B", 10_000_000, port, group is not None, *map(int, (group or "0.0.0.0").split("."))
    )
    return packet(
        SERVER_INFO,
        b"Motive".ljust(256, b"\0") + bytes((2, 1, 0, 0)) + bytes((*version, 0, 0)) + tail,
    )


def text(words):
    return words.encode() + b"\0"


def bone(name, id_, version):
    names = text("a") + text("b") if version >= (4, 0) else b""
    turn = struct.pack("<4f", 0, 0, 0, 1) if version >= (4, 2) else b""
    return (
        text(name)
        + struct.pack("<2i3f", id_, -1, 0, 0, 0)
        + turn
        + struct.pack("<i8i", 2, *range(8))
        + names
    )


def force_plate():
    numbers = struct.pack("<161f", *[0.5] * 161)
    return (
        struct.pack("<i", 1) + text("plate 1") + numbers + struct.pack("<3i", 0, 0, 1) + text("Fz")
    )


def model(name, labels, version=(3, 0)):
    """A marker set, a force plate, and the skeleton whose id its markers have."""
    parts = [
        (0, text(name) + struct.pack("<i", len(labels)) + b"".join(map(text, labels))),
        (
            0,
            text("all")
            + struct.pack("<i", len(labels))
            + b"".join(text(f"{name}_{x}") for x in labels),
        ),
        (3, force_plate()),
        (2, text(name) + struct.pack("<2i", MODEL_ID, 1) + bone("Hip", 1, version)),
    ]
    if version >= (4, 1):
        parts.insert(1, (9, b"something that is not known yet"))
        body = b"".join(struct.pack("<2i", kind, len(data)) + data for kind, data in parts)
    else:
        body = b"".join(struct.pack("<i", kind) + data for kind, data in parts)
    return packet(MODEL, struct.pack("<i", len(parts)) + body)


def frame(number, points, name, version=(3, 0), changed=False):
    """A frame of a skeleton's markers (P, 3), NaN where occluded: there the program fills in a
    place of its own.
    """
    section = (lambda n, data: struct.pack("<2i", n, len(data)) + data) if version >= (4, 1) else (
        lambda n, data: struct.pack("<i", n) + data
    )  # fmt: skip
    gone = np.isnan(points[:, 0])
    filled = np.where(gone[:, None], 9.0, points).astype("<f4")
    sets = text(name) + struct.pack("<i", len(points)) + filled.tobytes()
    joints = struct.pack("<i8fH", 1, *[0.0] * 7, 0.1, 1)
    marked = b"".join(
        struct.pack(
            "<I3ffHf", MODEL_ID << 16 | k + 1, *place, 0.014, 0x0B if hidden else 0x0A, 0.001
        )
        for k, (place, hidden) in enumerate(zip(filled, gone, strict=True))
    ) + struct.pack("<I3ffHf", 50_007, 1, 1, 1, 0.01, 0x12, 0.0)
    device = struct.pack("<3i2f", 1, 1, 2, 0.5, 0.5)
    body = [
        section(1, sets),
        section(1, struct.pack("<3f", 1, 1, 1)),
        section(1, joints),
        section(1, struct.pack("<2i", MODEL_ID, 2) + joints * 2),
        section(1, struct.pack("<2i", 8, 0) + struct.pack("<i", 0)) if version >= (4, 1) else b"",
        section(len(points) + 1, marked),
        section(1, device),
        section(0, b""),
    ]
    stamp = struct.pack("<2id3Q", 0, 0, number / 120, 0, 0, 0) + (
        b"\0" * 8 if version >= (4, 1) else b""
    )
    return packet(
        FRAME,
        struct.pack("<i", number) + b"".join(body) + stamp + struct.pack("<Hi", 2 * changed, 0),
    )


class NatNetServer:
    """Answers a client (unicast) and sends it packets at a rate; ``model`` may be changed in
    between.
    """

    def __init__(self, model_packet, version=(3, 0), rate_hz=120.0, answers=None, info=None):
        self.model = model_packet
        self.version = version
        self.rate_hz = rate_hz
        self.answers = {"FrameRate": struct.pack("<f", rate_hz), "UpAxis": struct.pack("<i", 1)} | (
            answers or {}
        )
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.socket.getsockname()[1]}"
        self.client = None
        self.asked = []
        self.info = info or server_info(version)
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def _answer(self):
        while True:
            try:
                data, client = self.socket.recvfrom(4096)
            except OSError:
                return
            kind = struct.unpack_from("<H", data)[0]
            self.asked.append(kind)
            if kind == CONNECT:
                self.client = client
                self.socket.sendto(self.info, client)
            elif kind == REQUEST_MODEL:
                self.socket.sendto(self.model, client)
            elif kind == REQUEST:
                found = self.answers.get(data[4:].split(b"\0")[0].decode())
                self.socket.sendto(
                    packet(100) if found is None else packet(RESPONSE, found), client
                )

    def send(self, packets, paced=True):
        began = time.perf_counter()
        for k, each in enumerate(packets):
            if paced:
                time.sleep(max(0.0, began + k / self.rate_hz - time.perf_counter()))
            self.socket.sendto(each, self.client)

    def close(self):
        self.socket.close()
        self._thread.join(0.1)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
