"""The viewer of a live fit: body, markers and quality in the browser, by viser, in a process of its
own, whose drawing never delays the solver. The two share a `Board`, which holds the latest frame
alone, so that neither waits for the other.
"""

import logging
import os
import signal
import sys
import time
from collections.abc import Mapping
from multiprocessing.context import SpawnContext
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prepared import PreparedBody
from habitus.report.page_server import PageServer

MAX_TEXT = 1024
"""Bytes of the text beside the picture."""
READS = 20
"""Attempts to read a frame that is not being written at that moment."""
FRAMES_HZ = 25.0
NEEDED = (
    "name",
    "v_template",
    "shapedirs",
    "posedirs",
    "joint_regressor",
    "skinning_index",
    "skinning_value",
    "parents",
    "faces",
    "joint_names",
    "skinning",
    "pose_features",
    "shape_features",
    "pose_joints",
    "hinges",
)
"""Fields of a body that its surface depends on, which the viewer gets."""
_SKIN = (196, 202, 212)
_MARKER = np.array([255, 138, 20])
_MARKER_OFF = np.array([220, 20, 60])
_MAX_DISTANCE = 0.06
"""Metres from the body at which a marker has the full colour of _MARKER_OFF."""
TEXT_S = 0.25
"""Seconds between two updates of the text: faster ones cannot be read."""
_PLANES = {"x": "yz", "y": "xz", "z": "xy"}
_MARKER_SIZE = 0.02
"""Metres."""
_FIELD_OF_VIEW = 0.75
"""Radians."""
_EYE_LEVEL = 0.9
"""Metres: height of the point that the camera looks at."""
_FOLLOW_RATE = 0.1
"""Share of the distance to the body that the world moves in a frame."""


class Shown(NamedTuple):
    """A frame: pose (J, 3) rad, trans (3,) m, markers (N, 3) m, their distances from the body (N,)
    m, and a text in Markdown. NaN where the body or a marker is not visible.
    """

    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    markers: Float[np.ndarray, "N 3"]
    distances: Float[np.ndarray, " N"]
    text: str


class Board:
    """The latest frame in shared memory, for a writer and a reader in different processes.

    A counter is odd while a frame is written: a read is valid where the counter is even and the
    same before and after (a sequence lock). ``port`` is the viewer's, 0 until it serves; ``stop``
    asks it to end.
    """

    def __init__(self, context: SpawnContext, joints: int, markers: int):
        self.joints = joints
        self.markers = markers
        self._count = context.RawArray("q", 3)
        self._numbers = context.RawArray("d", 3 * joints + 3 + 4 * markers)
        self._text: Any = context.RawArray("c", MAX_TEXT)

    @property
    def port(self) -> int:
        """Of the viewer's page; 0 until it serves."""
        return self._count[1]

    @port.setter
    def port(self, port: int) -> None:
        self._count[1] = port

    @property
    def stop(self) -> bool:
        """Asks the viewer to end."""
        return bool(self._count[2])

    @stop.setter
    def stop(self, stop: bool) -> None:
        self._count[2] = stop

    @property
    def count(self) -> int:
        """Number of frames written."""
        return self._count[0] // 2

    def write(self, shown: Shown) -> None:
        """Replace the frame; takes microseconds."""
        self._count[0] += 1
        np.frombuffer(self._numbers)[:] = np.concatenate([np.ravel(part) for part in shown[:4]])
        self._text.value = shown.text.encode()[: MAX_TEXT - 1]
        self._count[0] += 1

    def read(self) -> Shown | None:
        """The latest frame; None before there is one, or where all READS met a write."""
        for _ in range(READS):
            before = self._count[0]
            numbers = np.frombuffer(self._numbers).copy()
            text = self._text.value
            if before and before % 2 == 0 and self._count[0] == before:
                ends = np.cumsum([3 * self.joints, 3, 3 * self.markers])
                pose, trans, markers, distances = np.split(numbers, ends)
                return Shown(
                    pose.reshape(-1, 3),
                    trans,
                    markers.reshape(-1, 3),
                    distances,
                    text.decode("utf-8", "ignore"),
                )
        return None


