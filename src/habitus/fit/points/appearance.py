"""What a view with colours looks like before the whole energy is solved (thesis sec. 4.6.1): the
colour camera's translation beside the depth camera, from the person's outline in colour; then light
and albedo. Colour is the albedo of each vertex times spherical harmonics of the light.

    E_C = sum w (I - a_v h(n_v) L)²,    E_Q = sum over edges (log a_u - log a_v)² / sd²

(thesis eqs. 4.4 and 4.7) in linear light, solved for log albedo, one number a vertex, and the nine
numbers of the light (`channel_terms`). E_Q is robust, as clothes have seams. The common factor of
both and their tint are unobservable: the mean light is taken as white, and brings a white surface
to 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.ndimage import binary_erosion, binary_opening, gaussian_filter, label, map_coordinates

from habitus.fit.points.depth_settings import APPEARANCE, AppearanceSettings
from habitus.fit.points.prepared_views import PreparedView
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera
from habitus.observe.light import harmonics, linear_from_srgb
from habitus.parallel.workers import map_on_threads
from habitus.render.draw import draw
from habitus.render.frame import Frame
from habitus.render.jacobians.images import silhouette_jacobian
from habitus.render.triangles import Triangles
from habitus.solve.least_squares import Levenberg, Tolerances
from habitus.solve.minimize import Minimized, minimize
from habitus.solve.terms import GemanMcClure, Term, geman_mcclure_weight


@dataclass(frozen=True, eq=False)
class ColourShift:
    """What is added to the colour camera's translation (m, its own axes), and how well the outlines
    then overlap (None where there is none to compare); status: of `habitus.minimize`.
    """

    shift: Float[np.ndarray, " 3"]
    overlap: float | None
    status: str = "not tried"


def person_in_colour(
    prepared: PreparedView, settings: AppearanceSettings = APPEARANCE
) -> Bool[np.ndarray, "h w"] | None:
    """Pixels of the colour image that differ from the empty room's; None without that."""
    view = prepared.view
    if view.colour is None or view.background_colour is None:
        return None
    difference = np.abs(view.colour.astype(np.float32) - view.background_colour).max(-1)
    smooth = gaussian_filter(difference, 1.0)
    usual = settings.difference_medians * float(np.median(smooth))
    changed = binary_opening(smooth > max(settings.min_difference, usual))
    pieces, count = cast(tuple[np.ndarray, int], label(changed))
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    return pieces == sizes.argmax() if count else changed


def find_shift(
    views: list[PreparedView],
    vertices: list[Float[np.ndarray, "V 3"]],
    triangles: Triangles,
    settings: AppearanceSettings = APPEARANCE,
) -> ColourShift:
    """The shift at which the model's outlines in colour are the person's.

    "outline"      1/2 c sum |G * (drawn - observed)|^2,    c = ``outline``, G a Gaussian
    "calibration"  1/2 |shift|^2 / camera_shift_sd^2
    """
    seen = [person_in_colour(view, settings) for view in views]
    pairs = [
        (view.colour_camera, mask, surface)
        for view, mask, surface in zip(views, seen, vertices, strict=True)
        if view.colour_camera is not None and mask is not None and mask.any()
    ]
    if not pairs:
        return ColourShift(np.zeros(3), None)

    def outlines(shift: np.ndarray) -> list["Outline"]:
        return [
            Outline.of(
                moved(camera, shift).scaled(settings.reduction), mask, surface, triangles, settings
            )
            for camera, mask, surface in pairs
        ]

    def difference(shift: np.ndarray) -> tuple[np.ndarray, Any]:
        drawn = outlines(shift)
        residual = np.concatenate([each.residual for each in drawn])
        return residual, lambda: {"shift": np.concatenate([each.jacobian() for each in drawn])}

    def calibration(shift: np.ndarray) -> tuple[np.ndarray, Any]:
        return shift, {"shift": np.eye(3)}

    solution = minimize(
        {
            "outline": Term(difference, settings.outline),
            "calibration": Term(calibration, settings.camera_shift_sd**-2.0),
        },
        {"shift": np.zeros(3)},
        Levenberg(settings.damping),
        max_iterations=settings.shift_steps,
        tolerances=Tolerances(cost=1e-4),
        stretch=False,
    )
    shift = solution.values["shift"]
    overlap = min(each.overlap for each in outlines(shift))
    largest = settings.max_shift_sds * settings.camera_shift_sd
    wrong = overlap < settings.min_overlap or np.linalg.norm(shift) > largest
    return ColourShift(np.zeros(3) if wrong else shift, overlap, solution.status)


