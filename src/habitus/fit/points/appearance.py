"""What a view with colours looks like before the whole energy is solved (thesis sec. 4.6.1): the
colour camera's translation beside the depth camera, from the person's outline in colour; then light
and albedo. Colour is the albedo of each vertex times spherical harmonics of the light.

    E_C = sum w (I - a_v h(n_v) L)²,    E_Q = sum over edges (log a_u - log a_v)² / sd²

(thesis eqs. 4.4 and 4.7) in linear light, by Gauss-Newton: of each step log albedo, one number a
vertex, is eliminated (a sparse Schur complement), which leaves the nine numbers of the light. E_Q
is robust, as clothes have seams. Their common factor and tint cannot be told: the light that comes
from everywhere together is taken as white, and brings a white surface to 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.ndimage import binary_erosion, binary_opening, gaussian_filter, label, map_coordinates
from scipy.sparse.linalg import splu

from habitus.fit.points.prepared_views import PreparedView
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera
from habitus.observe.harmonics import harmonics
from habitus.observe.srgb import linear_from_srgb
from habitus.render.draw import draw
from habitus.render.frame import Frame
from habitus.render.jacobians.images import silhouette_jacobian
from habitus.render.triangles import Triangles

SHIFT_STEPS = 5
BLUR = 1.5
REDUCED = 0.5
CAMERA_SHIFT_SD = 0.008
"""Metres by which a calibration may be off."""
CERTAINTY = 0.01
"""Weight of a pixel of the outlines' difference: neighbours along an outline are off together."""
LEAST_OVERLAP = 0.6
"""Share of the outline's pixels that must be the model's: with less, something else differs from
the background.
"""


@dataclass(frozen=True, eq=False)
class ColourShift:
    """What is added to the colour camera's translation (m, its own axes), and how well the outlines
    then overlap.
    """

    shift: Float[np.ndarray, " 3"]
    overlap: float | None


def person_in_colour(sight: PreparedView) -> Bool[np.ndarray, "h w"] | None:
    """Pixels of the colour image that differ from the empty room's; None without that."""
    view = sight.view
    if view.colour is None or view.background_colour is None:
        return None
    apart = np.abs(view.colour.astype(np.float32) - view.background_colour).max(-1)
    smooth = gaussian_filter(apart, 1.0)
    found = binary_opening(smooth > max(12.0, 5.0 * float(np.median(smooth))))
    pieces, count = cast(tuple[np.ndarray, int], label(found))
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    return pieces == sizes.argmax() if count else found


def find_shift(
    sights: list[PreparedView], vertices: list[Float[np.ndarray, "V 3"]], triangles: Triangles
) -> ColourShift:
    """The shift at which the model's outline in colour is the person's, by Gauss-Newton through the
    renderer.
    """
    seen = [person_in_colour(sight) for sight in sights]
    pairs = [
        (s, m, v)
        for s, m, v in zip(sights, seen, vertices, strict=True)
        if m is not None and m.any()
    ]
    if not pairs:
        return ColourShift(np.zeros(3), None)
    shift = np.zeros(3)
    overlap = 0.0
    for _ in range(SHIFT_STEPS):
        matrix = np.eye(3) / CAMERA_SHIFT_SD**2
        right = -shift / CAMERA_SHIFT_SD**2
        overlaps = []
        for sight, mask, surface in pairs:
            assert sight.colour_camera is not None
            camera = moved(sight.colour_camera, shift).scaled(REDUCED)
            residual, jacobian, share = _difference(camera, mask, surface, triangles)
            matrix += CERTAINTY * jacobian.T @ jacobian
            right -= CERTAINTY * jacobian.T @ residual
            overlaps.append(share)
        overlap = min(overlaps)
        shift = shift + np.linalg.solve(matrix, right)
    wrong = overlap < LEAST_OVERLAP or np.linalg.norm(shift) > 3.0 * CAMERA_SHIFT_SD
    return ColourShift(np.zeros(3) if wrong else shift, overlap)


def moved(camera: Camera, shift: Float[np.ndarray, " 3"]) -> Camera:
    """The camera with its translation shifted."""
    return camera.replace(translation=camera.translation + torch.from_numpy(shift))


