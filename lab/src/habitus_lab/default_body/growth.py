"""Published medians of stature, weight, sitting height and head by sex and age: what the bodies of
each age must match.

Numbers were read from the tables named in SOURCES, not recalled. What no table gives is marked:
`derived` by a stated rule from published numbers, `not verified` where only a guide value is known
(it pulls a little and is not counted).
"""

from __future__ import annotations

from dataclasses import dataclass

# years; straight lines between them miss CDC's monthly medians of 6 to 20 years by at most 0.9 cm
# and 0.7 kg, WHO's of 1 to 5 years by 0.9 cm
AGES = (1, 2, 3, 5, 8, 11, 13, 15, 17, 20, 25, 40, 60, 80, 90)
ADULT = 25  # years: the people's own mean body
SEXES = ("female", "male")

SOURCES = {
    "who": "WHO Child Growth Standards 2006 and 2007: length-for-age (1 year, lying) or "
    "height-for-age, weight-for-age and head-circumference-for-age, medians, LMS tables by day",
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
    "between": "derived: linear between the published medians of 8, 12, 16 and 20 years",
    "sorkin": "derived: height as at 80 less 3 cm (women) or 2 cm (men), what the seventies cost "
    "(Sorkin et al. 1999, Am J Epidemiol 150:969-977); not verified: body-mass index one less",
    "infant": "not verified: crown-rump length over length, from memory of growth studies",
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
        1: Median(0.7400, 8.95, "who", 0.6200, "infant", 0.4489, "who", 0.160),
        2: Median(0.8572, 11.48, "who", 0.5900, "infant", 0.4718, "who", 0.171),
        3: Median(0.9506, 13.85, "who", 0.5700, "infant", 0.4851, "who", 0.176),
        5: Median(1.0942, 18.22, "who", 0.5462, "fredriks", 0.4992, "who", 0.181),
        8: Median(1.2759, 25.63, "cdc", 0.5306, "fredriks", 0.5165, "fredriks_head", 0.190),
        11: Median(1.4398, 37.21, "cdc", 0.5197, "between", 0.5327, "between", 0.203),
        13: Median(1.5715, 45.82, "cdc", 0.5181, "between", 0.5413, "between", 0.209),
        15: Median(1.6186, 52.04, "cdc", 0.5220, "between", 0.5477, "between", 0.214),
        17: Median(1.6291, 55.14, "cdc", 0.5249, "between", 0.5532, "between", 0.217),
        20: Median(1.6334, 58.22, "cdc", 0.5279, "ansur", 0.5600, "ansur", 0.218),
        25: Median(1.6300, 67.90, "nhanes", 0.5272, "ansur", 0.5600, "ansur", 0.218),
        40: Median(1.6320, 71.40, "nhanes", 0.5248, "ansur", 0.5590, "ansur", 0.218),
        60: Median(1.6220, 75.90, "nhanes", 0.5232, "loss", 0.5555, "ansur", 0.218),
        80: Median(1.5590, 62.70, "nhanes", 0.5126, "loss", 0.5555, "same", 0.218),
        90: Median(1.5290, 58.00, "sorkin", 0.5030, "loss", 0.5555, "same", 0.218),
    },
    "male": {
        1: Median(0.7574, 9.65, "who", 0.6200, "infant", 0.4606, "who", 0.163),
        2: Median(0.8713, 12.15, "who", 0.5900, "infant", 0.4825, "who", 0.175),
        3: Median(0.9609, 14.34, "who", 0.5700, "infant", 0.4946, "who", 0.181),
        5: Median(1.0996, 18.34, "who", 0.5459, "fredriks", 0.5074, "who", 0.188),
        8: Median(1.2788, 25.64, "cdc", 0.5308, "fredriks", 0.5245, "fredriks_head", 0.198),
        11: Median(1.4352, 35.89, "cdc", 0.5172, "between", 0.5370, "between", 0.209),
        13: Median(1.5609, 45.59, "cdc", 0.5124, "between", 0.5470, "between", 0.217),
        15: Median(1.6994, 56.28, "cdc", 0.5120, "between", 0.5585, "between", 0.224),
        17: Median(1.7529, 64.57, "cdc", 0.5148, "between", 0.5664, "between", 0.229),
        20: Median(1.7685, 70.60, "cdc", 0.5236, "ansur", 0.5730, "ansur", 0.232),
        25: Median(1.7600, 81.10, "nhanes", 0.5241, "ansur", 0.5750, "ansur", 0.232),
        40: Median(1.7650, 88.50, "nhanes", 0.5221, "ansur", 0.5750, "ansur", 0.232),
        60: Median(1.7620, 88.00, "nhanes", 0.5215, "loss", 0.5740, "ansur", 0.232),
        80: Median(1.7210, 78.60, "nhanes", 0.5172, "loss", 0.5740, "same", 0.232),
        90: Median(1.7010, 73.90, "sorkin", 0.5115, "loss", 0.5740, "same", 0.232),
    },
}

# years between those of AGES -> stature (metres) and weight (kilograms), sources `who` (up to 4) and
# `cdc`: how linear growth is in between
BETWEEN = {
    "female": {
        1.5: (0.8071, 10.23),
        2.5: (0.9068, 12.70),
        4: (1.0273, 16.07),
        6: (1.1471, 20.24),
        7: (1.2149, 22.76),
        10: (1.3799, 32.89),
        12: (1.5119, 41.65),
        14: (1.6039, 49.36),
        16: (1.6255, 53.88),
        18: (1.6312, 56.19),
    },
    "male": {
        1.5: (0.8226, 10.94),
        2.5: (0.9193, 13.30),
        4: (1.0333, 16.35),
        6: (1.1539, 20.68),
        7: (1.2177, 23.07),
        10: (1.3862, 31.94),
        12: (1.4905, 40.47),
        14: (1.6384, 51.00),
        16: (1.7351, 60.92),
        18: (1.7616, 67.20),
    },
}

# years -> spread of stature and weight as shares of the median (S of the LMS tables named above)
SPREAD = {
    "female": {
        1: (0.0348, 0.1227),
        2: (0.0376, 0.1239),
        3: (0.0401, 0.1292),
        5: (0.0435, 0.1482),
        8: (0.0459, 0.1716),
        11: (0.0505, 0.2018),
        13: (0.0440, 0.1977),
        15: (0.0401, 0.1784),
    },
    "male": {
        1: (0.0314, 0.1093),
        2: (0.0351, 0.1143),
        3: (0.0386, 0.1212),
        5: (0.0421, 0.1352),
        8: (0.0451, 0.1556),
        11: (0.0489, 0.1896),
        13: (0.0503, 0.1968),
        15: (0.0460, 0.1821),
    },
}

# years -> degrees that the thoracic spine is bent more than at 25. Women: O'Gorman and Jull 1987,
# Clin Biomech 2:154-159: 41 degrees in the third decade, no change before the fifth, 60 over 70
# years. Men, and women of 60 and 90: not verified; men's spines bend about two thirds as much.
KYPHOSIS = {
    "female": {40: 0.0, 60: 6.0, 80: 19.0, 90: 22.0},
    "male": {40: 0.0, 60: 4.0, 80: 12.0, 90: 15.0},
}