def moved(camera: Camera, shift: Float[np.ndarray, " 3"]) -> Camera:
    """The camera with its translation shifted."""
    return camera.replace(translation=camera.translation + torch.from_numpy(shift))


@dataclass(frozen=True, eq=False)
class Outline:
    """A model's silhouette in a camera against an observed one (h, w): the blurred difference, and
    how much both overlap (intersection over union).
    """

    frame: Frame
    camera: Camera
    points: torch.Tensor
    residual: Float[np.ndarray, " hw"]
    overlap: float
    blur: float

    @staticmethod
    def of(
        camera: Camera,
        mask: Bool[np.ndarray, "H W"],
        vertices: Float[np.ndarray, "V 3"],
        triangles: Triangles,
        settings: AppearanceSettings,
    ) -> "Outline":
        """camera: of a reduced image; mask: of the full one."""
        points = torch.from_numpy(vertices)
        frame = draw(camera, points, triangles)
        assert isinstance(frame, Frame)  # one camera, one surface
        drawn = frame.silhouette().numpy()
        rows, columns = (
            ((np.arange(size) + 0.5) / settings.reduction).astype(int).clip(max=limit - 1)
            for size, limit in zip((camera.height, camera.width), mask.shape, strict=True)
        )
        observed = mask[np.ix_(rows, columns)].astype(float)
        union = max(float(np.maximum(drawn, observed).sum()), 1e-9)
        overlap = float(np.minimum(drawn, observed).sum()) / union
        residual = gaussian_filter(drawn - observed, settings.blur).ravel()
        return Outline(frame, camera, points, residual, overlap, settings.blur)

    def jacobian(self) -> Float[np.ndarray, "hw 3"]:
        """Of the residual by the camera's translation."""
        by_pixel = silhouette_jacobian(self.frame).to_camera(
            self.camera, self.points, ["translation"]
        )["translation"]
        shape = (self.camera.height, self.camera.width)
        return np.stack(
            [gaussian_filter(each.reshape(shape), self.blur).ravel() for each in by_pixel.T], 1
        )


@dataclass(frozen=True, eq=False)
class Appearance:
    """Albedo (V, 3) of each vertex, light (9, 3) in the world of the views, linear; share of
    vertices seen (V,).

    shift: of the colour camera. residual: root mean square of colour, observed less rendered (0..1,
    linear), on vertices that are seen. status: of `habitus.minimize`.
    """

    albedo: Float[np.ndarray, "V 3"]
    light: Float[np.ndarray, "9 3"]
    seen: Float[np.ndarray, " V"]
    shift: ColourShift
    residual: float
    status: str = "iterations"


@dataclass(frozen=True, eq=False)
class Samples:
    """Colours (N, 3) of vertices as a view shows them, their harmonics (N, 9) and weights (N,)."""

    vertex: Int[np.ndarray, " N"]
    colour: Float[np.ndarray, "N 3"]
    harmonics: Float[np.ndarray, "N 9"]
    weight: Float[np.ndarray, " N"]


def find_appearance(
    views: Sequence[PreparedView],
    vertices: Float[np.ndarray, "K V 3"],
    faces: Int[np.ndarray, "F 3"],
    shift: ColourShift | None = None,
    settings: AppearanceSettings = APPEARANCE,
) -> Appearance | None:
    """Light and albedo from all views with colour; None where there is none, or too little is seen.

    shift: of the colour camera, where it is known; else the outlines tell it.
    """
    with_colour = [k for k, view in enumerate(views) if view.colour_camera is not None]
    if not with_colour:
        return None
    some = [views[k] for k in with_colour]
    surfaces = [vertices[k] for k in with_colour]
    triangles = Triangles.of(faces, num_vertices=vertices.shape[1])
    shift = shift or find_shift(some, surfaces, triangles, settings)
    samples = joined(
        [
            sample(view, surface, triangles, shift.shift, settings)
            for view, surface in zip(some, surfaces, strict=True)
        ]
    )
    if len(samples.vertex) < settings.min_samples:
        return None
    return solve_appearance(samples, faces, vertices.shape[1], shift, settings)


