"""People from measurements: for each measured person a body drawn from the posterior over
MakeHuman's sliders.

Draw sliders from their prior, then find the sliders nearest to that draw whose measurements are the
person's: what was measured is matched, what was not stays as varied as the prior (randomised
maximum likelihood). Gender is exactly woman or man; men have no breast sliders.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch

from . import waist
from .measure import MEASURES, TAPES, Tapes
from .sliders import (
    ANCHORS,
    RACES,
    MorphSpace,
    age_slider,
    macro_anchor_weights,
    widening_sliders,
)
from .survey import People

MACROS = tuple(name for name in ANCHORS if name not in ("age", "gender"))
MACRO_PRIOR = {
    "muscle": (0.5, 0.12),
    "weight": (0.7, 0.15),
    "height": (0.5, 0.15),
    "proportions": (0.5, 0.12),
}
MACRO_PRIOR |= {"cup": (0.5, 0.2), "firmness": (0.5, 0.12)}
LOCAL_PRIOR = 0.15  # standard deviation of a local slider
WIDENING_PRIOR = 0.10  # of a slider that only widens the population
SHAPE_PRIOR = 0.3  # of the trunk's shapes that MakeHuman lacks
# sliders that change the look under equal tapes (mean, standard deviation): their mean stays within
# about this of the given one, for it would drift to wherever that helps a tape. The mean of those
# that only widen is 0.
PINNED = {
    "buttocks-volume-decr-incr": (0.05, 0.08),
    "measure-thigh-circ-decr-incr": (0.2, 0.10),
    "torso-muscle-pectoral-decr-incr": (0.0, 0.07),
    "torso-muscle-dorsi-decr-incr": (0.0, 0.07),
    "torso-vshape-decr-incr": (0.0, 0.10),
    "breast-dist-decr-incr": (0.0, 0.08),
    "breast-trans-down-up": (0.0, 0.10),
    "breast-point-decr-incr": (0.0, 0.10),
    "head-fat-decr-incr": (0.0, 0.10),
    "chest-boxy": (0.2, 0.15),
}
FREER = {
    "upperarm-shoulder-muscle-decr-incr": 0.35,  # bideltoid breadth apart from biacromial
    "hip-boxy": 0.5,  # hips' breadth and depth apart from their girth
}
LOCAL_RANGE = 1.2
WOMEN_ONLY = ("cup", "firmness", "breast-")
# what a measurement is trusted to, metres or kg: landmarks and posture differ from the survey's by
# this much
TRUST = {
    "stature": 0.0015,
    "weightkg": 0.5,
    "cervicaleheight": 0.012,
    "suprasternaleheight": 0.010,
    "crotchheight": 0.003,
    "kneeheightmidpatella": 0.004,
    "waistheightomphalion": 0.010,
    "iliocristaleheight": 0.015,
    "trochanterionheight": 0.02,
    "lateralmalleolusheight": 0.006,
    "acromialheight": 0.012,
    "chestheight": 0.015,
    "acromionradialelength": 0.010,
    "radialestylionlength": 0.008,
    "handlength": 0.002,
    "headlength": 0.006,
    "headheight": 0.003,
    "handbreadth": 0.005,
    "biacromialbreadth": 0.0015,
    "headbreadth": 0.006,
    "footlength": 0.002,
    "span": 0.010,
    "chestdepth": 0.004,
    "waistbreadth": 0.005,
    "waistdepth": 0.005,
    "buttockdepth": 0.002,
    "hipbreadth": 0.003,
    "bideltoidbreadth": 0.005,
    "footbreadthhorizontal": 0.002,
    "bimalleolarbreadth": 0.0015,
    "breastprominence": 0.003,
    "naturalwaistcircumference": 0.008,
    "midthighcircumference": 0.010,
    "lowerthighcircumference": 0.005,
    "balloffootcircumference": 0.004,
}
TAPE_TRUST = 0.003
STEPS = 12
PRIOR_PEOPLE = 120
PRIOR_STEPS = 8  # Gauss-Newton steps of the few people on whom the prior is checked
PRIOR_ROUNDS = 4  # each cuts rings anew, on the mean so far
MEAN_STEPS = 12
LINE_SEARCH = 8  # shares of a step that are tried, each half of the one before
# TRUST over how well the mean of many is known, approached so that tapes' kinks do not stop the fit
MEAN_TIGHTNESS = (0.5, 1.0, 2.0)
ASKED_AGAIN = 0.005  # metres: what is trusted less (landmarks' heights) is not asked for again
MEAN_FREEDOM = 1.5  # standard deviations of a local slider that count as one for its mean
HOLDS = 3
LONGEST_STEP = 0.6
BATCH = 250
# macro weights are linear in each slider between kinks: differences over this step are exact there
KINK = 1e-3


@dataclass(frozen=True)
class Sliders:
    """Sliders of N people."""

    macro: dict[str, np.ndarray]  # each (N,)
    races: np.ndarray  # (N, 3)
    local: np.ndarray  # (N, L)

    def of(self, rows: np.ndarray) -> Sliders:
        """Some of them."""
        macro = {name: value[rows] for name, value in self.macro.items()}
        return Sliders(macro, self.races[rows], self.local[rows])

    @staticmethod
    def joined(parts: Iterable[Sliders]) -> Sliders:
        """People of several groups in one."""
        parts = list(parts)
        macro = {name: np.concatenate([p.macro[name] for p in parts]) for name in parts[0].macro}
        races = np.concatenate([p.races for p in parts])
        return Sliders(macro, races, np.concatenate([p.local for p in parts]))


@dataclass(frozen=True)
class Prior:
    """Of one sex: the sliders' means (S,), and the tapes, whose rings lie on the body of these."""

    mean: np.ndarray
    tapes: Tapes


