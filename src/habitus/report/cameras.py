"""The report of a fit to keypoints of cameras: one HTML file that opens offline, with overlays of
body and keypoints in every camera, errors, corrections, and the body in 3D.
"""

from collections.abc import Iterable, Mapping
from html import escape
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from habitus.errors import listed, shown
from habitus.export.png import png
from habitus.fit.cameras.determined import determined, open_skin
from habitus.fit.cameras.result import CameraFit
from habitus.observe.camera_rig import NEAR, CameraRig, RigCamera
from habitus.report.drawing import Look, draw_surface, plain_colours, still_page
from habitus.report.fit.texts import segment
from habitus.report.shell import (
    MAX_NAME,
    Tile,
    banner,
    card,
    columns,
    file_links,
    heading,
    image_uri,
    measurements_table,
    notes_list,
    numbers_table,
    solution_card,
    tiles,
)
from habitus.results.save import finite
from habitus.rotations import up_rotation

TERMS = {
    "pixels": "Keypoints, detected and of the body",
    "shape": "Shape prior",
    "pose": "Pose prior",
    "definitions": "The detector's own places of keypoints",
    "cameras": "Corrections of cameras",
    "scale": "Distance between cameras",
    "height": "Height that was given",
}
FILES = {
    "body.npz": "shape, poses, keypoints and cameras, for Python",
    "body.glb": "the body in motion, for Blender, game engines and web viewers",
    "measurements.csv": "height, girths and lengths",
    "metrics.json": "the numbers of this page, for programs",
}
GUESSED = (
    "Keypoints tell of the lengths of bones. Girths and mass, and the shape of face, hands and "
    "feet, come from what is usual for people."
)
OPEN_PLACE = "Crosshatched: no keypoint determines how this part is held ({names})."
OPEN_TURN = "Hatched: no keypoint determines the turn of this part about its own axis ({names})."
OPEN_REST = " What is hatched, and all girths, are as is usual for people."
ALONE = (
    " One camera sees no depth: distance, and turns towards the camera and away from it, are "
    "guesses of the priors."
)
MOMENTS = 3
"""Overlays of each camera."""
PICTURE = 300
"""Pixels, the height of an overlay."""
MARGIN = 0.15
BODY_COLOUR, CAMERA_COLOUR, GIVEN_COLOUR = (158, 153, 145), (20, 110, 130), (180, 180, 180)
FRUSTUM = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 3, 2], [1, 4, 3]])
FRUSTUM_LENGTH = 0.3
"""Metres."""
OVER_PICTURE = 0.6
"""Opacity of the body over a picture."""
SAMPLES = 3
"""Samples of a picture along a side of an overlay's pixel."""
Pictures = Mapping[tuple[int, int], UInt8[np.ndarray, "H W 3"]]


def camera_page(
    fit: CameraFit, numbers: Mapping[str, Any], pictures: Pictures | None = None
) -> str:
    """The report as text. numbers: `habitus.results.cameras.camera_metrics` of the fit; pictures:
    of the cameras' videos at `moments`, by camera and frame.
    """
    numbers = finite(dict(numbers))
    guessed = GUESSED + ALONE * (len(numbers["cameras"]) == 1)
    hatching = _hatching(fit)
    drawn = [bool(own.any()) for own in hatching.skin.T]
    said = [text for text, on in zip(hatching.texts, drawn, strict=True) if on]
    guessed = " ".join([guessed, *said])
    below = [
        *_overlays(fit, pictures or {}),
        _cameras(numbers),
        _keypoints(fit),
        card("Measurements", measurements_table(fit.measurements), guessed),
        columns(
            card("Notes", notes_list(fit.warnings)),
            solution_card(numbers["status"], numbers["costs"], TERMS),
        ),
        file_links(FILES),
    ]
    return still_page(
        f"{shown(fit.capture_name, MAX_NAME)} · habitus",
        (_head(fit, numbers), "\n".join(below)),
        _looks(fit, hatching),
        "The fitted body at some moments",
    )


