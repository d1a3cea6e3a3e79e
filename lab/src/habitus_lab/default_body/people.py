"""People from measurements: for each measured person a body drawn from the posterior over
MakeHuman's sliders.

Draw sliders from their prior, then find the sliders nearest to that draw whose measurements are the
person's: what was measured is matched, what was not stays as varied as the prior (randomised
maximum likelihood). Gender is exactly woman or man; men have no breast sliders.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from . import waist
from .measure import MEASURES, TAPES, Tapes
from .sliders import ANCHORS, RACES, MorphSpace, age_slider, macro_anchor_weights
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
SHAPE_PRIOR = 0.3  # of the trunk's shapes that MakeHuman lacks
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
    "kneeheightmidpatella": 0.010,
    "waistheightomphalion": 0.015,
    "iliocristaleheight": 0.015,
    "trochanterionheight": 0.02,
    "lateralmalleolusheight": 0.006,
    "acromialheight": 0.012,
    "chestheight": 0.015,
    "acromionradialelength": 0.010,
    "radialestylionlength": 0.008,
    "handlength": 0.002,
    "headlength": 0.006,
    "handbreadth": 0.005,
    "biacromialbreadth": 0.012,
    "headbreadth": 0.006,
    "footlength": 0.002,
    "span": 0.010,
    "chestdepth": 0.004,
    "waistbreadth": 0.005,
    "waistdepth": 0.005,
    "buttockdepth": 0.003,
    "hipbreadth": 0.003,
    "bideltoidbreadth": 0.005,
    "footbreadthhorizontal": 0.002,
    "bimalleolarbreadth": 0.0015,
    "breastprominence": 0.003,
    "lowerthighcircumference": 0.008,
    "balloffootcircumference": 0.004,
}
TAPE_TRUST = 0.003
STEPS = 12
PRIOR_PEOPLE = 120
PRIOR_STEPS = (6, 5, 5, 5, 6)  # Gauss-Newton steps of each round in which the prior is learned
PRIOR_STRIDE = 1.5  # the prior follows its people slowly: it goes further than they did
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
    spread = [(m, MACRO_PRIOR[m][1]) for m in MACROS]
    spread += [(name, SHAPE_PRIOR if name in waist.NAMES else LOCAL_PRIOR) for name in names]
    return np.array(
        [0.0 if not female and name.startswith(WOMEN_ONLY) else value for name, value in spread]
    )


def learn_prior(
    morphs: MorphSpace, tapes: Tapes, people: People, rng: np.random.Generator
) -> np.ndarray:
    """Mean sliders (2, S) of men and women: where MakeHuman's middle is not the survey's, the prior
    moves there.

    Empirical Bayes: rebuild a few people, take their mean sliders for the prior's, again and again.
    """
    few = [
        rng.choice(group, min(PRIOR_PEOPLE, len(group)), replace=False)
        for group in (np.flatnonzero(~people.female), np.flatnonzero(people.female))
    ]
    sample = people[np.concatenate(few)]
    start = np.array([MACRO_PRIOR[m][0] for m in MACROS] + [0.0] * len(morphs.local_names))
    mean = np.tile(start, (2, 1))
    for steps in PRIOR_STEPS:
        sliders, _ = rebuild(morphs, tapes, sample, rng, mean, steps)
        free = np.concatenate([np.stack([sliders.macro[m] for m in MACROS], 1), sliders.local], 1)
        found = np.stack([free[sample.female == woman].mean(0) for woman in (False, True)])
        mean = mean + PRIOR_STRIDE * (found - mean)
    return mean


def rebuild(
    morphs: MorphSpace,
    tapes: Tapes,
    people: People,
    rng: np.random.Generator,
    mean: np.ndarray,
    steps: int = STEPS,
) -> tuple[Sliders, np.ndarray]:
    """Sliders of every person, and the residuals (N, M) of their measurements.

    `morphs` spans the tapes' points (`Tapes.over`); `mean` (2, S) holds the prior's means of men
    and women.
    """
    count = len(people.age)
    races = rng.dirichlet(np.ones(len(RACES)), count)
    fixed = {
        "gender": np.where(people.female, 0.0, 1.0),
        "age": age_slider(np.clip(people.age, 25, 90)),
    }
    spread = np.stack([prior_spread(morphs.local_names, woman) for woman in (False, True)])[
        people.female.astype(int)
    ]
    drawn = mean[people.female.astype(int)] + spread * rng.normal(size=spread.shape)
    x = np.zeros(drawn.shape)
    residual = np.zeros(people.values.shape)
    for part in np.array_split(np.arange(count), max(1, count // BATCH)):
        batch = _Batch(morphs, tapes, {k: v[part] for k, v in fixed.items()}, races[part])
        x[part] = _solve(batch, drawn[part], spread[part], people.values[part], steps)
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
    batch: _Batch, drawn: np.ndarray, spread: np.ndarray, wanted: np.ndarray, steps: int
) -> np.ndarray:
    """Gauss-Newton on |(x - drawn)/spread|^2 + |(measure(x) - wanted)/trust|^2, in the space of
    measurements (M < S).

    Sliders that would leave their range are held at its end while the others take over their part.
    """
    low, high = _ranges(drawn.shape[1])
    x = np.clip(drawn, low, high)
    y, jac = batch.jacobian(x)
    cost = _cost(x, y, drawn, spread, wanted)
    share = np.ones(
        len(x)
    )  # of the way to the goal: halved where it led uphill, as kinks of the sliders make it
    for _ in range(steps):
        held = np.zeros(x.shape, bool)
        goal = x
        for _ in range(HOLDS):
            goal = np.where(
                held, np.clip(goal, low, high), _goal(x, y, jac, drawn, spread, wanted, held, goal)
            )
            held |= (goal < low) | (goal > high)
        trial = np.clip(
            x + share[:, None] * np.clip(goal - x, -LONGEST_STEP, LONGEST_STEP), low, high
        )
        there, slope = batch.jacobian(trial)
        trial_cost = _cost(trial, there, drawn, spread, wanted)
        better = trial_cost < cost
        x[better], y[better], jac[better], cost[better] = (
            new[better] for new in (trial, there, slope, trial_cost)
        )
        share = np.where(better, np.minimum(1.0, 2 * share), 0.5 * share)
    return x


def _cost(
    x: np.ndarray, y: np.ndarray, drawn: np.ndarray, spread: np.ndarray, wanted: np.ndarray
) -> np.ndarray:
    """(N,) what `_solve` minimises; sliders without spread stay where they are drawn and cost
    nothing.
    """
    away = np.divide(x - drawn, spread, out=np.zeros(x.shape), where=spread > 0)
    return (away**2).sum(1) + (((y - wanted) / trust()) ** 2).sum(1)


def _goal(x, y, jac, drawn, spread, wanted, held, goal) -> np.ndarray:
    """Best sliders (N, S) of the linearised problem, with those in `held` fixed where `goal` has
    them.
    """
    start = np.where(held, goal, drawn)
    scaled = jac * np.where(held, 0.0, spread**2)[:, None, :]
    gap = wanted - y - np.einsum("nms,ns->nm", jac, start - x)
    step = np.linalg.solve(scaled @ jac.transpose(0, 2, 1) + np.diag(trust() ** 2), gap[..., None])
    return start + np.einsum("nms,nm->ns", scaled, step[..., 0])


def _ranges(count: int) -> tuple[np.ndarray, np.ndarray]:
    low = np.full(count, -LOCAL_RANGE)
    high = np.full(count, LOCAL_RANGE)
    low[: len(MACROS)], high[: len(MACROS)] = 0.0, 1.0
    return low, high
