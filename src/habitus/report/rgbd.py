"""The report of a fit to depth views: one HTML file that opens offline, with pictures, numbers and
the body in 3D. Pictures show what was observed, the rendered model and their difference, and light
and albedo separately (T Fig. 4-9).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Real, UInt8
from scipy.ndimage import gaussian_filter

from habitus.errors import shown
from habitus.export.png import png
from habitus.fit.points.appearance import Appearance, moved, to_linear
from habitus.fit.points.prepared_views import PreparedView
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera
from habitus.observe.light import harmonics, srgb_bytes
from habitus.render.draw import draw
from habitus.render.triangles import Triangles
from habitus.report.drawing import Look, ramp_colours, still_page
from habitus.report.shell import (
    MAX_NAME,
    Tile,
    banner,
    card,
    columns,
    figure,
    file_links,
    heading,
    image_uri,
    measurement_tiles,
    measurements_table,
    notes_list,
    solution_card,
    tiles,
)
from habitus.results.save import finite

if TYPE_CHECKING:
    from habitus.fit.points.colour_views import Skin
    from habitus.fit.points.depth_result import RgbdFit

TERMS = {
    "depth": "E_D: depth, observed and of the body",
    "outline": "Body in front of observed background",
    "colour": "E_C: colours, observed and rendered",
    "floor": "E_F: soles on the floor",
    "shape": "E_S: shape prior",
    "pose": "E_P: pose prior",
    "skin": "Prior of the skin offsets",
}
FILES = {
    "body.npz": "shape, poses, albedo and light, for Python",
    "body.glb": "the person in their own colours, for Blender, game engines and web viewers",
    "measurements.csv": "height, girths and lengths",
    "metrics.json": "the numbers of this page, for programs",
}
TILES = {"height_m": "Height", "waist_circumference_m": "Waist", "hip_circumference_m": "Hip"}
TEXTS = {
    "depth": (
        "Depth errors go from red (the person is {limit:.0f} mm closer than the body) over white "
        "to blue ({limit:.0f} mm farther away); grey: only one of the two is there."
    ),
    "view": (
        "turned {turn:+.0f}° · depth error {median:.1f} mm median (noise {noise:.1f}), bias "
        "{bias:+.1f} mm · {explained:.1f} % explained, {outside:.1f} % of the body in front of "
        "observed background · outlines overlap by {overlap:.0f} % · {floor}"
    ),
    "light": (
        "A white ball in the estimated light: spherical harmonics with nine coefficients a "
        "channel. The colour residual is {residual:.1f} % of full scale; {seen:.0f} % of the "
        "surface was observed, the rest is filled in smoothly. The colour camera was moved by "
        "({shift}) mm. Albedo is determined up to one factor and tint, which the light could have "
        "as well."
    ),
    "form": "The fitted person in the first view's pose.",
    "betas": (
        "The body of the shape coefficients alone, up to {most:.0f} mm from the fitted skin."
    ),
    "colours": "The fitted person in the first view's pose, in the skin's albedo, without light.",
}
MAX_DEPTH_ERROR_MM = 30.0
"""Where the scale of depth errors ends."""
MAX_COLOUR_ERROR = 100.0
"""Where the scale of differences of colour ends, of 255."""
DEPTH_RAMP = ("#b2182b", "#f7f7f7", "#2166ac")
COLOUR_RAMP = ("#f8f9fa", "#fdbb63", "#b21825", "#3c0514")
PAPER = np.array([248, 249, 250], np.uint8)
"""The colour that stands for nothing; transparent on the page."""
MARGIN = 0.06
"""Around the person, of the person's size."""
MAX_PICTURE_HEIGHT = 640
"""Pixels; larger pictures are thinned: a page shows them at half of that."""
RELIEF_BLUR = 1.5
"""Pixels (standard deviation): noise of depth sensors would drown the shape."""
Picture = UInt8[np.ndarray, "h w 3"]


def rgbd_page(fit: "RgbdFit", numbers: Mapping[str, Any], skin: "Skin | None" = None) -> str:
    """The report as text. numbers: `habitus.results.depth.depth_metrics` of the fit."""
    numbers = finite(numbers)
    below = [
        *_views(fit),
        _light(fit),
        card("Measurements", measurements_table(fit.measurements)),
        _solution(fit, numbers),
        file_links(FILES),
    ]
    return still_page(
        f"{shown(fit.capture_name, MAX_NAME)} · habitus",
        (_head(fit, numbers), "\n".join(below)),
        _looks(fit, skin),
        "The fitted body in the pose of the first view",
        styles=["rgbd.css"],
    )


def _head(fit: "RgbdFit", numbers: Mapping[str, Any]) -> str:
    count = len(numbers["views"])
    facts = [
        f"{count} view{'s' * (count != 1)}",
        f"body {fit.body_name}",
        f"person segmented by {numbers['segmentation']}",
    ]
    return (
        heading(fit.capture_name, facts) + banner(numbers["verdict"]) + tiles(_tiles(fit, numbers))
    )