# what a measurement told by a body's first components may be off, metres or kg
TOLERANCE = {
    "stature": 0.003,
    "weightkg": 1.0,
    "crotchheight": 0.006,
    "chestcircumference": 0.008,
    "waistcircumference": 0.008,
    "buttockcircumference": 0.008,
    "thighcircumference": 0.008,
    "footlength": 0.004,
    "handlength": 0.004,
    "span": 0.012,
    "chestdepth": 0.010,
    "waistdepth": 0.010,
    "buttockdepth": 0.010,
    "waistbreadth": 0.010,
    "hipbreadth": 0.010,
    "bideltoidbreadth": 0.010,
    "neckcircumference": 0.005,
    "calfcircumference": 0.005,
    "anklecircumference": 0.005,
    "bicepscircumferenceflexed": 0.005,
    "forearmcircumferenceflexed": 0.005,
    "wristcircumference": 0.005,
    "headcircumference": 0.005,
}


def trust() -> np.ndarray:
    """(M,) standard deviation of each measurement in the order of MEASURES."""
    return np.array([TRUST.get(name, TAPE_TRUST if name in TAPES else np.nan) for name in MEASURES])


def prior_spread(names: tuple[str, ...], female: bool) -> np.ndarray:
    """(S,) standard deviation of the free sliders, first the macros, then the local ones; 0 for a
    man's breasts.
    """
    local = np.where(widening_sliders(names), WIDENING_PRIOR, LOCAL_PRIOR)
    special = dict.fromkeys(waist.NAMES, SHAPE_PRIOR) | FREER
    special |= {name: sd for name, (_, sd) in PINNED.items()}
    spread = [(m, MACRO_PRIOR[m][1]) for m in MACROS]
    spread += [(name, special.get(name, sd)) for name, sd in zip(names, local, strict=True)]
    return np.array(
        [0.0 if not female and name.startswith(WOMEN_ONLY) else value for name, value in spread]
    )


def learn_prior(
    morphs: MorphSpace,
    tapes: Callable[[np.ndarray], Tapes],
    people: People,
    rng: np.random.Generator,
) -> Prior:
    """The prior of people of one sex: where MakeHuman's middle is not the survey's, the prior moves
    there, to the nearest sliders that give the mean measurements.

    What the people's own bodies then miss on average is asked of the mean besides. `morphs` span
    the base mesh; `tapes` makes those of a mean body (W, 3). A ring that is level on a mean of both
    sexes would slope at women's flanks, so rings are cut on the sex's own mean.
    """
    few = rng.choice(len(people.age), min(PRIOR_PEOPLE, len(people.age)), replace=False)
    sample = people[few]
    names = morphs.local_names
    start = {m: MACRO_PRIOR[m][0] for m in MACROS} | {name: m for name, (m, _) in PINNED.items()}
    middle = np.array([start.get(name, 0.0) for name in (*MACROS, *names)])
    spread = prior_spread(names, bool(people.female[0]))
    free = np.array([name not in start for name in (*MACROS, *names)])
    spread[free] *= MEAN_FREEDOM
    spread[len(MACROS) :][widening_sliders(names)] = 0.0
    wanted = people.values.mean(0)
    mean = middle
    own = tapes(mean_body(morphs, people, mean))
    for turn in range(PRIOR_ROUNDS):
        points = own.over(morphs)
        tightness = MEAN_TIGHTNESS[-1 if turn else 0 :]
        mean = _mean_sliders(points, own, people, wanted, (mean, middle, spread), tightness)
        own = tapes(mean_body(morphs, people, mean))
        if turn < PRIOR_ROUNDS - 1:
            _, residual = rebuild(own.over(morphs), own, sample, rng, mean, PRIOR_STEPS)
            wanted = wanted - (trust() <= ASKED_AGAIN) * residual.mean(0)
    return Prior(mean, own)


