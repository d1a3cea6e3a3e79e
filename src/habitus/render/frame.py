"""Drawing: triangles before a camera, and the images that can be taken of what it sees (T 4.3: f(V, A, U)).

    frame = draw(camera, vertices, triangles)          # what is where: decided once
    colour, depth = frame.image(brightness), frame.depth()

Images are differentiable in vertices, values, textures and cameras. How the border of a surface counts is a choice:

- "antialias": a pixel is the value at its centre plus, for each visible part of an edge in it, the jump there times the
  area that the part cuts off. That is box filtering, and its derivative the true one: what moving edges sweep.
- "filter": pixels are values at centres, their derivative to positions is the thesis' image filter (T 4.4.3).
- "none": values at centres; surfaces end without a derivative.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from habitus.errors import HabitusError
from habitus.observe.camera import Camera
from habitus.render import operators
from habitus.render.clipping import Clipped, clip_near
from habitus.render.filters import filter_slopes
from habitus.render.parts import Parts
from habitus.render.triangles import Triangles

BOUNDARIES = ("antialias", "filter", "none")


def draw_one(
    camera: Camera,
    vertices: Float[Tensor, "V 3"],
    triangles: Triangles,
    boundary: str = "antialias",
    cull: bool = False,
) -> "Frame":
    """What one camera sees of vertices (metres, world) joined by triangles; `cull` drops faces seen from behind."""
    points = camera.to_camera(vertices)
    clipped = clip_near(points, triangles, camera.near)
    points, triangles = (points, triangles) if clipped is None else (clipped.points, clipped.triangles)
    screen = torch.cat([camera.project_camera_points(points), points[:, 2:]], -1)
    size = camera.width, camera.height
    ids, parts = operators.visibility(_shown(screen, points, camera), triangles, *size, cull, boundary != "none")
    return Frame(camera.width, camera.height, boundary, screen, triangles, clipped, ids, parts)


def _shown(screen: Tensor, points: Tensor, camera: Camera) -> Tensor:
    """The screen without vertices so far out that the lens' polynomials fold back there (`valid_radius_squared`)."""
    if camera.distortion is None:
        return screen
    radius = (points[:, :2] ** 2).sum(-1) / points[:, 2].clamp(min=camera.near / 2) ** 2
    return torch.where((radius < camera.valid_radius_squared())[:, None], screen, math.nan)


