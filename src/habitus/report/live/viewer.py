"""The viewer of a live fit, in a process of its own: body, markers and quality in the browser, by
viser.

It has its own interpreter so that drawing never holds up the solver.
"""

import logging
import os
import signal
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prepared import PreparedBody
from habitus.report.live.board import Board, Shown

HOST = "127.0.0.1"
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
)
"""Fields of a body that its surface needs: what is handed to the viewer."""
_SKIN = (196, 202, 212)
_GOOD = np.array([255, 138, 20])
_FAR = np.array([220, 20, 60])
_FAR_M = 0.06
_TEXT_S = 0.25
_PLANES = {"x": "yz", "y": "xz", "z": "xy"}
_MARKER_M = 0.02
_FOV = 0.75
_HEIGHT = 0.9
_EASE = 0.1


def serve(
    board: Board, fields: Mapping[str, Any], betas: Float[np.ndarray, " B"], up_axis: str, port: int
) -> None:
    """Serve the page until the board says stop, or whoever started this is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the solver's
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - the page's address is told by who asked for it
    if hasattr(os, "nice"):
        os.nice(5)
    import viser

    logging.disable(logging.CRITICAL)  # a browser that leaves is no error
    body = BodyModel(**fields).prepare(betas)
    parent = os.getppid()
    server = viser.ViserServer(HOST, port, label="habitus live", verbose=False)
    scene = _Scene(server, body, fields["faces"], up_axis)
    board.port = server.get_port()
    count = 0
    while not board.stop and os.getppid() == parent:
        began = time.perf_counter()
        if board.count != count and (shown := board.read()) is not None:
            count = board.count
            scene.show(shown)
        time.sleep(max(0.002, 1.0 / FRAMES_HZ - (time.perf_counter() - began)))
    server.stop()


class _Scene:
    """What the page shows."""

    def __init__(
        self, server: Any, body: PreparedBody, faces: Int[np.ndarray, "F 3"], up_axis: str
    ):
        self._server = server
        self._body = body
        self._faces = faces
        self._told = 0.0
        self._up = np.zeros(3)
        self._up["xyz".index(up_axis[-1])] = -1.0 if up_axis.startswith("-") else 1.0
        server.scene.set_up_direction(tuple(self._up))
        self._world = server.scene.add_frame("/world", show_axes=False)
        server.scene.add_grid(
            "/world/floor", 8.0, 8.0, plane=_PLANES[up_axis[-1]], cell_size=0.5, infinite_grid=True
        )
        server.gui.configure_theme(control_layout="collapsible", show_logo=False)
        self._text = server.gui.add_markdown("waiting for frames")
        self._follow = server.gui.add_checkbox("keep in the middle", True)
        self._skin = None
        self._middle = np.zeros(3)

    def show(self, shown: Shown) -> None:
        """The latest frame."""
        with self._server.atomic():
            self._show_markers(shown.markers, shown.distances)
            self._show_body(shown)
        if time.perf_counter() - self._told > _TEXT_S:
            self._told = time.perf_counter()
            self._text.content = shown.text

    def _show_body(self, shown: Shown) -> None:
        there = bool(np.isfinite(shown.trans).all())
        if there:
            vertices = self._body(shown.pose, shown.trans).vertices.astype(np.float32)
            if self._skin is None:
                self._skin = self._server.scene.add_mesh_simple(
                    "/world/body", vertices, self._faces, color=_SKIN
                )
                self._look_at(vertices)
            else:
                self._skin.vertices = vertices
                self._keep_in_the_middle(shown.trans)
        if self._skin is not None and self._skin.visible != there:
            self._skin.visible = there

    def _show_markers(self, markers: np.ndarray, distances: np.ndarray) -> None:
        seen = np.isfinite(markers[:, 0])
        share = np.clip(np.nan_to_num(distances[seen]) / _FAR_M, 0, 1)[:, None]
        colours = ((1 - share) * _GOOD + share * _FAR).astype(np.uint8)
        self._server.scene.add_point_cloud(
            "/world/markers",
            markers[seen].astype(np.float32),
            colours,
            point_size=_MARKER_M,
            point_shape="circle",
            precision="float32",
        )

    def _keep_in_the_middle(self, place: np.ndarray) -> None:
        """The world is moved, and the camera stays as the user has turned it."""
        if self._follow.value:
            level = place - (place @ self._up) * self._up
            self._middle += _EASE * (level - self._middle)
            self._world.position = tuple(-self._middle)

    def _look_at(self, vertices: np.ndarray) -> None:
        """Seen from some metres off, a little from above."""
        middle = vertices.mean(axis=0)
        self._middle = middle - (middle @ self._up) * self._up
        self._world.position, camera = tuple(-self._middle), self._server.initial_camera
        camera.fov = _FOV
        camera.look_at = tuple(_HEIGHT * self._up)
        camera.position = tuple(
            3.2 * np.roll(self._up, 1) + 1.6 * np.roll(self._up, 2) + (_HEIGHT + 0.5) * self._up
        )
