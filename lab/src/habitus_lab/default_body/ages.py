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
from .contacts import Meetings, with_room
from .growth import ADULT, AGES, KYPHOSIS, MEDIANS, SEXES, SPREAD
from .rig import joint_weights
from .ruler import NUMBERS, Ruler
from .sliders import ANCHORS, RACES, MorphSpace, read_morphs
from .sources import BODY_VERTICES, Source
from .stoop import stooped
from .tpose import RestPose

# years at which LOOK gives sliders; straight lines between
KNOTS = (1, 2, 3, 5, 8, 12, 16, 20, 25, 40, 60, 80, 90)
# sliders that tell how an age looks, one value a year of KNOTS; girls and boys differ little before
# puberty
LOOK = {
    "female": {
        "gender": (0.45, 0.43, 0.42, 0.4, 0.35, 0.15, 0, 0, 0, 0, 0, 0, 0),
        "age": (0.0, 0.04, 0.07, 0.115, 0.165, 0.28, 0.43, 0.5, 0.5, 0.615, 0.77, 0.923, 1.0),
        "muscle": (0.4, 0.4, 0.4, 0.35, 0.35, 0.4, 0.45, 0.45, 0.45, 0.45, 0.42, 0.38, 0.36),
        "cup": (0.0, 0.0, 0.0, 0.0, 0.0, 0.15, 0.45, 0.5, 0.5, 0.55, 0.6, 0.5, 0.45),
        "firmness": (0.5, 0.5, 0.5, 0.5, 0.5, 0.6, 0.6, 0.55, 0.5, 0.45, 0.4, 0.35, 0.3),
        "hip-scale-horiz-decr-incr": (0, 0, -0.2, -0.3, -0.3, -0.15, 0, 0, 0, 0, 0, 0, 0),
        "buttocks-volume-decr-incr": (0, 0, -0.2, -0.3, -0.3, -0.1, 0, 0, 0, 0, 0, 0, 0),
        "torso-muscle-pectoral-decr-incr": (-0.3, -0.3, -0.3, -0.3, -0.3, 0, 0, 0, 0, 0, 0, 0, 0),
        "measure-neck-height-decr-incr": (0.3, 0.3, 0.3, 0.3, 0.2, 0, 0, 0, 0, 0, 0, 0, 0),
    },
    "male": {
        "age": (0.0, 0.04, 0.07, 0.11, 0.155, 0.26, 0.42, 0.48, 0.5, 0.615, 0.77, 0.923, 1.0),
        "muscle": (0.4, 0.4, 0.4, 0.3, 0.3, 0.36, 0.45, 0.48, 0.5, 0.5, 0.45, 0.4, 0.37),
        "torso-muscle-pectoral-decr-incr": (-0.3, -0.3, -0.3, -0.3, -0.3, -0.15, *7 * (0,)),
        "measure-neck-height-decr-incr": (0.3, 0.3, 0.3, 0.3, 0.2, 0, 0, 0, 0, 0, 0, 0, 0),
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
# how much of the people's mean's own character each year of KNOTS has
CHARACTER = (0.0, 0.0, 0.0, 0.0, 0.0, 0.35, 0.7, 0.85, 1.0, 0.95, 0.8, 0.6, 0.5)
TRUST = np.array([0.002, 0.1, 0.002, 0.002, 0.003, 0.003, 0.004])
EXACT = np.array(
    [1, 1, 1, 1, 0, 0, 0]
)  # the published numbers: what a fit leaves of them is asked for again
STEPS = 4
CORRECTIONS = 3
STEP = 0.01
PEOPLE = 100  # drawn to measure a spread


def at_years(values: tuple[float, ...], age: int) -> float:
    """A value of KNOTS at place `age` of AGES."""
    return float(np.interp(AGES[age], KNOTS, values))


def wanted(sex: str, age: int, adult: np.ndarray) -> np.ndarray:
    """Targets in the order of NUMBERS at place `age` of AGES; `adult`: the numbers of the adult
    mean, whose head's shape stays.
    """
    median = MEDIANS[sex][AGES[age]]
    of = dict(zip(NUMBERS, adult, strict=True))
    grow = median.head_girth / of["head_girth"]
    taller = of["head_height"] / MEDIANS[sex][ADULT].head_height - 1
    height = median.head_height * (1 + at_years(CHARACTER, age) * taller)
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
    weights: np.ndarray  # (V, J) of the skin to the joints

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
            name: np.full(count, at_years(values, age)) for name, values in LOOK[self.sex].items()
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

    def posed(self, age: int, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) and joints (J, 3) in the T-pose."""
        vertices, joints = self.rest(self.points(self.posing, age, parameters[None]))
        return vertices[0].astype(float), joints[0]

    def bodies(self, template: np.ndarray) -> np.ndarray:
        """(A, V, 3) mean bodies at AGES in the T-pose; `template` (V, 3) is the people's mean, the
        adult of 25.
        """
        adult = AGES.index(ADULT)
        now = self.ruler(template[None])[0]
        own, _ = self.posed(adult, self.fit(adult, now))
        return np.stack([self._body(age, template, own, now) for age in range(len(AGES))])

    def _body(
        self, age: int, template: np.ndarray, own: np.ndarray, adult: np.ndarray
    ) -> np.ndarray:
        if AGES[age] == ADULT:
            return template
        goal = wanted(self.sex, age, adult)
        scale = goal[0] / adult[0]
        character = at_years(CHARACTER, age) * scale * (template - own)
        bent = KYPHOSIS[self.sex].get(AGES[age], 0.0)
        asked = goal
        found = None
        for _ in range(CORRECTIONS):
            found = self.fit(age, asked, found)
            posed, joints = self.posed(age, found)
            upright = self.cleft(posed + character, template, scale)
            body = stooped(upright, joints, self.weights, bent)
            asked = asked + EXACT * (goal - self.ruler(body[None])[0])
        return body


def age_spaces(
    source: Source, base: np.ndarray, rest: RestPose, ruler: Ruler
) -> dict[str, AgeSpace]:
    """Both sexes' sliders; base (V,) the base mesh's vertex of each of the body's."""
    morphs = read_morphs(source, ANCHORS["age"])
    pick = sparse.eye(BODY_VERTICES, len(source.vertices), format="csr")
    cleft = Cleft(rest.left, rest.mirror, ruler.skin)
    weights = joint_weights(source, base, rest.mirror)
    return {
        sex: AgeSpace(sex, own.at(pick), own.at(rest.points), rest, ruler, cleft, weights)
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


@dataclass(frozen=True)
class Variation:
    """How adults vary about a template, and the skins that must not meet."""

    template: np.ndarray  # (V, 3)
    shapedirs: np.ndarray  # (V, 3, B)
    skins: tuple[np.ndarray, ...]  # (F, 3) each, levels of detail over the same vertices
    mirror: np.ndarray  # (V,)


def age_directions(
    spaces: dict[str, AgeSpace], variations: dict[str, Variation]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """`agedirs` (V, 3, A) and `age_spread` (A,) of every template: female, male, and neutral (the
    mean of both sexes' offsets).

    Where random bodies of an age would meet themselves, its mean has the adult's gaps; what one
    age or body needs, the next begins with.
    """
    means = {sex: space.bodies(variations[sex].template) for sex, space in spaces.items()}
    offsets = [bodies - variations[sex].template for sex, bodies in means.items()]
    means["neutral"] = variations["neutral"].template + sum(offsets) / len(offsets)
    ruler = next(iter(spaces.values())).ruler
    meetings = Meetings(len(variations["neutral"].template), {})
    return {
        name: _with_room(name, means[name], how, ruler, meetings)
        for name, how in variations.items()
    }


def _with_room(
    name: str, means: np.ndarray, how: Variation, ruler: Ruler, meetings: Meetings
) -> tuple[np.ndarray, np.ndarray]:
    sexes = SEXES if name == "neutral" else (name,)
    adult = how.template
    directions = []
    spreads = []
    for years, mean in zip(AGES, means, strict=True):
        scale = _stature(mean) / _stature(adult)
        spread = _spread(years, sexes, mean, scale * how.shapedirs, ruler)
        if years != ADULT:
            moves = scale * spread * how.shapedirs
            mean = with_room(mean, scale * adult, moves, how.skins, how.mirror, meetings)
        directions.append(mean - adult)
        spreads.append(spread)
    return np.stack(directions, -1), np.array(spreads)


def _stature(body: np.ndarray) -> float:
    return float(np.ptp(body[:BODY_VERTICES, 1]))


def _spread(
    years: int, sexes: tuple[str, ...], mean: np.ndarray, shapedirs: np.ndarray, ruler: Ruler
) -> float:
    """By how much adults' scaled shapes must shrink to vary in stature and weight, in the geometric
    mean of both, as published; at most 1.
    """
    if years not in SPREAD[sexes[0]]:
        return 1.0
    published = np.mean([SPREAD[sex][years] for sex in sexes], axis=0)
    betas = np.random.default_rng(years).normal(size=(PEOPLE, shapedirs.shape[-1]))
    drawn = ruler(mean + np.einsum("vcb,nb->nvc", shapedirs, betas))[:, :2]
    own = np.log(drawn).std(0)
    return float(np.clip(np.sqrt((published / own).prod()), 0.0, 1.0).round(2))


def pelvis_kept(offsets: np.ndarray, regressor: sparse.csr_matrix) -> np.ndarray:
    """Offsets (V, 3, A) moved so that the regressed pelvis, the first joint, stays where the
    template's is.
    """
    weights = regressor[:1].toarray()[0]
    return offsets - np.einsum("v,vca->ca", weights, offsets)
