"""A server that speaks QTM's real-time protocol on loopback: parameters, frames of labelled
markers, events.
"""

import socket
import struct
import threading
import time

import numpy as np

COMMAND = 1
XML = 2
DATA = 3
EVENT = 6
SETTINGS_CHANGED = 11
SHUTTING_DOWN = 12


def packet(kind, payload):
    return struct.pack("<II", 8 + len(payload), kind) + payload


def parameters(labels, rate_hz, up="+Z"):
    names = "".join(f"<Label><Name>{x}</Name><RGBColor>65280</RGBColor></Label>" for x in labels)
    three = f"<The_3D><AxisUpwards>{up}</AxisUpwards><Labels>{len(labels)}</Labels>{names}</The_3D>"
    general = f"<General><Frequency>{rate_hz:g}</Frequency></General>"
    return (
        f'<?xml version="1.0"?><QTM_Parameters_Ver_1.20>{general}{three}</QTM_Parameters_Ver_1.20>'
    )


def frame(number, points):
    """points (P, 3) in mm, NaN where missing."""
    markers = struct.pack("<IHH", len(points), 0, 0) + np.asarray(points, "<f4").tobytes()
    component = struct.pack("<II", 8 + len(markers), 1) + markers
    return packet(DATA, struct.pack("<qII", number * 8333, number, 1) + component)


class QtmServer:
    """Serves one client; ``labels`` may be changed in between."""

    def __init__(self, labels, rate_hz=120.0):
        self.labels = labels
        self.rate_hz = rate_hz
        self.commands = []
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listening.getsockname()[1]}"
        self.streaming = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self):
        self.client, _ = self.listening.accept()
        self.send(COMMAND, b"QTM RT Interface connected\0")
        data = b""
        while True:
            try:
                received = self.client.recv(4096)
            except OSError:
                return
            if not received:
                return
            data += received
            while len(data) >= 8 and len(data) >= (size := struct.unpack_from("<I", data)[0]):
                self._answer(data[8 : size - 1].decode())
                data = data[size:]

    def _answer(self, command):
        self.commands.append(command)
        word = command.split()[0].lower()
        if word == "version":
            self.send(COMMAND, f"Version set to {command.split()[1]}\0".encode())
        elif word == "getparameters":
            self.send(XML, parameters(self.labels, self.rate_hz).encode() + b"\0")
        elif word == "streamframes":
            self.streaming.set()

    def send(self, kind, payload):
        self.client.sendall(packet(kind, payload))

    def event(self, number):
        self.send(EVENT, bytes([number]))

    def send_frames(self, frames, paced=False):
        assert self.streaming.wait(5.0)
        began = time.perf_counter()
        for k, each in enumerate(frames):
            if paced:
                time.sleep(max(0.0, began + k / self.rate_hz - time.perf_counter()))
            self.client.sendall(each)

    def close(self):
        for one in (self.listening, getattr(self, "client", None)):
            if one is not None:
                one.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def take(source, count):
    """The frames of a source, once there are so many."""
    frames = []
    for _ in range(100):
        frames += source.poll(0.1)
        if len(frames) >= count:
            break
    return frames
