"""Bodies of every age: sliders fitted to the published medians of each sex and age, as offsets from
the adult mean.

MakeHuman's age targets give the look of a child or an old person; how large, heavy, long-legged and
large-headed they are comes from the medians. A whole-body size is free beside the sliders, because
MakeHuman's children are small for their nominal years. What sets the people's mean apart from
MakeHuman's own adult goes into the other adults, but not into children: its breasts, muscles and
fat are an adult's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.optimize import lsq_linear

from .cleft import Cleft
from .growth import ADULT, AGES, MEDIANS, SEXES
from .ruler import NUMBERS, Ruler
from .sliders import ANCHORS, RACES, MorphSpace, read_morphs
from .sources import BODY_VERTICES, Source
from .tpose import RestPose

# sliders that tell how an age looks, one value an age of AGES
LOOK = {
    "female": {
        "gender": (
            0.4,
            0.35,
            0.15,
            0,
            0,
            0,
            0,
            0,
            0,
        ),  # before puberty girls and boys differ little
        "age": (0.115, 0.165, 0.28, 0.43, 0.50, 0.50, 0.615, 0.77, 0.923),
        "muscle": (0.35, 0.35, 0.4, 0.45, 0.45, 0.45, 0.45, 0.42, 0.38),
        "cup": (0.0, 0.0, 0.15, 0.45, 0.5, 0.5, 0.55, 0.6, 0.5),
        "firmness": (0.5, 0.5, 0.6, 0.6, 0.55, 0.5, 0.45, 0.4, 0.35),
        "hip-scale-horiz-decr-incr": (-0.3, -0.3, -0.15, 0, 0, 0, 0, 0, 0),
        "buttocks-volume-decr-incr": (-0.3, -0.3, -0.1, 0, 0, 0, 0, 0, 0),
        "torso-muscle-pectoral-decr-incr": (-0.3, -0.3, 0, 0, 0, 0, 0, 0, 0),
        "measure-neck-height-decr-incr": (0.3, 0.2, 0, 0, 0, 0, 0, 0, 0),
    },
    "male": {
        "age": (0.11, 0.155, 0.26, 0.42, 0.48, 0.50, 0.615, 0.77, 0.923),
        "muscle": (0.3, 0.3, 0.36, 0.45, 0.48, 0.5, 0.5, 0.45, 0.4),
        "torso-muscle-pectoral-decr-incr": (-0.3, -0.3, -0.15, 0, 0, 0, 0, 0, 0),
        "measure-neck-height-decr-incr": (0.3, 0.2, 0, 0, 0, 0, 0, 0, 0),
    },
}
# free parameters: start, spread, lowest, highest
FREE = {
    "size": (0.0, 0.05, -0.3, 0.3),  # logarithm of the whole body's scale
    "height": (0.5, 0.15, 0.0, 1.0),
    "weight": (0.8, 0.2, 0.0, 1.3),
    "stomach-pregnant-decr-incr": (0.0, 0.05, -0.2, 0.2),
    "stomach-tone-decr-incr": (0.0, 0.2, -0.6, 0.6),
    "hip-scale-depth-decr-incr": (0.0, 0.06, -0.3, 0.3),
    "torso-scale-depth-decr-incr": (0.0, 0.1, -0.4, 0.4),
    "torso-scale-horiz-decr-incr": (0.0, 0.1, -0.4, 0.4),
    "measure-waist-circ-decr-incr": (0.0, 0.15, -0.6, 0.6),
    "measure-hips-circ-decr-incr": (0.0, 0.08, -0.4, 0.4),
    "measure-underbust-circ-decr-incr": (0.0, 0.1, -0.4, 0.4),
    "upperleg-fat-decr-incr": (0.0, 0.12, -0.5, 0.5),
    "upperarm-fat-decr-incr": (0.0, 0.2, -0.5, 0.5),
    "head-scale-horiz-decr-incr": (0.0, 0.5, -1.1, 1.1),
    "head-scale-depth-decr-incr": (0.0, 0.5, -1.1, 1.1),
    "head-scale-vert-decr-incr": (0.0, 0.5, -1.1, 1.1),
    "upperlegs-height-decr-incr": (0.0, 0.2, -0.8, 0.8),
    "lowerlegs-height-decr-incr": (0.0, 0.2, -0.8, 0.8),
    "measure-napetowaist-dist-decr-incr": (0.0, 0.1, -0.5, 0.5),
    "hip-scale-vert-decr-incr": (0.0, 0.1, -0.4, 0.4),
}
GROWN_SIZE_SPREAD = 0.004  # of those from 16 years on
GROWN = 16  # years: from here on a body's size is nearly the sliders' own
# how much of the people's mean's own character each age of AGES has
CHARACTER = np.array([0.0, 0.0, 0.35, 0.7, 0.85, 1.0, 0.95, 0.8, 0.6])
TRUST = np.array([0.002, 0.1, 0.002, 0.002, 0.003, 0.003, 0.004])
EXACT = np.array(
    [1, 1, 1, 1, 0, 0, 0]
)  # the published numbers: what a fit leaves of them is asked for again
STEPS = 8
CORRECTIONS = 3
STEP = 0.01


def wanted(sex: str, age: int, adult: np.ndarray) -> np.ndarray:
    """Targets in the order of NUMBERS at place `age` of AGES; `adult`: the numbers of the adult
    mean, whose head's shape stays.
    """
    median = MEDIANS[sex][AGES[age]]
    of = dict(zip(NUMBERS, adult, strict=True))
    grow = median.head_girth / of["head_girth"]
    taller = of["head_height"] / MEDIANS[sex][ADULT].head_height - 1
    height = median.head_height * (1 + CHARACTER[age] * taller)
    head = median.head_girth, grow * of["head_length"], grow * of["head_breadth"], height
    return np.array([median.stature, median.weight, median.sitting_height, *head])


@dataclass(frozen=True)
class AgeSpace:
    """Sliders of one sex at every age, over body vertices (for fitting) and over what the T-pose
    needs.
    """

    sex: str
    skin: MorphSpace
    posing: MorphSpace
    rest: RestPose
    ruler: Ruler
    cleft: Cleft

    def points(self, morphs: MorphSpace, age: int, parameters: np.ndarray) -> np.ndarray:
        """Points (N, P, 3) at place `age` of AGES from parameters (N, len(FREE)), in MakeHuman's
        A-pose.
        """
        count = len(parameters)
        free = dict(zip(FREE, parameters.T, strict=True))
        given = {name: np.full(count, 0.5) for name in ANCHORS} | {
            "gender": np.full(count, float(self.sex == "male"))
        }
        given |= {
            name: np.full(count, float(values[age])) for name, values in LOOK[self.sex].items()
        } | free
        local = np.stack([given.get(name, np.zeros(count)) for name in morphs.local_names], 1)
        macro = {name: given[name] for name in ANCHORS}
        points = morphs.bodies(macro, np.full((count, len(RACES)), 1 / len(RACES)), local)
        return points * np.exp(free["size"])[:, None, None]

    def fit(self, age: int, target: np.ndarray, first: np.ndarray | None = None) -> np.ndarray:
        """Parameters (len(FREE),): Gauss-Newton on |(numbers - target)/trust|^2 + |(x -
        start)/spread|^2 in bounds.
        """
        start, spread, low, high = np.array(list(FREE.values())).T
        if AGES[age] >= GROWN:
            spread = np.where(np.array(list(FREE)) == "size", GROWN_SIZE_SPREAD, spread)
        x = start.copy() if first is None else first
        for _ in range(STEPS if first is None else 2):
            steps = np.concatenate([x[None], x + STEP * np.eye(len(x))])
            numbers = self.ruler(self.points(self.skin, age, steps))
            jacobian = (numbers[1:] - numbers[0]).T / STEP
            matrix = np.concatenate([jacobian / TRUST[:, None], np.diag(1 / spread)])
            gap = np.concatenate([(target - numbers[0]) / TRUST, (start - x) / spread])
            x = (
                x
                + lsq_linear(
                    matrix, gap, (np.minimum(low - x, -1e-9), np.maximum(high - x, 1e-9))
                ).x
            )
        return x

    def posed(self, age: int, parameters: np.ndarray) -> np.ndarray:
        """(V, 3) in the T-pose."""
        return self.rest(self.points(self.posing, age, parameters[None]))[0][0].astype(float)

    def bodies(self, template: np.ndarray) -> np.ndarray:
        """(A, V, 3) mean bodies at AGES in the T-pose; `template` (V, 3) is the people's mean, the
        adult of 25.
        """
        adult = AGES.index(ADULT)
        now = self.ruler(template[None])[0]
        own = self.posed(adult, self.fit(adult, now))
        return np.stack([self._body(age, template, own, now) for age in range(len(AGES))])

    def _body(
        self, age: int, template: np.ndarray, own: np.ndarray, adult: np.ndarray
    ) -> np.ndarray:
        if AGES[age] == ADULT:
            return template
        goal = wanted(self.sex, age, adult)
        scale = goal[0] / adult[0]
        character = CHARACTER[age] * scale * (template - own)
        asked = goal
        found = None
        for _ in range(CORRECTIONS):
            found = self.fit(age, asked, found)
            body = self.cleft(self.posed(age, found) + character, template, scale)
            asked = asked + EXACT * (goal - self.ruler(body[None])[0])
        return body


def age_spaces(source: Source, rest: RestPose, ruler: Ruler) -> dict[str, AgeSpace]:
    """Both sexes' sliders."""
    morphs = read_morphs(source, ANCHORS["age"])
    pick = sparse.eye(BODY_VERTICES, len(source.vertices), format="csr")
    cleft = Cleft(rest.left, rest.mirror, ruler.skin)
    return {
        sex: AgeSpace(sex, own.at(pick), own.at(rest.points), rest, ruler, cleft)
        for sex, own in ((sex, _of_sex(morphs, sex)) for sex in SEXES)
    }