def _difference(
    camera: Camera,
    mask: Bool[np.ndarray, "h w"],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Blurred outlines' difference, its derivative by the translation, and their overlap."""
    points = torch.from_numpy(vertices)
    frame = draw(camera, points, triangles)
    assert isinstance(frame, Frame)  # one camera, one surface
    drawn = frame.silhouette().numpy()
    rows = (
        (np.arange(camera.height) / REDUCED + 0.5 / REDUCED).astype(int).clip(max=mask.shape[0] - 1)
    )
    columns = (
        (np.arange(camera.width) / REDUCED + 0.5 / REDUCED).astype(int).clip(max=mask.shape[1] - 1)
    )
    observed = mask[np.ix_(rows, columns)].astype(float)
    jacobian = silhouette_jacobian(frame).to_camera(camera, points, ["translation"])["translation"]
    blurred = [gaussian_filter(one.reshape(drawn.shape), BLUR).ravel() for one in jacobian.T]
    both = np.minimum(drawn, observed).sum() / max(np.maximum(drawn, observed).sum(), 1e-9)
    return gaussian_filter(drawn - observed, BLUR).ravel(), np.stack(blurred, 1), float(both)


ROUNDS = 8
SMOOTH_SD = 0.05
"""Spread of log albedo between neighbouring vertices (T eq. 4.7)."""
LIGHT_SD = (0.01, 0.5, 0.25)
"""Spread of the light's harmonics of order 0, 1 and 2 about white light from everywhere."""
TINT_SD = (0.01, 0.01, 0.01)
"""Spread of a channel's light about the grey one's."""
NOISE = 0.02
"""Of colours, linear."""
OUTLIER = 0.15
"""Difference of colours that counts a quarter."""
EDGE = 0.2
"""Jump of log albedo between neighbours that counts a quarter: seams of clothing are none of the
light's doing.
"""
STEEPEST = 0.25
BEHIND = 0.02
DARKEST = 0.004


@dataclass(frozen=True, eq=False)
class Appearance:
    """Albedo (V, 3) of each vertex, light (9, 3) in the world of the views, linear; share of
    vertices seen (V,).

    shift: of the colour camera. residual: root mean square of colour, observed less rendered (0..1,
    linear), on vertices that are seen.
    """

    albedo: Float[np.ndarray, "V 3"]
    light: Float[np.ndarray, "9 3"]
    seen: Float[np.ndarray, " V"]
    shift: ColourShift
    residual: float


@dataclass(frozen=True, eq=False)
class Samples:
    """Colours (N, 3) of vertices as a view shows them, their harmonics (N, 9) and weights (N,)."""

    vertex: Int[np.ndarray, " N"]
    colour: Float[np.ndarray, "N 3"]
    harmonics: Float[np.ndarray, "N 9"]
    weight: Float[np.ndarray, " N"]


def find_appearance(
    sights: Sequence[PreparedView],
    vertices: Float[np.ndarray, "K V 3"],
    faces: Int[np.ndarray, "F 3"],
    shift: ColourShift | None = None,
) -> Appearance | None:
    """Light and albedo from all views with colour; None where there is none, or too little is seen.

    shift: of the colour camera, where it is known; else the outlines tell it.
    """
    with_colour = [k for k, sight in enumerate(sights) if sight.colour_camera is not None]
    if not with_colour:
        return None
    some = [sights[k] for k in with_colour]
    surfaces = [vertices[k] for k in with_colour]
    triangles = Triangles.of(faces, num_vertices=vertices.shape[1])
    shift = shift or find_shift(some, surfaces, triangles)
    samples = joined(
        [
            sample(sight, surface, triangles, shift.shift)
            for sight, surface in zip(some, surfaces, strict=True)
        ]
    )
    if len(samples.vertex) < 200:
        return None
    return solve_appearance(samples, faces, vertices.shape[1], shift)


def solve_appearance(
    samples: Samples, faces: Int[np.ndarray, "F 3"], count: int, shift: ColourShift
) -> Appearance:
    """Light and albedo of samples: Gauss-Newton on both, of grey first, then of each channel near
    the grey light.
    """
    edges = edges_of(faces)
    white = float(samples.harmonics[0, 0])
    light = np.zeros((9, 3))
    albedo = np.empty((count, 3))
    light[0] = 1.0 / white
    grey = light[:, 0]
    plain = samples.colour.mean(1)
    tone = _lit(samples, plain, grey, count)
    for _ in range(ROUNDS):
        tone, grey = _step(samples, plain, (tone, grey), light[:, 0], LIGHT_SD, edges)
    for channel in range(3):
        colour = samples.colour[:, channel]
        own = grey
        tone = _lit(samples, colour, grey, count)
        for _ in range(ROUNDS // 2):
            tone, own = _step(samples, colour, (tone, own), grey, TINT_SD, edges)
        albedo[:, channel], light[:, channel] = tone, own
    scale = light[0] * white
    light = light / scale
    albedo = albedo * scale
    rendered = albedo[samples.vertex] * (samples.harmonics @ light)
    residual = float(
        np.sqrt(np.average((rendered - samples.colour) ** 2, 0, samples.weight).mean())
    )
    return Appearance(
        albedo, light, np.bincount(samples.vertex, samples.weight, count), shift, residual
    )


def _lit(
    samples: Samples, colour: Float[np.ndarray, " N"], light: Float[np.ndarray, " 9"], count: int
) -> Float[np.ndarray, " V"]:
    """Albedo of each vertex by its own samples alone; the usual one where there are none."""
    found = colour / (samples.harmonics @ light).clip(0.1)
    weight = np.bincount(samples.vertex, samples.weight, count)
    mean = np.bincount(samples.vertex, samples.weight * found, count) / np.maximum(weight, 1e-9)
    return np.where(weight > 0, mean, np.median(found)).clip(0.005, 1.5)


def _step(
    samples: Samples,
    colour: Float[np.ndarray, " N"],
    now: tuple[Float[np.ndarray, " V"], Float[np.ndarray, " 9"]],
    usual: Float[np.ndarray, " 9"],
    spread: tuple[float, float, float],
    edges: sparse.csr_array,
) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " 9"]]:
    """Log albedo and light of one channel a step further: albedo is eliminated by its Schur
    complement.

    The light's prior is ``usual`` with a spread for each order.
    """
    (albedo, light), shape = now, samples.harmonics
    count = len(albedo)
    shade = (shape @ light).clip(0.05)
    drawn = albedo[samples.vertex] * shade
    apart = colour - drawn
    weight = samples.weight / NOISE**2 / (1.0 + (apart / OUTLIER) ** 2) ** 2
    by_light = albedo[samples.vertex, None] * shape
    log, (smooth, pull) = np.log(albedo), log_smoothness(edges, albedo)
    diagonal = np.bincount(samples.vertex, weight * drawn**2, count)
    factor = splu((sparse.diags_array(diagonal + 1e-2) + smooth).tocsc())
    entries = (weight * drawn, (samples.vertex, np.arange(len(drawn))))
    meeting = sparse.csr_array(entries, (count, len(drawn))) @ by_light
    right = np.bincount(samples.vertex, weight * drawn * apart, count) - pull
    solved = factor.solve(np.column_stack([meeting, right]))
    prior = np.diag(1.0 / np.array(spread)[ORDERS] ** 2)
    shared = (by_light * weight[:, None]).T @ by_light + prior - meeting.T @ solved[:, :9]
    away = light - usual
    slope = (by_light * weight[:, None]).T @ apart - prior @ away - meeting.T @ solved[:, 9]
    move = np.linalg.solve(shared, slope)
    change = np.clip(solved[:, 9] - solved[:, :9] @ move, -1.0, 1.0)
    return np.exp(np.clip(log + change, np.log(0.003), np.log(3.0))), light + move


