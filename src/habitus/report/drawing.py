"""Pictures of bodies drawn in software, and the viewer of still bodies.

A picture shows surfaces or clouds of points along parallel rays, as an RGBA image. A surface is
rasterised by the renderer's compiled kernels (`habitus.render.kernels.raster`: the nearest triangle
at each sample) with ``SAMPLES`` x ``SAMPLES`` samples a pixel, and shaded by one Lambertian light
over the viewer's left shoulder. It needs neither torch nor a display.

The viewer shows surfaces and clouds in 3D, one at a time, and can lay one more over it: `Look` is
one of them, `still_page` the page around them; `SCRIPTS` draw them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from habitus.export.png import png
from habitus.mesh.normals import vertex_normals
from habitus.parallel.workers import map_on_threads
from habitus.render.kernels import raster
from habitus.render.kernels.structs import ScreenFaces
from habitus.report.shell import NO_SCRIPT_STILL, THEME, Blob, card, figure, shell

Rgba = UInt8[np.ndarray, "H W 4"]
ERROR_RAMP = ("#ece7df", "#f7d48a", "#f0934a", "#cf3f4b", "#6a1b5f")
"""Colours from no error to the largest; pale is good, on light and dark pages alike."""
CHANGE_RAMP = ("#2364aa", "#8fbfe0", "#ece7df", "#f2a679", "#c0392b")
"""Colours from a decrease to an increase, neutral in the middle."""
PLAIN = "#b9b2a7"
FRONT = np.eye(3)
"""The view from +z: axes to the right, up and to the viewer."""
BACK = np.diag([-1.0, 1.0, -1.0])
LEFT_SIDE = np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]])
"""The view from +x, of the left side of a person who faces +z."""
SAMPLES = 2
"""Samples a pixel along each axis: enough against jagged outlines at the sizes of a page."""
AMBIENT = 0.45
"""Brightness of a surface that the light does not reach, of 1."""
MARGIN = 1.04
"""Height and width of a picture, in those of what it shows."""
WIDEST = 1.6
"""Width over height from which on the width determines the scale."""
_LIGHT = np.array([-0.35, 0.45, 1.0]) / np.linalg.norm([-0.35, 0.45, 1.0])


def rgb(colour: str) -> tuple[float, ...]:
    """Red, green, blue (0 to 1) of "#rrggbb"."""
    return tuple(int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))


def ramp_colours(
    values: Float[np.ndarray, " V"],
    limit: float,
    ramp: Sequence[str] = ERROR_RAMP,
    low: float = 0.0,
) -> Float[np.ndarray, "V 3"]:
    """Colours (0 to 1) of values from ``low`` to ``limit``, clipped there."""
    position = np.clip((values - low) / max(limit - low, 1e-12), 0.0, 1.0) * (len(ramp) - 1)
    stops = np.array([rgb(colour) for colour in ramp])
    return np.stack([np.interp(position, np.arange(len(ramp)), channel) for channel in stops.T], 1)


def plain_colours(count: int) -> Float[np.ndarray, "V 3"]:
    """The same grey for all."""
    return np.tile(rgb(PLAIN), (count, 1))


def axes_from(direction: Sequence[float] | Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The view from ``direction``: axes to the right, up (as +y as possible) and to the viewer."""
    back = np.asarray(direction, float) / np.linalg.norm(direction)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def facing_views(root: Float[np.ndarray, "3 3"]) -> dict[str, Float[np.ndarray, "3 3"]]:
    """Views from the front and the back of a person whose pelvis has the rotation ``root``; as if
    it faced +z where the person lies.
    """
    ahead = root @ np.array([0.0, 0.0, 1.0])
    ahead = np.array([ahead[0], 0.0, ahead[2]])
    upright = np.linalg.norm(ahead) > 0.2
    front = axes_from(ahead if upright else (0.0, 0.0, 1.0))
    return {"front": front, "back": BACK @ front}


def draw_surface(
    points: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
    width: int,
    height: int,
) -> Rgba:
    """A surface whose points are given as the picture's x (to the right) and y (down, both in
    pixels from its left top) and depth towards the viewer, in pixels too; colours are 0 to 1.
    """
    fine = SAMPLES * np.asarray(points, np.float64)
    ids = _nearest_faces(fine, faces, SAMPLES * width, SAMPLES * height)
    light = vertex_normals(fine * [1.0, -1.0, 1.0], faces) @ _LIGHT
    shaded = colours * (AMBIENT + (1 - AMBIENT) * np.clip(light, 0.0, 1.0))[:, None]
    rows, columns = np.nonzero(ids >= 0)
    corners = faces[ids[rows, columns]]
    share = _barycentric(fine[corners, :2], np.stack([columns, rows], 1) + 0.5)
    layers = np.zeros((*ids.shape, 4))
    layers[rows, columns, :3] = np.einsum("pk,pkc->pc", share, shaded[corners])
    layers[rows, columns, 3] = 1.0
    sums = layers.reshape(height, SAMPLES, width, SAMPLES, 4).sum((1, 3))
    cover = sums[..., 3:]
    image = np.concatenate([sums[..., :3] / np.maximum(cover, 1.0), cover / SAMPLES**2], -1)
    return np.round(255 * np.clip(image, 0.0, 1.0)).astype(np.uint8)


