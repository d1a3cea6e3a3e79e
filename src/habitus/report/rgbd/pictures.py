"""Pictures of a fit to depth views: observed, rendered, their difference, light and albedo apart (T
Fig 4-9).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter

from habitus.fit.points.appearance import Appearance, moved, to_linear
from habitus.fit.points.prepared_views import Sight
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera
from habitus.observe.harmonics import harmonics
from habitus.observe.srgb import srgb_bytes
from habitus.render.draw import draw
from habitus.render.triangles import Triangles

if TYPE_CHECKING:
    from habitus.fit.points.depth_result import RgbdFit

ERROR_MM = 30.0
"""Where the scale of depth errors ends."""
PAPER = np.array([248, 249, 250], np.uint8)
MARGIN = 0.06
_BLUE = np.array([33, 102, 172.0])
_WHITE = np.array([247, 247, 247.0])
_RED = np.array([178, 24, 43.0])
Picture = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class ViewPictures:
    """Pictures of one view, by what they show."""

    name: str
    pictures: dict[str, Picture]


def view_pictures(fit: "RgbdFit") -> list[ViewPictures]:
    """The pictures of all views."""
    triangles = Triangles.of(fit.body.faces, num_vertices=fit.body.num_vertices)
    surfaces = fit.vertices()
    return [
        ViewPictures(sight.view.name, _of_view(sight, surface, triangles, fit.appearance))
        for sight, surface in zip(fit.sights, surfaces, strict=True)
    ]


def _of_view(
    sight: Sight,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
    appearance: Appearance | None,
) -> dict[str, Picture]:
    box = _box(sight)
    frame = draw(sight.camera, torch.from_numpy(vertices), triangles, boundary="none")
    model = frame.depth().numpy()
    own = sight.mask & (sight.view.depth > 0)
    found = {
        "Depth observed": _relief(sight.camera, np.where(own, sight.view.depth, np.inf))[box],
        "Depth of the body": _relief(sight.camera, model)[box],
        "Depth observed less the body's": _signed(sight, model, own)[box],
    }
    if appearance is None or sight.colour_camera is None or sight.view.colour is None:
        return found
    return found | _coloured(sight, vertices, triangles, appearance)


def _coloured(
    sight: Sight, vertices: Float[np.ndarray, "V 3"], triangles: Triangles, appearance: Appearance
) -> dict[str, Picture]:
    assert sight.colour_camera is not None and sight.view.colour is not None
    camera = moved(sight.colour_camera, appearance.shift.shift)
    observed = sight.view.colour
    normals = vertex_normals(vertices, triangles.faces.numpy())
    shade = (harmonics(torch.from_numpy(normals)).numpy() @ appearance.light).clip(0.0)
    frame = draw(camera, torch.from_numpy(vertices), triangles)
    empty = sight.view.background_colour
    behind = to_linear(observed if empty is None else empty)

    def image(values: np.ndarray, background: object) -> np.ndarray:
        return frame.image(torch.from_numpy(values), background).numpy()  # pyright: ignore[reportArgumentType]

    rendered = image(appearance.albedo * shade, torch.from_numpy(behind))
    paper = to_linear(PAPER).tolist()
    scale = 0.92 / max(float(np.percentile(appearance.albedo.max(1), 99.5)), 1e-3)
    covered = frame.silhouette().numpy() > 0.5
    apart = np.abs(srgb_bytes(rendered).astype(int) - observed).max(-1)
    box = _around(covered)
    return {
        "Colour observed": observed[box],
        "Rendered": srgb_bytes(rendered)[box],
        "Difference of colours": _heat(apart / 100.0)[box],
        "Albedo": srgb_bytes(image(appearance.albedo * scale, torch.tensor(paper)))[box],
        "Light": srgb_bytes(
            image(0.7 * shade / max(float(np.percentile(shade, 99)), 1e-3), torch.tensor(paper))
        )[box],
    }


def light_ball(appearance: Appearance, size: int = 160) -> Picture:
    """A white ball in the light that was found, seen as the camera sees the person."""
    y, x = 1.0 - 2.0 * (np.mgrid[:size, :size] + 0.5) / size
    inside = x**2 + y**2 < 1.0
    normals = np.stack([-x, y, np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))], -1)
    shade = (
        harmonics(torch.from_numpy(normals.reshape(-1, 3))).numpy().reshape(size, size, 9)
        @ appearance.light
    )
    picture = srgb_bytes((0.75 * shade / max(float(shade[inside].max()), 1e-3)).clip(0.0))
    picture[~inside] = PAPER
    return picture


def _box(sight: Sight) -> tuple[slice, slice]:
    return _around(sight.mask)


def _around(mask: np.ndarray) -> tuple[slice, slice]:
    """The part of an image that shows the person, with a margin."""
    parts = []
    for axis in (1, 0):
        ends = np.flatnonzero(mask.any(axis))
        low, high = (ends[0], ends[-1]) if len(ends) else (0, mask.shape[1 - axis])
        room = int(MARGIN * (high - low)) + 4
        parts.append(slice(max(low - room, 0), high + room))
    return parts[0], parts[1]


def _relief(camera: Camera, depth: Float[np.ndarray, "H W"]) -> Picture:
    """A depth image as a surface lit from the camera: shape is seen, not only distance."""
    rows, columns = np.indices(depth.shape)
    pixels = np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2)
    rays = np.nan_to_num(camera.rays(torch.from_numpy(pixels)).numpy()).reshape(*depth.shape, 3)
    seen = np.isfinite(depth)
    smooth = _smoothed(np.where(seen, depth, 0.0), seen)
    points = rays * smooth[..., None]
    across = np.gradient(points, axis=1)
    down = np.gradient(points, axis=0)
    normal = np.cross(across, down)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    facing = np.abs((normal * rays).sum(-1) / np.linalg.norm(rays, axis=-1))
    tone = 60 + 175 * facing.clip(0, 1)
    picture = np.repeat(tone[..., None], 3, axis=2) * [0.93, 0.97, 1.0]
    picture[~seen] = PAPER
    return picture.astype(np.uint8)


def _smoothed(depth: np.ndarray, seen: np.ndarray) -> np.ndarray:
    weight = gaussian_filter(seen.astype(float), 1.5)
    return gaussian_filter(depth * seen, 1.5) / np.maximum(weight, 1e-6)


def _signed(sight: Sight, model: Float[np.ndarray, "H W"], own: np.ndarray) -> Picture:
    """Red: the person is nearer than the body; blue: further away. Grey: one of both is not
    there.
    """
    both = own & np.isfinite(model)
    off = np.where(both, 1e3 * (sight.view.depth - np.where(both, model, 0.0)), 0.0)
    share = (off / ERROR_MM).clip(-1, 1)[..., None]
    picture = np.where(
        share > 0, _WHITE + share * (_BLUE - _WHITE), _WHITE - share * (_RED - _WHITE)
    )
    picture[own & ~both], picture[~own & np.isfinite(model)] = (120, 120, 120), (190, 190, 190)
    picture[~own & ~np.isfinite(model)] = PAPER
    return picture.astype(np.uint8)


def _heat(share: Float[np.ndarray, "h w"]) -> Picture:
    """White, orange, dark red."""
    stops = np.array([[248, 249, 250], [253, 187, 99], [178, 24, 43], [60, 5, 20]], float)
    at = share.clip(0, 1) * 3
    low = np.floor(at).clip(0, 2).astype(int)
    part = (at - low)[..., None]
    return (stops[low] * (1 - part) + stops[low + 1] * part).astype(np.uint8)
