"""The verdict on a fit to depth views: limits, checks and sentences (`habitus.fit.verdict` weighs
them).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from habitus.fit.rgbd.evidence import Evidence
from habitus.fit.verdict import (
    DOUBTFUL,
    GOOD,
    PEOPLE,
    PEOPLE_SENTENCES,
    Bound,
    PeopleLimits,
    Reason,
    Verdict,
    above,
    below,
    measurement_reasons,
    percent,
    shape_reasons,
    weigh,
    worst,
)

KNOWN_WAYS = ("background", "mask")
"""How the person was segmented where the capture says it."""


@dataclass(frozen=True)
class RgbdLimits:
    """Limits of the evidence on a fit, set by simulated people (benchmarks/rgbd_people.py)."""

    over_noise: Bound = Bound(1.8, 3.5)
    """Median depth residual as a multiple of the sensor's noise."""
    median_mm: Bound = Bound(14.0, 30.0)
    explained: Bound = Bound(0.97, 0.90)
    outside: Bound = Bound(0.02, 0.08)
    overlap: Bound = Bound(0.86, 0.72)
    beta_max: Bound = Bound(3.9, 6.5)
    beta_rms: Bound = Bound(2.1, 3.0)
    height: Bound = Bound(0.03, 0.08)
    """Metres between the body's height and the person's highest point."""
    limb_apart: Bound = Bound(0.25, np.inf)
    """Metres between a joint in two views."""
    people: PeopleLimits = PEOPLE


LIMITS = RgbdLimits()

SENTENCES: Mapping[str, str] = MappingProxyType(
    {
        **PEOPLE_SENTENCES,
        "depth": "Half of the depth pixels lie within {median:.1f} mm of the body, 95 % within "
        "{p95:.0f} mm{where}; the sensor's noise alone leaves {noise:.1f} mm.",
        "unexplained": "{view}: {share} of the person's pixels are more than 5 cm from the body.",
        "outside": "{view}: {share} of the body covers pixels where the background was seen.",
        "overlap": "{view}: body and person overlap by {share} only.",
        "height": "The person's highest point is {seen:.0f} cm above the floor; the body is "
        "{height:.0f} cm tall.",
        "limb": "The {joint} differs by {distance:.0f} cm between the views: the person moved, or "
        "an arm or leg is lost.",
        "segmentation": "No background frame or mask was given, so the segmentation is uncertain; "
        "check the limbs.",
        "cut off": "The person reaches beyond the image; unseen parts follow the shape prior.",
        "one view": "One view only; the unseen side follows the shape prior.",
    }
)


def judge(found: Evidence, limits: RgbdLimits = LIMITS) -> Verdict:
    """The verdict on the evidence of a fit."""
    return weigh(CHECKS, found, limits, SENTENCES)


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
            yield Reason(level, "unexplained", {"view": view.name, "share": share})
        level = above(view.outside, limits.outside)
        if level != GOOD:
            share = percent(view.outside, 1)
            yield Reason(level, "outside", {"view": view.name, "share": share})
        level = below(view.overlap, limits.overlap)
        if level != GOOD:
            share = percent(view.overlap)
            yield Reason(level, "overlap", {"view": view.name, "share": share})


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
    if e.limb_apart is None:
        return
    distance, joint = e.limb_apart
    level = above(distance, limits.limb_apart)
    if level != GOOD:
        yield Reason(level, "limb", {"joint": joint, "distance": 100 * distance})


def _seen(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    if any(view.cut_off for view in e.views):
        yield Reason(GOOD, "cut off")
    if len(e.views) == 1:
        yield Reason(GOOD, "one view")


def _segmentation(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    """Without a background frame or mask a lost limb hides in what was not cut out: in three of
    twelve simulated people, and no other check finds it.
    """
    if e.way not in KNOWN_WAYS:
        yield Reason(DOUBTFUL, "segmentation")


CHECKS: tuple[Callable[[Evidence, RgbdLimits], Iterator[Reason]], ...] = (
    _depth,
    _explained,
    _height,
    _people,
    _limbs,
    _shape,
    _segmentation,
    _seen,
)
