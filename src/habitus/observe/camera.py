"""Pinhole cameras with lens distortion: OpenCV's model (T 4.3, T 4.4.2), differentiable in
everything.

The camera's frame is OpenCV's: x right, y down, z forward. A point X of the world is R X + t in it.
Its first two coordinates over the third, bent by the lens (`habitus.observe.lens`), times focal
length, plus principal point, are its pixel (u, v).

Pixel (row r, column c) has its centre at (u, v) = (c + 0.5, r + 0.5). OpenCV gives that centre the
number (c, r): its principal points and pixels are half a pixel less.

Also what depth cameras saw of one person: views of depth, colour, an empty room, masks and
keypoints (T 4.6.1).
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from habitus.arrays import broadcast_shapes
from habitus.errors import HabitusError
from habitus.observe.lens import distorted, first_turn, undistorted
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

Numbers: TypeAlias = Tensor | np.ndarray | Sequence | float

_SIZES = {"focal_length": 2, "principal_point": 2, "rotation": 3, "translation": 3, "distortion": 8}


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera, or a batch of cameras of one image size; leading axes broadcast against each
    other and the points'.

    ``focal_length`` and ``principal_point`` are (x, y) in pixels, ``rotation`` is a rotation vector
    from world to camera, ``translation`` is in metres. ``distortion`` is OpenCV's k1 k2 p1 p2 k3 k4
    k5 k6, or None for a lens without any, which is faster; pass zeros to differentiate with respect
    to them. Nothing nearer than ``near`` metres shows.
    """

    width: int
    height: int
    focal_length: Float[Tensor, "*#batch 2"]
    principal_point: Float[Tensor, "*#batch 2"]
    rotation: Float[Tensor, "*#batch 3"]
    translation: Float[Tensor, "*#batch 3"]
    distortion: Float[Tensor, "*#batch 8"] | None = None
    near: float = 0.01

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if not isinstance(size, int | np.integer) or size < 1:
                raise HabitusError(
                    f"camera: {name} is {size!r}; expected a whole number of pixels, at least 1"
                )
        if not 0.0 < self.near < math.inf:
            raise HabitusError(
                f"camera: near is {self.near!r}; expected a distance in metres greater than 0"
            )
        fields = {name: getattr(self, name) for name in _SIZES if getattr(self, name) is not None}
        for name, value in fields.items():
            _check_field(name, value, self.focal_length)
        try:
            broadcast_shapes(*(value.shape[:-1] for value in fields.values()))
        except ValueError:
            shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in fields.items())
            raise HabitusError(
                f"camera: leading axes do not fit each other: {shapes}; make them equal or 1"
            ) from None
        for name, value in fields.items():
            if not _all(value.isfinite()):
                raise HabitusError(
                    f"camera: {name} has NaN or infinite numbers; expected finite ones"
                )
        if not _all(self.focal_length > 0):
            raise HabitusError(
                "camera: focal_length is not greater than 0; expected pixels, x and y"
            )

    @staticmethod
    def of(
        width: int,
        height: int,
        focal_length: Numbers | None = None,
        principal_point: Numbers | None = None,
        rotation: Numbers = (0.0, 0.0, 0.0),
        translation: Numbers = (0.0, 0.0, 0.0),
        distortion: Numbers | None = None,
        near: float = 0.01,
        dtype: torch.dtype = torch.float64,
    ) -> "Camera":
        """A camera from plain numbers or tensors (which stay in the graph and give the device).

        ``focal_length`` is one number, (*batch, 2), or None for the longer side of the image (53
        degrees of view); ``principal_point`` is the image's middle if None; ``distortion`` is
        (*batch, 4), (*batch, 5) or (*batch, 8).
        """
        given = (focal_length, principal_point, rotation, translation, distortion)
        device = next((value.device for value in given if isinstance(value, Tensor)), None)

        def tensor(value: Any, name: str) -> Tensor:
            try:
                return torch.as_tensor(value, dtype=dtype, device=device)
            except (TypeError, ValueError, RuntimeError):
                raise HabitusError(
                    f"camera: {name} is {value!r}; expected numbers, {_SIZES[name]} of them"
                ) from None

        focal = tensor(max(width, height) if focal_length is None else focal_length, "focal_length")
        return Camera(
            width,
            height,
            focal[..., None].expand(2) if focal.ndim == 0 else focal,
            tensor(
                (width / 2, height / 2) if principal_point is None else principal_point,
                "principal_point",
            ),
            tensor(rotation, "rotation"),
            tensor(translation, "translation"),
            None if distortion is None else _eight(tensor(distortion, "distortion")),
            near,
        )

    @staticmethod
    def from_opencv(
        matrix: Numbers,
        distortion: Numbers | None,
        rotation: Numbers,
        translation: Numbers,
        width: int,
        height: int,
        near: float = 0.01,
        dtype: torch.dtype = torch.float64,
    ) -> "Camera":
        """A camera from what OpenCV's calibration returns; its pixel centres are integers, so 0.5
        is added.

        ``matrix`` is (3, 3) without skew, ``rotation`` a rotation vector or a matrix,
        ``translation`` in metres. Of 12 or 14 distortion coefficients, those of the thin prism and
        the tilted sensor must be zero.
        """
        k = torch.as_tensor(matrix, dtype=dtype)
        if (
            k.shape != (3, 3)
            or not _all(k[[0, 1, 2, 2], [1, 0, 0, 1]] == 0)
            or not _all(k[2, 2] == 1)
        ):
            raise HabitusError(
                f"camera matrix is {k.tolist()}; expected (3, 3): fx 0 cx, 0 fy cy, 0 0 1"
            )
        r = torch.as_tensor(rotation, dtype=dtype).squeeze()
        if r.shape == (3, 3):
            if not _all(
                (r @ r.mT - torch.eye(3, dtype=dtype, device=r.device)).abs() < 1e-4
            ) or not _all(r.det() > 0):
                raise HabitusError(f"camera rotation is {r.tolist()}; expected a rotation matrix")
            r = rotvec_from_matrix(r)
        d = None if distortion is None else torch.as_tensor(distortion, dtype=dtype).flatten()
        if d is not None and len(d) > 8:
            if not _all(d[8:] == 0):
                raise HabitusError(
                    "camera: thin prism and tilt coefficients are not zero; calibrate with 4, 5 "
                    "or 8 coefficients"
                )
            d = d[:8]
        d = None if d is None or len(d) == 0 else d
        t = torch.as_tensor(translation, dtype=dtype).flatten()
        return Camera.of(width, height, k.diagonal()[:2], k[:2, 2] + 0.5, r, t, d, near, dtype)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The leading axes of all fields together."""
        fields = (getattr(self, name) for name in _SIZES)
        return broadcast_shapes(*(value.shape[:-1] for value in fields if value is not None))

    def to_camera(self, points: Float[Tensor, "*batch V 3"]) -> Float[Tensor, "*out V 3"]:
        """Points of the world in the camera's frame: R X + t, metres."""
        _check_points(points, 3, self.rotation)
        return points @ matrix_from_rotvec(self.rotation).mT + self.translation[..., None, :]

    def to_world(self, points: Float[Tensor, "*batch V 3"]) -> Float[Tensor, "*out V 3"]:
        """Points of the camera's frame in the world: the inverse of ``to_camera``."""
        _check_points(points, 3, self.rotation)
        return (points - self.translation[..., None, :]) @ matrix_from_rotvec(self.rotation)

    def project_camera_points(
        self, points: Float[Tensor, "*batch V 3"]
    ) -> Float[Tensor, "*out V 2"]:
        """Pixels (u, v) of points in the camera's frame.

        A point behind the camera, or nearer than half of ``near``, is projected as if its depth
        were half of ``near``: it has no true pixel, and this one is finite with finite derivatives.
        """
        _check_points(points, 3, self.focal_length)
        plane = points[..., :2] / points[..., 2:].clamp(min=self.near / 2)
        if self.distortion is not None:
            plane = distorted(plane, self.distortion)
        return plane * self.focal_length[..., None, :] + self.principal_point[..., None, :]

    def project(
        self, points: Float[Tensor, "*batch V 3"]
    ) -> tuple[Float[Tensor, "*out V 2"], Float[Tensor, "*out V"]]:
        """Pixels (u, v) and depths (z in the camera's frame, metres) of points of the world."""
        moved = self.to_camera(points)
        return self.project_camera_points(moved), moved[..., 2]

    def screen(self, points: Float[Tensor, "*batch V 3"]) -> Float[Tensor, "*out V 3"]:
        """Points of the world as (u, v, z): what the renderer draws."""
        moved = self.to_camera(points)
        return torch.cat(
            [self.project_camera_points(moved), moved[..., 2:].expand(*moved.shape[:-1], 1)], -1
        )

    def rays(self, pixels: Float[Tensor, "*batch N 2"]) -> Float[Tensor, "*out N 3"]:
        """Directions (x', y', 1) in the camera's frame that project to ``pixels``; first
        derivatives are exact.

        NaN where the lens shows no direction inside ``valid_radius_squared``.
        """
        _check_points(pixels, 2, self.focal_length)
        plane = (pixels - self.principal_point[..., None, :]) / self.focal_length[..., None, :]
        if self.distortion is not None:
            plane = undistorted(plane, self.distortion)
        return torch.cat([plane, torch.ones_like(plane[..., :1])], -1)

    def valid_radius_squared(self) -> Float[Tensor, "*batch"]:
        """x'^2 + y'^2 up to which a growing radius grows in the image too (without p1, p2);
        infinite if it always does.

        Beyond it the polynomials fold the picture back, or divide by zero. A constant: it has no
        derivative.
        """
        if self.distortion is None:
            return torch.full(
                (), math.inf, dtype=self.focal_length.dtype, device=self.focal_length.device
            )
        return first_turn(self.distortion)

    def scaled(self, factor: float) -> "Camera":
        """The same camera with ``factor`` times as many pixels a side, rounded at the right and at
        the bottom.
        """
        if not 0.0 < factor < math.inf:
            raise HabitusError(f"camera: factor is {factor!r}; expected a number greater than 0")
        width, height = (max(1, round(size * factor)) for size in (self.width, self.height))
        focal = self.focal_length * factor
        middle = self.principal_point * factor
        return self.replace(width=width, height=height, focal_length=focal, principal_point=middle)

    def replace(self, **fields: Any) -> "Camera":
        """The same camera with other values in the named fields."""
        unknown = fields.keys() - {field.name for field in dataclasses.fields(self)}
        if unknown:
            raise HabitusError(
                f"camera has no field {', '.join(sorted(unknown))}; see Camera for its fields"
            )
        return dataclasses.replace(self, **fields)

    def to(self, target: torch.dtype | torch.device | str) -> "Camera":
        """The same camera with its tensors in another floating type or on another device."""
        moved = {
            name: getattr(self, name).to(target)
            for name in _SIZES
            if getattr(self, name) is not None
        }
        return dataclasses.replace(self, **moved)