def log_smoothness(
    edges: sparse.csr_array, albedo: Float[np.ndarray, " V"]
) -> tuple[sparse.csr_array, Float[np.ndarray, " V"]]:
    """E_Q of one channel (T eq. 4.7), over log albedo: its Gauss-Newton matrix (V, V) and gradient
    (V,).
    """
    log = np.log(albedo)
    jump = edges @ log
    smooth = (
        edges.T @ sparse.diags_array(1.0 / (1.0 + (jump / EDGE) ** 2) ** 2 / SMOOTH_SD**2) @ edges
    )
    return smooth, smooth @ log


def smoothness_cost(edges: sparse.csr_array, albedo: Float[np.ndarray, " V"]) -> float:
    """E_Q of one channel, robust (Geman-McClure)."""
    square = (edges @ np.log(albedo)) ** 2
    return 0.5 * float((square / (1.0 + square / EDGE**2)).sum()) / SMOOTH_SD**2


ORDERS = np.repeat([0, 1, 2], [1, 3, 5])


def edges_of(faces: Int[np.ndarray, "F 3"]) -> sparse.csr_array:
    """Differences of neighbouring vertices (E, V)."""
    count = int(faces.max()) + 1
    pairs = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1),
        axis=0,
    )
    rows = np.repeat(np.arange(len(pairs)), 2)
    return sparse.csr_array(
        (np.tile([1.0, -1.0], len(pairs)), (rows, pairs.ravel())), (len(pairs), count)
    )


