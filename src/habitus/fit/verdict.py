"""Verdicts: how far a fit can be trusted, weighed by checks of its evidence against limits.

    level(part) = worst of level(evidence_i, limit_i),        good < doubtful < failed
    level       = worst of level(body) and, one level milder, level(head), level(hands), level(feet)

The whole is milder on what hangs at the body's ends: one wrong hand makes the hands failed and the
fit doubtful, as shape and motion of everything else stay right.

A recipe states its *evidence* (numbers measured of a fit, without knowing the truth), its *limits*
(a `Bound` each, as data of its sensor), its *checks* (functions of both that yield reasons) and its
*sentences* (a template for each kind of reason); `weigh` does the rest. Limits of a body's
measurements are the same for every sensor and depend on age (`PeopleLimits`).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Int

from habitus.body.body_arrays import ADULT
from habitus.body.model import BodyModel

SIDES = ("left", "right")

E = TypeVar("E")
L = TypeVar("L")

GOOD, DOUBTFUL, FAILED = LEVELS = ("good", "doubtful", "failed")
NOT_FINITE = "not finite"
"""The status of a solve that met a cost, gradient or matrix with numbers that are not finite."""
BODY, HEAD, HANDS, FEET = PARTS = ("body", "head", "hands", "feet")
MILDER: Mapping[str, str] = MappingProxyType({GOOD: GOOD, DOUBTFUL: GOOD, FAILED: DOUBTFUL})
"""What the level of a part other than the body makes of the whole."""
PART_ROOTS: Mapping[str, str] = MappingProxyType(
    {"head": HEAD, "wrist": HANDS, "hand": HANDS, "ankle": FEET, "foot": FEET}
)
"""Joints, by name without the side, at which a part of the body other than the trunk begins."""


class Bound(NamedTuple):
    """Beyond the first a fit is doubtful, beyond the second it has failed."""

    doubtful: float
    failed: float


class Range(NamedTuple):
    """The smallest and the largest value measured in a survey."""

    least: float
    most: float


class Reason(NamedTuple):
    """A level, and why: the key of a sentence, the values that go into it, and the part of the body
    (`PARTS`) that it speaks of.
    """

    level: str
    key: str
    values: Mapping[str, Any] = MappingProxyType({})
    part: str = BODY


class PartVerdict(NamedTuple):
    """The level of one part of the body and its reasons, the gravest first."""

    level: str
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """A fit's level, ``good``, ``doubtful`` or ``failed``, and its reasons, the gravest first.

    reasons: a sentence each. keys: which kind of reason each is; not compared. parts: the same of
    body (what concerns all of it included), head, hands and feet; not compared.
    """

    level: str
    reasons: tuple[str, ...]
    keys: tuple[str, ...] = field(default=(), compare=False)
    parts: Mapping[str, PartVerdict] = field(
        default_factory=lambda: MappingProxyType({}), compare=False
    )

    def __str__(self) -> str:
        """One line."""
        return f"{self.level}: {' '.join(self.reasons)}" if self.reasons else self.level

    def entry(self) -> dict[str, Any]:
        """As metrics.json holds it: ``level``, ``reasons`` and, for each part, the same."""
        parts = {
            name: {"level": part.level, "reasons": list(part.reasons)}
            for name, part in self.parts.items()
        }
        return {"level": self.level, "reasons": list(self.reasons), "parts": parts}


def weigh(
    checks: Sequence[Callable[[E, L], Iterable[Reason]]],
    evidence: E,
    limits: L,
    sentences: Mapping[str, str],
) -> Verdict:
    """The verdict on some evidence: the worst level that a check finds, and all reasons.

    Among reasons of one level, those of earlier checks come first. sentences: a format string for
    each key of a reason.
    """
    return verdict_of([reason for check in checks for reason in check(evidence, limits)], sentences)


def verdict_of(reasons: Sequence[Reason], sentences: Mapping[str, str]) -> Verdict:
    """The verdict of some reasons, sorted by the level that they give the whole."""
    by_gravity = sorted(reasons, key=lambda r: -LEVELS.index(whole_level({r.part: r.level})))
    texts = [sentences[reason.key].format(**reason.values) for reason in by_gravity]
    parts = {}
    for part in PARTS:
        own = [k for k, reason in enumerate(by_gravity) if reason.part == part]
        level = worst([by_gravity[k].level for k in own])
        parts[part] = PartVerdict(level, tuple(texts[k] for k in own))
    return Verdict(
        whole_level({name: part.level for name, part in parts.items()}),
        tuple(texts),
        tuple(reason.key for reason in by_gravity),
        MappingProxyType(parts),
    )


def whole_level(parts: Mapping[str, str]) -> str:
    """The level of a fit from those of its parts; all but the body's count one level milder."""
    return worst([level if part == BODY else MILDER[level] for part, level in parts.items()])


def part_of_joint(joint_names: Sequence[str], parents: Sequence[int]) -> tuple[str, ...]:
    """Of each joint, the part of the body (`PARTS`) that its skin belongs to; parents come before
    their children, -1 for the root.
    """
    parts: list[str] = []
    for name, parent in zip(joint_names, parents, strict=True):
        side, _, plain = name.rpartition("_")
        own = PART_ROOTS.get(plain if side in SIDES else name)
        parts.append(own or (parts[parent] if parent >= 0 else BODY))
    return tuple(parts)


