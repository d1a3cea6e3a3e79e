"""What can be checked of a fit to depth views: how far depth is from the body, how much of the
person it explains, whether the views agree, whom the body shows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.offsets import along_normals
from habitus.fit.points.depth_energy import (
    degrees_between,
    in_pelvis_frame,
    look,
    person_distances,
    wrong_rows,
)
from habitus.fit.points.depth_settings import STANDARD, RgbdSettings
from habitus.fit.points.depth_start import yaw_of
from habitus.fit.points.prepared_views import SEGMENTATIONS, PreparedView
from habitus.fit.verdict import FEET, HANDS, HEAD, PARTS, SIDES, vertex_parts
from habitus.render.triangles import Triangles

END_PARTS: Mapping[str, str] = MappingProxyType({"head": HEAD, "hand": HANDS, "foot": FEET})
"""The part in `habitus.fit.verdict.PARTS` of an end of the body."""


@dataclass(frozen=True)
class ViewEvidence:
    """Of one view: depth less the body's (mm, across the surface): median of its size, bias, 95th
    percentile; shares: ``explained`` of the person's pixels that are near the body, ``outside`` of
    the body's that were seen through, ``overlap`` of both outlines. noise_mm: what the sensor's
    noise leaves as the median. turn_deg: of the person, to its left. ends: of head, hands and feet,
    as "left hand", the share of pixels further than `RgbdSettings.end_distance` from the body.
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
    ends: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class Evidence:
    """All that the verdict is drawn from. limb_apart, limb_turned: the largest difference of a limb
    joint's position (m) and rotation (degrees), relative to the pelvis, between two views, and the
    joint; None of one view. height_seen: of the highest point above the floor, less measured hair
    (m). explained_distance, end_distance: of the settings (m). age, stature:
    the body's age, if it was brought to one (years), and the height of its mean person (m). status:
    how the last solve ended (`habitus.minimize`).
    """

    views: tuple[ViewEvidence, ...]
    beta_max: float
    beta_rms: float
    measurements: Mapping[str, float]
    has_background: bool
    has_colour: bool
    segmentation: str
    height_seen: float | None
    limb_apart: tuple[float, str] | None = None
    limb_turned: tuple[float, str] | None = None
    explained_distance: float = STANDARD.explained_distance
    end_distance: float = STANDARD.end_distance
    age: float | None = None
    stature: float = 0.0
    status: str = "converged"