def _tiles(fit: "RgbdFit", numbers: Mapping[str, Any]) -> Iterable[Tile]:
    error = numbers["depth_error_mm"]
    explained = 100 * min(view["explained_fraction"] for view in numbers["views"])
    yield "Depth error", f"{error['median']:.1f}", "mm", "median, across the surface"
    yield "95 % are below", f"{error['p95']:.0f}", "mm", "in the worst view"
    yield "Explained", f"{explained:.1f}", "%", "of the person's pixels"
    yield from measurement_tiles(fit.measurements, TILES)


def _views(fit: "RgbdFit") -> list[str]:
    """A card with pictures and numbers of each view."""
    sections = []
    note = escape(TEXTS["depth"].format(limit=MAX_DEPTH_ERROR_MM))
    for made, view in zip(view_pictures(fit), fit.evidence.views, strict=True):
        figures = "".join(
            figure(name, _page_png(picture)) for name, picture in made.pictures.items()
        )
        facts = TEXTS["view"].format(
            turn=view.turn_deg,
            median=view.median_mm,
            noise=view.noise_mm,
            bias=view.bias_mm,
            explained=100 * view.explained,
            outside=100 * view.outside,
            overlap=100 * view.overlap,
            floor="feet on the detected floor" if view.on_floor else "no floor detected",
        )
        inside = f"<div class='shots'>{figures}</div><p class='quiet small'>{note}</p>"
        sections.append(card(f"View {shown(view.name, MAX_NAME)}", inside, facts))
    return sections


def _light(fit: "RgbdFit") -> str:
    """The estimated light; empty where colours were not used."""
    appearance = fit.appearance
    if appearance is None:
        return ""
    text = TEXTS["light"].format(
        residual=100 * appearance.residual,
        seen=100 * (appearance.seen > 0).mean(),
        shift=", ".join(f"{1e3 * value:+.1f}" for value in appearance.shift.shift),
    )
    ball = image_uri(_page_png(light_ball(appearance)))
    inside = (
        f"<div class='ball'><img alt='A ball in the estimated light' src='{ball}'>"
        f"<p>{escape(text)}</p></div>"
    )
    return card("Light", inside)


def _solution(fit: "RgbdFit", numbers: Mapping[str, Any]) -> str:
    rows = [
        (name.replace("_", " ").capitalize(), f"{value:.2f} s")
        for name, value in numbers["stage_seconds"].items()
    ]
    solution = solution_card(numbers["status"], numbers["costs"], TERMS, rows=rows)
    return columns(card("Notes", notes_list(fit.warnings)), solution)


def _looks(fit: "RgbdFit", skin: "Skin | None") -> list[Look]:
    """The person in the pose of the first view: with their albedo, without it, and as the shape
    coefficients alone have them.
    """
    vertices = np.asarray(fit.vertices(0))
    faces = fit.body.faces
    looks = [Look("Shape", TEXTS["form"], vertices, faces)]
    if fit.skin is not None:
        model = np.asarray(fit.body(fit.betas, fit.pose[0], fit.trans[0]).vertices)
        caption = TEXTS["betas"].format(most=1e3 * np.abs(fit.skin).max())
        looks.append(Look("Without offsets", caption, model, faces))
    if skin is None:
        return looks
    is_fine = fit.body.full_vertices is not None and len(skin.vertex_albedo) != len(vertices)
    albedo = skin.vertex_albedo[fit.body.full_vertices] if is_fine else skin.vertex_albedo
    colours = srgb_bytes(albedo)
    return [Look("Colours", TEXTS["colours"], vertices, faces, colours=colours), *looks]