def _mean_sliders(
    points: MorphSpace,
    tapes: Tapes,
    people: People,
    wanted: np.ndarray,
    sliders: tuple[np.ndarray, np.ndarray, np.ndarray],
    tightness: tuple[float, ...],
) -> np.ndarray:
    """(S,) the sliders nearest to a middle whose body has the measurements `wanted` (M,); sliders:
    start, middle, spread (S,) each.
    """
    x, middle, spread = sliders
    shares = 0.5 ** np.arange(LINE_SEARCH)
    fixed = {name: np.full(LINE_SEARCH, value.mean()) for name, value in _known(people).items()}
    batch = _Batch(points, tapes, fixed, np.full((LINE_SEARCH, len(RACES)), 1 / len(RACES)))
    low, high = _ranges(len(middle))
    x = np.clip(x, low, high)
    for times in tightness:
        limits = trust() / times
        y, jac = (value[:1] for value in batch.jacobian(np.tile(x, (LINE_SEARCH, 1))))
        cost = _cost(x[None], y, middle[None], spread[None], wanted[None], limits)[0]
        for _ in range(MEAN_STEPS):
            target = _goal_in_range(
                x[None], y, jac, middle[None], spread[None], wanted[None], limits
            )[0]
            trial = np.clip(x + shares[:, None] * (target - x), low, high)
            there, slope = batch.jacobian(trial)
            costs = _cost(trial, there, middle, spread, wanted, limits)
            best = int(costs.argmin())
            if costs[best] > cost - 1e-3:
                break
            x, y, jac, cost = trial[best], there[[best]], slope[[best]], costs[best]
    return x


def mean_body(morphs: MorphSpace, people: People, mean: np.ndarray) -> np.ndarray:
    """(W, 3) the body of mean sliders (S,) at the mean age of people of one sex."""
    macro = {name: mean[[k]] for k, name in enumerate(MACROS)}
    macro |= {name: value.mean(keepdims=True) for name, value in _known(people).items()}
    races = np.full((1, len(RACES)), 1 / len(RACES))
    return morphs.bodies(macro, races, mean[None, len(MACROS) :])[0].astype(float)


def _known(people: People) -> dict[str, np.ndarray]:
    """The macro sliders (N,) that are given: sex and age."""
    return {
        "gender": np.where(people.female, 0.0, 1.0),
        "age": age_slider(np.clip(people.age, 25, 90)),
    }


