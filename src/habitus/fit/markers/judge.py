"""The verdict on a marker fit: limits, checks and sentences (`habitus.fit.verdict` weighs them).

Limits were learned from real captures and from spoilt copies of them;
`benchmarks/mosh_verdicts.py` measures how well they separate the two.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from habitus.fit.markers.evidence import EVIDENCE, Evidence, EvidenceSettings, evidence
from habitus.fit.markers.shape import HOPELESS
from habitus.fit.markers.solution import MarkerSolution
from habitus.fit.verdict import (
    BODY,
    COMMON_SENTENCES,
    DOUBTFUL,
    FAILED,
    FEET,
    GOOD,
    HANDS,
    HEAD,
    PARTS,
    PEOPLE,
    Bound,
    PeopleLimits,
    Range,
    Reason,
    Verdict,
    above,
    below,
    enumerated,
    measured,
    measurement_reasons,
    percent,
    shape_reasons,
    words,
    worst,
)
from habitus.fit.verdict import weigh as weigh_checks

INFINITY = float("inf")
ADULTS_OR_LARGER = PeopleLimits(below=Bound(0.0, PEOPLE.below.failed))
"""None of the survey's 6,068 adults measures less than its least value, and 19 sound captures stay
4 % above it. Adults scaled by 0.8 have the height of short adults; heads, necks or waists are
smaller than anyone's, some by less than the 5 % that is tolerated elsewhere."""


@dataclass(frozen=True)
class Limits:
    """Limits of the evidence on a fit (`habitus.fit.markers.evidence`), in its units.

    A `Bound` holds two limits: where doubt begins and where the fit has failed.
    """

    mean_mm: Bound = Bound(15.0, 30.0)
    p95_mm: Bound = Bound(35.0, 80.0)
    usual: Bound = Bound(2.5, 5.0)
    """Mean error as a multiple of the error that such motion usually leaves."""
    usual_still_mm: float = 4.0
    """Mean error (mm) of sound fits at rest."""
    usual_moving_mm: float = 3.0
    """How much more of it (mm) for each m/s of motion."""
    displaced: Bound = Bound(1.4, 4.0)
    """Distance of markers from the layout's places, in the layout's spreads, at the median: 0.5 to
    1.13 in 19 sound captures, 1.44 and more with each marker 40 mm off its place."""
    distrusted: Bound = Bound(0.05, 0.20)
    """Share of samples that the robust loss gives less than half of their weight."""
    beta_sd: Bound = Bound(3.5, INFINITY)
    """Largest magnitude of a beta, in standard deviations of people. 19 sound captures reach 2.9; a
    short person scaled by 1.25 to 1.83 m has 3.6 and nothing else against it. Scanned people have
    single betas of 3 to 5: a rare shape is a doubt and alone never a failure.
    """
    betas_rms: Bound = Bound(1.6, INFINITY)
    """Root mean square of the betas, in standard deviations of people; 1.2 in sound captures."""
    suspects: Bound = Bound(0.35, INFINITY)
    """Share of the markers under suspicion."""
    markers: Bound = Bound(12, 4)
    """Number of markers: below."""
    unseen: float = 0.5
    """Share of the frames in which no marker determines where a limb is."""
    no_data: Bound = Bound(0.05, 0.5)
    """Share of the frames with too few markers."""
    gap_s: Bound = Bound(1.0, INFINITY)
    height: Bound = Bound(0.03, 0.12)
    """Recorded height against the estimate, as a share."""
    mass: Bound = Bound(0.20, 0.60)
    mass_remark: float = 0.05
    """Beyond this share the recorded mass is mentioned, without a doubt."""
    confidence: Bound = Bound(0.4, 0.0)
    """Of the layout's choice, 0..1: below."""
    tilt_deg: Bound = Bound(50.0, 181.0)
    standing_tilt_deg: Bound = Bound(20.0, 181.0)
    size: Bound = Bound(1.5, 2.5)
    """Of the markers against the body that was fitted to them, as a factor."""
    height_m: Range = Range(0.6, 2.8)
    """Of anybody, children included."""
    torn: Bound = Bound(0.02, 0.15)
    """Share of the pairs of markers close on the body that are far apart in the capture."""
    torn_level: float = 0.6
    """Share of those pairs whose markers are at one height: above it there are two people, below it
    labels are mixed up."""
    slow_hz: Bound = Bound(15.0, 1.0)
    """Recorded frame rate: below."""
    fast_hz: Bound = Bound(1500.0, 10000.0)
    """Recorded frame rate: above."""
    speed: Bound = Bound(12.0, 40.0)
    """Of the body as a whole (m/s), at the median."""
    fall: Bound = Bound(1.3, 2.5)
    """Acceleration of the centre of mass downwards (g), 95th percentile, over 20 ms. Nothing falls
    faster than 1 g: running, jumping and cartwheeling people reach 1.07 (19 captures), walking ones
    played at four times their rate 1.8 to 4.5, any motion with its frames out of order 4 to 320."""
    force: Bound = Bound(4.0, 10.0)
    """The same in any direction (g). A sprinter's steps push with 3 to 5 body weights for a tenth
    of a second (Weyand 2000, Journal of Applied Physiology 89); the 19 captures reach 1.5."""
    marker_speed: Bound = Bound(20.0, 60.0)
    """Speed of the markers (m/s), 95th percentile over all. A sprinter's foot swings at 20 m/s; the
    19 captures reach 6.8."""
    marker_acceleration: Bound = Bound(300.0, 1500.0)
    """Acceleration of the markers (m/s^2), 95th percentile. The 19 captures reach 75, a sprinter's
    legs move 4 times as fast as those of their runner."""
    joint_speed: Bound = Bound(20.0, 60.0)
    """Speed of a joint's turn (rad/s), 95th percentile over all joints. Single joints reach 30 in a
    kick and 120 in a pitch for moments; the 19 captures' 95th percentiles reach 7."""
    joint_acceleration: Bound = Bound(1000.0, 4000.0)
    """Of a joint's turn (rad/s^2), 95th percentile."""
    left_out: Bound = Bound(0.0, 0.34)
    """Share of the labels that had to be left out."""
    people: PeopleLimits = ADULTS_OR_LARGER
    evidence: EvidenceSettings = EVIDENCE
    """How the evidence is measured."""