def look_at(
    eye: Float[Tensor, "*#batch 3"],
    target: Float[Tensor, "*#batch 3"],
    up: Float[Tensor, "*#batch 3"] | None = None,
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Rotation vector and translation of a camera at ``eye`` with ``target`` in its middle; ``up``
    is y if None.
    """
    up = eye.new_tensor([0.0, 1.0, 0.0]) if up is None else up
    eye, target, up = torch.broadcast_tensors(eye, target, up)
    forward = target - eye
    right = torch.linalg.cross(forward, up)
    lengths = torch.linalg.norm(forward, dim=-1) * torch.linalg.norm(up, dim=-1)
    if not _all(torch.linalg.norm(right, dim=-1) > 1e-6 * lengths):
        raise HabitusError(
            "look_at: eye is target, or up points along the view; choose another target or up"
        )
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack(
        [torch.nn.functional.normalize(row, dim=-1, eps=0.0) for row in (right, down, forward)], -2
    )
    return rotvec_from_matrix(rotation), -(rotation @ eye[..., None]).squeeze(-1)


def _check_field(name: str, value: Any, like: Any) -> None:
    if not isinstance(value, Tensor) or not value.is_floating_point():
        kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise HabitusError(
            f"camera: {name} is {kind}; expected a tensor of floating numbers (Camera.of takes "
            "others)"
        )
    if value.ndim < 1 or value.shape[-1] != _SIZES[name]:
        raise HabitusError(
            f"camera: {name} is {tuple(value.shape)}; expected (*batch, {_SIZES[name]})"
        )
    if value.dtype != like.dtype or value.device != like.device:
        raise HabitusError(
            f"camera: {name} is {value.dtype} on {value.device}, focal_length is {like.dtype} on "
            f"{like.device}; "
            "make them equal"
        )


def _check_points(points: Tensor, size: int, like: Tensor) -> None:
    if points.ndim < 2 or points.shape[-1] != size:
        raise HabitusError(
            f"points are {tuple(points.shape)}; expected (*batch, number of points, {size})"
        )
    if points.dtype != like.dtype:
        raise HabitusError(
            f"points are {points.dtype}, the camera is {like.dtype}; convert one (camera.to)"
        )


def _eight(distortion: Tensor) -> Tensor:
    if distortion.ndim < 1 or distortion.shape[-1] not in (4, 5, 8):
        raise HabitusError(
            f"distortion is {tuple(distortion.shape)}; expected 4, 5 or 8 coefficients: k1 k2 p1 "
            "p2 k3 k4 k5 k6"
        )
    return torch.nn.functional.pad(distortion, (0, 8 - distortion.shape[-1]))


def _all(condition: Tensor) -> bool:
    """Whether it holds everywhere; true where values cannot be read (inside torch.vmap)."""
    try:
        return bool(condition.all())
    except RuntimeError:
        return True


FARTHEST = 12.0
"""Metres beyond which no depth camera for people measures."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """One shot of a person.

    depth (H, W): metres along the camera's axis, 0 where nothing was measured. ``camera`` takes
    points of the sensor's frame (x right, y down, z forward, metres; that of the depth camera) to
    depth pixels, ``colour_camera`` the same points to colour pixels: its rotation and translation
    are the way from the depth to the colour camera. background: depth of the same room without the
    person, as is ``background_colour``. mask: where the person is, in depth pixels. keypoints:
    pixels (u, v) in the colour image and confidence by name, as `habitus.body.keypoints` calls
    them.
    """

    depth: Float[np.ndarray, "H W"]
    camera: Camera
    colour: UInt8[np.ndarray, "h w 3"] | None = None
    colour_camera: Camera | None = None
    background: Float[np.ndarray, "H W"] | None = None
    background_colour: UInt8[np.ndarray, "h w 3"] | None = None
    mask: Bool[np.ndarray, "H W"] | None = None
    keypoints: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for name in ("depth", "background", "mask"):
            image = getattr(self, name)
            if image is not None and image.shape != size:
                raise HabitusError(
                    f"{self.name or 'a view'}: {name} has {_pixels(image.shape)}, the depth "
                    f"camera {_pixels(size)}; "
                    "give the intrinsics of this resolution"
                )
        if (self.colour is None) != (self.colour_camera is None):
            raise HabitusError(
                f"{self.name or 'a view'}: colour and its camera come together; give both or "
                "neither"
            )
        if self.colour_camera is not None:
            size = (self.colour_camera.height, self.colour_camera.width)
            for name in ("colour", "background_colour"):
                image = getattr(self, name)
                if image is not None and image.shape != (*size, 3):
                    raise HabitusError(
                        f"{self.name or 'a view'}: {name} has {_pixels(image.shape)}, the colour "
                        "camera "
                        f"{_pixels(size)}; give the intrinsics of this resolution"
                    )
        with np.errstate(invalid="ignore"):
            usable = np.isfinite(self.depth) & (self.depth > 0) & (self.depth < FARTHEST)
        object.__setattr__(self, "depth", np.where(usable, self.depth, 0.0).astype(np.float32))

    @property
    def rays(self) -> Float[np.ndarray, "H W 3"]:
        """The direction of every depth pixel in the sensor's frame, z = 1; NaN where the lens shows
        none.
        """
        rows, columns = np.mgrid[: self.camera.height, : self.camera.width]
        pixels = np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2)
        rays = self.camera.rays(torch.from_numpy(pixels).to(self.camera.focal_length.dtype))
        return rays.numpy().reshape(self.camera.height, self.camera.width, 3)

    def points(self) -> Float[np.ndarray, "H W 3"]:
        """The points (m) that depth shows, in the sensor's frame; zero where nothing was
        measured.
        """
        return np.nan_to_num(self.rays) * self.depth[..., None]

    def in_camera_frame(self) -> "DepthView":
        """The same view with its depth camera at the origin: what it saw is in the sensor's frame.

        A calibrated camera, with a rotation and translation from a world, takes its colour camera
        along.
        """
        if not (self.camera.rotation.any() or self.camera.translation.any()):
            return self
        camera, colour = self.camera.to(torch.float64), self.colour_camera
        still = torch.zeros(3, dtype=torch.float64)
        if colour is not None:
            colour = colour.to(torch.float64)
            turn = matrix_from_rotvec(colour.rotation) @ matrix_from_rotvec(camera.rotation).mT
            colour = colour.replace(
                rotation=rotvec_from_matrix(turn),
                translation=colour.translation - turn @ camera.translation,
            )
        return replace(
            self, camera=camera.replace(rotation=still, translation=still), colour_camera=colour
        )

    def without(self, *names: str) -> "DepthView":
        """The same view without what these fields hold: "background" (both), "colour", "mask",
        "keypoints".
        """
        empty: dict[str, object] = {
            "background": {"background": None, "background_colour": None},
            "colour": {"colour": None, "colour_camera": None, "background_colour": None},
            "mask": {"mask": None},
            "keypoints": {"keypoints": {}},
        }
        fields: dict[str, object] = {}
        for name in names:
            fields |= empty[name]  # type: ignore[operator]
        return replace(self, **fields)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class RgbdCapture:
    """Views of one person, each turned otherwise, and what must be known of how they were read
    (``notes``).
    """

    name: str
    views: tuple[DepthView, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.views:
            raise HabitusError(f"{self.name}: no view; expected one depth image at least")

    def without(self, *names: str) -> "RgbdCapture":
        """The same without some fields of all views (`DepthView.without`)."""
        return replace(self, views=tuple(view.without(*names) for view in self.views))


def _pixels(shape: tuple[int, ...]) -> str:
    return " x ".join(str(size) for size in shape[1::-1]) + " pixels"