def rebuild(
    morphs: MorphSpace,
    tapes: Tapes,
    people: People,
    rng: np.random.Generator,
    mean: np.ndarray,
    steps: int = STEPS,
) -> tuple[Sliders, np.ndarray]:
    """Sliders of every person, and the residuals (N, M) of their measurements.

    The people are of one sex. `morphs` spans the tapes' points (`Tapes.over`); `mean` (S,) holds
    the prior's means.
    """
    count = len(people.age)
    races = rng.dirichlet(np.ones(len(RACES)), count)
    fixed = _known(people)
    spread = prior_spread(morphs.local_names, bool(people.female[0]))
    drawn = mean + spread * rng.normal(size=(count, len(spread)))
    spread = np.broadcast_to(spread, drawn.shape)
    x = np.zeros(drawn.shape)
    residual = np.zeros(people.values.shape)
    for part in np.array_split(np.arange(count), max(1, count // BATCH)):
        batch = _Batch(morphs, tapes, {k: v[part] for k, v in fixed.items()}, races[part])
        x[part] = _solve(batch, drawn[part], spread[part], people.values[part], steps, trust())
        residual[part] = batch.measure(x[part]) - people.values[part]
    macro = fixed | {name: x[:, k] for k, name in enumerate(MACROS)}
    return Sliders(macro, races, x[:, len(MACROS) :]), residual


class _Batch:
    """Measurements of some people as a function of their free sliders."""

    def __init__(
        self, morphs: MorphSpace, tapes: Tapes, fixed: dict[str, np.ndarray], races: np.ndarray
    ):
        self.tapes = tapes
        self.factors = morphs.macro_factors
        self.fixed = {k: torch.as_tensor(v) for k, v in fixed.items()}
        self.races = torch.as_tensor(races)
        self.base = morphs.base.ravel()
        down = morphs.local_offsets[:, 0]
        up = morphs.local_offsets[:, 1]
        self.offsets = np.concatenate([morphs.macro_offsets, down, up]).reshape(
            -1, len(self.base)
        )  # (K + 2 L, 3P)

    def _macro(self, x: np.ndarray) -> np.ndarray:
        sliders = self.fixed | {name: torch.as_tensor(x[:, k]) for k, name in enumerate(MACROS)}
        return macro_anchor_weights(sliders, self.races, self.factors).numpy()

    def _points(self, x: np.ndarray):
        local = x[:, len(MACROS) :]
        weights = np.concatenate(
            [self._macro(x), np.maximum(-local, 0), np.maximum(local, 0)], 1
        ).astype(np.float32)

        def points(where: slice) -> np.ndarray:
            return self.base[where] + (weights @ self.offsets[:, where]).astype(float)

        return points

    def measure(self, x: np.ndarray) -> np.ndarray:
        """Measurements (N, M) from free sliders (N, S)."""
        return self.tapes.values(self._points(x))

    def jacobian(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Measurements (N, M) and their derivatives (N, M, S)."""
        y, slope = self.tapes.slopes(self._points(x), self.offsets)
        columns = []
        count = len(self.factors)
        for k in range(len(MACROS)):
            step = np.zeros(x.shape)
            step[:, k] = KINK
            turn = ((self._macro(x + step) - self._macro(x - step)) / (2 * KINK)).astype(np.float32)
            columns.append(np.einsum("nmk,nk->nm", slope[:, :, :count], turn))
        down, up = np.split(slope[:, :, count:], 2, axis=2)
        below = (x[:, None, len(MACROS) :] < 0).astype(np.float32)
        return y, np.concatenate([np.stack(columns, 2), up * (1 - below) - down * below], 2).astype(
            float
        )


def _solve(
    batch: _Batch,
    drawn: np.ndarray,
    spread: np.ndarray,
    wanted: np.ndarray,
    steps: int,
    limits: np.ndarray,
) -> np.ndarray:
    """Gauss-Newton on |(x - drawn)/spread|^2 + |(measure(x) - wanted)/limits|^2, in the space of
    measurements (M < S).

    Sliders that would leave their range are held at its end while the others take over their part.
    """
    low, high = _ranges(drawn.shape[1])
    x = np.clip(drawn, low, high)
    y, jac = batch.jacobian(x)
    cost = _cost(x, y, drawn, spread, wanted, limits)
    share = np.ones(
        len(x)
    )  # of the way to the goal: halved where it led uphill, as kinks of the sliders make it
    for _ in range(steps):
        goal = _goal_in_range(x, y, jac, drawn, spread, wanted, limits)
        trial = np.clip(
            x + share[:, None] * np.clip(goal - x, -LONGEST_STEP, LONGEST_STEP), low, high
        )
        there, slope = batch.jacobian(trial)
        trial_cost = _cost(trial, there, drawn, spread, wanted, limits)
        better = trial_cost < cost
        x[better], y[better], jac[better], cost[better] = (
            new[better] for new in (trial, there, slope, trial_cost)
        )
        share = np.where(better, np.minimum(1.0, 2 * share), 0.5 * share)
    return x


def _cost(
    x: np.ndarray,
    y: np.ndarray,
    drawn: np.ndarray,
    spread: np.ndarray,
    wanted: np.ndarray,
    limits: np.ndarray,
) -> np.ndarray:
    """(N,) what `_solve` minimises; sliders without spread stay where they are drawn and cost
    nothing.
    """
    away = np.divide(x - drawn, spread, out=np.zeros(x.shape), where=spread > 0)
    return (away**2).sum(1) + (((y - wanted) / limits) ** 2).sum(1)


def _goal_in_range(x, y, jac, drawn, spread, wanted, limits) -> np.ndarray:
    """As `_goal`, with sliders that would leave their range held at its end."""
    low, high = _ranges(x.shape[1])
    held = np.zeros(x.shape, bool)
    goal = x
    for _ in range(HOLDS):
        free = _goal(x, y, jac, drawn, spread, wanted, held, goal, limits)
        goal = np.where(held, np.clip(goal, low, high), free)
        held |= (goal < low) | (goal > high)
    return goal


def _goal(x, y, jac, drawn, spread, wanted, held, goal, limits) -> np.ndarray:
    """Best sliders (N, S) of the linearised problem, with those in `held` fixed where `goal` has
    them.
    """
    start = np.where(held, goal, drawn)
    scaled = jac * np.where(held, 0.0, spread**2)[:, None, :]
    gap = wanted - y - np.einsum("nms,ns->nm", jac, start - x)
    step = np.linalg.solve(scaled @ jac.transpose(0, 2, 1) + np.diag(limits**2), gap[..., None])
    return start + np.einsum("nms,nm->ns", scaled, step[..., 0])


def _ranges(count: int) -> tuple[np.ndarray, np.ndarray]:
    low = np.full(count, -LOCAL_RANGE)
    high = np.full(count, LOCAL_RANGE)
    low[: len(MACROS)], high[: len(MACROS)] = 0.0, 1.0
    return low, high
