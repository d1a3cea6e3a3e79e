"""Correspondences of depth views: "depth", the point of the model's surface that a pixel belongs to
(the nearest that the camera would see, or the same pixel's); "outline", the silhouette's nearest
pixel of what covers the background.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from habitus.fit.points.depth_settings import STANDARD, DepthStage, RgbdSettings
from habitus.fit.points.prepared_views import Grid
from habitus.render.draw import draw
from habitus.render.triangles import Triangles
from habitus.residuals.points import PointObservations
from habitus.solve.terms import geman_mcclure_weight


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a grid's camera would see of the model: N surface points.

    pixel (N,): number in the grid; face, barycentric: where on the surface; points, normals (N, 3):
    world.
    """

    pixel: Int[np.ndarray, " N"]
    face: Int[np.ndarray, " N"]
    barycentric: Float[np.ndarray, "N 3"]
    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]


def look(grid: Grid, vertices: Float[np.ndarray, "V 3"], triangles: Triangles) -> Drawn:
    """The model's points at the centres of a grid's pixels."""
    frame = draw(grid.camera, torch.from_numpy(vertices), triangles, boundary="none", cull=True)
    ids = frame.face_ids.numpy().ravel()
    pixel = np.flatnonzero(ids >= 0)
    face = ids[pixel].astype(np.int64)
    barycentric = frame.barycentrics.numpy().reshape(-1, 3)[pixel]
    corners = triangles.faces.numpy()[face]
    points = np.einsum("nk,nkc->nc", barycentric, vertices[corners])
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Drawn(pixel, face, barycentric, points, normals)


@dataclass(frozen=True, eq=False)
class Matching:
    """Terms by name, each as points of the surface against places, and how far (m) the person's
    pixels were off.
    """

    matches: Mapping[str, PointObservations]
    distance: Float[np.ndarray, " P"]


def match(
    grid: Grid,
    drawn: Drawn,
    stage: DepthStage,
    reach: float,
    noise: float,
    settings: RgbdSettings,
) -> Matching:
    """E_D of one view and its outline, at the model as it is."""
    correspondences = (_nearest if stage.matching == "nearest" else _same_pixel)(grid, drawn)
    rows, target = correspondences
    normal = drawn.normals[rows]
    point = drawn.points[rows]
    view = point - grid.eye
    depth = np.linalg.norm(view, axis=1)
    cosine = np.abs((normal * view).sum(1)) / np.maximum(depth, 1e-6)
    spread = np.hypot(noise * depth**2 * np.maximum(cosine, settings.min_cosine), settings.model_sd)
    off = ((point - target) * normal).sum(1)
    distance = (
        np.linalg.norm(point - target, axis=1) if stage.matching == "nearest" else np.abs(off)
    )
    weight = settings.depth * grid.stride**2 / spread**2 * geman_mcclure_weight(distance, reach)
    slide = settings.slide if stage.matching == "nearest" else 0.0
    depth_term = PointObservations.to_planes(
        drawn.face[rows], drawn.barycentric[rows], target, normal, weight, slide
    )
    return Matching(
        {"depth": depth_term, "outline": outline(grid, drawn, reach, settings)}, distance
    )


def _nearest(grid: Grid, drawn: Drawn) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the person the nearest point of the model: its row, and the pixel's own
    point.
    """
    target = grid.points[grid.person]
    if not len(drawn.points):
        return np.zeros(0, np.int64), target[:0]
    return np.asarray(KDTree(drawn.points).query(target)[1]), target


def _same_pixel(grid: Grid, drawn: Drawn) -> tuple[np.ndarray, np.ndarray]:
    own = grid.person.ravel()[drawn.pixel]
    return np.flatnonzero(own), grid.points.reshape(-1, 3)[drawn.pixel[own]]


def outline(grid: Grid, drawn: Drawn, reach: float, settings: RgbdSettings) -> PointObservations:
    """Points of the model before what was seen through are drawn to the person's nearest pixel,
    across the view.
    """
    rows = wrong_rows(grid, drawn, settings.seen_through)
    pixel = drawn.pixel[rows]
    nearest = grid.nearest.reshape(2, -1)[:, pixel]
    depth = np.linalg.norm(drawn.points[rows] - grid.eye, axis=1)
    centres = np.stack([nearest[1] + 0.5, nearest[0] + 0.5], -1)
    rays = grid.camera.to_world(grid.camera.rays(torch.from_numpy(centres))).numpy() - grid.eye
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    target = grid.eye + rays * depth[:, None]
    weight = settings.outline * grid.stride**2 / settings.outline_sd**2
    weight = weight * geman_mcclure_weight(
        np.linalg.norm(target - drawn.points[rows], axis=1), max(reach, settings.min_outline_scale)
    )
    across = np.cross(rays, [0.0, 1.0, 0.0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    directions = np.stack([across, np.cross(rays, across)], 1) * np.sqrt(weight)[:, None, None]
    return PointObservations(drawn.face[rows], drawn.barycentric[rows], target, directions)


def wrong_rows(grid: Grid, drawn: Drawn, clearance: float) -> Int[np.ndarray, " n"]:
    """Points of the model that lie ``clearance`` (m) or more before what was seen through them."""
    behind, own = (image.ravel()[drawn.pixel] for image in (grid.behind, grid.person))
    depth = grid.camera.to_camera(torch.from_numpy(drawn.points)).numpy()[:, 2]
    return np.flatnonzero(~own & (behind > depth + clearance))


def misfit(grid: Grid, drawn: Drawn, settings: RgbdSettings = STANDARD) -> float:
    """How badly the model explains a view: mean distance (m), capped, from the person's pixels to
    the model, and the cap for each pixel of the model that was seen through.
    """
    most = settings.search.max_misfit_distance
    own = grid.points[grid.person]
    if not len(drawn.points) or not len(own):
        return 2.0 * most
    distance = np.minimum(KDTree(drawn.points).query(own)[0], most).mean()
    return float(distance + most * len(wrong_rows(grid, drawn, settings.seen_through)) / len(own))
