"""Draw meshes before cameras, one or a batch: the renderer's public function.

frame = draw(camera, vertices, triangles)
colour, depth, coverage = frame.image(brightness), frame.depth(), frame.silhouette()
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from habitus.arrays import broadcast_shapes
from habitus.errors import HabitusError
from habitus.observe.camera import Camera, Numbers
from habitus.render.frame import BOUNDARIES, Frame, draw_one
from habitus.render.textures import Texture
from habitus.render.transforms import KERNEL_TYPES, real_numbers
from habitus.render.triangles import Array, Triangles


def draw(
    camera: Camera,
    vertices: Shaped[Tensor, "*batch V 3"] | Numbers,
    triangles: Triangles | Array,
    boundary: str = "antialias",
    cull: bool = False,
) -> "Frame | Frames":
    """What cameras see of vertices (metres, world) that triangles join; images are then taken from
    the frame.

    triangles: `Triangles`, prepared once, or faces (F, 3); these are welded where vertices
    coincide. boundary: "antialias", "exact", "filter" or "none" (see `habitus.render.frame`). cull:
    leave out faces seen from behind. A batch of cameras or of vertices, or both, gives `Frames`.
    HabitusError: shapes, types or indices that do not fit, vertices that are not finite.
    """
    if boundary not in BOUNDARIES:
        raise HabitusError(f"boundary is {boundary!r}; expected one of {', '.join(BOUNDARIES)}")
    vertices = _checked_vertices(vertices, camera)
    if not isinstance(triangles, Triangles):
        first = vertices.detach()
        while first.ndim > 2:
            first = first[0]
        triangles = Triangles.of(triangles, first, vertices.shape[-2])
    if triangles.num_vertices != vertices.shape[-2]:
        raise HabitusError(
            f"got {vertices.shape[-2]} vertices; expected {triangles.num_vertices}, as triangles "
            "join"
        )
    try:
        batch = torch.Size(broadcast_shapes(camera.batch_shape, vertices.shape[:-2]))
    except ValueError:
        raise HabitusError(
            f"cameras are a batch of {tuple(camera.batch_shape)}, vertices of "
            f"{tuple(vertices.shape[:-2])}; "
            "make them equal or 1"
        ) from None
    if not batch:
        return draw_one(camera, vertices, triangles, boundary, cull)
    meshes = vertices.expand(*batch, *vertices.shape[-2:]).reshape(-1, *vertices.shape[-2:])
    cameras = _apart(camera, batch)
    frames = (
        draw_one(each, mesh, triangles, boundary, cull)
        for each, mesh in zip(cameras, meshes, strict=True)
    )
    return Frames(batch, tuple(frames))


def _checked_vertices(vertices: Any, camera: Camera) -> Tensor:
    """Vertices as a tensor; HabitusError: another shape or type, a batch of none."""
    converted = real_numbers("vertices", vertices, camera.focal_length)
    if (
        converted.ndim < 2
        or converted.shape[-1] != 3
        or (isinstance(vertices, Tensor) and vertices.dtype not in KERNEL_TYPES)
    ):
        kind = getattr(vertices, "dtype", converted.dtype)
        raise HabitusError(
            f"vertices are {tuple(converted.shape)} {kind}; expected (*batch, V, 3) of float32 or "
            "float64"
        )
    for name, batch in (("vertices", converted.shape[:-2]), ("cameras", camera.batch_shape)):
        if 0 in batch:
            raise HabitusError(
                f"{name} are a batch of {tuple(batch)}; expected at least one to draw"
            )
    return converted


@dataclass(frozen=True, eq=False)
class Frames:
    """A batch of frames, whose images are stacked: leading axes `shape`.

    Values, textures' places and backgrounds may have the same leading axes, or none.
    """

    shape: torch.Size
    frames: tuple[Frame, ...]

    @property
    def face_ids(self) -> Int[Tensor, "*_ H W"]:
        """`Frame.face_ids` of each."""
        return self._stack(lambda frame: frame.face_ids)

    @property
    def boundary(self) -> Bool[Tensor, "*_ H W"]:
        """`Frame.boundary` of each."""
        return self._stack(lambda frame: frame.boundary)

    @property
    def intersections(self) -> Bool[Tensor, "*_ H W"]:
        """`Frame.intersections` of each."""
        return self._stack(lambda frame: frame.intersections)

    @property
    def barycentrics(self) -> Float[Tensor, "*_ H W 3"]:
        """`Frame.barycentrics` of each."""
        return self._stack(lambda frame: frame.barycentrics)

    def image(
        self,
        values: Shaped[Tensor, "*_ V C"] | Numbers,
        background: Shaped[Tensor, "..."] | Numbers = 0.0,
    ) -> Float[Tensor, "*_ H W C"]:
        """`Frame.image` of each."""
        return self._stack(Frame.image, (values, 2), (background, 3))

    def textured(
        self,
        texture: Texture,
        uv: Float[Tensor, "*_ U 2"],
        uv_faces: Int[Tensor, "F 3"] | None = None,
        brightness: Shaped[Tensor, "*_ V K"] | Numbers | None = None,
        background: Shaped[Tensor, "..."] | Numbers = 0.0,
    ) -> Float[Tensor, "*_ H W C"]:
        """`Frame.textured` of each."""

        def take(frame: Frame, uv: Tensor, brightness: Tensor | None, background: Any) -> Tensor:
            return frame.textured(texture, uv, uv_faces, brightness, background)

        return self._stack(take, (uv, 2), (brightness, 2), (background, 3))

    def depth(
        self, background: Shaped[Tensor, "*_ H W"] | Numbers = math.inf
    ) -> Float[Tensor, "*_ H W"]:
        """`Frame.depth` of each."""
        return self._stack(Frame.depth, (background, 2))

    def silhouette(self) -> Float[Tensor, "*_ H W"]:
        """`Frame.silhouette` of each."""
        return self._stack(Frame.silhouette)

    def normals(self, normals: Shaped[Tensor, "*_ V 3"] | Numbers) -> Float[Tensor, "*_ H W 3"]:
        """`Frame.normals` of each."""
        return self._stack(Frame.normals, (normals, 2))

    def _stack(self, take: Callable[..., Tensor], *arguments: tuple[Any, int]) -> Tensor:
        """What `take` gives for each frame and its own part of the arguments; an argument comes
        with its own rank.
        """
        parts = [_each(value, rank, self.shape) for value, rank in arguments]
        images = [take(frame, *(part[k] for part in parts)) for k, frame in enumerate(self.frames)]
        return torch.stack(images).unflatten(0, self.shape) if images else torch.zeros(self.shape)


def _each(value: Any, rank: int, shape: torch.Size) -> list[Any]:
    """The part of a value for each entry of a batch: the whole where it has no more axes than
    `rank`.
    """
    if not isinstance(value, Tensor) or value.ndim <= rank:
        return [value] * shape.numel()
    try:
        return list(value.expand(*shape, *value.shape[-rank:]).reshape(-1, *value.shape[-rank:]))
    except RuntimeError:
        raise HabitusError(
            f"values of {tuple(value.shape)} for a batch of {tuple(shape)}; expected these "
            "leading axes, or none"
        ) from None


def _apart(camera: Camera, batch: torch.Size) -> list[Camera]:
    """The single cameras of a batch."""
    names = [
        field.name for field in fields(camera) if isinstance(getattr(camera, field.name), Tensor)
    ]
    rows = {
        name: getattr(camera, name).expand(*batch, -1).reshape(batch.numel(), -1) for name in names
    }
    return [
        replace(camera, **{name: rows[name][k] for name in names}) for k in range(batch.numel())
    ]
