"""The result of a fit to depth views: a body, its poses in all views, its appearance and its
verdict: limits of the evidence, checks and sentences (`habitus.fit.verdict` weighs them).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import Frames, Moving
from habitus.fit.offsets import along_normals
from habitus.fit.points.appearance import Appearance
from habitus.fit.points.depth_evidence import END_PARTS, Evidence
from habitus.fit.points.prepared_views import PreparedView
from habitus.fit.verdict import (
    COMMON_SENTENCES,
    DOUBTFUL,
    GOOD,
    HEAD,
    Bound,
    PeopleLimits,
    Reason,
    Verdict,
    above,
    below,
    measurement_reasons,
    percent,
    shape_reasons,
    solver_reasons,
    weigh,
    worst,
)

SEEN_PEOPLE = PeopleLimits(above=Bound(0.15, 0.25), head=HEAD)
"""Clothes and hair are measured, too, and only add to girths; a person smaller than adults may be a
child."""


@dataclass(frozen=True)
class RgbdLimits:
    """Limits of the evidence on a fit, set by simulated people (benchmarks/rgbd_people.py)."""

    over_noise: Bound = Bound(1.8, 3.5)
    """Median depth residual as a multiple of the sensor's noise."""
    median_mm: Bound = Bound(14.0, 30.0)
    explained: Bound = Bound(0.97, 0.90)
    outside: Bound = Bound(0.02, 0.04)
    """Right fits reach 0.005, of a real frame of five people 0.014; a focal length wrong by 1.3 has
    0.05 and more."""
    ends: Bound = Bound(0.05, 0.15)
    """Of 256 images of hands of people unlike the body's own, one of a hand within 15 mm has more
    than the first; of eight that are 30 to 85 mm off in a found pose, none has less."""
    overlap: Bound = Bound(0.86, 0.72)
    beta_max: Bound = Bound(6.0, 9.0)
    """Of 64 people unlike the body's own (40 wide, 24 about foreign means) right fits reach 5.8,
    and wrong ones begin at 4.6."""
    beta_rms: Bound = Bound(2.5, 3.0)
    height: Bound = Bound(0.03, 0.08)
    """Metres between the body's height and the person's highest point."""
    limb_apart: Bound = Bound(0.25, np.inf)
    """Metres between a joint in two views."""
    limb_turned: Bound = Bound(60.0, np.inf)
    """Degrees between a joint's rotations in two views. 26 is the most of 38 right fits; a forearm
    turned about itself has 110."""
    people: PeopleLimits = SEEN_PEOPLE


LIMITS = RgbdLimits()

SENTENCES: Mapping[str, str] = MappingProxyType(
    {
        **COMMON_SENTENCES,
        "depth": "Half of the depth pixels lie within {median:.1f} mm of the body, 95 % within "
        "{p95:.0f} mm{where}; the sensor's noise alone leaves {noise:.1f} mm.",
        "unexplained": "{view}: {share} of the person's pixels are more than {distance:.0f} cm "
        "from the body.",
        "end": "{view}: {share} of the pixels of the {end} are more than {distance:.0f} cm "
        "from the body.",
        "outside": "{view}: {share} of the body covers pixels where the background was seen.",
        "overlap": "{view}: body and person overlap by {share} only.",
        "height": "The person's highest point is {seen:.0f} cm above the floor; the body is "
        "{height:.0f} cm tall.",
        "limb": "The {joint} differs by {distance:.0f} cm between the views: the person moved, or "
        "an arm or leg is lost.",
        "turned": "The {joint} is rotated by {angle:.0f} degrees between the views: the person "
        "moved, or the limb is turned about its axis in one of them.",
        "segmentation": "No background frame or mask was given, so the segmentation is uncertain; "
        "check the limbs.",
        "cut off": "The person reaches beyond the image; unseen parts follow the shape prior.",
        "one view": "One view only; the unseen side follows the shape prior.",
    }
)


def judge(evidence: Evidence, limits: RgbdLimits = LIMITS) -> Verdict:
    """The verdict on the evidence of a fit."""
    return weigh(CHECKS, evidence, limits, SENTENCES)


