"""The panels of `habitus view` in the browser, by viser: a body with sliders, a motion, a mesh or a
cloud of points.

A panel owns its part of the page: it adds shapes below a node of the scene and controls to a folder
of the side bar, and redraws what a control changes.
"""

import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.report.shell import measurement_text
from habitus.rotations import up_rotation

MAX_BETAS = 10
"""Shape coefficients that have a slider."""
MAX_BETA = 4.0
"""Range of these, in standard deviations."""
MAX_DEGREES = 180.0
"""Range of the sliders of a joint's rotation vector."""
SKIN = (199, 148, 120)
SCAN = (150, 160, 172)
JOINT = (40, 110, 200)
LANDMARK = (220, 90, 30)
NAMED = (20, 20, 20)
MEASURED = {
    "height": "height_m",
    "mass": "mass_kg",
    "chest": "chest_circumference_m",
    "waist": "waist_circumference_m",
    "hip": "hip_circumference_m",
    "inseam": "inseam_m",
}
NO_JOINT = "(none)"
_FPS = 30.0


class BodyPanel:
    """A body model with sliders: shape, the rotation of any joint, names of joints and landmarks,
    measurements.
    """

    def __init__(self, server: Any, body: BodyModel, node: str):
        self._server = server
        self._body = body
        self._node = node
        self._drawing = threading.Lock()
        self._pose = np.zeros((body.num_joints, 3))
        with server.gui.add_folder(body.name):
            self._text = server.gui.add_markdown("")
            self.betas = [
                server.gui.add_slider(f"beta {k + 1}", -MAX_BETA, MAX_BETA, 0.05, 0.0)
                for k in range(min(MAX_BETAS, body.num_betas))
            ]
            self.joint = server.gui.add_dropdown("joint", tuple(body.joint_names))
            self.turn = [
                server.gui.add_slider(axis, -MAX_DEGREES, MAX_DEGREES, 1.0, 0.0) for axis in "xyz"
            ]
            self.joints = server.gui.add_checkbox("joints", False)
            self.landmarks = server.gui.add_checkbox(
                "landmarks", False, disabled=not body.landmarks
            )
            self.named = server.gui.add_dropdown(
                "name", (NO_JOINT, *body.joint_names, *(body.landmarks or {}))
            )
            self.rest = server.gui.add_button("at rest")
        for slider in (*self.betas, self.joints, self.landmarks, self.named):
            slider.on_update(lambda _: self.draw())
        for slider in self.turn:
            slider.on_update(lambda _: self._on_turn())
        self.joint.on_update(lambda _: self._on_joint())
        self.rest.on_click(lambda _: self._on_rest())
        self._skin = server.scene.add_mesh_simple(
            f"{node}/skin", self._surface().vertices, body.faces, color=SKIN
        )
        self.draw()

    @property
    def pose(self) -> Float[np.ndarray, "J 3"]:
        """The pose shown, rotation vectors in rad."""
        return self._pose.copy()

    def draw(self) -> None:
        """Redraw surface, names and measurements for the values of the sliders."""
        with self._drawing, self._server.atomic():
            surface = self._surface()
            self._skin.vertices = surface.vertices.astype(np.float32)
            values = self._body.measure(self._betas())
            self._text.content = "  \n".join(
                f"{word} {measurement_text(name, values[name])}"
                for word, name in MEASURED.items()
                if name in values
            )
            marks = self._body.landmarks or {}
            landmarks = (
                surface.vertices[np.array([*marks.values()], int)] if marks else np.zeros((0, 3))
            )
            self._dots("joints", surface.joints, JOINT, self.joints.value)
            self._dots("landmarks", landmarks, LANDMARK, self.landmarks.value)
            self._name(
                {
                    **dict(zip(self._body.joint_names, surface.joints, strict=True)),
                    **dict(zip(marks, landmarks, strict=True)),
                }
            )

    def _betas(self) -> Float[np.ndarray, " B"]:
        betas = np.zeros(self._body.num_betas)
        betas[: len(self.betas)] = [slider.value for slider in self.betas]
        return betas

    def _surface(self) -> Any:
        return self._body(self._betas(), self._pose)

    def _on_turn(self) -> None:
        joint = self._body.joint_names.index(self.joint.value)
        self._pose[joint] = np.deg2rad([slider.value for slider in self.turn])
        self.draw()

    def _on_joint(self) -> None:
        """Move the sliders to the rotation of the selected joint."""
        joint = self._body.joint_names.index(self.joint.value)
        for slider, radians in zip(self.turn, self._pose[joint].copy(), strict=True):
            slider.value = float(np.round(np.rad2deg(radians), 3))

    def _on_rest(self) -> None:
        self._pose[:] = 0.0
        for slider in (*self.betas, *self.turn):
            slider.value = 0.0
        self.draw()

    def _dots(
        self, kind: str, points: Float[np.ndarray, "N 3"], colour: tuple, visible: bool
    ) -> None:
        _cloud(
            self._server, f"{self._node}/{kind}", points if visible else points[:0], colour, 0.012
        )

    def _name(self, points: Mapping[str, Float[np.ndarray, " 3"]]) -> None:
        """Show the name of the selected point; all names at once would hide the body."""
        point = points.get(self.named.value)
        self._server.scene.add_label(
            f"{self._node}/name",
            "" if point is None else self.named.value,
            position=(0, 0, 0) if point is None else tuple(point),
            visible=point is not None,
        )
        if point is not None:
            _cloud(self._server, f"{self._node}/named", point[None], NAMED, 0.02)
        else:
            self._server.scene.remove_by_name(f"{self._node}/named")