def _of_sex(morphs: MorphSpace, sex: str) -> MorphSpace:
    """Without the targets and the sliders that no age of this sex uses."""
    other = "" if "gender" in LOOK[sex] else SEXES[1 - SEXES.index(sex)]
    macro = [k for k, factors in enumerate(morphs.macro_factors) if other not in factors]
    local = [k for k, name in enumerate(morphs.local_names) if name in FREE or name in LOOK[sex]]
    return MorphSpace(
        morphs.base,
        morphs.macro_offsets[macro],
        tuple(morphs.macro_factors[k] for k in macro),
        tuple(morphs.local_names[k] for k in local),
        morphs.local_offsets[local],
    )


def age_directions(
    spaces: dict[str, AgeSpace], templates: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """`agedirs` (V, 3, A) of every template: female, male, and neutral (the mean of both sexes'
    offsets).
    """
    offsets = {
        sex: (space.bodies(templates[sex]) - templates[sex]).transpose(1, 2, 0)
        for sex, space in spaces.items()
    }
    return offsets | {"neutral": sum(offsets.values()) / len(offsets)}


def pelvis_kept(offsets: np.ndarray, regressor: sparse.csr_matrix) -> np.ndarray:
    """Offsets (V, 3, A) moved so that the regressed pelvis, the first joint, stays where the
    template's is.
    """
    weights = regressor[:1].toarray()[0]
    return offsets - np.einsum("v,vca->ca", weights, offsets)