def _solver(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    return solver_reasons(e.status)


def _depth(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    view = max(e.views, key=lambda view: view.median_mm)
    level = worst(
        [
            above(view.median_mm / max(view.noise_mm, 2.0), limits.over_noise),
            above(view.median_mm, limits.median_mm),
        ]
    )
    where = f" (the worst view, {view.name})" if len(e.views) > 1 and level != GOOD else ""
    values = {
        "median": view.median_mm,
        "p95": view.p95_mm,
        "where": where,
        "noise": view.noise_mm,
    }
    yield Reason(level, "depth", values)


def _explained(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    for view in e.views:
        level = below(view.explained, limits.explained)
        if level != GOOD:
            share = percent(1.0 - view.explained, 1)
            values = {"view": view.name, "share": share, "distance": 100 * e.explained_distance}
            yield Reason(level, "unexplained", values)
        level = above(view.outside, limits.outside)
        if level != GOOD:
            share = percent(view.outside, 1)
            yield Reason(level, "outside", {"view": view.name, "share": share})
        level = below(view.overlap, limits.overlap)
        if level != GOOD:
            share = percent(view.overlap)
            yield Reason(level, "overlap", {"view": view.name, "share": share})


def _ends(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    for view in e.views:
        for end, share in view.ends.items():
            level = above(share, limits.ends)
            if level != GOOD:
                values = {
                    "view": view.name,
                    "share": percent(share),
                    "end": end,
                    "distance": 100 * e.end_distance,
                }
                yield Reason(level, "end", values, END_PARTS[end.rpartition(" ")[2]])


def _shape(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    return shape_reasons(e.beta_max, e.beta_rms, limits.beta_max, limits.beta_rms)


def _people(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    return measurement_reasons(e.measurements, e.age, e.stature, limits.people)


def _height(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    """A standing person bends a little: the body may be somewhat taller than the highest point,
    never lower.
    """
    value = e.measurements.get("height_m")
    if value is None or e.height_seen is None:
        return
    level = above(max(e.height_seen - value, value - 1.03 * e.height_seen), limits.height)
    if level != GOOD:
        yield Reason(level, "height", {"seen": 100 * e.height_seen, "height": 100 * value})


def _limbs(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    """A limb lost in front of the body or behind it is near all depth, and near the outline; but
    not in both views.
    """
    if e.limb_apart is not None:
        distance, joint = e.limb_apart
        level = above(distance, limits.limb_apart)
        if level != GOOD:
            yield Reason(level, "limb", {"joint": joint, "distance": 100 * distance})
    if e.limb_turned is not None:
        angle, joint = e.limb_turned
        level = above(angle, limits.limb_turned)
        if level != GOOD:
            yield Reason(level, "turned", {"joint": joint, "angle": angle})


def _seen(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    if any(view.cut_off for view in e.views):
        yield Reason(GOOD, "cut off")
    if len(e.views) == 1:
        yield Reason(GOOD, "one view")


def _segmentation(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    """Without a background frame or mask a lost limb hides in what was not cut out: in three of
    twelve simulated people, and no other check finds it.
    """
    if e.segmentation == "planes":
        yield Reason(DOUBTFUL, "segmentation")


CHECKS: tuple[Callable[[Evidence, RgbdLimits], Iterator[Reason]], ...] = (
    _solver,
    _depth,
    _explained,
    _ends,
    _height,
    _people,
    _limbs,
    _shape,
    _segmentation,
    _seen,
)


@dataclass(frozen=True, eq=False)
class RgbdFit(Moving):
    """A body found from depth views: one shape, a pose and a place for each of K views.

    Metres and radians; a view's world has y up and the floor, where one was found, at 0;
    ``prepared_views`` hold what was seen, in the same world. ``appearance``: light and albedo, None
    without colour. ``evidence``: what the verdict is drawn from. ``costs``: after the last step, by
    term; ``body_costs``: of the bodies that were tried, after the first steps with skin offsets
    (the lowest one is taken); empty where the body was given; ``status``: how it ended
    (`habitus.minimize`: "converged", "iterations", "stalled", …).
    ``skin``: how far the person's skin is off the body of betas, outwards along its normals (m);
    `vertices` and `measurements` have it, `surfaces` are of betas alone. ``hair``: thickness (m) of
    measured hair, which is in none of them; 0 where it is flat. View k is what a fit of
    markers calls frame k: ``vertices(k)``.
    """

    capture_name: str
    body_name: str
    body: BodyModel
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "K J 3"]
    trans: Float[np.ndarray, "K 3"]
    prepared_views: tuple[PreparedView, ...]
    evidence: Evidence
    appearance: Appearance | None = None
    costs: Mapping[str, float] = field(default_factory=dict)
    body_costs: Mapping[str, float] = field(default_factory=dict)
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    gender: str = "neutral"
    rate_hz: float = 1.0
    up_axis: str = "+y"
    skin: Float[np.ndarray, " V"] | None = None
    hair: Float[np.ndarray, " V"] | None = None
    status: str = "iterations"
    soft_tissue: None = None
    dynamics: None = None

    @property
    def pose_stage(self) -> tuple[Float[np.ndarray, "K J 3"], Float[np.ndarray, "K 3"]]:
        """Pose and trans, as a motion has them."""
        return self.pose, self.trans

    @property
    def errors_mm(self) -> Float[np.ndarray, " K"]:
        """The median distance of each view's depth from the body, across its surface (mm)."""
        return np.array([view.median_mm for view in self.evidence.views])

    def vertices(self, frames: Frames = None) -> Float[np.ndarray, "*frames V 3"]:
        """The person's surface (K, V, 3) in metres, in each view's world, skin off the model
        included; (V, 3) of one view.
        """
        vertices = super().vertices(frames)
        return vertices if self.skin is None else along_normals(vertices, self.skin, self.body)

    @property
    def measurements(self) -> Mapping[str, float]:
        """Height, girths and lengths of the person at rest (m, kg), under
        `habitus.body.measurement_names`.
        """
        return self.evidence.measurements

    @cached_property
    def verdict(self) -> Verdict:
        """What the fit is worth: ``level`` (good, doubtful or failed) and ``reasons``, a sentence
        each.
        """
        return judge(self.evidence)
