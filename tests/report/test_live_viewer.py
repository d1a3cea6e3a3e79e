"""The live viewer: a board that is never read half written, and a page served by a process of its
own.
"""

import multiprocessing
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from synthetic import synthetic_body

from habitus.report.live import NEEDED, Board, Shown, serve
from habitus.report.page_server import page_address

CONTEXT = multiprocessing.get_context("spawn")


def shown(value, joints=24, markers=5):
    fill = lambda *shape: np.full(shape, float(value))  # noqa: E731
    return Shown(fill(joints, 3), fill(3), fill(markers, 3), fill(markers), f"frame {value}")


def test_a_board_holds_the_latest_frame_and_no_mixture():
    board = Board(CONTEXT, 24, 5)
    assert board.read() is None and board.count == 0
    writing = threading.Thread(target=lambda: [board.write(shown(k)) for k in range(3000)])
    writing.start()
    while writing.is_alive():
        found = board.read()
        if found is not None:
            values = np.concatenate([np.ravel(part) for part in found[:4]])
            assert (values == values[0]).all() and found.text == f"frame {values[0]:.0f}"
    writing.join()
    last = board.read()
    assert (
        last.pose.shape == (24, 3)
        and last.markers.shape == (5, 3)
        and last.text == "frame 2999"
        and board.count == 3000
    )


def test_the_page_is_served_and_ends_when_it_is_told():
    pytest.importorskip("viser")
    body = synthetic_body("smpl")
    board = Board(CONTEXT, body.num_joints, 5)
    told = (
        board,
        {name: getattr(body, name) for name in NEEDED},
        np.zeros(body.num_betas),
        "+z",
        8951,
        "a-token",
    )
    process = CONTEXT.Process(target=serve, args=told, daemon=True)
    process.start()
    until = time.monotonic() + 60
    while not board.port and process.is_alive() and time.monotonic() < until:
        time.sleep(0.02)
    assert board.port
    address = page_address(board.port, "a-token")
    assert b"<html" in urllib.request.urlopen(address, timeout=10).read().lower()
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(f"http://127.0.0.1:{board.port}", timeout=10)
    for value in (0.1, np.nan, 0.2):  # somebody, nobody, somebody
        board.write(shown(value))
        time.sleep(0.15)
        assert process.is_alive()
    board.stop = True
    process.join(20)
    assert process.exitcode == 0