def _head(fit: CameraFit, numbers: Mapping[str, Any]) -> str:
    count = len(numbers["cameras"])
    facts = [
        f"{count} cameras" if count > 1 else "1 camera",
        f"{len(fit.pose)} frames at {fit.rate_hz:g} Hz",
        f"keypoints {fit.convention}",
        f"body {fit.body_name}",
    ]
    return (
        heading(fit.capture_name, facts) + banner(numbers["verdict"]) + tiles(_tiles(fit, numbers))
    )


def _tiles(fit: CameraFit, numbers: Mapping[str, Any]) -> Iterable[Tile]:
    error = numbers["keypoint_error_px"]
    if error is not None:
        yield "Keypoint error", f"{error['median']:.1f}", "px", "median over all cameras"
        yield "95 % are below", f"{error['p95']:.0f}", "px", "over all cameras"
    size = float(np.median(fit.size_px))
    yield "Person in the images", f"{size:.0f}", "px", "height, median"
    given = "" if fit.given_height is None else f"; {100 * fit.given_height:.1f} cm were given"
    yield "Height", f"{100 * fit.height:.1f}", "cm", f"of the body at rest{given}"
    yield "Acceleration", f"{fit.acceleration:.1f}", "m/s²", "of joints, root mean square"


def _cameras(numbers: Mapping[str, Any]) -> str:
    rows = []
    for camera in numbers["cameras"]:
        error = camera["keypoint_error_px"] or {"median": float("nan"), "p95": float("nan")}
        rows.append(
            (
                shown(camera["name"], MAX_NAME),
                f"{error['median']:.1f}",
                f"{error['p95']:.0f}",
                f"{100 * camera['detected_fraction']:.0f} %",
                f"{camera['corrected_degrees']:.2f}°",
                f"{100 * camera['corrected_m']:.1f}",
                f"{camera['late_frames']:+.2f}",
                f"{camera['frames_with_sides_exchanged']}",
            )
        )
    heads = ("Camera", "Error px", "95 %", "Detected", "Turned", "Shifted cm", "Late frames",
             "Sides put back")  # fmt: skip
    lead = "What each camera saw, and how its calibration and clock were corrected."
    return card("Cameras", numbers_table(rows, heads), lead)


def _keypoints(fit: CameraFit) -> str:
    rows = []
    for k, name in enumerate(fit.keypoint_names):
        own = fit.errors_px[..., k]
        own = own[np.isfinite(own)]
        off = 1e3 * float(np.linalg.norm(fit.keypoint_places[k]))
        median = f"{np.median(own):.1f}" if len(own) else "not seen"
        cameras = float((fit.confidence[..., k] > 0.0).sum(1).mean())
        rows.append((name.replace("_", " "), median, f"{cameras:.1f}", f"{off:.0f}"))
    heads = ("Keypoint", "Error px", "Cameras that see it", "Detector's own place mm")
    lead = (
        "The last column is how far the detector puts a keypoint from where the joint or landmark "
        "of that name is, as the fit found it."
    )
    return card("Keypoints", numbers_table(rows, heads), lead)


def moments(frames: int) -> list[int]:
    """The frames of the overlays."""
    return np.unique(np.linspace(0, frames - 1, MOMENTS + 2).round().astype(int)[1:-1]).tolist()


class _Hatching(NamedTuple):
    """Vertices (V, 2) whose turn, and whose place, no keypoint determines, and what that is in
    words.
    """

    skin: Bool[np.ndarray, "V 2"]
    texts: tuple[str, str]


def _hatching(fit: CameraFit) -> _Hatching:
    """By the keypoints that were seen."""
    place, turn = determined(fit).open
    names = [segment(name) for name in fit.body.joint_names]
    said = [listed((names[k] for k in np.flatnonzero(bones)), 12) for bones in (turn, place)]
    texts = OPEN_TURN.format(names=said[0]), OPEN_PLACE.format(names=said[1])
    held = open_skin(fit, place)
    return _Hatching(np.stack([open_skin(fit, turn | place) & ~held, held], 1), texts)


