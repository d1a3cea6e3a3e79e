"""How a scan lies to a registered surface: distances, what of it is matched and lost, cloth, and
the energy of a fit.
"""

from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.fit.offsets import field_precision
from habitus.fit.points.clothes import REGIONS
from habitus.fit.points.correspondences import find_correspondences
from habitus.fit.points.limb_settings import LimbSettings
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_fitting import OffsetFit, ScanFitter
from habitus.fit.points.settings import SCANS
from habitus.fit.verdict import BODY, PARTS, vertex_parts
from habitus.mesh.normals import vertex_normals


class ScanDistances(TypedDict):
    """The fields of `ScanFit` that `compared` gives."""

    to_surface: Float[np.ndarray, " M"]
    to_model: Float[np.ndarray, " M"]
    far_from_surface: Float[np.ndarray, " N"]
    matched: float
    lost: float
    lost_part: str
    cloth: dict[str, float]


def compared(
    fitter: ScanFitter,
    cloud: Cloud,
    surface: Float[np.ndarray, "V 3"],
    model: Float[np.ndarray, "V 3"],
) -> ScanDistances:
    """Distances of a scan from surface and model, and the shares that are matched and lost; cloth
    that hangs off the surface counts for none of them.
    """
    settings = fitter.settings
    there, near = (
        find_correspondences(fitter.topology, each, cloud.points, cloud.normals)
        for each in (surface, model)
    )
    corners = fitter.topology.faces[there.face]
    skin = ~fitter.clothes.hanging(there, corners, cloud.points)
    to_surface, to_model = (each.distances(cloud.points) for each in (there, near))
    matched = (to_model < settings.matched_distance) & (near.cosine > settings.matched_cosine)
    counted = np.ones(len(matched), bool)
    if matched.any():
        counted = to_surface < settings.matched_distance
        counted &= np.abs(there.cosine) > settings.matched_cosine
    limbs = settings.limbs
    on_body = vertex_parts(fitter.body)[corners[:, 0]] == PARTS.index(BODY)
    limit = np.where(on_body, limbs.lost_in_folds, limbs.lost_distance)
    off = np.where(skin, to_surface, 0.0) * limbs.lost_distance / limit
    lost, place = lost_piece(cloud.points, off, limbs)
    hung = np.where(skin, 0.0, there.outside(cloud.points))
    joint = np.array(fitter.body.joint_names)[fitter.body.strongest_joint[corners[:, 0]]]
    return {
        "to_surface": to_surface[counted & skin],
        "to_model": to_model[counted & skin],
        "far_from_surface": to_surface,
        "matched": float(matched[skin].mean()) if skin.any() else 0.0,
        "lost": lost,
        "lost_part": part_around(fitter.body, surface, place),
        "cloth": {
            region: float(np.median(hung[np.isin(joint, joints)]))
            for region, joints in REGIONS.items()
            if fitter.clothes.loose and np.isin(joint, joints).any()
        },
    }


def energy(fitter: ScanFitter, fit: OffsetFit, clouds: Sequence[Cloud]) -> float:
    """E of all scans (`scans`) at surfaces that lie off the model along its normals; noise and
    scale are those of `ScanSettings.choice_stage`.
    """
    state = fit.state
    settings = fitter.settings
    stage = settings.choice_stage
    total = 0.5 * float(state.betas @ state.betas)
    for k, (cloud, surface) in enumerate(zip(clouds, fit.surfaces, strict=True)):
        model = fitter.vertices(state, k)
        offset = ((surface - model) * vertex_normals(model, fitter.topology.faces)).sum(1)
        offset -= fit.prior.mean
        precision = field_precision(
            fitter.topology.faces, model, fit.prior.spread, settings.offsets.range
        )
        deviation = state.pose[k, 1:].ravel() - fitter.prior.mean
        total += 0.5 * float(offset @ (precision @ offset))
        total += 0.5 * float(deviation @ fitter.precision @ deviation)
        distances = fitter.distances(surface, cloud.first(stage.points))
        square = distances**2
        loss = square * stage.scale**2 / (square + stage.scale**2)
        total += 0.5 / stage.noise**2 * float(loss.sum())
    return total


def lost_share(
    points: Float[np.ndarray, "N 3"],
    distances: Float[np.ndarray, " N"],
    settings: LimbSettings = SCANS.limbs,
) -> float:
    """The share of a scan, by area, that lies off the surface (``distances``, m) in the place where
    most of it does.
    """
    return lost_piece(points, distances, settings)[0]


def lost_piece(
    points: Float[np.ndarray, "N 3"],
    distances: Float[np.ndarray, " N"],
    settings: LimbSettings = SCANS.limbs,
) -> tuple[float, Float[np.ndarray, " 3"]]:
    """That share, and the place (m)."""
    far = distances > settings.lost_distance
    off = points[far]
    if len(off) == 0:
        return 0.0, points.mean(0)
    area = area_shares(points, settings)[far]
    few = off[:: max(1, len(off) // settings.lost_balls)]
    balls = KDTree(off).query_ball_point(few, settings.lost_radius)
    lost = np.array([area[ball].sum() for ball in balls])
    return float(lost.max()), few[lost.argmax()]


def area_shares(
    points: Float[np.ndarray, "N 3"], settings: LimbSettings = SCANS.limbs
) -> Float[np.ndarray, " N"]:
    """The share of the scan's area that each point stands for: vertices of a mesh are dense at
    hands and faces. By the square of the distance to a neighbour; that of a stray point is bounded.
    """
    count = min(settings.area_neighbours + 1, len(points))
    radius = KDTree(points).query(points, k=count)[0].reshape(len(points), -1)[:, -1]
    radius = np.minimum(radius, np.quantile(radius, settings.area_quantile))
    area = np.square(radius)
    return area / area.sum()


def part_around(
    body: BodyModel, surface: Float[np.ndarray, "V 3"], place: Float[np.ndarray, " 3"]
) -> str:
    """The part of the body (`habitus.fit.verdict.PARTS`) whose skin is nearest to a place (m)."""
    nearest = np.linalg.norm(surface - place, axis=1).argmin()
    return PARTS[vertex_parts(body)[nearest]]
