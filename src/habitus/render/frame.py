"""Drawing: triangles before a camera, and the images that can be taken of what it sees (T 4.3: f(V,
A, U)).

    frame = draw(camera, vertices, triangles)          # what is where: decided once
    colour, depth = frame.image(brightness), frame.depth()

Images are differentiable in vertices, values, textures and cameras. How the border of a surface
counts is a choice:

- "antialias": a pixel is the value at its centre plus, for each visible edge fragment in it, the
  jump there times the
  area that the fragment cuts off. That is box filtering, and its derivative the true one: what
  moving edges sweep.
- "exact": a pixel is the mean over what shows in it, face by face, small ones too: slower, and its
  derivative
  is the mean's.
- "filter": pixels are values at centres, their derivative to positions is the thesis' image filter
  (T 4.4.3).
- "none": values at centres; surfaces end without a derivative.

`render/README.md` has the formula of a pixel and its derivatives, and which file computes which
part.

`fragment_weights` is how much of their pixels edge fragments cut off, as a torch function of the
screen: what makes moving edges count.
"""

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.autograd.function import once_differentiable

from habitus.errors import HabitusError
from habitus.observe.camera import Camera, Numbers
from habitus.render import operators
from habitus.render.clipping import Clipped
from habitus.render.derivatives import fragment_weights_vjp, on_screen
from habitus.render.filters import filter_derivative, surface_motion
from habitus.render.rasterize import intersections
from habitus.render.reference import images as reference
from habitus.render.textures import Texture, footprint
from habitus.render.transforms import (
    KERNEL_TYPES,
    Operator,
    no_vmap,
    of_one_type,
    outside,
    real_numbers,
)
from habitus.render.triangles import EdgeFragments, Triangles, Visibility


def fragment_weights(screen: Float[Tensor, "V 3"], fragments: EdgeFragments) -> Float[Tensor, " S"]:
    """The fragments' weights, with the derivative of the area that moving edges sweep: -(normal
    velocity) integrated.

    It is the derivative of the pixel's exact coverage (Reynolds' transport theorem).
    """
    if screen.device.type != "cpu":
        return reference.fragment_weights(screen, fragments)
    return _FragmentWeights.apply(screen, fragments)