LIMITS = Limits()

SENTENCES: Mapping[str, str] = MappingProxyType(
    {
        **COMMON_SENTENCES,
        "no markers": "No marker was ever seen, so nothing determines the body.",
        "errors": "Markers lie {mean:.1f} mm from the body on average, 95 % within {p95:.0f} mm.",
        "large errors": "Markers lie {mean:.1f} mm from the body on average, 95 % within "
        "{p95:.0f} mm; typical error for this kind of motion: {usual:.0f} mm.",
        "distrusted": "{share} of the marker samples are so far off that the robust loss almost "
        "ignores them.",
        "displaced": "Half of the markers are more than {displaced:.1f} times as far from the "
        "layout's places as usual; check the layout.",
        "recorded": "The file states {name} {recorded}; the fitted body has {estimate} "
        "({change:+.0f} %).",
        "unseen limbs": "No markers on the {limbs}; their motion comes from the pose prior.",
        "gaps": "{share} of the frames have too few markers to place a body{longest}.",
        "layout": "The labels match the layout only loosely (confidence {confidence:.2f}); markers "
        "may be misplaced.",
        "doubt": "{text}",
        "tilt": "The body leans {tilt:.0f} degrees from {up}, the capture's up axis; check the up "
        "axis.",
        "rate": "At {rate:g} frames a second the body moves at {speed:.1f} m/s; check the frame "
        "rate.",
        "falls": "The body accelerates downwards at {fall:.1f} g for 5 % of the time, and nothing "
        "falls faster than 1 g; check the frame rate and the order of the frames.",
        "speeds": "For 5 % of the time markers move at more than {speed:.0f} m/s and "
        "{acceleration:.0f} m/s\u00b2, joints at {turn:.0f} rad/s, the body at {force:.1f} g: "
        "faster than people; check the frame rate and the order of the frames.",
        "span": "The markers span {size:.2g} times what the fitted body spans; check the unit of "
        "length.",
        "tall": "The body is {height} tall; check the unit of length.",
        "two people": "{share} of the pairs of markers that belong close together are far apart: "
        "perhaps two people in one capture.",
        "mixed labels": "{share} of the pairs of markers that belong close together are far apart: "
        "perhaps labels are mixed up.",
        "suspects": "{share} of the markers look wrong or mislabelled: exchanged labels, or a "
        "mirrored space.",
        "few markers": "Only {count} markers were used; shape and pose follow mostly the priors.",
        "left out": "Left out because nothing fits them: {labels}.",
        "tried": "{text}",
        # of a live fit, over its last second (`habitus.fit.markers.live`)
        "nobody": "Nobody is seen.",
        "live few": "Too few markers are seen to place a body.",
        "live errors": "Markers lie {mean:.0f} mm from the body.",
        "live outliers": "Markers lie {mean:.0f} mm from the body; far off: {named}.",
        "live missing": "Only {share:.0%} of the markers are seen.",
    }
)