def solve_appearance(
    samples: Samples,
    faces: Int[np.ndarray, "F 3"],
    count: int,
    shift: ColourShift,
    settings: AppearanceSettings = APPEARANCE,
) -> Appearance:
    """Light and albedo of samples, of ``count`` vertices: of grey first, then of each channel, its
    light about the grey one's.
    """
    edges = edges_of(faces)
    white = float(samples.harmonics[0, 0])
    usual = np.zeros(9)
    usual[0] = 1.0 / white
    mean = samples.colour.mean(1)
    solved = _solved(samples, mean, usual, settings.light_sd, edges, settings.grey_steps, settings)
    grey = solved.values["light"]
    tinted = grey, settings.tint_sd, edges, settings.channel_steps, settings
    channels = map_on_threads(lambda each: _solved(samples, each, *tinted), samples.colour.T)
    light = np.stack([each.values["light"] for each in channels], 1)
    logs = np.stack([each.values["log_albedo"] for each in channels], 1)
    albedo = np.exp(logs).clip(settings.min_albedo, settings.max_albedo)
    scale = light[0] * white
    light = light / scale
    albedo = albedo * scale
    rendered = albedo[samples.vertex] * (samples.harmonics @ light)
    residual = float(
        np.sqrt(np.average((rendered - samples.colour) ** 2, 0, samples.weight).mean())
    )
    seen = np.bincount(samples.vertex, samples.weight, count)
    status = next((each.status for each in channels if not each.converged), "converged")
    return Appearance(albedo, light, seen, shift, residual, status)


def _solved(
    samples: Samples,
    colour: Float[np.ndarray, " N"],
    usual: Float[np.ndarray, " 9"],
    spread: tuple[float, float, float],
    edges: sparse.csr_array,
    steps: int,
    settings: AppearanceSettings,
) -> Minimized:
    """Log albedo (V,) and light (9,) of one channel, from the usual light."""
    count = edges.shape[1]  # pyright: ignore[reportOptionalSubscript]  (SciPy has no annotations)
    albedo = _lit(samples, colour, usual, count)
    return minimize(
        channel_terms(samples, colour, usual, spread, edges, settings),
        {"log_albedo": np.log(albedo), "light": usual},
        Levenberg(settings.damping),
        max_step={"log_albedo": settings.max_log_step},
        max_iterations=steps,
        tolerances=Tolerances(cost=1e-4),
        stretch=False,
    )


def channel_terms(
    samples: Samples,
    colour: Float[np.ndarray, " N"],
    usual: Float[np.ndarray, " 9"],
    spread: tuple[float, float, float],
    edges: sparse.csr_array,
    settings: AppearanceSettings = APPEARANCE,
) -> dict[str, Term]:
    """E_C and E_Q of one channel, and the prior of its light about ``usual``."""
    shape = samples.harmonics
    vertex = samples.vertex
    root = np.sqrt(samples.weight)
    ends = np.arange(len(vertex) + 1)
    sd = np.array(spread)[ORDERS]
    noise = settings.noise
    smooth_sd = settings.smooth_sd

    def observed(log_albedo: np.ndarray, light: np.ndarray) -> tuple[np.ndarray, Any]:
        albedo = np.exp(log_albedo)[vertex]
        drawn = albedo * (shape @ light).clip(settings.min_shade)
        by_albedo = sparse.csr_array(
            (root * drawn / noise, vertex, ends), (len(vertex), len(log_albedo))
        )
        by_light = (root * albedo / noise)[:, None] * shape
        residual = (root * (drawn - colour) / noise)[:, None]
        return residual, {"log_albedo": by_albedo, "light": by_light}

    def jumps(log_albedo: np.ndarray) -> tuple[np.ndarray, Any]:
        return (edges @ log_albedo)[:, None] / smooth_sd, {"log_albedo": edges / smooth_sd}

    def about_usual(light: np.ndarray) -> tuple[np.ndarray, Any]:
        return (light - usual) / sd, {"light": np.diag(1.0 / sd)}

    return {
        "colour": Term(observed, robust=GemanMcClure(root * settings.outlier / noise)),
        "smoothness": Term(jumps, robust=GemanMcClure(settings.edge / smooth_sd)),
        "light": Term(about_usual),
    }


