"""`habitus live` on a real capture and on NatNet packets made of it, hostile ones between them:
lines, messages sent on, the result.
"""

import socket
import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from natnet_server import NatNetServer, frame, model, packet
from real_fit import real_fit

import habitus as hb
from habitus.cli.main import main

SHARED = Path(__file__).resolve().parents[3] / "shared"
CAPTURE = SHARED / "mocap" / "85_02.c3d"
pytestmark = pytest.mark.skipif(not CAPTURE.exists(), reason="no ../shared/mocap here")


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    folder = tmp_path_factory.mktemp("subject")
    fit, _ = real_fit(SHARED, folder)
    fit.export(folder / "body.npz")
    return folder / "body.npz"


def test_packets_become_poses_and_messages_and_a_result(subject, tmp_path, capsys):
    capture = hb.read_capture(CAPTURE)
    with (
        NatNetServer(model("Bob", capture.labels), rate_hz=120.0) as server,
        socket.socket(type=socket.SOCK_DGRAM) as ear,
        socket.socket(type=socket.SOCK_DGRAM) as stranger,
    ):
        try:
            stranger.bind(("127.0.0.2", 0))
        except OSError:
            pytest.skip("this machine's loopback network has one address only")
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(1.0)
        packets = [
            frame(k, markers, "Bob")
            for k, markers in enumerate(capture.markers[:150])
            if not 100 <= k < 104
        ]

        def play():
            while 4 not in server.asked:
                time.sleep(0.01)
            server.send(packets)

        def attack():
            """Sizes below zero, frames and models of somebody else, nonsense from the server."""
            while not server.client or len(server.asked) < 5:
                time.sleep(0.01)
            backward = packet(5, struct.pack("<3i", 2, 9, -100_000).ljust(80, b"\0"))
            elsewhere = frame(10**6, 3.0 + np.nan_to_num(capture.markers[0]), "Bob")
            for k in range(60):
                for hostile in (backward, elsewhere, model("Eve", ("a", "b")), b"", b"\xff" * 99):
                    stranger.sendto(hostile, server.client)
                server.socket.sendto(
                    (packet(5, b"\xff" * 80), packet(7, b"\xff" * 50))[k % 2], server.client
                )
                time.sleep(0.02)

        threading.Thread(target=attack, daemon=True).start()
        playing = threading.Thread(target=play, daemon=True)
        playing.start()
        words = [
            "live",
            "--source",
            "natnet",
            server.address,
            "--known",
            str(subject),
            "--stop-after",
            "4",
        ]
        main(
            [
                *words,
                "--out",
                str(tmp_path / "take.npz"),
                "--send",
                f"vmc=127.0.0.1:{ear.getsockname()[1]}",
            ]
        )
        first = ear.recv(2000)
    said = capsys.readouterr().out
    fit = hb.load_fit(tmp_path / "take.npz")
    assert first.startswith(b"#bundle\0") and b"/VMC/Ext/OK" in first
    assert "41 markers (cmu-41)" in said and "wrote" in said and "as saved" in said
    assert fit.num_frames == 150 and fit.rate_hz == 120.0 and fit.up_axis == capture.up_axis
    assert fit.flagged_frames[100:104].all() and any(
        "4 frames lost on the way" in warning for warning in fit.warnings
    )
    (skipped,) = (warning for warning in fit.warnings if "skipped" in warning)
    assert "300 packets from 127.0.0.2, which is not the server" in skipped
    assert "truncated" in skipped
    seen = np.isfinite(fit.errors_mm)
    assert fit.errors_mm[seen].mean() < 30 and fit.errors_mm[-5:].max() < 120


def test_what_cannot_be_is_told_in_one_line(subject, tmp_path, capsys):
    wrong = {
        ("--send", "midi"): "expected osc or vmc",
        ("--out", str(tmp_path / "take.fbx")): "expected a name that ends in .npz or .glb",
        ("--known", str(tmp_path / "none.npz")): "no such file",
    }
    for words, told in wrong.items():
        with pytest.raises(SystemExit) as end:
            main(["live", "--source", "replay", str(CAPTURE), *words])
        assert end.value.code == 2 and told in capsys.readouterr().err