def gather(
    body: BodyModel,
    state: BodyState,
    prepared: Sequence[PreparedView],
    settings: RgbdSettings,
    surfaces: Float[np.ndarray, "K V 3"],
    skin: Float[np.ndarray, " V"],
    hair: Float[np.ndarray, " V"],
    status: str,
) -> Evidence:
    """The evidence of a fit. surfaces: of each view (m), with skin offsets, clothes and hair; skin:
    offsets of the skin from the model, outwards along its normals (m); hair: thickness of measured
    hair (m); status: of the last solve.
    """
    triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
    ends = end_names(body)
    views = tuple(
        _of_view(
            view,
            surface,
            triangles,
            ends,
            state.pose[k, 0],
            settings,
        )
        for k, (view, surface) in enumerate(zip(prepared, surfaces, strict=True))
    )
    whole = [view for view in prepared if view.on_floor and not view.cut_off]
    height = (
        float(np.median([np.percentile(s.points[s.mask][:, 1], 99.8) for s in whole]) - hair.max())
        if whole
        else None
    )
    return Evidence(
        views=views,
        has_background=any(view.view.background is not None for view in prepared),
        has_colour=any(view.colour_camera is not None for view in prepared),
        segmentation=next(
            each for each in SEGMENTATIONS if any(s.segmentation == each for s in prepared)
        ),
        height_seen=height,
        explained_distance=settings.explained_distance,
        end_distance=settings.end_distance,
        status=status,
        **_between_views(body, state),
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


def _between_views(body: BodyModel, state: BodyState) -> dict[str, tuple[float, str] | None]:
    """How much limbs differ between the views: people keep their pose, so that a limb with another
    position or rotation is wrong in one of the views.
    """
    limbs = [
        k
        for k, name in enumerate(body.joint_names)
        if name.endswith(("elbow", "wrist", "knee", "ankle"))
    ]
    if len(state.pose) < 2 or not limbs:
        return {"limb_apart": None, "limb_turned": None}
    joints, rotations = (each[:, limbs] for each in in_pelvis_frame(body, state))
    distance = np.linalg.norm(joints[:, None] - joints, axis=-1).max((0, 1))
    angle = degrees_between(rotations[:, None], rotations).max((0, 1))

    def most(values: np.ndarray) -> tuple[float, str]:
        worst = int(values.argmax())
        return float(values[worst]), body.joint_names[limbs[worst]].replace("_", " ")

    return {"limb_apart": most(distance), "limb_turned": most(angle)}


def _of_view(
    view: PreparedView,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
    ends: np.ndarray,
    root: np.ndarray,
    settings: RgbdSettings,
) -> ViewEvidence:
    noise = settings.noise if view.noise is None else view.noise
    grid = view.grid(settings.judged_stride)
    drawn = look(grid, vertices, triangles)
    own = grid.person.ravel()
    shown = np.zeros(grid.person.size, bool)
    shown[drawn.pixel] = True
    both = own[drawn.pixel]
    target = grid.points.reshape(-1, 3)[drawn.pixel[both]]
    off = ((target - drawn.points[both]) * drawn.normals[both]).sum(1)
    far = np.linalg.norm(drawn.points[both] - grid.eye, axis=1)
    distance = person_distances(grid, drawn)
    size = np.abs(off) if len(off) else np.array([np.nan])
    return ViewEvidence(
        view.view.name,
        float(1e3 * np.median(size)),
        float(1e3 * np.median(off)) if len(off) else np.nan,
        float(1e3 * np.percentile(size, 95)),
        float(1e3 * 0.6745 * noise * np.median(far**2)) if len(far) else np.nan,
        float((distance < settings.explained_distance).mean()),
        float(len(wrong_rows(grid, drawn, settings.seen_through)) / max(len(drawn.pixel), 1)),
        float((own & shown).sum() / max((own | shown).sum(), 1)),
        float(np.rad2deg(yaw_of(root))),
        view.on_floor,
        view.cut_off,
        int(view.mask.sum()),
        _ends_off(
            ends,
            vertices,
            ends[triangles.faces.numpy()[drawn.face, 0]],
            grid.points[grid.person],
            distance > settings.end_distance,
        ),
    )


def end_names(body: BodyModel) -> np.ndarray:
    """For each vertex the name of the head, hand or foot that it belongs to, as "left hand"; "" for
    the rest of the body.
    """
    singular = {part: end for end, part in END_PARTS.items()}
    parts = np.array([singular.get(part, "") for part in PARTS])[vertex_parts(body)]
    joints = np.array(body.joint_names)[body.strongest_joint]
    sides = np.array([name.partition("_")[0] for name in joints])
    sided = (parts != "") & np.isin(sides, SIDES)
    return np.where(sided, np.char.add(np.char.add(sides, " "), parts), parts)


def _ends_off(
    names: np.ndarray,
    vertices: Float[np.ndarray, "V 3"],
    drawn: np.ndarray,
    person: Float[np.ndarray, "n 3"],
    far: Bool[np.ndarray, " n"],
) -> Mapping[str, float]:
    """Pixels of each end that are far from the body, over its pixels: those that are nearest to it
    or those that the body's would fill, whichever are more. names: as `end_names`; drawn: those of
    the body's pixels.
    """
    nearest = names[KDTree(vertices).query(person)[1]] if len(person) else names[:0]
    shares = {}
    for name in filter(None, np.unique(drawn).tolist()):
        own = nearest == name
        shares[name] = float((own & far).sum() / max(own.sum(), (drawn == name).sum()))
    return MappingProxyType(shares)
