"""Published medians of stature, weight, sitting height and head by sex and age: what the bodies of
each age must match.

Numbers were read from the tables named in SOURCES, not recalled. What no table gives is marked:
`derived` by a stated rule from published numbers, `not verified` where only a guide value is known
(it pulls a little and is not counted).
"""

from __future__ import annotations

from dataclasses import dataclass

AGES = (5, 8, 12, 16, 20, 25, 40, 60, 80)
ADULT = 25  # years: the people's own mean body
SEXES = ("female", "male")

SOURCES = {
    "cdc": "CDC 2000 growth charts, stature-for-age and weight-for-age, 50th percentile, LMS "
    "tables (Kuczmarski et al. "
    "2002, Vital Health Stat 11(246))",
    "nhanes": "NHANES 2009-2012 public microdata, examination weights, pregnant women left out: "
    "weighted medians at "
    "20-29, 35-44, 55-64 and 80 or more years (the survey of Fryar et al., Vital Health Stat "
    "11(252) and 3(39))",
    "fredriks": "Fredriks et al. 2005, Arch Dis Child 90:807-812: sitting height over height, LMS "
    "medians, Dutch "
    "children 1997",
    "fredriks_head": "Fredriks et al. 2000, Pediatr Res 47:316-323: head circumference, medians, "
    "Dutch children 1997",
    "ansur": "ANSUR II public tables (2012): medians of soldiers of 17-22, 23-27, 36-44 and 45-58 "
    "years",
    "loss": "derived: of what the old are shorter than those of 40, 45 % (women) or 60 % (men) is "
    "the birth cohort's "
    "and leaves proportions alone (Cline et al. 1989, Hum Biol 61:415-425); the rest is lost from "
    "the trunk",
    "same": "derived: an adult's head keeps its size; as at 45-58 years",
    "guide": "not verified: vertex to menton as craniofacial norms give it, from memory",
}


@dataclass(frozen=True)
class Median:
    """The median person of a sex and age; every value with the key of its source."""

    stature: float  # metres
    weight: float  # kilograms
    size_source: str
    sitting_ratio: float  # sitting height over stature; one minus it is the leg length over stature
    sitting_source: str
    head_girth: float  # metres
    head_source: str
    head_height: float  # metres, vertex to menton; source `guide`, a weak pull on children only

    @property
    def sitting_height(self) -> float:
        """Metres."""
        return self.stature * self.sitting_ratio

    @property
    def leg_length(self) -> float:
        """Metres: stature less sitting height."""
        return self.stature - self.sitting_height


MEDIANS = {
    "female": {
        5: Median(1.0766, 17.93, "cdc", 0.5462, "fredriks", 0.5059, "fredriks_head", 0.181),
        8: Median(1.2759, 25.63, "cdc", 0.5306, "fredriks", 0.5165, "fredriks_head", 0.190),
        12: Median(1.5119, 41.65, "cdc", 0.5161, "fredriks", 0.5381, "fredriks_head", 0.207),
        16: Median(1.6255, 53.88, "cdc", 0.5239, "fredriks", 0.5509, "fredriks_head", 0.216),
        20: Median(1.6334, 58.22, "cdc", 0.5279, "ansur", 0.5600, "ansur", 0.218),
        25: Median(1.630, 67.9, "nhanes", 0.5272, "ansur", 0.5600, "ansur", 0.218),
        40: Median(1.632, 71.4, "nhanes", 0.5248, "ansur", 0.5590, "ansur", 0.218),
        60: Median(1.622, 75.9, "nhanes", 0.5232, "loss", 0.5555, "ansur", 0.218),
        80: Median(1.559, 62.7, "nhanes", 0.5126, "loss", 0.5555, "same", 0.218),
    },
    "male": {
        5: Median(1.0890, 18.39, "cdc", 0.5459, "fredriks", 0.5150, "fredriks_head", 0.188),
        8: Median(1.2788, 25.64, "cdc", 0.5308, "fredriks", 0.5245, "fredriks_head", 0.198),
        12: Median(1.4905, 40.47, "cdc", 0.5126, "fredriks", 0.5412, "fredriks_head", 0.213),
        16: Median(1.7351, 60.92, "cdc", 0.5118, "fredriks", 0.5642, "fredriks_head", 0.227),
        20: Median(1.7685, 70.60, "cdc", 0.5236, "ansur", 0.5730, "ansur", 0.232),
        25: Median(1.760, 81.1, "nhanes", 0.5241, "ansur", 0.5750, "ansur", 0.232),
        40: Median(1.765, 88.5, "nhanes", 0.5221, "ansur", 0.5750, "ansur", 0.232),
        60: Median(1.762, 88.0, "nhanes", 0.5215, "loss", 0.5740, "ansur", 0.232),
        80: Median(1.721, 78.6, "nhanes", 0.5172, "loss", 0.5740, "same", 0.232),
    },
}

# years between those of AGES -> stature (metres) and weight (kilograms), source `cdc`: how linear
# growth is in between
BETWEEN = {
    "female": {6: (1.1471, 20.24), 10: (1.3799, 32.89), 14: (1.6039, 49.36), 18: (1.6312, 56.19)},
    "male": {6: (1.1539, 20.68), 10: (1.3862, 31.94), 14: (1.6384, 51.00), 18: (1.7616, 67.20)},
}