def _page_png(picture: Picture) -> bytes:
    """A picture's PNG, not larger than a page shows it, transparent where it is PAPER."""
    step = max(1, -(-picture.shape[0] // MAX_PICTURE_HEIGHT))
    small = picture[::step, ::step]
    image = np.dstack([small, np.full(small.shape[:2], 255, np.uint8)])
    image[(small == PAPER).all(-1), 3] = 0
    return png(image)


@dataclass(frozen=True, eq=False)
class ViewPictures:
    """Pictures of one view, by their captions."""

    name: str
    pictures: dict[str, Picture]


def view_pictures(fit: "RgbdFit") -> list[ViewPictures]:
    """The pictures of all views."""
    triangles = Triangles.of(fit.body.faces, num_vertices=fit.body.num_vertices)
    surfaces = fit.vertices()
    return [
        ViewPictures(view.view.name, _of_view(view, surface, triangles, fit.appearance))
        for view, surface in zip(fit.prepared_views, surfaces, strict=True)
    ]


def _of_view(
    view: PreparedView,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
    appearance: Appearance | None,
) -> dict[str, Picture]:
    box = _around(view.mask)
    frame = draw(view.camera, torch.from_numpy(vertices), triangles, boundary="none")
    model = frame.depth().numpy()
    person = view.mask & (view.view.depth > 0)
    pictures = {
        "Depth observed": _relief(view.camera, np.where(person, view.view.depth, np.inf))[box],
        "Depth of the body": _relief(view.camera, model)[box],
        "Difference of depth": _depth_difference(view, model, person)[box],
    }
    if appearance is None or view.colour_camera is None or view.view.colour is None:
        return pictures
    return pictures | _colour_pictures(view, vertices, triangles, appearance)


def _colour_pictures(
    view: PreparedView,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
    appearance: Appearance,
) -> dict[str, Picture]:
    assert view.colour_camera is not None and view.view.colour is not None
    camera = moved(view.colour_camera, appearance.shift.shift)
    observed = view.view.colour
    normals = vertex_normals(vertices, triangles.faces.numpy())
    shade = (harmonics(normals) @ appearance.light).clip(0.0)
    frame = draw(camera, torch.from_numpy(vertices), triangles)
    empty = view.view.background_colour
    behind = to_linear(observed if empty is None else empty)

    def image(values: np.ndarray, background: object) -> np.ndarray:
        return frame.image(torch.from_numpy(values), background).numpy()  # pyright: ignore[reportArgumentType]

    rendered = image(appearance.albedo * shade, torch.from_numpy(behind))
    paper = to_linear(PAPER).tolist()
    scale = 0.92 / max(float(np.percentile(appearance.albedo.max(1), 99.5)), 1e-3)
    covered = frame.silhouette().numpy() > 0.5
    difference = np.abs(srgb_bytes(rendered).astype(int) - observed).max(-1)
    box = _around(covered)
    return {
        "Colour observed": observed[box],
        "Rendered": srgb_bytes(rendered)[box],
        "Difference of colours": _ramp_picture(difference, MAX_COLOUR_ERROR, COLOUR_RAMP)[box],
        "Albedo": srgb_bytes(image(appearance.albedo * scale, torch.tensor(paper)))[box],
        "Light": srgb_bytes(
            image(0.7 * shade / max(float(np.percentile(shade, 99)), 1e-3), torch.tensor(paper))
        )[box],
    }


def light_ball(appearance: Appearance, size: int = 160) -> Picture:
    """A white ball in the estimated light, seen as the camera sees the person."""
    y, x = 1.0 - 2.0 * (np.mgrid[:size, :size] + 0.5) / size
    inside = x**2 + y**2 < 1.0
    normals = np.stack([-x, y, np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))], -1)
    shade = harmonics(normals) @ appearance.light
    picture = srgb_bytes((0.75 * shade / max(float(shade[inside].max()), 1e-3)).clip(0.0))
    picture[~inside] = PAPER
    return picture


def _around(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of an image around the person, with a margin."""
    parts = []
    for axis in (1, 0):
        ends = np.flatnonzero(mask.any(axis))
        low, high = (ends[0], ends[-1]) if len(ends) else (0, mask.shape[1 - axis])
        margin = int(MARGIN * (high - low)) + 4
        parts.append(slice(max(low - margin, 0), high + margin))
    return parts[0], parts[1]


def _relief(camera: Camera, depth: Float[np.ndarray, "H W"]) -> Picture:
    """A depth image as a surface lit from the camera, which shows its shape."""
    pixels = np.moveaxis(np.indices(depth.shape)[::-1], 0, -1).reshape(-1, 2) + 0.5
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
    weight = gaussian_filter(seen.astype(float), RELIEF_BLUR)
    return gaussian_filter(depth * seen, RELIEF_BLUR) / np.maximum(weight, 1e-6)


def _depth_difference(
    view: PreparedView, model: Float[np.ndarray, "H W"], person: Bool[np.ndarray, "H W"]
) -> Picture:
    """Observed depth less the body's: red where the person is closer, blue where farther, grey
    where only one of the two is there.
    """
    body = np.isfinite(model)
    both = person & body
    difference = np.where(both, 1e3 * (view.view.depth - np.where(both, model, 0.0)), 0.0)
    picture = _ramp_picture(difference, MAX_DEPTH_ERROR_MM, DEPTH_RAMP, -MAX_DEPTH_ERROR_MM)
    picture[person & ~both] = 120
    picture[body & ~person] = 190
    picture[~body & ~person] = PAPER
    return picture


def _ramp_picture(
    values: Real[np.ndarray, "h w"], limit: float, ramp: tuple[str, ...], low: float = 0.0
) -> Picture:
    colours = ramp_colours(np.ravel(values).astype(float), limit, ramp, low)
    return (255 * colours).astype(np.uint8).reshape(*values.shape, 3)