def _nearest_faces(
    points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], width: int, height: int
) -> Int[np.ndarray, "H W"]:
    """The face at each pixel's centre, -1 where there is none.

    Along parallel rays depth is linear on the screen, as 1 / depth is in a camera: it stands where
    the kernels expect that, counted from behind the surface so that it is positive.
    """
    nearness = points[:, 2] - points[:, 2].min() + 1.0
    triangles = np.ascontiguousarray(faces, np.int32)
    facing = np.empty(len(faces), np.int8)
    on_screen = ScreenFaces(np.ascontiguousarray(points), nearness, triangles, facing)
    bounds = np.empty((len(faces), 5), np.float32)
    raster.place_faces(on_screen, False, width, height, 0, len(faces), bounds)
    ids = np.empty((height, width), np.int32)
    rows, columns = -(-height // raster.TILE), -(-width // raster.TILE)
    room = np.empty((height, width)), np.empty((rows, columns))
    raster.draw_rows(on_screen, bounds, 0, rows, ids, *room)
    return ids


def _barycentric(
    corners: Float[np.ndarray, "P 3 2"], points: Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, "P 3"]:
    """Barycentric coordinates of points in the plane."""
    (ax, ay), (bx, by), (x, y) = (
        side.T for side in (corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0],
                            points - corners[:, 0])
    )  # fmt: skip
    area = ax * by - ay * bx
    second = (x * by - y * bx) / area
    third = (ax * y - ay * x) / area
    return np.stack([1.0 - second - third, second, third], 1)


def picture(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
    axes: Float[np.ndarray, "3 3"],
    *,
    height: int = 420,
    frame: Float[np.ndarray, "n 3"] | None = None,
) -> Rgba:
    """A surface (m) in the view ``axes`` (rows: right, up, to the viewer), on a transparent
    background.

    ``frame``: points (m) that fill the picture; by default the whole surface.
    """
    placed, width = _placed(vertices, vertices if frame is None else frame, axes, height)
    return draw_surface(placed, faces, colours, width, height)


def point_picture(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    colours: Float[np.ndarray, "N 3"],
    axes: Float[np.ndarray, "3 3"],
    *,
    height: int = 420,
    radius: int = 2,
) -> Rgba:
    """A cloud of points (m) with unit normals in the view ``axes``; each point that faces the
    viewer is a square of ``2 radius + 1`` pixels, nearer ones over farther ones.
    """
    placed, width = _placed(points, points, axes, height)
    facing = normals @ axes.T
    front = np.flatnonzero(facing[:, 2] > 0.0)
    front = front[np.argsort(placed[front, 2], kind="stable")]
    light = AMBIENT + (1 - AMBIENT) * np.clip(facing[front] @ _LIGHT, 0.0, 1.0)
    shade = np.round(255 * np.clip(colours[front] * light[:, None], 0.0, 1.0)).astype(np.uint8)
    image = np.zeros((height, width, 4), np.uint8)
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            rows = np.clip(placed[front, 1].astype(int) + down, 0, height - 1)
            columns = np.clip(placed[front, 0].astype(int) + right, 0, width - 1)
            image[rows, columns, :3], image[rows, columns, 3] = shade, 255
    return image