def joined(parts: Sequence[Samples]) -> Samples:
    """All samples of several views."""
    return Samples(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0]))
    )


def sample(
    sight: PreparedView,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
    shift: Float[np.ndarray, " 3"],
) -> Samples:
    """The vertices that a view's colour camera sees well, and their colours."""
    normals = vertex_normals(vertices, triangles.faces.numpy())
    assert sight.colour_camera is not None
    camera = moved(sight.colour_camera, shift)
    colour, weight = look_up(
        sight, camera, vertices, normals, depth_of(camera, vertices, triangles)
    )
    rows = np.flatnonzero(weight > 0)
    shade = harmonics(torch.from_numpy(normals[rows])).numpy()
    return Samples(rows, colour[rows], shade, weight[rows])


def depth_of(
    camera: Camera, vertices: Float[np.ndarray, "V 3"], triangles: Triangles
) -> Float[np.ndarray, "h w"]:
    """Depth of the model in a camera; infinite beside it."""
    return draw(camera, torch.from_numpy(vertices), triangles, boundary="none").depth().numpy()


def look_up(
    sight: PreparedView,
    camera: Camera,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    depth: Float[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Linear colours (N, 3) of points on the surface and how far to trust them (N,), 0 where they
    are not seen.

    depth: the model's own in this camera, which hides what lies behind it; its border's pixels are
    not trusted.
    """
    pixels, z = (
        found.numpy() for found in camera.project(torch.from_numpy(np.ascontiguousarray(points)))
    )
    view = points - eye_of(camera)
    view /= np.maximum(np.linalg.norm(view, axis=1, keepdims=True), 1e-9)
    cosine = -(normals * view).sum(1)
    at = pixels.T[::-1] - 0.5
    inside = ((at > 1) & (at < np.array(depth.shape)[:, None] - 2)).all(0)
    cell = np.where(inside, np.round(at), 0).astype(int)
    solid = np.asarray(binary_erosion(np.isfinite(depth), iterations=3), dtype=bool)
    shown = inside & solid[tuple(cell)] & (z < depth[tuple(cell)] + BEHIND) & (cosine > STEEPEST)
    assert sight.view.colour is not None
    linear = to_linear(sight.view.colour)
    colour = np.stack(
        [map_coordinates(linear[..., c], np.where(inside, at, 0.0), order=1) for c in range(3)], 1
    )
    shown &= (colour.max(1) > DARKEST) & (colour.min(1) < 0.995)
    return colour, shown * np.maximum(cosine, 0.0) ** 2


def eye_of(camera: Camera) -> Float[np.ndarray, " 3"]:
    """Where a camera stands in the world."""
    return camera.to_world(torch.zeros(1, 3, dtype=camera.rotation.dtype)).numpy()[0]


def to_linear(image: np.ndarray) -> Float[np.ndarray, "*any"]:
    """Linear light 0..1 of bytes of sRGB."""
    return _LINEAR[image]


_LINEAR = linear_from_srgb(np.arange(256) / 255.0)