@dataclass(frozen=True, eq=False)
class Frame:
    """What a camera sees: for each pixel the nearest face, and where images jump. Images are taken by its methods.

    screen: u, v and depth of vertices, those that cutting at the near plane added last. face_ids (H, W): faces of the
    triangles drawn, -1 where there is none. parts: visible parts of edges at which an image may jump.
    """

    width: int
    height: int
    mode: str
    screen: Float[Tensor, "V 3"]
    triangles: Triangles
    clipped: Clipped | None
    drawn_ids: Int[Tensor, "H W"]
    parts: Parts | None

    @property
    def face_ids(self) -> Int[Tensor, "H W"]:
        """The face seen at each pixel's centre, by its number in the triangles that were given; -1 for none."""
        if self.clipped is None:
            return self.drawn_ids
        seen = self.drawn_ids >= 0
        source = (
            self.clipped.source_face[self.drawn_ids.clamp(min=0).long()] if len(self.triangles.faces) else seen.long()
        )
        return torch.where(seen, source, -1).to(self.drawn_ids.dtype)

    @cached_property
    def boundary(self) -> Bool[Tensor, "H W"]:
        """Pixels that a visible border or silhouette crosses."""
        mask = torch.zeros(self.height * self.width, dtype=torch.bool, device=self.screen.device)
        if self.parts is not None:
            mask[self.parts.pixel[~self.parts.seam]] = True
        return mask.unflatten(0, (self.height, self.width))

    @cached_property
    def pixels(self) -> Int[Tensor, " N"]:
        """The pixels that show a face, row by row."""
        return torch.nonzero(self.drawn_ids.flatten() >= 0).squeeze(-1)

    @cached_property
    def samples(self) -> "Samples":
        """Where values are taken: centres of `pixels`, then inner and outer points of parts that show a face."""
        centres = torch.stack([self.pixels % self.width, self.pixels // self.width], -1) + 0.5
        faces, points = self.drawn_ids.flatten()[self.pixels].long(), centres.to(self.screen.dtype)
        if self.mode == "antialias" and self.parts is not None:
            for face, point in _sides(self.parts):
                shows = face >= 0
                faces = torch.cat([faces, face[shows]])
                points = torch.cat([points, point[shows].to(points.dtype)])
        screen = self.screen.detach() if self.mode == "filter" else self.screen
        return Samples(faces, points, operators.barycentrics(screen, self.triangles.faces, faces, points))

    @property
    def barycentrics(self) -> Float[Tensor, "H W 3"]:
        """Perspective-correct barycentric coordinates at pixel centres, in the order of the face drawn; else 0."""
        image = self.screen.new_zeros(self.height * self.width, 3)
        found = image.index_copy(0, self.pixels, self.samples.barycentrics[: len(self.pixels)])
        return found.unflatten(0, (self.height, self.width))

    def image(
        self, values: Float[Tensor, "V C"], background: Float[Tensor, "*size C"] | float = 0.0
    ) -> Float[Tensor, "H W C"]:
        """Values of vertices, any channels, linear on triangles in space; behind them the background.

        background: a number, C of them, or an image (H, W, C).
        """
        values = values if self.clipped is None else self.clipped.extend(values)
        samples = self.samples
        found = operators.interpolate(values, self.triangles.faces, samples.faces, samples.barycentrics)
        return self.compose(found, background)

    def compose(
        self, found: Float[Tensor, "N C"], background: Float[Tensor, "*size C"] | float = 0.0
    ) -> Float[Tensor, "H W C"]:
        """The image of any values at `samples`: what every image ends with, and the place for shading of one's own."""
        count, channels = len(self.pixels), found.shape[-1]
        behind = _background(background, self.height, self.width, channels, found)
        image = behind.index_copy(0, self.pixels, found[:count])
        if self.mode == "antialias" and self.parts is not None and len(self.parts.pixel):
            image = self._smoothed(image, behind, found[count:])
        if self.mode == "filter":
            image = filter_slopes(self, image)
        return image.unflatten(0, (self.height, self.width))

    def _smoothed(self, image: Tensor, behind: Tensor, found: Tensor) -> Tensor:
        """Box filtering: jump times area, added up over the parts in each pixel. Nothing is mixed with infinity."""
        parts, values = self.parts, []
        assert parts is not None
        for face, _ in _sides(parts):
            shows = torch.nonzero(face >= 0).squeeze(-1)
            values.append(behind[parts.pixel].index_copy(0, shows, found[: len(shows)]))
            found = found[len(shows) :]
        jump = values[1] - values[0]
        jump = torch.where(jump.isfinite(), jump, 0.0)
        return image.index_add(0, parts.pixel, operators.part_weights(self.screen, parts)[:, None] * jump)

    def depth(self, background: Float[Tensor, "H W"] | float = math.inf) -> Float[Tensor, "H W"]:
        """Distance along the camera's axis in metres; infinite, or the background's, where there is no surface.

        Surfaces are mixed with finite backgrounds only: before nothing, depth ends at pixel centres.
        """
        behind = background[..., None] if isinstance(background, Tensor) else background
        found = operators.interpolate(
            self.screen[:, 2:], self.triangles.faces, self.samples.faces, self.samples.barycentrics
        )
        return self.compose(found, behind).squeeze(-1)

    def silhouette(self) -> Float[Tensor, "H W"]:
        """How much of each pixel is covered."""
        return self.compose(self.screen.new_ones(len(self.samples.faces), 1)).squeeze(-1)

    def normals(self, normals: Float[Tensor, "V 3"]) -> Float[Tensor, "H W 3"]:
        """Unit normals of vertices, interpolated and made unit again; 0 where there is no surface."""
        values = normals if self.clipped is None else self.clipped.extend(normals)
        samples = self.samples
        found = operators.interpolate(values, self.triangles.faces, samples.faces, samples.barycentrics)
        return self.compose(torch.nn.functional.normalize(found, dim=-1))


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of the screen on faces: faces (N,), points (N, 2) in pixels, barycentric coordinates (N, 3)."""

    faces: Int[Tensor, " N"]
    points: Float[Tensor, "N 2"]
    barycentrics: Float[Tensor, "N 3"]


def _sides(parts: Parts) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Faces and points on the inside of parts, and on their outside."""
    return (parts.inner_face, parts.inner_point), (parts.outer_face, parts.outer_point)


def _background(background: Tensor | float, height: int, width: int, channels: int, like: Tensor) -> Tensor:
    """The background as (H W, C)."""
    given = torch.as_tensor(background, dtype=like.dtype, device=like.device)
    try:
        return given.expand(height, width, channels).reshape(-1, channels)
    except RuntimeError:
        raise HabitusError(
            f"background is {tuple(given.shape)}; expected one number, ({channels},) or ({height}, {width}, {channels})"
        ) from None