def vertex_parts(body: BodyModel) -> Int[np.ndarray, " V"]:
    """The number in `PARTS` of each vertex's part."""
    parts = part_of_joint(body.joint_names, body.parents)
    return np.array([PARTS.index(part) for part in parts])[body.strongest_joint]


def worst(levels: Sequence[str]) -> str:
    """The gravest of some levels, good where there is none."""
    return max(levels, key=LEVELS.index, default=GOOD)


def above(value: float, bound: Bound) -> str:
    """The level of a value of which more is worse; NaN has failed."""
    return FAILED if not value <= bound.failed else DOUBTFUL if value > bound.doubtful else GOOD


def below(value: float, bound: Bound) -> str:
    """The level of a value of which less is worse; NaN has failed."""
    return FAILED if not value >= bound.failed else DOUBTFUL if value < bound.doubtful else GOOD


# The smallest and largest of the 6,068 adults of ANSUR II; the neck is the survey's at its
# narrowest, upper arm and forearm flexed, the inseam its crotch height. Metres and kilograms.
ADULTS: Mapping[str, Range] = MappingProxyType(
    {
        "height_m": Range(1.409, 1.993),
        "mass_kg": Range(35.8, 144.2),
        "arm_span_m": Range(1.323, 2.121),
        "inseam_m": Range(0.610, 1.031),
        "foot_length_m": Range(0.198, 0.323),
        "chest_circumference_m": Range(0.695, 1.469),
        "waist_circumference_m": Range(0.611, 1.379),
        "hip_circumference_m": Range(0.737, 1.341),
        "neck_circumference_m": Range(0.275, 0.514),
        "head_circumference_m": Range(0.500, 0.635),
        "thigh_circumference_m": Range(0.412, 0.870),
        "calf_circumference_m": Range(0.266, 0.523),
        "ankle_circumference_m": Range(0.156, 0.293),
        "upper_arm_circumference_m": Range(0.216, 0.490),
        "forearm_circumference_m": Range(0.200, 0.402),
        "wrist_circumference_m": Range(0.124, 0.216),
    }
)

RIGID = ("height_m", "head_length_m", "head_breadth_m", "foot_length_m", "foot_breadth_m")
"""Measurements that change neither with the pose nor much with fat."""
HEADS = ("head_length_m", "head_breadth_m", "head_circumference_m")
"""Measurements that hair adds to."""
ADULTS_MEAN = np.array([0.5377, -1.6289, -1.8835, -1.3377, -2.3163])
ADULTS_WHITENING = np.array(
    [
        [36.37, -5.05, -0.33, -21.05, -1.62],
        [0.0, 29.79, -4.47, -7.58, -3.79],
        [0.0, 0.0, 28.03, -2.9, -5.94],
        [0.0, 0.0, 0.0, 23.16, -17.42],
        [0.0, 0.0, 0.0, 0.0, 14.77],
    ]
)
"""Mean of the logarithms of `RIGID` over the 6,068 adults of ANSUR II (stature, headlength,
headbreadth, footlength, footbreadthhorizontal; m), and W with W' W their inverse covariance. The
adult furthest from the mean lies at 5.36 standard deviations (from one half of the survey to the
other: 5.0 to 5.3); without the head's two, at 4.91."""


@dataclass(frozen=True)
class PeopleLimits:
    """How far a measurement may lie outside the range of a survey of adults, as a share of it.

    Lower values are tolerated longer than higher ones: children are smaller than any adult.
    `ranges` are those of an age.
    """

    above: Bound = Bound(0.05, 0.15)
    below: Bound = Bound(0.05, 0.60)
    adults: Mapping[str, Range] = field(default_factory=lambda: ADULTS)
    proportions: Bound = Bound(np.inf, np.inf)
    """How far an adult's `RIGID` measurements may lie from the survey's mean, in standard
    deviations."""
    head: str = BODY
    """The part of the body to which a head that is out of range or out of proportion belongs:
    `HEAD` where hair is measured with it."""
    without_head: float = 4.5
    """How far height and feet alone may lie, for a person out of proportion to be so by the head.
    One in a thousand of the survey lies beyond 4.2; of 50 people drawn from the default bodies and
    stretched by 1.3 across, 49 lie beyond 4.5, squeezed by 0.7 in depth or stretched upwards all.
    """

    def ranges(self, age: float | None, stature: float) -> Mapping[str, Range]:
        """What people of an age (years) measure: adults (None), or children of a mean stature (m).

        From adult to child, the least values shrink with stature (the mass with its cube), the
        greatest heights and lengths too, the greatest mass with its square, girths with its root:
        small children are stouter. Heads keep an adult's greatest girth.
        """
        if age is None or age >= ADULT:
            return self.adults
        scale = min(stature / (sum(self.adults["height_m"]) / 2), 1.0)
        return {
            name: Range(
                least * scale ** (3.0 if name.endswith("_kg") else 1.0),
                most * scale ** _greatest_power(name),
            )
            for name, (least, most) in self.adults.items()
        }