class _FragmentWeights(Operator):
    @staticmethod
    def forward(screen: Tensor, fragments: EdgeFragments) -> Tensor:
        return fragments.weight.to(screen.dtype, copy=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(inputs[0])
        ctx.save_for_forward(inputs[0])
        ctx.fragments = inputs[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        return outside(
            partial(fragment_weights_vjp, fragments=ctx.fragments), *ctx.saved_tensors, cotangent
        ), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: Any) -> Tensor:
        return reference.swept(ctx.saved_tensors[0], tangent, ctx.fragments)

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise no_vmap()


BOUNDARIES = ("antialias", "exact", "filter", "none")
AVERAGED = ("antialias", "exact")
"""Modes whose pixels at borders count how much each surface covers."""


def draw_one(
    camera: Camera,
    vertices: Float[Tensor, "V 3"],
    triangles: Triangles,
    boundary: str = "antialias",
    cull: bool = False,
) -> "Frame":
    """`draw` of one camera and one mesh."""
    screen, triangles, clipped = on_screen(camera, vertices, triangles)
    size = camera.width, camera.height
    visibility = operators.rasterize_detached(
        screen, triangles, *size, cull, boundary != "none", boundary == "exact"
    )
    return Frame(*size, boundary, screen, triangles, clipped, visibility, cull)


@dataclass(frozen=True, eq=False)
class Frame:
    """What a camera sees: for each pixel the nearest face, and where images jump. Images are taken
    by its methods.

    screen: u, v and depth of vertices, those that cutting at the near plane added last.
    """

    width: int
    height: int
    mode: str
    screen: Float[Tensor, "V 3"]
    triangles: Triangles
    clipped: Clipped | None
    visibility: Visibility
    cull: bool = False

    @property
    def face_ids(self) -> Int[Tensor, "H W"]:
        """The face seen at each pixel's centre, by its number in the triangles that were given; -1
        for none.
        """
        ids = self.visibility.ids
        if self.clipped is None or not len(self.triangles.faces):
            return ids
        source = self.clipped.source_face[ids.clamp(min=0).long()]
        return torch.where(ids >= 0, source, -1).to(ids.dtype)

    @cached_property
    def boundary(self) -> Bool[Tensor, "H W"]:
        """Pixels that a visible border or silhouette crosses."""
        mask = torch.zeros(self.height * self.width, dtype=torch.bool, device=self.screen.device)
        if self.visibility.fragments is not None:
            mask[self.visibility.fragments.pixel[~self.visibility.fragments.seam]] = True
        return mask.unflatten(0, (self.height, self.width))

    @cached_property
    def intersections(self) -> Bool[Tensor, "H W"]:
        """Pixels in which surfaces pass through each other: no edge of a mesh lies there, and none
        has a derivative.

        It is looked for when first asked for.
        """

        def find(screen: Tensor) -> Tensor:
            return intersections(screen, self.triangles, self.width, self.height, self.cull)

        return outside(find, self.screen)

    @cached_property
    def samples(self) -> Float[Tensor, "N 3"]:
        """Perspective-correct barycentric coordinates of the samples that `visibility` lists."""
        screen = self.screen.detach() if self.mode == "filter" else self.screen
        return operators.barycentrics(
            screen,
            self.triangles.faces,
            self.visibility.faces,
            self.visibility.points,
            self.visibility.exact,
        )

    @property
    def barycentrics(self) -> Float[Tensor, "H W 3"]:
        """Perspective-correct barycentric coordinates at pixel centres, in the order of the face
        drawn; else 0.
        """
        image = self.screen.new_zeros(self.height * self.width, 3)
        weights = image.index_copy(
            0, self.visibility.pixels, self.samples[: len(self.visibility.pixels)]
        )
        return weights.unflatten(0, (self.height, self.width))

    def at_samples(self, values: Shaped[Tensor, "V C"] | Numbers) -> Float[Tensor, "N C"]:
        """Values of vertices, interpolated at the samples: linear on triangles in space."""
        return operators.interpolate(
            self._of_vertices(values), self.triangles.faces, self.visibility.faces, self.samples
        )

    @property
    def num_vertices(self) -> int:
        """How many vertices were given."""
        return (
            len(self.screen)
            if self.clipped is None
            else len(self.screen) - len(self.clipped.cut_fraction)
        )

    def image(
        self,
        values: Shaped[Tensor, "V C"] | Numbers,
        background: Shaped[Tensor, "*size C"] | Numbers = 0.0,
    ) -> Float[Tensor, "H W C"]:
        """Values of vertices, any channels, linear on triangles in space; behind them the
        background.

        background: a number, C of them, or an image (H, W, C). Whole numbers and truth values are
        taken as floating ones; the image has float64 where vertices or values do. HabitusError:
        shapes that do not fit, complex numbers.
        """
        return self._drawn(self._of_vertices(values), background)

    def compose(
        self,
        values: Shaped[Tensor, "N C"] | Numbers,
        background: Shaped[Tensor, "*size C"] | Numbers = 0.0,
    ) -> Float[Tensor, "H W C"]:
        """The image of any values at `samples`: what every image ends with, and where shading of
        one's own goes.
        """
        values = real_numbers("values at samples", values, self.screen)
        count = len(self.visibility.faces)
        centres = len(self.visibility.pixels)
        if values.ndim != 2 or len(values) not in (
            (count,) if self.mode in AVERAGED else (count, centres)
        ):
            raise HabitusError(
                f"values at samples are {tuple(values.shape)}; expected ({count}, channels), as "
                "at_samples"
            )
        behind = _background(background, self.height, self.width, values)
        return self._finished(operators.compose(values, behind, *self._mixing(values)))

    def _drawn(self, values: Tensor, background: Numbers, are_depths: bool = False) -> Tensor:
        """The image of values of the vertices of `screen`."""
        screen, values = of_one_type(
            self.screen.detach() if self.mode == "filter" else self.screen, values
        )
        behind = _background(background, self.height, self.width, values)
        image = operators.image(
            screen, self.triangles.faces, values, behind, *self._mixing(values), are_depths
        )
        return self._finished(image)

    def _mixing(self, like: Tensor) -> tuple[Tensor, Visibility]:
        """The weights of edge fragments and the visibility, with fragments where they count for
        pixels.
        """
        if self.mode in AVERAGED and self.visibility.fragments is not None:
            return self._weights.to(like.dtype), self.visibility
        return like.new_zeros(0), self._at_centres

    @cached_property
    def _weights(self) -> Tensor:
        assert self.visibility.fragments is not None
        return fragment_weights(self.screen, self.visibility.fragments)

    @cached_property
    def _at_centres(self) -> Visibility:
        return self.visibility.without_fragments()

    def _finished(self, image: Tensor) -> Tensor:
        if self.mode == "filter":
            motion = surface_motion(
                self.screen, self.triangles.faces, self.visibility, self.samples, self.boundary
            )
            image = filter_derivative(image, self.boundary, motion)
        return image.unflatten(0, (self.height, self.width))

    def _of_vertices(self, values: Numbers) -> Tensor:
        """Values with those at the near plane's cuts behind them; HabitusError if they are not one
        row a vertex.
        """
        values = real_numbers("values", values, self.screen)
        if values.ndim != 2 or len(values) != self.num_vertices:
            raise HabitusError(
                f"values are {tuple(values.shape)}; expected ({self.num_vertices}, channels), a "
                "row a vertex"
            )
        return values if self.clipped is None else self.clipped.extend(values)

    def textured(
        self,
        texture: Texture,
        uv: Float[Tensor, "U 2"],
        uv_faces: Int[Tensor, "F 3"] | None = None,
        brightness: Shaped[Tensor, "V K"] | Numbers | None = None,
        background: Shaped[Tensor, "*size C"] | Numbers = 0.0,
    ) -> Float[Tensor, "H W C"]:
        """The texture, laid on by the texture coordinates `uv` of vertices, times the vertices'
        brightness (T 4.3).

        uv_faces: rows of uv at the corners of each face given to `draw`, where they are not those
        of its vertices. HabitusError: uv or uv_faces of another shape or type, an index out of
        range.
        """
        self.check_uv(uv, uv_faces)
        corners, corner_uv = self._corner_values(uv, uv_faces)
        at = operators.interpolate(corner_uv, corners, self.visibility.faces, self.samples)
        size = None if len(texture.sizes) == 1 else self._footprint(texture, corner_uv, corners)
        values = texture.sample(at, size)
        if brightness is None:
            return self.compose(values, background)
        light = self.at_samples(brightness)
        if 1 not in (light.shape[1], values.shape[1]) and light.shape[1] != values.shape[1]:
            raise HabitusError(
                f"brightness has {light.shape[1]} channels; expected 1 or {values.shape[1]}, the "
                "texture's"
            )
        return self.compose(values * light, background)

    def check_uv(self, uv: Tensor, uv_faces: Tensor | None) -> None:
        """HabitusError if texture coordinates do not fit the mesh."""
        if uv.ndim != 2 or uv.shape[1] != 2 or uv.dtype not in KERNEL_TYPES:
            raise HabitusError(
                f"uv is {tuple(uv.shape)} {uv.dtype}; expected (U, 2) of float32 or float64"
            )
        if uv_faces is None:
            if len(uv) != self.num_vertices:
                raise HabitusError(
                    f"uv has {len(uv)} rows; expected {self.num_vertices}, a row a vertex, or "
                    "uv_faces"
                )
            return
        count = len(self.triangles.faces) if self.clipped is None else self.clipped.num_source_faces
        kind = uv_faces.dtype
        if (
            tuple(uv_faces.shape) != (count, 3)
            or kind.is_floating_point
            or kind.is_complex
            or kind == torch.bool
        ):
            raise HabitusError(
                f"uv_faces is {tuple(uv_faces.shape)} {kind}; expected ({count}, 3) whole numbers"
            )
        wrong = (uv_faces < 0) | (uv_faces >= len(uv))
        if bool(wrong.any()):
            row, corner = wrong.nonzero()[0].tolist()
            raise HabitusError(
                f"uv_faces[{row}, {corner}] is {int(uv_faces[row, corner])}; expected 0 to "
                f"{len(uv) - 1}, a row of uv"
            )

    def _corner_values(self, values: Tensor, faces: Tensor | None) -> tuple[Tensor, Tensor]:
        """Values that belong to corners rather than vertices: a table of corners' rows, and the
        rows.
        """
        if faces is None:
            values = values if self.clipped is None else self.clipped.extend(values)
            return self.triangles.faces, values
        faces = faces.to(self.triangles.faces.dtype)
        if self.clipped is None:
            return faces, values
        cut = self.clipped.corner_weights.to(values.dtype) @ values[faces[self.clipped.source_face]]
        return torch.arange(cut.shape[0] * 3, device=values.device).view(-1, 3), cut.flatten(0, 1)

    def _footprint(self, texture: Texture, corner_uv: Tensor, corners: Tensor) -> Tensor:
        """How many texels the samples' pixels span."""
        screen = self.screen.detach()
        steps = []
        points = self.visibility.points
        for step in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
            beside = points + points.new_tensor(step)
            coordinates = operators.barycentrics(
                screen, self.triangles.faces, self.visibility.faces, beside
            )
            steps.append(
                operators.interpolate(
                    corner_uv.detach(), corners, self.visibility.faces, coordinates
                )
            )
        return footprint(steps[1] - steps[0], steps[2] - steps[0], texture)

    def depth(self, background: Shaped[Tensor, "H W"] | Numbers = math.inf) -> Float[Tensor, "H W"]:
        """Distance along the camera's axis in metres; infinite, or the background's, where there is
        no surface.

        Surfaces are mixed with finite backgrounds only: before nothing, depth ends at pixel
        centres.
        """
        behind = background[..., None] if isinstance(background, Tensor) else background
        return self._drawn(self.screen[:, 2:], behind, are_depths=True).squeeze(-1)

    def silhouette(self) -> Float[Tensor, "H W"]:
        """How much of each pixel is covered."""
        return self.compose(self.screen.new_ones(len(self.visibility.faces), 1)).squeeze(-1)

    def normals(self, normals: Shaped[Tensor, "V 3"] | Numbers) -> Float[Tensor, "H W 3"]:
        """Unit normals of vertices, interpolated and made unit again; 0 where there is no
        surface.
        """
        directions = self.at_samples(normals)
        if directions.shape[1] != 3:
            raise HabitusError(f"normals have {directions.shape[1]} numbers a vertex; expected 3")
        return self.compose(torch.nn.functional.normalize(directions, dim=-1))


def _background(background: Numbers, height: int, width: int, like: Tensor) -> Tensor:
    """The background as (1, C), or (H W, C) where it is an image."""
    given = real_numbers("background", background, like).to(like.dtype)
    channels = like.shape[-1]
    try:
        if given.ndim < 2:
            return given.expand(1, channels)
        return given.expand(height, width, channels).reshape(-1, channels)
    except RuntimeError:
        raise HabitusError(
            f"background is {tuple(given.shape)}; expected one number, ({channels},) or "
            f"({height}, {width}, {channels})"
        ) from None