def _looks(fit: CameraFit, hatching: _Hatching) -> list[Look]:
    """The body at some moments, upright, and among the cameras."""
    turn = up_rotation(fit.up_axis)
    looks = []
    for t in moments(len(fit.pose)):
        vertices = np.asarray(fit.vertices(t)) @ turn.T
        vertices = vertices - [vertices[:, 0].mean(), vertices[:, 1].min(), vertices[:, 2].mean()]
        caption = f"The body at {t / fit.rate_hz:.2f} s."
        looks.append(
            Look(
                f"{t / fit.rate_hz:.2f} s",
                caption + OPEN_REST * bool(hatching.skin.any()),
                vertices,
                fit.body.faces,
                hatched=hatching.skin,
                hatching=hatching.texts,
            )
        )
    return [*looks, _among_cameras(fit, turn)]


def _among_cameras(fit: CameraFit, turn: Float[np.ndarray, "3 3"]) -> Look:
    """The body in the middle of the recording and what each camera's image spans nearby; cameras as
    they were given are grey.
    """
    assert fit.cameras is not None and fit.given_cameras is not None
    surface = np.asarray(fit.vertices(len(fit.pose) // 2)) @ turn.T
    points, faces = [surface], [fit.body.faces]
    colours: list[np.ndarray] = [np.full(surface.shape, BODY_COLOUR, np.uint8)]
    rigs = [(fit.cameras, CAMERA_COLOUR, FRUSTUM_LENGTH)]
    if fit.corrections.any():
        rigs.append((fit.given_cameras, GIVEN_COLOUR, 0.9 * FRUSTUM_LENGTH))
    for rig, colour, length in rigs:
        for camera in rig.cameras:
            faces.append(FRUSTUM + sum(map(len, points)))
            points.append(_frustum(camera, length) @ turn.T)
            colours.append(np.full((5, 3), colour, np.uint8))
    names = ", ".join(shown(name, MAX_NAME) for name in fit.cameras.names)
    caption = f"The cameras ({names}) around the body, in the middle of the recording"
    caption += "; grey: as calibrated." if len(rigs) > 1 else "."
    return Look(
        "Cameras",
        caption,
        np.concatenate(points),
        np.concatenate(faces),
        colours=np.concatenate(colours),
        alone=True,
    )


def _frustum(camera: RigCamera, length: float) -> Float[np.ndarray, "5 3"]:
    """A camera's place and the corners of its image in a plane ``length`` before it (m)."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [camera.width, camera.height]
    rays = np.column_stack([(corners - camera.centre) / camera.focal, np.ones(4)])
    own = np.concatenate([np.zeros((1, 3)), length * rays])
    return (own - camera.translation) @ camera.rotation


def _overlays(fit: CameraFit, pictures: Pictures) -> list[str]:
    """A card for each camera, with the body and its keypoints over the detected ones."""
    cameras = fit.cameras
    assert cameras is not None
    surfaces = {t: np.asarray(fit.vertices(t)) for t in moments(len(fit.pose))}
    cards = []
    for c, name in enumerate(cameras.names):
        figures = "".join(
            f"<figure>{overlay(fit, cameras, c, t, surface, pictures.get((c, t)))}"
            f"<figcaption>{t / fit.rate_hz:.2f} s</figcaption></figure>"
            for t, surface in surfaces.items()
        )
        lead = "Dots are detected keypoints, rings the body's, in an image without distortion."
        cards.append(
            card(f"Camera {shown(name, MAX_NAME)}", f"<div class='shots'>{figures}</div>", lead)
        )
    return cards


def overlay(
    fit: CameraFit,
    cameras: CameraRig,
    c: int,
    t: int,
    surface: Float[np.ndarray, "V 3"],
    picture: UInt8[np.ndarray, "H W 3"] | None = None,
) -> str:
    """One camera at one moment, as SVG: the body, over the camera's picture where there is one,
    detected keypoints (dots) and its own (rings).
    """
    pixels = cameras.project(surface)[c]
    own, seen = fit.predicted[t, c], fit.observed[t, c]
    sure = fit.confidence[t, c] > 0.0
    shown_points = np.concatenate([pixels, seen[sure]])
    shown_points = shown_points[np.isfinite(shown_points).all(1)]
    if not len(shown_points):
        return "<p class='quiet'>Behind the camera.</p>"
    low, high = np.percentile(shown_points, (0.5, 99.5), axis=0)
    pad = MARGIN * float((high - low).max())
    low, high = low - pad, high + pad
    width, height = high - low
    scale = PICTURE / height
    size = (max(1, int(np.ceil(scale * width))), PICTURE)
    layers = []
    if picture is not None:
        layers.append(undistorted(picture, cameras.cameras[c], low, scale, size))
    if np.isfinite(pixels).all():
        depth = surface @ cameras.rotation[c, 2] + cameras.translation[c, 2]
        flat = np.column_stack([scale * (pixels - low), -scale * height * (depth - depth.min())])
        if depth.min() > NEAR:
            layers.append(draw_surface(flat, fit.body.faces, plain_colours(len(flat)), *size))
    share = f" opacity='{OVER_PICTURE}'" if picture is not None else ""
    image = "".join(
        f"<image href='{image_uri(png(layer))}' width='{size[0]}' height='{size[1]}'"
        f"{share if k else ''}/>"
        for k, layer in enumerate(layers)
    )
    marks = []
    radius = 2.2
    for name, (x, y), there in zip(
        fit.keypoint_names, scale * (own - low), np.isfinite(own).all(1), strict=True
    ):
        if there:
            marks.append(
                f"<circle cx='{x:.1f}' cy='{y:.1f}' r='{radius + 1.2}' fill='none' "
                f"stroke='#111' stroke-width='1'><title>{escape(name)}, body</title></circle>"
            )
    for name, (x, y), there in zip(fit.keypoint_names, scale * (seen - low), sure, strict=True):
        if there and np.isfinite(x + y):
            colour = (
                "#1f77b4" if name.startswith("left") else
                "#d62728" if name.startswith("right") else "#2ca02c"
            )  # fmt: skip
            marks.append(
                f"<circle cx='{x:.1f}' cy='{y:.1f}' r='{radius}' fill='{colour}'>"
                f"<title>{escape(name)}, detected</title></circle>"
            )
    box = f"0 0 {scale * width:.0f} {PICTURE}"
    return (
        f"<svg viewBox='{box}' width='{scale * width:.0f}' height='{PICTURE}' role='img' "
        f"aria-label='Body and keypoints in one camera'>{image}{''.join(marks)}</svg>"
    )


def undistorted(
    picture: UInt8[np.ndarray, "H W 3"],
    camera: RigCamera,
    low: Float[np.ndarray, "2"],
    scale: float,
    size: tuple[int, int],
) -> UInt8[np.ndarray, "h w 3"]:
    """A part of a camera's picture without the lens' distortion: from the pixel ``low`` on,
    ``scale`` pixels for one, ``size`` wide and high; grey where the picture ends.
    """
    width, height = size
    columns, rows = (
        (np.arange(SAMPLES * n) + 0.5) / (SAMPLES * scale) + start
        for n, start in zip(size, low, strict=True)
    )
    at = camera.distorted(np.stack(np.meshgrid(columns, rows), -1))
    x, y = np.moveaxis(np.floor(np.nan_to_num(at, nan=-1.0)).astype(int), -1, 0)
    inside = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
    samples = np.full((*x.shape, 3), 128.0)
    samples[inside] = picture[y[inside], x[inside]]
    blocks = samples.reshape(height, SAMPLES, width, SAMPLES, 3)
    return np.rint(blocks.mean((1, 3))).astype(np.uint8)