def _placed(
    points: Float[np.ndarray, "N 3"],
    frame: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "3 3"],
    height: int,
) -> tuple[Float[np.ndarray, "N 3"], int]:
    """Points as `draw_surface` takes them in a picture of that height that shows ``frame``, and
    the picture's width.
    """
    box = np.asarray(frame, float) @ axes.T
    low = box.min(0)
    high = box.max(0)
    size = high - low
    scale = height / (MARGIN * max(size[1], size[0] / WIDEST))
    width = int(np.clip(np.ceil(MARGIN * size[0] * scale), height // 4, 2 * height))
    middle = 0.5 * (low + high)
    placed = (np.asarray(points, float) @ axes.T - middle) * scale * [1.0, -1.0, 1.0]
    return placed + np.array([0.5 * width, 0.5 * height, 0.0]), width


def front_and_back(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
    height: int = 520,
) -> Rgba:
    """A standing person (m, y up, facing +z) from the front and the back, side by side."""
    return side_by_side(
        [picture(vertices, faces, colours, axes, height=height) for axes in (FRONT, BACK)]
    )


def side_by_side(pictures: Sequence[UInt8[np.ndarray, "H _ 4"]], gap: int = 12) -> Rgba:
    """Pictures of one height beside each other, ``gap`` pixels between two."""
    space = np.zeros((pictures[0].shape[0], gap, 4), np.uint8)
    return np.concatenate([part for image in pictures for part in (space, image)][1:], 1)


def shades(image: Rgba) -> UInt8[np.ndarray, "H W"]:
    """Levels for `habitus.export.png.small_png` of a picture in white: 0 where less than half of a
    pixel is covered, 1 (dark) to 15 (lit).
    """
    light = (image[..., 0] / 255.0 - AMBIENT) / (1.0 - AMBIENT)
    levels = np.clip(1 + np.round(14 * light), 1, 15)
    return np.where(image[..., 3] >= 128, levels, 0).astype(np.uint8)


def shade_palette(dark: Sequence[float], pale: Sequence[float]) -> UInt8[np.ndarray, "16 3"]:
    """Transparent, then fifteen colours (0 to 255) from ``dark`` to ``pale``."""
    steps = np.asarray(dark) + np.linspace(0.0, 1.0, 15)[:, None] * np.subtract(pale, dark)
    return np.concatenate([np.zeros((1, 3)), steps]).round().astype(np.uint8)


SCRIPTS = (THEME, "viewer_inflate.js", "viewer_data.js", "still_viewer.js")
STYLE = "still.css"
MAX_POINTS = 30_000
"""Points of a cloud that a page holds: some 10 bytes each."""
SKIN_AREA = 2.0
"""Square metres that the points of a person's cloud cover, roughly: gives their spacing."""
SHALLOW = 0.6
"""Height over width below which the width determines the scale of the viewer."""
PICTURE_HEIGHT = 480
"""Pixels of a still picture."""


@dataclass(frozen=True, eq=False)
class Look:
    """Points (N, 3; m, y up) of a surface with ``faces`` (F, 3), or of a cloud with ``normals`` (N,
    3).

    ``name`` is the text of its button, ``caption`` stands under it; ``colours`` (N, 3) are sRGB,
    grey where None; ``ramp`` are the colours of a scale whose first is for ``ends[0]`` and whose
    last for ``ends[1]``. ``hatched`` (N, 2): where the surface has stripes, and where stripes both
    ways; ``hatching`` says what these mean. Looks are framed together, one that is ``alone`` by
    itself.
    """

    name: str
    caption: str
    points: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"] | None = None
    normals: Float[np.ndarray, "N 3"] | None = None
    colours: UInt8[np.ndarray, "N 3"] | None = None
    ramp: Sequence[str] = ()
    ends: tuple[str, str] = ("", "")
    hatched: Bool[np.ndarray, "N 2"] | None = None
    hatching: tuple[str, str] = ("", "")
    alone: bool = False


def still_page(
    title: str,
    sections: tuple[str, str],
    looks: Sequence[Look],
    name: str,
    over: Look | None = None,
    facing: float = 0.0,
    styles: Sequence[str] = (),
) -> str:
    """A page with the viewer between two sections of HTML.

    ``name`` describes what is viewed; ``over`` can be laid over any look; ``facing`` (radians about
    the vertical, from +z) is the direction in which the person faces, from where it is seen first.
    """
    blob = Blob()
    data = _still_data(looks, blob, over, facing)
    above, below = sections
    return shell(
        title,
        "\n".join((above, _still_html(looks, name, over), below)),
        data=data | {"arrays": blob.contents, "bytes": blob.size},
        arrays={"report-arrays": blob.base64()},
        scripts=SCRIPTS,
        styles=[STYLE, *styles],
        without_script=NO_SCRIPT_STILL,
    )


def still_pictures(looks: Sequence[Look], root: Float[np.ndarray, "3 3"]) -> str:
    """A card with pictures of all looks from the front and the back, for readers and printers
    without a 3D viewer; ``root`` is the rotation of the person's pelvis.
    """
    views = facing_views(root).values()
    drawn = map_on_threads(lambda look: [png(_picture(look, axes)) for axes in views], looks)
    figures = []
    for look, contents in zip(looks, drawn, strict=True):
        scale = f", {look.ends[0]} to {look.ends[1]}" if look.ramp else ""
        figures.append(figure(look.name + scale, *contents, alt=look.name))
    return card("Front and back", f"<div class='shots pairs'>{''.join(figures)}</div>")


def _picture(look: Look, axes: Float[np.ndarray, "3 3"]) -> Rgba:
    count = len(look.points)
    colours = plain_colours(count) if look.colours is None else look.colours / 255.0
    if look.faces is not None:
        return picture(look.points, look.faces, colours, axes, height=PICTURE_HEIGHT)
    assert look.normals is not None
    return point_picture(look.points, look.normals, colours, axes, height=PICTURE_HEIGHT)


def _still_data(
    looks: Sequence[Look], blob: Blob, over: Look | None, facing: float
) -> dict[str, Any]:
    """What the script reads; arrays go into ``blob``."""
    box = _box(looks)
    together = _frame(*_box([look for look in looks if not look.alone]))
    known: dict[int, str] = {}
    return {
        "looks": [
            _packed(look, blob, known, box) | (_frame(*_box([look])) if look.alone else together)
            for look in looks
        ],
        "over": None if over is None else _packed(over, blob, known, box),
        "facing": facing,
    }


def _box(looks: Sequence[Look]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The lowest and the highest coordinates (m)."""
    points = np.concatenate([look.points for look in looks])
    return points.min(0), points.max(0)


def _frame(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> dict[str, Any]:
    """What the viewer looks at, and the height (m) that it shows."""
    size = max(high[1] - low[1], SHALLOW * np.hypot(*(high - low)[[0, 2]]))
    return {"middle": ((low + high) / 2).tolist(), "size": float(size)}


def _still_html(looks: Sequence[Look], title: str, over: Look | None) -> str:
    """A button for each look, one for what is laid over it, and one for turning."""
    buttons = "".join(
        f"<button type='button' data-look='{k}' "
        f"aria-pressed='{str(k == 0).lower()}'>{escape(look.name)}</button>"
        for k, look in enumerate(looks)
    )
    overlay = (
        f"<button type='button' id='over' aria-pressed='false'>{escape(over.name)}</button>"
        if over
        else ""
    )
    captions = "".join(
        f"<p class='caption'{' hidden' if k else ''} data-caption='{k}'>"
        f"{escape(look.caption)}{_scale(look)}{_hatching(look)}</p>"
        for k, look in enumerate(looks)
    )
    return (
        f"<section class='card still' id='still' aria-label='{escape(title)}'><div class='over'>"
        "<div class='segments' role='group' aria-label='What is shown'>"
        f"{buttons}</div>{overlay}<button type='button' id='spin' aria-pressed='true'>Rotate"
        "</button></div><canvas id='body' tabindex='0' role='img' "
        f"aria-label='{escape(title)}. Drag to rotate, use the wheel to zoom.'></canvas>"
        "<p class='hint' id='hint'>Drag to rotate, wheel to zoom, double click to reset.</p>"
        f"{captions}</section>"
    )


def _packed(
    look: Look, blob: Blob, known: dict[int, str], box: tuple[np.ndarray, np.ndarray]
) -> dict[str, Any]:
    """A look by the names of its arrays in the blob; ``known`` are the names of arrays that are
    there already, by identity.
    """
    stride = max(1, -(-len(look.points) // MAX_POINTS)) if look.faces is None else 1

    def name(array: np.ndarray | None, kind: str) -> str | None:
        if array is None:
            return None
        if id(array) not in known:
            known[id(array)] = f"{kind}{len(known)}"
            _add(blob, known[id(array)], kind, array if kind == "faces" else array[::stride], box)
        return known[id(array)]

    parts = {
        "points": look.points,
        "faces": look.faces,
        "normals": look.normals,
        "colours": look.colours,
        "hatched": look.hatched,
    }
    spacing = float(np.sqrt(SKIN_AREA / max(len(look.points[::stride]), 1)))
    return {kind: name(array, kind) for kind, array in parts.items()} | {"spacing": spacing}


def _add(
    blob: Blob, name: str, kind: str, array: np.ndarray, box: tuple[np.ndarray, np.ndarray]
) -> None:
    if kind == "points":
        blob.add_points(name, array, *box)
    elif kind == "faces":
        blob.add(name, array.astype("u2" if array.max() < 65536 else "u4"))
    elif kind == "normals":
        blob.add(name, np.round(127 * np.pad(array, ((0, 0), (0, 1)))).astype("i1"))
    elif kind == "hatched":
        blob.add(name, np.pad(255 * array.astype("u1"), ((0, 0), (0, 2))))
    else:
        blob.add(name, np.pad(array, ((0, 0), (0, 1)), constant_values=255).astype("u1"))


def _scale(look: Look) -> str:
    if not look.ramp:
        return ""
    first, last = map(escape, look.ends)
    return (
        f" <span class='scale-of'>{first} <i style='background: linear-gradient(90deg, "
        f"{', '.join(look.ramp)})'></i>"
        f" {last}</span>"
    )


def _hatching(look: Look) -> str:
    """What stripes mean, of those that there are."""
    if look.hatched is None:
        return ""
    drawn = [bool(own.any()) for own in look.hatched.T]
    kinds = zip(("one-way", "both-ways"), look.hatching, drawn, strict=True)
    return "".join(
        f" <span class='hatching'><i class='{kind}'></i>{escape(text)}</span>"
        for kind, text, there in kinds
        if there
    )
