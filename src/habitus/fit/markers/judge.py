"""What a fit is worth: good, doubtful or failed, with its reasons in a sentence each."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from habitus.fit.markers.evidence import Evidence, evidence
from habitus.fit.markers.limits import LIMITS, Bound, Limits, Range, people_of
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.verdict import DOUBTFUL, FAILED, GOOD, LEVELS, Verdict, worst

# What hangs from a joint, by its name without the side, and whether a fit is in doubt where no
# marker tells of it.
LIMBS: Mapping[str, tuple[str, bool]] = {
    "hip": ("leg", True),
    "knee": ("lower leg", True),
    "ankle": ("foot", False),
    "collar": ("arm", True),
    "shoulder": ("arm", True),
    "elbow": ("forearm", True),
    "wrist": ("hand", False),
    "spine1": ("body above the pelvis", True),
    "spine2": ("body above the loins", True),
    "spine3": ("chest, arms and head", True),
    "neck": ("head", True),
    "head": ("head", True),
}
TIPS = (
    "foot",
    "hand",
    "thumb",
    "index",
    "middle",
    "ring",
    "pinky",
    "jaw",
    "eye",
    "toe",
)  # never in doubt by themselves


class Reason(NamedTuple):
    """A sentence and the level that it speaks for."""

    level: str
    text: str


def judge(fit: MarkerFit, limits: Limits = LIMITS) -> Verdict:
    """The verdict on a fit."""
    return weigh(evidence(fit), limits)


def weigh(found: Evidence, limits: Limits = LIMITS) -> Verdict:
    """The verdict on what was found about a fit."""
    decisive = [reason for check in DECISIVE for reason in check(found, limits)]
    plain = worst([reason.level for reason in decisive]) == FAILED
    checks = (_errors, _tried) if plain else [check for check in CHECKS if check not in DECISIVE]
    reasons = decisive + [reason for check in checks for reason in check(found, limits)]
    reasons.sort(key=lambda reason: -LEVELS.index(reason.level))
    return Verdict(
        worst([reason.level for reason in reasons]), tuple(reason.text for reason in reasons)
    )


def may_improve(fit: MarkerFit, limits: Limits = LIMITS) -> bool:
    """Whether a fit has failed in a way that another attempt may mend."""
    if fit.verdict.level != FAILED or not fit.visible.any():
        return False
    found = evidence(fit)
    if any(reason.level == FAILED for reason in _size(found, limits)):
        return False
    return worst([reason.level for check in MENDABLE for reason in check(found, limits)]) == FAILED


def above(value: float, bound: Bound) -> str:
    """The level that a value speaks for: the greater, the worse."""
    return FAILED if value > bound.failed else DOUBTFUL if value > bound.doubtful else GOOD


def below(value: float, bound: Bound) -> str:
    """The level that a value speaks for: the smaller, the worse."""
    return FAILED if value < bound.failed else DOUBTFUL if value < bound.doubtful else GOOD


def usual_mm(motion: float, limits: Limits = LIMITS) -> float:
    """The mean error (mm) that a sound fit leaves of markers that move so fast (m/s) against the
    body's middle.
    """
    return limits.usual_still_mm + limits.usual_moving_mm * motion


def _errors(e: Evidence, limits: Limits) -> Iterator[Reason]:
    if e.mean_mm is None or e.p95_mm is None:
        yield Reason(FAILED, "No marker was ever seen: there is nothing to judge the body by.")
        return
    usual = usual_mm(e.motion, limits)
    known = (
        (e.mean_mm, limits.mean_mm),
        (e.p95_mm, limits.p95_mm),
        (e.mean_mm / usual, limits.usual),
    )
    level = worst([above(value, bound) for value, bound in known])
    text = f"Markers lie {e.mean_mm:.1f} mm from the body on average, 95 % within {e.p95_mm:.0f} mm"
    yield Reason(
        level,
        f"{text}{'' if level == GOOD else f'; such motion usually leaves about {usual:.0f} mm'}.",
    )


def _trust(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = above(e.distrusted, limits.distrusted)
    if level != GOOD:
        yield Reason(
            level,
            f"{percent(e.distrusted)} of the marker samples are so far off that they hardly count.",
        )


def _placement(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = GOOD if e.displaced is None else above(e.displaced, limits.displaced)
    if level != GOOD:
        yield Reason(
            level,
            f"Half of the markers sit more than {e.displaced:.1f} times as far from the layout's "
            "places as markers "
            "usually do; it may be the wrong layout.",
        )


def _shape(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = worst([above(e.beta_sd, limits.beta_sd), above(e.betas_rms, limits.betas_rms)])
    if level != GOOD:
        yield Reason(
            level,
            f"The shape is rare: its coefficients reach {e.beta_sd:.1f} standard deviations "
            f"({e.betas_rms:.1f} RMS).",
        )


def _measurements(e: Evidence, limits: Limits) -> Iterator[Reason]:
    """The measurement furthest outside what people have, and how many others are."""
    people = people_of(e.age, e.stature, limits.people)
    far = {}
    for name, value in e.measurements.items():
        least, most = people.get(name, Range(0.0, float("inf")))
        over = value / most - 1.0
        under = least / max(value, 1e-6) - 1.0
        level = worst([above(over, limits.above_people), above(under, limits.below_people)])
        if level != GOOD:
            far[name] = (LEVELS.index(level), max(over, under))
    if not far:
        return
    name = max(far, key=lambda name: far[name])
    least, most = people[name]
    more = (
        f", and {len(far) - 1} more measurement{'s' * (len(far) > 2)} such as nobody has"
        if len(far) > 1
        else ""
    )
    whose = "adults" if people is limits.people else "people up to that age"
    said = (
        f"{measured(name, e.measurements[name])} where {whose} have {measured(name, least)} to "
        f"{measured(name, most)}"
    )
    yield Reason(LEVELS[far[name][0]], f"The body's {words(name)} is {said}{more}.")


def _recorded(e: Evidence, limits: Limits) -> Iterator[Reason]:
    for name, bound, remark in (
        ("height_m", limits.height, None),
        ("mass_kg", limits.mass, limits.mass_remark),
    ):
        known = e.recorded.get(name)
        value = e.measurements.get(name)
        if isinstance(known, str) or known is None or value is None or known <= 0:
            continue
        off = max(value / known, known / max(value, 1e-6)) - 1.0
        level = above(off, bound)
        if level != GOOD or (remark is not None and off > remark):
            text = (
                f"The file says {words(name)} {measured(name, known)}; the fitted body has "
                f"{measured(name, value)}"
            )
            yield Reason(level, f"{text} ({100 * value / known - 100:+.0f} %).")


def _limbs(e: Evidence, limits: Limits) -> Iterator[Reason]:
    limbs = unseen_limbs(e, limits.unseen)
    for counts, level in ((True, DOUBTFUL), (False, GOOD)):
        names = [name for name, grave in limbs.items() if grave == counts]
        if names:
            yield Reason(
                level,
                f"No marker tells of the {enumerated(names)}: the motion there is the pose "
                "prior's guess.",
            )


def unseen_limbs(e: Evidence, limit: float) -> dict[str, bool]:
    """Limbs that no marker tells of in more than a share of the frames, each as a whole; whether
    each counts.
    """
    found = {}
    for joint, share in e.unseen.items():
        parent = e.parents.get(joint)
        side, _, part = joint.rpartition("_")
        if (
            share > limit
            and parent is not None
            and e.unseen[parent] <= limit
            and not part.startswith(TIPS)
        ):
            name, grave = LIMBS.get(part, (joint.replace("_", " "), True))
            found[f"{side} {name}".strip() if part in LIMBS else name] = grave
    return found


def _gaps(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = worst([above(e.no_data, limits.no_data), above(e.gap_s, limits.gap_s)])
    if level != GOOD:
        longest = f", {e.gap_s:.1f} s at a stretch without any" if e.gap_s > 0 else ""
        yield Reason(
            level,
            f"{percent(e.no_data)} of the frames hold too few markers to place a body{longest}.",
        )
    elif e.no_data > 0:
        yield Reason(
            GOOD, f"{percent(e.no_data, 1)} of the frames hold too few markers to place a body."
        )


def _layout(e: Evidence, limits: Limits) -> Iterator[Reason]:
    if e.confidence is not None and below(e.confidence, limits.confidence) != GOOD:
        text = (
            f"The labels match the layout only loosely (confidence {e.confidence:.2f}); "
            "markers may be misplaced."
        )
        yield Reason(below(e.confidence, limits.confidence), text)


def _doubts(e: Evidence, limits: Limits) -> Iterator[Reason]:
    yield from (Reason(DOUBTFUL, text) for text in e.doubts)


def _world(e: Evidence, limits: Limits) -> Iterator[Reason]:
    bound = limits.standing_tilt_deg if e.standing else limits.tilt_deg
    if e.tilt_deg is not None and above(e.tilt_deg, bound) != GOOD:
        yield Reason(
            above(e.tilt_deg, bound),
            f"The body leans {e.tilt_deg:.0f} degrees from {e.up_axis}, which the capture calls "
            "up; is it?",
        )
    rate = worst([below(e.rate_hz, limits.slow_hz), above(e.rate_hz, limits.fast_hz)])
    speed = above(e.speed, limits.speed)
    if worst([rate, speed]) != GOOD:
        text = (
            f"At {e.rate_hz:g} frames a second the body moves at {e.speed:.1f} m/s; the rate "
            "may be wrong."
        )
        yield Reason(worst([rate, speed]), text)


def _size(e: Evidence, limits: Limits) -> Iterator[Reason]:
    """A wrong unit: the markers outgrow any body that the shape space has, or the body follows them
    out of all size.
    """
    level = _span(e, limits)
    height = e.measurements.get("height_m")
    if level != GOOD:
        text = (
            f"The markers span {e.size:.2g} times what the fitted body spans; the unit of "
            "length may be wrong."
        )
        yield Reason(level, text)
    elif (
        above(e.torn, limits.torn) == GOOD
        and height is not None
        and not limits.height_m.least <= height <= limits.height_m.most
    ):
        yield Reason(
            FAILED,
            f"The body is {measured('height_m', height)} tall; the unit of length may be wrong.",
        )


def _span(e: Evidence, limits: Limits) -> str:
    return GOOD if e.mean_mm is None else above(max(e.size, 1.0 / max(e.size, 1e-9)), limits.size)


def _people(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = above(e.torn, limits.torn)
    if (
        level != GOOD and _span(e, limits) == GOOD
    ):  # where all is too large, pairs are far apart as well
        pairs = (
            f"{percent(e.torn)} of the pairs of markers that belong close together are far apart"
        )
        two = e.torn_level > limits.torn_level
        yield Reason(
            level,
            f"{pairs}: perhaps {'two people in one capture' if two else 'labels are mixed up'}.",
        )


def _suspects(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = above(e.suspects, limits.suspects)
    if level != GOOD:
        text = (
            f"{percent(e.suspects)} of the markers look wrong or mislabelled: exchanged "
            "labels, or a mirrored space."
        )
        yield Reason(level, text)
    if below(e.markers, limits.markers) != GOOD:
        text = f"Only {e.markers} markers were used: most of shape and pose is the priors' guess."
        yield Reason(below(e.markers, limits.markers), text)


def _tried(e: Evidence, limits: Limits) -> Iterator[Reason]:
    if e.left_out:
        share = len(e.left_out) / (e.markers + len(e.left_out))
        yield Reason(
            above(share, limits.left_out),
            f"Left out because nothing fits them: {enumerated(e.left_out)}.",
        )
    if e.tried:
        yield Reason(GOOD, f"{' '.join(e.tried)}")


CHECKS: tuple[Callable[[Evidence, Limits], Iterator[Reason]], ...] = (
    _doubts,
    _errors,
    _trust,
    _size,
    _people,
    _measurements,
    _shape,
    _placement,
    _recorded,
    _layout,
    _suspects,
    _limbs,
    _gaps,
    _world,
    _tried,
)
"""What is looked at; among reasons of one level the earlier stands first."""
DECISIVE = (_size, _people)
"""What explains a failure by itself: other reasons only follow from it."""
MENDABLE = (_errors, _trust, _shape, _measurements)
"""What a bad start, bad frames or wrong labels make worse."""


def words(name: str) -> str:
    """``chest_circumference_m`` in words."""
    return name.rsplit("_", 1)[0].replace("_", " ")


def measured(name: str, value: float) -> str:
    """A measurement with its unit."""
    return f"{value:.1f} kg" if name.endswith("_kg") else f"{100 * value:.1f} cm"


def percent(share: float, digits: int = 0) -> str:
    """A share as a percentage."""
    return f"{100 * share:.{digits}f} %"


def enumerated(names: tuple[str, ...] | list[str]) -> str:
    """Names with commas and an "and"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