def serve(
    board: Board,
    fields: Mapping[str, Any],
    betas: Float[np.ndarray, " B"],
    up_axis: str,
    port: int,
    token: str,
) -> None:
    """Serve the page, at an address with a token, until ``board.stop``, or until the parent process
    has ended.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the solver handles Ctrl-C
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - the caller prints the page's address
    if hasattr(os, "nice"):
        os.nice(5)
    logging.disable(logging.CRITICAL)  # a browser that disconnects is not an error
    body = BodyModel(**fields).prepare(betas)
    parent = os.getppid()
    server = PageServer(port, "habitus live", token)
    scene = _Scene(server.viser, body, fields["faces"], up_axis)
    board.port = server.port
    count = 0
    while not board.stop and os.getppid() == parent:
        began = time.perf_counter()
        if board.count != count and (shown := board.read()) is not None:
            count = board.count
            scene.show(shown)
        time.sleep(max(0.002, 1.0 / FRAMES_HZ - (time.perf_counter() - began)))
    server.stop()


class _Scene:
    """The shapes and controls of the page."""

    def __init__(
        self, server: Any, body: PreparedBody, faces: Int[np.ndarray, "F 3"], up_axis: str
    ):
        self._server = server
        self._body = body
        self._faces = faces
        self._text_time = 0.0
        self._up = np.zeros(3)
        self._up["xyz".index(up_axis[-1])] = -1.0 if up_axis.startswith("-") else 1.0
        server.scene.set_up_direction(tuple(self._up))
        self._world = server.scene.add_frame("/world", show_axes=False)
        server.scene.add_grid(
            "/world/floor", 8.0, 8.0, plane=_PLANES[up_axis[-1]], cell_size=0.5, infinite_grid=True
        )
        server.gui.configure_theme(control_layout="collapsible", show_logo=False)
        self._text = server.gui.add_markdown("waiting for frames")
        self._follows = server.gui.add_checkbox("follow the body", True)
        self._skin = None
        self._middle = np.zeros(3)

    def show(self, shown: Shown) -> None:
        """The latest frame."""
        with self._server.atomic():
            self._show_markers(shown.markers, shown.distances)
            self._show_body(shown)
        if time.perf_counter() - self._text_time > TEXT_S:
            self._text_time = time.perf_counter()
            self._text.content = shown.text

    def _show_body(self, shown: Shown) -> None:
        is_visible = bool(np.isfinite(shown.trans).all())
        if is_visible:
            vertices = self._body(shown.pose, shown.trans).vertices.astype(np.float32)
            if self._skin is None:
                self._skin = self._server.scene.add_mesh_simple(
                    "/world/body", vertices, self._faces, color=_SKIN
                )
                self._look_at(vertices)
            else:
                self._skin.vertices = vertices
                self._follow_body(shown.trans)
        if self._skin is not None and self._skin.visible != is_visible:
            self._skin.visible = is_visible

    def _show_markers(self, markers: np.ndarray, distances: np.ndarray) -> None:
        seen = np.isfinite(markers[:, 0])
        share = np.clip(np.nan_to_num(distances[seen]) / _MAX_DISTANCE, 0, 1)[:, None]
        colours = ((1 - share) * _MARKER + share * _MARKER_OFF).astype(np.uint8)
        self._server.scene.add_point_cloud(
            "/world/markers",
            markers[seen].astype(np.float32),
            colours,
            point_size=_MARKER_SIZE,
            point_shape="circle",
            precision="float32",
        )

    def _follow_body(self, position: Float[np.ndarray, " 3"]) -> None:
        """Move the world, so that the camera stays as the user has turned it."""
        if self._follows.value:
            level = position - (position @ self._up) * self._up
            self._middle += _FOLLOW_RATE * (level - self._middle)
            self._world.position = tuple(-self._middle)

    def _look_at(self, vertices: np.ndarray) -> None:
        """Place the camera some metres away and a little above."""
        middle = vertices.mean(axis=0)
        self._middle = middle - (middle @ self._up) * self._up
        self._world.position, camera = tuple(-self._middle), self._server.initial_camera
        camera.fov = _FIELD_OF_VIEW
        camera.look_at = tuple(_EYE_LEVEL * self._up)
        camera.position = tuple(
            3.2 * np.roll(self._up, 1) + 1.6 * np.roll(self._up, 2) + (_EYE_LEVEL + 0.5) * self._up
        )