# The limb that a joint moves, by the joint's name without the side, and the part of the body that
# is doubtful where no marker determines its motion.
LIMBS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "hip": ("leg", BODY),
        "knee": ("lower leg", BODY),
        "ankle": ("foot", FEET),
        "collar": ("arm", BODY),
        "shoulder": ("arm", BODY),
        "elbow": ("forearm", BODY),
        "wrist": ("hand", HANDS),
        "spine1": ("body above the pelvis", BODY),
        "spine2": ("body above the loins", BODY),
        "spine3": ("chest, arms and head", BODY),
        "neck": ("head", HEAD),
        "head": ("head", HEAD),
    }
)
# Parts that usually carry no markers: never mentioned by themselves.
TIPS = ("foot", "hand", "thumb", "index", "middle", "ring", "pinky", "jaw", "eye", "toe")


def judge(fit: MarkerSolution, limits: Limits = LIMITS) -> Verdict:
    """The verdict on a fit."""
    return weigh(evidence(fit, limits.evidence), limits)


def weigh(found: Evidence, limits: Limits = LIMITS) -> Verdict:
    """The verdict on the evidence of a fit.

    Where a decisive check fails, the others only follow from it and are not mentioned.
    """
    decisive = [reason.level for check in DECISIVE for reason in check(found, limits)]
    rest = (_errors, _tried) if worst(decisive) == FAILED else CHECKS
    checks = [*DECISIVE, *(check for check in rest if check not in DECISIVE)]
    return weigh_checks(checks, found, limits, SENTENCES)


def may_improve(fit: MarkerSolution, verdict: Verdict, limits: Limits = LIMITS) -> bool:
    """Whether a fit with this verdict has failed in a way that another attempt may mend."""
    if verdict.level != FAILED or fit.shape_status == HOPELESS or not fit.visible.any():
        return False
    found = evidence(fit, limits.evidence)
    if any(reason.level == FAILED for reason in _size(found, limits)):
        return False
    return worst([reason.level for check in MENDABLE for reason in check(found, limits)]) == FAILED


def usual_mm(motion: float, limits: Limits = LIMITS) -> float:
    """The mean error (mm) of a sound fit of markers that move at ``motion`` (m/s) relative to the
    body's middle.
    """
    return limits.usual_still_mm + limits.usual_moving_mm * motion


def _errors(e: Evidence, limits: Limits) -> Iterator[Reason]:
    if e.mean_mm is None or e.p95_mm is None:
        yield Reason(FAILED, "no markers")
        return
    usual = usual_mm(e.motion, limits)
    level = worst(
        [
            above(e.mean_mm, limits.mean_mm),
            above(e.p95_mm, limits.p95_mm),
            above(e.mean_mm / usual, limits.usual),
        ]
    )
    values = {"mean": e.mean_mm, "p95": e.p95_mm, "usual": usual}
    yield Reason(level, "errors" if level == GOOD else "large errors", values)


