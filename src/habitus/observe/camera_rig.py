"""Calibrated cameras that see one scene: pinholes with OpenCV's lens distortion, in NumPy.

A point X of the world is p = R X + t in a camera's frame (x right, y down, z forward), and its
pixel u = f p_xy / p_z + c once the lens is taken out (`RigCamera.ideal`). Pixel centres lie at
halves; OpenCV's and detectors' numbers are half a pixel less, which readers add.
`habitus.observe.camera.Camera` is the differentiable camera of images.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError, listed

NEAR = 0.1
"""Metres: nothing nearer to a camera counts."""
_ITERATIONS = 20
_CLOSE = 1e-10
"""In the plane at unit depth: no further step is needed."""


@dataclass(frozen=True, eq=False)
class RigCamera:
    """One camera. ``focal`` and ``centre`` (x, y) in pixels, ``rotation`` (3, 3) from world to
    camera, ``translation`` in metres, ``distortion`` OpenCV's k1 k2 p1 p2 k3 k4 k5 k6.
    """

    name: str
    width: int
    height: int
    focal: Float[np.ndarray, "2"]
    centre: Float[np.ndarray, "2"]
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    distortion: Float[np.ndarray, "8"]

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """Where the camera is (m)."""
        return -self.rotation.T @ self.translation

    def project(self, points: Float[np.ndarray, "*any 3"]) -> Float[np.ndarray, "*any 2"]:
        """Pixels of points (m), distorted as in the images; NaN behind the camera."""
        there = points @ self.rotation.T + self.translation
        depth = np.where(there[..., 2:] > NEAR, there[..., 2:], np.nan)
        return self.focal * _distorted(there[..., :2] / depth, self.distortion) + self.centre

    def ideal(self, pixels: Float[np.ndarray, "*any 2"]) -> Float[np.ndarray, "*any 2"]:
        """Pixels as the same camera without distortion would have them; NaN where the lens has no
        inverse.
        """
        if not self.distortion.any():
            return np.asarray(pixels, float)
        target = (pixels - self.centre) / self.focal
        plane = target.copy()
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):  # fixed point: distortion of a plane's middle is small
                step = target - _distorted(plane, self.distortion)
                plane = plane + step
                if not (np.abs(step) > _CLOSE).any():
                    break
            off = np.linalg.norm(_distorted(plane, self.distortion) - target, axis=-1)
        plane[~(off < 1e-6)] = np.nan
        return self.focal * plane + self.centre

    def distorted(self, pixels: Float[np.ndarray, "*any 2"]) -> Float[np.ndarray, "*any 2"]:
        """Pixels in the images of those that the camera would have without distortion."""
        return self.focal * _distorted((pixels - self.centre) / self.focal, self.distortion) + (
            self.centre
        )

    def moved(self, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> "RigCamera":
        """The camera after a turn and a shift (m) in its own frame: p becomes ``turn`` p +
        ``shift``.
        """
        return replace(
            self, rotation=turn @ self.rotation, translation=turn @ self.translation + shift
        )


def _distorted(plane: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    x, y = plane[..., 0], plane[..., 1]
    s = x * x + y * y
    radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )


@dataclass(frozen=True, eq=False)
class CameraRig:
    """Cameras in one world (m), and what was noticed while they were read."""

    cameras: tuple[RigCamera, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.cameras:
            raise HabitusError("the rig has no camera; expected one at least")
        names = self.names
        if len(set(names)) < len(names):
            raise HabitusError(f"cameras share a name: {listed(names)}; expected names that differ")

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cameras."""
        return tuple(camera.name for camera in self.cameras)

    @property
    def places(self) -> Float[np.ndarray, "C 3"]:
        """Where the cameras are (m)."""
        return np.stack([camera.place for camera in self.cameras])

    @property
    def focal(self) -> Float[np.ndarray, "C 2"]:
        """Focal lengths (px)."""
        return np.stack([camera.focal for camera in self.cameras])

    @property
    def centre(self) -> Float[np.ndarray, "C 2"]:
        """Principal points (px)."""
        return np.stack([camera.centre for camera in self.cameras])

    @property
    def rotation(self) -> Float[np.ndarray, "C 3 3"]:
        """From the world to the cameras."""
        return np.stack([camera.rotation for camera in self.cameras])

    @property
    def translation(self) -> Float[np.ndarray, "C 3"]:
        """Metres."""
        return np.stack([camera.translation for camera in self.cameras])

    def project(self, points: Float[np.ndarray, "*any 3"]) -> Float[np.ndarray, "C *any 2"]:
        """Ideal pixels of points (m) in all cameras, without distortion; NaN behind one."""
        there = np.einsum("cij,...j->c...i", self.rotation, points)
        shape = (len(self.cameras), *[1] * (points.ndim - 1))
        there = there + self.translation.reshape(*shape, 3)
        depth = np.where(there[..., 2:] > NEAR, there[..., 2:], np.nan)
        return self.focal.reshape(*shape, 2) * there[..., :2] / depth + self.centre.reshape(
            *shape, 2
        )

    def ideal(self, pixels: Float[np.ndarray, "C *any 2"]) -> Float[np.ndarray, "C *any 2"]:
        """`RigCamera.ideal` of each camera's pixels."""
        return np.stack(
            [camera.ideal(own) for camera, own in zip(self.cameras, pixels, strict=True)]
        )
