"""A capture of a known person: the default body with few betas, planted shape, motion and marker
placement.

Markers are carried by the posed surface with NumPy alone, so that a fit is held against a second
spelling of M eq. 2.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior, shipped_prior
from habitus.fit.markers.recipe import Recording, fit_markers
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body
from habitus.markers.layouts import MarkerLayout
from habitus.observe.markers import attach
from habitus.observe.simulated_markers import misplace, smooth_motion

BETAS = 4
RATE_HZ = 30.0
NOISE = 5e-4  # metres, sd of each coordinate


@dataclass(frozen=True)
class Planted:
    """Markers (T, M, 3) as observed and without noise, and the truth behind them; metres,
    radians.
    """

    body: BodyModel
    prior: PosePrior
    layout: MarkerLayout
    observed: np.ndarray
    exact: np.ndarray
    latent_markers: np.ndarray
    betas: np.ndarray
    pose: np.ndarray
    trans: np.ndarray

    def column(self, label: str) -> int:
        return self.layout.labels.index(label)

    def columns(self, *labels: str) -> list[int]:
        return [self.column(label) for label in labels]


@cache
def person() -> BodyModel:
    return load_body("default").with_betas(BETAS)


@cache
def layout_of(name: str = "cmu-41") -> MarkerLayout:
    return load_layout(name)


@cache
def prior_of_poses() -> PosePrior:
    return shipped_prior()


def surface(betas, pose, trans, vertices=None) -> np.ndarray:
    """Vertices (T, V, 3) of the body, betas (T, B) or (B,)."""
    body = person()
    shape = np.broadcast_to(betas, (len(pose), body.num_betas))
    arrays = [torch.as_tensor(np.array(a, dtype=float)) for a in (shape, pose, trans)]
    chosen = {} if vertices is None else {"vertices": torch.as_tensor(vertices)}
    return np.asarray(body(*arrays, **chosen).vertices)


def carried(attachment, betas, pose, trans) -> np.ndarray:
    """Markers (T, M, 3) that ride on the posed surface."""
    used, corners = np.unique(np.asarray(attachment.triangles), return_inverse=True)
    a, b, c = np.moveaxis(surface(betas, pose, trans, used)[:, corners.reshape(-1, 3)], 2, 0)
    t = (b - a) / np.linalg.norm(b - a, axis=-1, keepdims=True)
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return a + np.einsum(
        "ktmc,mk->tmc", np.stack([n, t, np.cross(n, t)]), np.asarray(attachment.coefficients)
    )


def rest(betas) -> np.ndarray:
    """Vertices (V, 3) at rest."""
    joints = person().num_joints
    return surface(betas, np.zeros((1, joints, 3)), np.zeros((1, 3)))[0]


def motion(frames: int, seed: int = 0, share: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Pose (T, J, 3) and trans (T, 3) of a smooth motion about the prior's mean, by a share of its
    spread.
    """
    prior = prior_of_poses().for_joints(person().joint_names)
    sd = np.sqrt(np.diag(prior.covariance))
    rng = np.random.default_rng(seed)
    return smooth_motion(np.asarray(prior.mean), share * sd, frames, RATE_HZ, rng)


def place_by_hand(betas, layout: MarkerLayout) -> np.ndarray:
    """The layout's places (M, 3) on the body at rest: along the vertex normal, as far from the skin
    as it says.
    """
    points = rest(betas)
    faces = np.asarray(person().faces)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    normals = np.zeros_like(points)
    for corner in faces.T:
        np.add.at(normals, corner, np.cross(b - a, c - a))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ids = layout.vertices(person())
    return points[ids] + layout.distances()[:, None] * normals[ids]


def plant(
    frames: int = 60,
    seed: int = 1,
    *,
    layout: str = "cmu-41",
    betas=(1.2, -0.8, 0.6, -1.0),
    placement: float = 0.0,
    standoff: float = 0.0,
    noise: float = NOISE,
    states=None,
    soft_tissue=0.0,
) -> Planted:
    """A capture and its truth.

    placement: sd of the markers' places on the skin; standoff: how much further from it they are
    than the layout says; states: pose and trans; soft_tissue (T, B) comes on top of betas.
    """
    rng = np.random.default_rng(seed)
    body = person()
    markers = layout_of(layout)
    betas = np.array(betas)
    pose, trans = motion(frames, seed) if states is None else states
    latent = misplace(
        body, betas, markers.vertices(body), markers.distances() + standoff, placement, rng
    )
    attachment = attach(latent, rest(betas), np.asarray(body.faces))
    exact = carried(attachment, betas + soft_tissue, pose, trans)
    observed = exact + noise * rng.normal(size=exact.shape)
    return Planted(body, prior_of_poses(), markers, observed, exact, latent, betas, pose, trans)


def settings(shape=None, pose=None, **changes) -> MoshSettings:
    """The ordinary settings with fewer frames; ``shape`` and ``pose``: weights that differ, by
    name.
    """
    base = MoshSettings(frames=6)
    return replace(
        base,
        shape=replace(base.shape, **shape or {}),
        pose=replace(base.pose, **pose or {}),
        **changes,
    )


def fit(planted: Planted, observed=None, which: MoshSettings | None = None) -> MarkerFit:
    observed = planted.observed if observed is None else observed
    recording = Recording("planted", np.array(observed), RATE_HZ, "+y")
    return fit_markers(
        planted.body, planted.prior, planted.layout, [recording], which or settings()
    )[0]


def degrees_apart(a, b) -> np.ndarray:
    """Angles (...) in degrees between rotation vectors (..., 3)."""
    shape = np.shape(a)[:-1]
    turn = Rotation.from_rotvec(np.reshape(a, (-1, 3))).inv() * Rotation.from_rotvec(
        np.reshape(b, (-1, 3))
    )
    return np.degrees(turn.magnitude()).reshape(shape)