def _greatest_power(name: str) -> float:
    """The power of stature with which the greatest value of a measurement falls among children."""
    if name == "head_circumference_m":
        return 0.0
    if name.endswith("_kg"):
        return 2.0
    return 0.5 if name.endswith("_circumference_m") else 1.0


PEOPLE = PeopleLimits()


def measurement_reasons(
    measurements: Mapping[str, float], age: float | None, stature: float, limits: PeopleLimits
) -> Iterator[Reason]:
    """The measurement furthest outside what people of that age have, and how many others are, of
    each part of the body.

    age: that the body was brought to (years), None of an adult's body; stature: of that body's mean
    person (m).
    """
    ranges = limits.ranges(age, stature)
    people = "adults" if ranges is limits.adults else "people of that age"
    outside: dict[str, dict[str, tuple[int, float]]] = {}
    for name, value in measurements.items():
        if name not in ranges:
            continue
        least, most = ranges[name]
        over = value / most - 1.0
        under = least / max(value, 1e-6) - 1.0
        level = worst([above(over, limits.above), above(under, limits.below)])
        if level != GOOD:
            part = limits.head if name in HEADS else BODY
            outside.setdefault(part, {})[name] = (LEVELS.index(level), max(over, under))
    for part, names in outside.items():
        name = max(names, key=lambda name: names[name])
        others = len(names) - 1
        values = {
            "name": words(name),
            "value": measured(name, measurements[name]),
            "people": people,
            "least": measured(name, ranges[name].least),
            "most": measured(name, ranges[name].most),
            "more": f"; {others} more measurement{'s' * (others > 1)} out of range"
            if others
            else "",
        }
        yield Reason(LEVELS[names[name][0]], "measurement", values, part)


def proportion_reasons(
    measurements: Mapping[str, float], age: float | None, limits: PeopleLimits
) -> Iterator[Reason]:
    """An adult's height, head and feet in proportions outside those of the survey: data stretched
    along one axis can be fitted well by a body with every single measurement in range.

    Where height and feet without the head are in proportion (`PeopleLimits.without_head`) and the
    head is too large, as hair makes it, the reason is the head's.
    """
    if (age is not None and age < ADULT) or any(name not in measurements for name in RIGID):
        return
    logs = np.log(np.maximum([measurements[name] for name in RIGID], 1e-6)) - ADULTS_MEAN
    distance = float(np.linalg.norm(ADULTS_WHITENING @ logs))
    level = above(distance, limits.proportions)
    if level == GOOD:
        return
    head = np.isin(RIGID, HEADS)
    seen = ADULTS_WHITENING[:, ~head] @ logs[~head]
    # the head that makes such a body likeliest
    nearest = np.linalg.lstsq(ADULTS_WHITENING[:, head], seen)[0]
    without = float(np.linalg.norm(seen - ADULTS_WHITENING[:, head] @ nearest))
    larger = float((logs[head] + nearest).sum()) > 0.0
    part = limits.head if larger and without <= limits.without_head else BODY
    yield Reason(level, "proportions", {"distance": distance}, part)


def shape_reasons(
    largest: float, rms: float, largest_limit: Bound, rms_limit: Bound
) -> Iterator[Reason]:
    """Shape coefficients that are rare: the largest of them, and their root mean square, both in
    standard deviations of people.
    """
    level = worst([above(largest, largest_limit), above(rms, rms_limit)])
    if level != GOOD:
        yield Reason(level, "shape", {"largest": largest, "rms": rms})


def solver_reasons(status: str) -> Iterator[Reason]:
    """A solve that ended with the status (`habitus.minimize`) "not finite" has failed: its state is
    that of the step before, wherever that was.
    """
    if status == NOT_FINITE:
        yield Reason(FAILED, NOT_FINITE)


COMMON_SENTENCES: Mapping[str, str] = MappingProxyType(
    {
        NOT_FINITE: "The solver met a cost that is not finite and ended early.",
        "measurement": "The body's {name} is {value}; {people} have {least} to {most}{more}.",
        "proportions": "Height, head and feet are {distance:.1f} standard deviations from the mean "
        "adult's proportions; no adult of a survey is beyond 5.4: data may be stretched along an "
        "axis.",
        "shape": "The shape is rare: its coefficients reach {largest:.1f} standard deviations "
        "({rms:.1f} RMS).",
    }
)
"""Sentences of the reasons here, for a recipe's own to be joined to."""


def words(name: str) -> str:
    """``chest_circumference_m`` in words."""
    return name.rsplit("_", 1)[0].replace("_", " ")


def measured(name: str, value: float) -> str:
    """A measurement with its unit."""
    return f"{value:.1f} kg" if name.endswith("_kg") else f"{100 * value:.1f} cm"


def percent(share: float, digits: int = 0) -> str:
    """A share as a percentage."""
    return f"{100 * share:.{digits}f} %"


def enumerated(names: Sequence[str]) -> str:
    """Names with commas and an "and"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
