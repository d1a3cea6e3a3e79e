"""What a fit to depth views is worth: good, doubtful or failed, with its reasons in a sentence
each.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from habitus.fit.markers.judge import Reason, above, below, measured, percent, words
from habitus.fit.markers.limits import LIMITS as PEOPLE
from habitus.fit.markers.limits import Bound
from habitus.fit.markers.verdict import DOUBTFUL, GOOD, LEVELS, Verdict, worst
from habitus.fit.rgbd.evidence import Evidence

KNOWN_WAYS = ("background", "mask")
"""How the person was found, where the view's maker told it."""


@dataclass(frozen=True)
class RgbdLimits:
    """Where a fit begins to be doubtful and to have failed; held against made people
    (benchmarks/rgbd_people.py).
    """

    over_noise: Bound
    median_mm: Bound
    explained: Bound
    outside: Bound
    overlap: Bound
    beta_max: Bound
    beta_rms: Bound
    height: Bound
    limb_apart: Bound


LIMITS = RgbdLimits(
    over_noise=Bound(1.8, 3.5),
    median_mm=Bound(14.0, 30.0),
    explained=Bound(0.97, 0.90),
    outside=Bound(0.02, 0.08),
    overlap=Bound(0.86, 0.72),
    beta_max=Bound(3.9, 6.5),
    beta_rms=Bound(2.1, 3.0),
    height=Bound(0.03, 0.08),
    limb_apart=Bound(0.25, np.inf),
)


def judge(found: Evidence, limits: RgbdLimits = LIMITS) -> Verdict:
    """The verdict on what was found about a fit."""
    reasons = [reason for check in CHECKS for reason in check(found, limits)]
    reasons.sort(key=lambda reason: -LEVELS.index(reason.level))
    return Verdict(
        worst([reason.level for reason in reasons]), tuple(reason.text for reason in reasons)
    )


def _depth(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    least = max(e.views, key=lambda view: view.median_mm)
    expected = max(least.noise_mm, 2.0)
    level = worst(
        [
            above(least.median_mm / expected, limits.over_noise),
            above(least.median_mm, limits.median_mm),
        ]
    )
    text = (
        f"Half of the depth pixels lie within {least.median_mm:.1f} mm of the body, 95 % "
        f"within {least.p95_mm:.0f} mm"
    )
    where = f" (the worst view, {least.name})" if len(e.views) > 1 and level != GOOD else ""
    yield Reason(level, f"{text}{where}; the sensor's noise alone leaves {least.noise_mm:.1f} mm.")


def _explained(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    for view in e.views:
        level = below(view.explained, limits.explained)
        if level != GOOD:
            share = percent(1.0 - view.explained, 1)
            yield Reason(
                level,
                f"{view.name}: {share} of the person's pixels are more than 5 cm from the body.",
            )
        level = above(view.outside, limits.outside)
        if level != GOOD:
            share = percent(view.outside, 1)
            yield Reason(
                level, f"{view.name}: {share} of the body stands where the room behind was seen."
            )
        level = below(view.overlap, limits.overlap)
        if level != GOOD:
            yield Reason(
                level, f"{view.name}: body and person overlap by {percent(view.overlap)} only."
            )


def _shape(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    level = worst([above(e.beta_max, limits.beta_max), above(e.beta_rms, limits.beta_rms)])
    if level != GOOD:
        yield Reason(
            level,
            f"The shape is rare: its coefficients reach {e.beta_max:.1f} standard deviations "
            f"({e.beta_rms:.1f} RMS).",
        )


def _people(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    for name, (least, most) in PEOPLE.people.items():
        value = e.measurements.get(name)
        if value is None:
            continue
        level = worst(
            [
                above(value / most - 1.0, PEOPLE.above_people),
                above(least / value - 1.0, PEOPLE.below_people),
            ]
        )
        if level != GOOD:
            span = f"{measured(name, least)} to {measured(name, most)}"
            yield Reason(
                level,
                f"The body's {words(name)} is {measured(name, value)} where adults have {span}.",
            )


def _height(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    """People bend a little where they stand: the body may be somewhat taller than the person is
    high, never lower.
    """
    value = e.measurements.get("height_m")
    if value is None or e.height_seen is None:
        return
    off = max(e.height_seen - value, value - 1.03 * e.height_seen)
    level = above(off, limits.height)
    if level != GOOD:
        seen = f"{100 * e.height_seen:.0f} cm"
        yield Reason(
            level,
            f"The person's highest point is {seen} above the floor, the body {100 * value:.0f} cm "
            "tall.",
        )


def _limbs(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    """A limb that is lost before the body or behind it is near all depth, and near the outline; not
    in both views.
    """
    if e.limb_apart is None:
        return
    apart, joint = e.limb_apart
    level = above(apart, limits.limb_apart)
    if level != GOOD:
        told = f"The {joint} is {100 * apart:.0f} cm elsewhere in another view"
        yield Reason(level, f"{told}: the person moved, or an arm or leg is lost.")


def _seen(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    if any(view.cut_off for view in e.views):
        yield Reason(
            GOOD,
            "The person reaches beyond the image: what is not seen is the shape space's guess.",
        )
    if len(e.views) == 1:
        yield Reason(GOOD, "One view only: the side that was not seen is the shape space's guess.")


def _room(e: Evidence, limits: RgbdLimits) -> Iterator[Reason]:
    """Where nobody told what is person and what is room, a lost limb hides in what was not cut out:
    in three of twelve made people, and nothing else that is looked at tells it.
    """
    if e.way not in KNOWN_WAYS:
        told = (
            "Neither an empty room nor masks say what is person: a limb may be elsewhere; look "
            "at the pictures."
        )
        yield Reason(DOUBTFUL, told)


CHECKS: tuple[Callable[[Evidence, RgbdLimits], Iterator[Reason]], ...] = (
    _depth,
    _explained,
    _height,
    _people,
    _limbs,
    _shape,
    _room,
    _seen,
)