def _trust(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = above(e.distrusted, limits.distrusted)
    if level != GOOD:
        yield Reason(level, "distrusted", {"share": percent(e.distrusted)})


def _placement(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = GOOD if e.displaced is None else above(e.displaced, limits.displaced)
    if level != GOOD:
        yield Reason(level, "displaced", {"displaced": e.displaced})


def _shape(e: Evidence, limits: Limits) -> Iterator[Reason]:
    return shape_reasons(e.beta_sd, e.betas_rms, limits.beta_sd, limits.betas_rms)


def _measurements(e: Evidence, limits: Limits) -> Iterator[Reason]:
    return measurement_reasons(e.measurements, e.age, e.stature, limits.people)


def _recorded(e: Evidence, limits: Limits) -> Iterator[Reason]:
    for name, bound, remark in (
        ("height_m", limits.height, None),
        ("mass_kg", limits.mass, limits.mass_remark),
    ):
        recorded = e.recorded.get(name)
        estimate = e.measurements.get(name)
        if isinstance(recorded, str) or recorded is None or estimate is None or recorded <= 0:
            continue
        difference = max(estimate / recorded, recorded / max(estimate, 1e-6)) - 1.0
        level = above(difference, bound)
        if level != GOOD or (remark is not None and difference > remark):
            values = {
                "name": words(name),
                "recorded": measured(name, recorded),
                "estimate": measured(name, estimate),
                "change": 100 * estimate / recorded - 100,
            }
            yield Reason(level, "recorded", values)


def _limbs(e: Evidence, limits: Limits) -> Iterator[Reason]:
    limbs = unseen_limbs(e, limits.unseen)
    for part in PARTS:
        names = [name for name, of_part in limbs.items() if of_part == part]
        if names:
            yield Reason(DOUBTFUL, "unseen limbs", {"limbs": enumerated(names)}, part)


def unseen_limbs(e: Evidence, limit: float) -> dict[str, str]:
    """Limbs whose motion no marker determines in more than a share of the frames, each as a whole,
    and the part of the body (`habitus.fit.verdict.PARTS`) that is doubtful by that.
    """
    limbs = {}
    for joint, share in e.unseen.items():
        parent = e.parents.get(joint)
        side, _, part = joint.rpartition("_")
        if (
            share > limit
            and parent is not None
            and e.unseen[parent] <= limit
            and not part.startswith(TIPS)
        ):
            name, of_part = LIMBS.get(part, (joint.replace("_", " "), BODY))
            limbs[f"{side} {name}".strip() if part in LIMBS else name] = of_part
    return limbs


def _gaps(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = worst([above(e.no_data, limits.no_data), above(e.gap_s, limits.gap_s)])
    if level != GOOD:
        longest = f", the longest gap is {e.gap_s:.1f} s" if e.gap_s > 0 else ""
        yield Reason(level, "gaps", {"share": percent(e.no_data), "longest": longest})
    elif e.no_data > 0:
        yield Reason(GOOD, "gaps", {"share": percent(e.no_data, 1), "longest": ""})


def _layout(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = GOOD if e.confidence is None else below(e.confidence, limits.confidence)
    if level != GOOD:
        yield Reason(level, "layout", {"confidence": e.confidence})


def _doubts(e: Evidence, limits: Limits) -> Iterator[Reason]:
    yield from (Reason(DOUBTFUL, "doubt", {"text": text}) for text in e.doubts)


def _world(e: Evidence, limits: Limits) -> Iterator[Reason]:
    bound = limits.standing_tilt_deg if e.standing else limits.tilt_deg
    if e.tilt_deg is not None and above(e.tilt_deg, bound) != GOOD:
        yield Reason(above(e.tilt_deg, bound), "tilt", {"tilt": e.tilt_deg, "up": e.up_axis})
    level = worst(
        [
            below(e.rate_hz, limits.slow_hz),
            above(e.rate_hz, limits.fast_hz),
            above(e.speed, limits.speed),
        ]
    )
    if level != GOOD:
        yield Reason(level, "rate", {"rate": e.rate_hz, "speed": e.speed})


def _motion(e: Evidence, limits: Limits) -> Iterator[Reason]:
    """What no person does, who is held by the ground alone."""
    if e.extremes is None:
        return
    m = e.extremes
    level = above(m.fall, limits.fall)
    if level != GOOD:
        yield Reason(level, "falls", {"fall": m.fall})
    level = worst(
        [
            above(m.force, limits.force),
            above(m.marker_speed, limits.marker_speed),
            above(m.marker_acceleration, limits.marker_acceleration),
            above(m.joint_speed, limits.joint_speed),
            above(m.joint_acceleration, limits.joint_acceleration),
        ]
    )
    if level != GOOD:
        values = {
            "speed": m.marker_speed,
            "acceleration": m.marker_acceleration,
            "turn": m.joint_speed,
            "force": m.force,
        }
        yield Reason(level, "speeds", values)


def _size(e: Evidence, limits: Limits) -> Iterator[Reason]:
    """A wrong unit: the markers outgrow any body of the shape space, or the body follows them to an
    impossible size.
    """
    level = _span(e, limits)
    height = e.measurements.get("height_m")
    if level != GOOD:
        yield Reason(level, "span", {"size": e.size})
    elif (
        above(e.torn, limits.torn) == GOOD
        and height is not None
        and not limits.height_m.least <= height <= limits.height_m.most
    ):
        yield Reason(FAILED, "tall", {"height": measured("height_m", height)})


def _span(e: Evidence, limits: Limits) -> str:
    return GOOD if e.mean_mm is None else above(max(e.size, 1.0 / max(e.size, 1e-9)), limits.size)


def _people(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = above(e.torn, limits.torn)
    # where everything is too large, pairs are far apart as well
    if level != GOOD and _span(e, limits) == GOOD:
        key = "two people" if e.torn_level > limits.torn_level else "mixed labels"
        yield Reason(level, key, {"share": percent(e.torn)})


def _suspects(e: Evidence, limits: Limits) -> Iterator[Reason]:
    level = above(e.suspects, limits.suspects)
    if level != GOOD:
        yield Reason(level, "suspects", {"share": percent(e.suspects)})
    level = below(e.markers, limits.markers)
    if level != GOOD:
        yield Reason(level, "few markers", {"count": e.markers})


def _tried(e: Evidence, limits: Limits) -> Iterator[Reason]:
    if e.left_out:
        share = len(e.left_out) / (e.markers + len(e.left_out))
        level = above(share, limits.left_out)
        yield Reason(level, "left out", {"labels": enumerated(e.left_out)})
    if e.tried:
        yield Reason(GOOD, "tried", {"text": " ".join(e.tried)})


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
    _motion,
    _tried,
)
"""All checks; among reasons of one level the earlier comes first."""
DECISIVE = (_size, _people)
"""Checks that explain a failure by themselves: other reasons only follow from them."""
MENDABLE = (_errors, _trust, _shape, _measurements)
"""Checks whose failures may come from a bad start, bad frames or wrong labels."""