def _lit(
    samples: Samples, colour: Float[np.ndarray, " N"], light: Float[np.ndarray, " 9"], count: int
) -> Float[np.ndarray, " V"]:
    """Albedo of each vertex by its own samples alone; the usual one where there are none."""
    albedo = colour / (samples.harmonics @ light).clip(0.1)
    weight = np.bincount(samples.vertex, samples.weight, count)
    mean = np.bincount(samples.vertex, samples.weight * albedo, count) / np.maximum(weight, 1e-9)
    return np.where(weight > 0, mean, np.median(albedo)).clip(0.005, 1.5)


def log_smoothness(
    edges: sparse.csr_array,
    albedo: Float[np.ndarray, " V"],
    settings: AppearanceSettings = APPEARANCE,
) -> tuple[sparse.csc_array, Float[np.ndarray, " V"]]:
    """E_Q of one channel (T eq. 4.7), over log albedo: its Gauss-Newton matrix (V, V) and gradient
    (V,).
    """
    log = np.log(albedo)
    jump = edges @ log
    weight = geman_mcclure_weight(jump, settings.edge) / settings.smooth_sd**2
    smooth = edges.T @ sparse.diags_array(weight) @ edges
    return smooth, smooth @ log


def smoothness_cost(
    edges: sparse.csr_array,
    albedo: Float[np.ndarray, " V"],
    settings: AppearanceSettings = APPEARANCE,
) -> float:
    """E_Q of one channel, robust (Geman-McClure)."""
    square = (edges @ np.log(albedo)) ** 2
    return 0.5 * float((square / (1.0 + square / settings.edge**2)).sum()) / settings.smooth_sd**2


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
    view: PreparedView,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
    shift: Float[np.ndarray, " 3"],
    settings: AppearanceSettings = APPEARANCE,
) -> Samples:
    """The vertices that a view's colour camera sees well, and their colours."""
    normals = vertex_normals(vertices, triangles.faces.numpy())
    assert view.colour_camera is not None
    camera = moved(view.colour_camera, shift)
    colour, weight = look_up(
        view, camera, vertices, normals, depth_of(camera, vertices, triangles), settings
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
    prepared: PreparedView,
    camera: Camera,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    depth: Float[np.ndarray, "h w"],
    settings: AppearanceSettings = APPEARANCE,
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Linear colours (N, 3) of points on the surface and how far to trust them (N,), 0 where they
    are not seen.

    depth: the model's own in this camera, which hides what lies behind it; its border's pixels are
    not trusted.
    """
    pixels, z = (
        array.numpy() for array in camera.project(torch.from_numpy(np.ascontiguousarray(points)))
    )
    view = points - eye_of(camera)
    view /= np.maximum(np.linalg.norm(view, axis=1, keepdims=True), 1e-9)
    cosine = -(normals * view).sum(1)
    at = pixels.T[::-1] - 0.5
    inside = ((at > 1) & (at < np.array(depth.shape)[:, None] - 2)).all(0)
    cell = np.where(inside, np.round(at), 0).astype(int)
    solid = np.asarray(binary_erosion(np.isfinite(depth), iterations=3), dtype=bool)
    shown = inside & solid[tuple(cell)] & (z < depth[tuple(cell)] + settings.hidden)
    shown &= cosine > settings.min_cosine
    assert prepared.view.colour is not None
    linear = to_linear(prepared.view.colour)
    colour = np.stack(
        [map_coordinates(linear[..., c], np.where(inside, at, 0.0), order=1) for c in range(3)], 1
    )
    shown &= (colour.max(1) > settings.min_colour) & (colour.min(1) < settings.max_colour)
    return colour, shown * np.maximum(cosine, 0.0) ** 2


def eye_of(camera: Camera) -> Float[np.ndarray, " 3"]:
    """Where a camera stands in the world."""
    return camera.to_world(torch.zeros(1, 3, dtype=camera.rotation.dtype)).numpy()[0]


def to_linear(image: np.ndarray) -> Float[np.ndarray, "*any"]:
    """Linear light 0..1 of bytes of sRGB."""
    return _LINEAR[image]


_LINEAR = linear_from_srgb(np.arange(256) / 255.0)