class MotionPanel:
    """A body in motion: a frame on a slider, or playback at the recorded rate."""

    def __init__(
        self,
        server: Any,
        motion: Moving,
        node: str,
        markers: Float[np.ndarray, "T M 3"] | None = None,
    ):
        self._server = server
        self._motion = motion
        self._node = node
        self._turn = up_rotation(motion.up_axis)
        self._markers = markers
        self._origin = self._turn @ motion.joints(0)[0] * [1.0, 0.0, 1.0]
        self._share = 0.0
        with server.gui.add_folder(motion.capture_name):
            self.frame = server.gui.add_slider("frame", 0, max(1, motion.num_frames - 1), 1, 0)
            self.playing = server.gui.add_checkbox("play", False)
            self.speed = server.gui.add_dropdown("speed", ("1", "0.5", "0.25", "0.1"))
            self.shown = server.gui.add_checkbox(
                "markers", markers is not None, disabled=markers is None
            )
        self._skin = server.scene.add_mesh_simple(
            f"{node}/skin", self._at(0), motion.body.faces, color=SKIN
        )
        self.frame.on_update(lambda _: self.draw())
        self.shown.on_update(lambda _: self.draw())
        self._last = time.perf_counter()
        self.draw()

    def draw(self) -> None:
        """Redraw the body at the slider's frame."""
        with self._server.atomic():
            self._skin.vertices = self._at(self.frame.value)
            if self._markers is None:
                return
            seen = self._markers[min(self.frame.value, len(self._markers) - 1)]
            seen = seen[np.isfinite(seen[:, 0])] if self.shown.value else np.zeros((0, 3))
            _cloud(self._server, f"{self._node}/markers", self._placed(seen), LANDMARK, 0.02)

    def tick(self) -> None:
        """Advance playback by the time that has passed; frames are skipped rather than delayed."""
        now = time.perf_counter()
        passed = now - self._last
        self._last = now
        if self.playing.value:
            on = passed * self._motion.rate_hz * float(self.speed.value)
            step, self._share = divmod(self._share + on, 1.0)
            self.frame.value = int(self.frame.value + step) % self._motion.num_frames

    def _at(self, frame: int) -> Float[np.ndarray, "V 3"]:
        return self._placed(self._motion.vertices(int(frame))).astype(np.float32)

    def _placed(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Points with y up, and the motion's first position at the node's origin."""
        return points @ self._turn.T - self._origin


class MeshPanel:
    """A mesh, or a cloud of points where there are no triangles; y up, metres."""

    def __init__(
        self,
        server: Any,
        name: str,
        points: Float[np.ndarray, "N 3"],
        faces: Int[np.ndarray, "F 3"] | None,
        node: str,
    ):
        with server.gui.add_folder(name):
            server.gui.add_markdown(
                f"{len(points):,} points"
                + (f", {len(faces):,} triangles" if faces is not None else "")
            )
            self.shown = server.gui.add_checkbox("show", True)
        vertices = points.astype(np.float32)
        if faces is not None:
            self._shape = server.scene.add_mesh_simple(
                f"{node}/mesh", vertices, faces, color=SCAN, side="double"
            )
        else:
            self._shape = _cloud(server, f"{node}/points", vertices, SCAN, 0.004)
        self.shown.on_update(lambda _: setattr(self._shape, "visible", self.shown.value))


def _cloud(
    server: Any, node: str, points: Float[np.ndarray, "N 3"], colour: tuple, size: float
) -> Any:
    colours = np.tile(np.array(colour, np.uint8), (len(points), 1))
    return server.scene.add_point_cloud(
        node,
        points.astype(np.float32),
        colours,
        point_size=size,
        point_shape="circle",
        precision="float32",
    )


def studio(server: Any) -> None:
    """A floor, y up, and a camera in front."""
    server.scene.set_up_direction("+y")
    server.scene.add_grid("/floor", 8.0, 8.0, plane="xz", cell_size=0.5, infinite_grid=True)
    server.gui.configure_theme(control_layout="collapsible", show_logo=False)
    camera = server.initial_camera
    camera.fov = 0.75
    camera.look_at = (0.0, 0.9, 0.0)
    camera.position = (0.8, 1.4, 3.6)


def play(panels: list[Any], stop: threading.Event) -> None:
    """Advance the motions until ``stop`` is set."""
    while not stop.wait(1.0 / _FPS):
        for panel in panels:
            if isinstance(panel, MotionPanel):
                panel.tick()
