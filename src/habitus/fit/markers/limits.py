"""What a verdict holds a fit against: one table of limits, and what a survey of people measured.

Learned from real captures and from spoilt copies of them; `benchmarks/mosh_verdicts.py` measures
how well they part.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from habitus.body.ages import ADULT


class Bound(NamedTuple):
    """Beyond the first a fit is doubtful, beyond the second it has failed."""

    doubtful: float
    failed: float


class Range(NamedTuple):
    """The least and the most that any of the people measured had."""

    least: float
    most: float


# The least and most of the 6,068 adults of ANSUR II; the neck is the survey's at its narrowest,
# upper arm and forearm flexed, the inseam its crotch height. Metres and kilograms.
PEOPLE: Mapping[str, Range] = MappingProxyType(
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


def people_of(
    age: float | None, stature: float, adults: Mapping[str, Range] = PEOPLE
) -> Mapping[str, Range]:
    """What people of an age measure: adults (None), or people of all sizes down to adults scaled to
    a child's stature (m).
    """
    if age is None or age >= ADULT:
        return adults
    scale = stature / (sum(adults["height_m"]) / 2)
    least = {
        name: scale ** (3 if name.endswith("_kg") else 1) * low for name, (low, _) in adults.items()
    }
    return {name: Range(least[name], most) for name, (_, most) in adults.items()}


@dataclass(frozen=True)
class Limits:
    """Limits of the evidence on a fit (`habitus.fit.markers.evidence`), in its units."""

    mean_mm: Bound
    p95_mm: Bound
    usual: Bound
    """Mean error as a multiple of what the layout and the motion usually leave."""
    usual_still_mm: float
    usual_moving_mm: float
    """What sound fits leave: so many mm, and so many more for each m/s."""
    displaced: Bound
    """How far markers sit from the layout's places, in the layout's spreads, at the median."""
    distrusted: Bound
    """Share of samples that the robust loss counts for less than half."""
    beta_sd: Bound
    betas_rms: Bound
    above_people: Bound
    below_people: Bound
    """How far a measurement lies outside what the survey of adults saw, as a share; children are
    smaller.
    """
    suspects: Bound
    """Share of the markers under suspicion."""
    markers: Bound
    """How many markers there are: below."""
    unseen: float
    """Share of the frames in which no marker tells where a limb is."""
    no_data: Bound
    gap_s: Bound
    height: Bound
    """Recorded height against the estimate, as a share."""
    mass: Bound
    mass_remark: float
    confidence: Bound
    """Of the layout's choice, 0..1: below."""
    tilt_deg: Bound
    standing_tilt_deg: Bound
    size: Bound
    """Of the markers against the body that was fitted to them, as a factor."""
    height_m: Range
    """Of anybody, children included."""
    torn: Bound
    torn_level: float
    """Pairs of markers that are close on the body and far apart in the capture; level ones speak of
    two people.
    """
    slow_hz: Bound
    fast_hz: Bound
    speed: Bound
    """Of the body as a whole (m/s), at the median."""
    left_out: Bound
    """Share of the labels that had to be left out."""
    people: Mapping[str, Range]


LIMITS = Limits(
    mean_mm=Bound(15.0, 30.0),
    p95_mm=Bound(35.0, 80.0),
    usual=Bound(2.5, 5.0),
    usual_still_mm=4.0,
    usual_moving_mm=3.0,
    displaced=Bound(2.0, 4.0),
    distrusted=Bound(0.05, 0.20),
    beta_sd=Bound(3.5, 6.0),
    betas_rms=Bound(1.6, 2.5),
    above_people=Bound(0.05, 0.15),
    below_people=Bound(0.05, 0.60),
    suspects=Bound(0.35, float("inf")),
    markers=Bound(12, 4),
    unseen=0.5,
    no_data=Bound(0.05, 0.5),
    gap_s=Bound(1.0, float("inf")),
    height=Bound(0.03, 0.12),
    mass=Bound(0.20, 0.60),
    mass_remark=0.05,
    confidence=Bound(0.4, 0.0),
    tilt_deg=Bound(50.0, 181.0),
    standing_tilt_deg=Bound(20.0, 181.0),
    size=Bound(1.5, 2.5),
    height_m=Range(0.6, 2.8),
    torn=Bound(0.02, 0.15),
    torn_level=0.6,
    slow_hz=Bound(15.0, 1.0),
    fast_hz=Bound(1500.0, 10000.0),
    speed=Bound(12.0, 40.0),
    left_out=Bound(0.0, 0.34),
    people=PEOPLE,
)
