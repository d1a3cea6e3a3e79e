"""What can be checked of a fit: how far depth is from the body, how much of the person it explains,
whom it shows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.fit.rgbd.energy import State
from habitus.fit.rgbd.matching import look, wrong_rows
from habitus.fit.rgbd.off_model import along_normals
from habitus.fit.rgbd.sights import Sight
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec

STRIDE = 3
FAR = 0.05
"""Metres from the body at which a pixel of the person is not explained by it."""


@dataclass(frozen=True)
class ViewEvidence:
    """Of one view: depth less the body's (mm, across the surface): median of its size, bias, 95th
    percentile; shares: ``explained`` of the person's pixels that are near the body, ``outside`` of
    the body's that were seen through, ``overlap`` of both outlines. noise_mm: what the sensor's
    noise leaves as the median. turn_deg: of the person, to its left.
    """

    name: str
    median_mm: float
    bias_mm: float
    p95_mm: float
    noise_mm: float
    explained: float
    outside: float
    overlap: float
    turn_deg: float
    on_floor: bool
    cut_off: bool
    pixels: int


@dataclass(frozen=True)
class Evidence:
    """All that the verdict is drawn from. limb_apart: how far (m) a limb's joint, seen from the
    pelvis, is elsewhere in another view, and which; None of one view. age, stature: the body's
    age, if it was brought to one (years), and how tall its mean person is (m).
    """

    views: tuple[ViewEvidence, ...]
    beta_max: float
    beta_rms: float
    measurements: Mapping[str, float]
    has_background: bool
    has_colour: bool
    way: str
    height_seen: float | None
    limb_apart: tuple[float, str] | None = None
    age: float | None = None
    stature: float = 0.0


def gather(
    body: BodyModel,
    state: State,
    sights: Sequence[Sight],
    noise: float,
    surfaces: Float[np.ndarray, "K V 3"],
    skin: Float[np.ndarray, " V"],
) -> Evidence:
    """The evidence of a fit. surfaces: as they were seen, with what is worn; skin: off the model,
    along normals (m).
    """
    triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
    views = tuple(
        _of_view(
            sight,
            surface,
            triangles,
            state.pose[k, 0],
            noise if sight.noise is None else sight.noise,
        )
        for k, (sight, surface) in enumerate(zip(sights, surfaces, strict=True))
    )
    whole = [sight for sight in sights if sight.on_floor and not sight.cut_off]
    height = (
        float(np.median([np.percentile(s.points[s.mask][:, 1], 99.8) for s in whole]))
        if whole
        else None
    )
    return Evidence(
        views=views,
        has_background=any(sight.view.background is not None for sight in sights),
        has_colour=any(sight.colour_camera is not None for sight in sights),
        way=sights[0].way,
        height_seen=height,
        limb_apart=_limb_apart(body, state),
        **body_evidence(body, state.betas, skin),
    )


def body_evidence(
    body: BodyModel, betas: Float[np.ndarray, " B"], skin: Float[np.ndarray, " V"]
) -> dict[str, Any]:
    """What `Evidence` holds of the body: how rare its betas are, its measurements, and whose they
    are compared with.
    """
    mean = np.zeros(body.num_betas) if body.people_mean is None else body.people_mean
    difference = betas - mean
    return {
        "beta_max": float(np.abs(difference).max(initial=0.0)),
        "beta_rms": float(np.sqrt(np.mean(difference**2))),
        "measurements": body.measure_rest(along_normals(body.rest_vertices(betas), skin, body)),
        "age": body.age,
        "stature": float(np.ptp(body.v_template[:, 1])),
    }


def _limb_apart(body: BodyModel, state: State) -> tuple[float, str] | None:
    """People who are seen twice stand alike: a limb that one view has elsewhere is lost in one of
    them.
    """
    limbs = [
        k
        for k, name in enumerate(body.joint_names)
        if name.endswith(("elbow", "wrist", "knee", "ankle"))
    ]
    if len(state.pose) < 2 or not limbs:
        return None
    joints = np.asarray(body(state.betas, state.pose, state.trans).joints)
    own = np.stack(
        [
            (j[limbs] - j[0]) @ matrix_from_rotvec(pose[0])
            for j, pose in zip(joints, state.pose, strict=True)
        ]
    )
    apart = np.linalg.norm(own[:, None] - own, axis=-1).max((0, 1))
    worst = int(apart.argmax())
    return float(apart[worst]), body.joint_names[limbs[worst]].replace("_", " ")


def _of_view(
    sight: Sight,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
    root: np.ndarray,
    noise: float,
) -> ViewEvidence:
    grid = sight.grid(STRIDE)
    drawn = look(grid, vertices, triangles)
    own = grid.own.ravel()
    shown = np.zeros(grid.own.size, bool)
    shown[drawn.pixel] = True
    both = own[drawn.pixel]
    target = grid.points.reshape(-1, 3)[drawn.pixel[both]]
    off = ((target - drawn.points[both]) * drawn.normals[both]).sum(1)
    far = np.linalg.norm(drawn.points[both] - grid.eye, axis=1)
    near = (
        KDTree(drawn.points).query(grid.points[grid.own])[0] < FAR
        if len(drawn.points)
        else np.zeros(1, bool)
    )
    size = np.abs(off) if len(off) else np.array([np.nan])
    facing = _facing(root)
    return ViewEvidence(
        sight.view.name,
        float(1e3 * np.median(size)),
        float(1e3 * np.median(off)) if len(off) else np.nan,
        float(1e3 * np.percentile(size, 95)),
        float(1e3 * 0.6745 * noise * np.median(far**2)) if len(far) else np.nan,
        float(near.mean()),
        float(len(wrong_rows(grid, drawn)) / max(len(drawn.pixel), 1)),
        float((own & shown).sum() / max((own | shown).sum(), 1)),
        float(np.rad2deg(np.arctan2(facing[0], facing[2]))),
        sight.on_floor,
        sight.cut_off,
        int(sight.mask.sum()),
    )


def _facing(root: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    return np.asarray(matrix_from_rotvec(root))[:, 2]
