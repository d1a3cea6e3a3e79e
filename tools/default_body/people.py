"""People from measurements: for each measured person a body drawn from the posterior over MakeHuman's sliders.

Randomised maximum likelihood: draw sliders from their prior and a measurement error, then find the sliders nearest to
that draw whose measurements come nearest to the (perturbed) ones. What was measured is matched, what was not stays as
varied as the prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from .measure import MEASURES, Tapes
from .sliders import ANCHORS, RACES, MorphSpace, age_slider, macro_anchor_weights
from .survey import People

MACROS = tuple(name for name in ANCHORS if name not in ("age", "gender"))
MACRO_PRIOR = {"muscle": (0.47, 0.13), "weight": (0.8, 0.25), "height": (0.5, 0.15), "proportions": (0.5, 0.15)}
MACRO_PRIOR |= {"cup": (0.5, 0.2), "firmness": (0.45, 0.15)}
MACRO_RANGE = {"weight": (0.0, 1.4), "height": (0.0, 1.0)}  # the weight slider may pass its end a little: heavy people
LOCAL_PRIOR = 0.17  # standard deviation of a local slider
LOCAL_RANGE = 1.1
GENDER_SPREAD = 0.14
# what a measurement is trusted to, metres or kg: landmarks and posture differ from the survey's by this much
TRUST = {
    "stature": 0.004, "weightkg": 0.8, "cervicaleheight": 0.015, "suprasternaleheight": 0.012, "crotchheight": 0.012,
    "kneeheightmidpatella": 0.010, "waistheightomphalion": 0.02, "iliocristaleheight": 0.02,
    "trochanterionheight": 0.02,
    "lateralmalleolusheight": 0.006, "acromionradialelength": 0.010, "radialestylionlength": 0.010, "handlength": 0.004,
    "headlength": 0.004, "handbreadth": 0.004, "biacromialbreadth": 0.012, "headbreadth": 0.004, "footlength": 0.003,
}  # fmt: skip
TAPE_TRUST = {"chestcircumference": 0.008, "waistcircumference": 0.008, "buttockcircumference": 0.008}
OTHER_TAPE_TRUST = 0.005
STEPS = 20
PRIOR_PEOPLE = 250
PRIOR_ROUNDS = 4
HOLDS = 3
LONGEST_STEP = 0.6


@dataclass(frozen=True)
class Sliders:
    """Sliders of N people."""

    macro: dict[str, np.ndarray]  # each (N,)
    races: np.ndarray  # (N, 3)
    local: np.ndarray  # (N, L)


def trust() -> np.ndarray:
    """(M,) standard deviation of each measurement in the order of MEASURES."""
    return np.array([TRUST.get(name, TAPE_TRUST.get(name, OTHER_TAPE_TRUST)) for name in MEASURES])


def learn_prior(morphs: MorphSpace, tapes: Tapes, people: People, rng: np.random.Generator) -> np.ndarray:
    """Mean sliders (2, S) of men and women: where MakeHuman's middle is not the survey's, the prior moves there.

    Empirical Bayes: rebuild a few people, take their mean sliders for the prior's, again and again.
    """
    few = rng.choice(len(people.age), PRIOR_PEOPLE, replace=False)
    sample = People(people.names, people.values[few], people.female[few], people.age[few])
    mean = np.tile(_prior(morphs)[0], (2, 1))
    for _ in range(PRIOR_ROUNDS):
        sliders, _ = rebuild(morphs, tapes, sample, rng, mean)
        free = np.concatenate([np.stack([sliders.macro[m] for m in MACROS], 1), sliders.local], 1)
        mean = np.stack([free[sample.female == woman].mean(0) for woman in (False, True)])
    return mean


def _prior(morphs: MorphSpace) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (S,) of the free sliders: first the macros, then the local ones."""
    mean = np.array([MACRO_PRIOR[m][0] for m in MACROS] + [0.0] * len(morphs.local_names))
    return mean, np.array([MACRO_PRIOR[m][1] for m in MACROS] + [LOCAL_PRIOR] * len(morphs.local_names))


def rebuild(
    morphs: MorphSpace, tapes: Tapes, people: People, rng: np.random.Generator, mean: np.ndarray
) -> tuple[Sliders, np.ndarray]:
    """Sliders of every person, and the residuals (N, M) of their measurements.

    `morphs` spans the tapes' points; `mean` (2, S) holds the prior's means of men and women.
    """
    count = len(people.age)
    races = rng.dirichlet(np.ones(len(RACES)), count)
    gender = np.clip(np.where(people.female, 0.0, 1.0) + rng.normal(0, GENDER_SPREAD, count), 0, 1)
    age = age_slider(np.clip(people.age, 25, 90))
    spread = _prior(morphs)[1]
    drawn = mean[people.female.astype(int)] + spread * rng.normal(size=(count, len(spread)))
    wanted = people.values + rng.normal(size=people.values.shape) * trust() * 0.5
    fixed = {"gender": gender, "age": age}
    found, residual = [], []
    for part in np.array_split(np.arange(count), max(1, count // 250)):
        batch = _Batch(morphs, tapes, {k: v[part] for k, v in fixed.items()}, races[part])
        sliders = _solve(batch, drawn[part], spread, wanted[part])
        found.append(sliders)
        residual.append(torch.stack(batch.measure(torch.as_tensor(sliders)), 1).numpy() - people.values[part])
    x = np.concatenate(found)
    macro = fixed | {name: x[:, k] for k, name in enumerate(MACROS)}
    return Sliders(macro, races, x[:, len(MACROS) :]), np.concatenate(residual)


class _Batch:
    """Measurements of some people as a function of their free sliders."""

    def __init__(self, morphs: MorphSpace, tapes: Tapes, fixed: dict[str, np.ndarray], races: np.ndarray):
        self.morphs, self.tapes = morphs, tapes
        self.fixed = {k: torch.as_tensor(v) for k, v in fixed.items()}
        self.races = torch.as_tensor(races)
        self.base = torch.as_tensor(morphs.base)
        down, up = torch.as_tensor(morphs.local_offsets).unbind(1)
        self.offsets = torch.cat([torch.as_tensor(morphs.macro_offsets), down, up])  # (K + 2 L, P, 3)

    def measure(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Measurements, each (N,), from free sliders (N, S)."""
        macro = self.fixed | {name: x[:, k] for k, name in enumerate(MACROS)}
        weights = macro_anchor_weights(macro, self.races, self.morphs.macro_factors)
        local = x[:, len(MACROS) :]
        weights = torch.cat([weights, torch.relu(-local), torch.relu(local)], 1).float()

        def points(where: slice) -> torch.Tensor:
            moved = weights @ self.offsets[:, where].flatten(1)
            return self.base[where] + moved.double().reshape(len(x), -1, 3)

        return self.tapes(points)

    def jacobian(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Measurements (N, M) and their derivatives (N, M, S)."""
        leaf = torch.tensor(x, requires_grad=True)
        y = self.measure(leaf)
        rows = [torch.autograd.grad(each.sum(), leaf, retain_graph=True)[0] for each in y]
        return torch.stack(y, 1).detach().numpy(), torch.stack(rows, 1).numpy()


def _solve(batch: _Batch, drawn: np.ndarray, spread: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Gauss-Newton on |(x - drawn)/spread|^2 + |(measure(x) - wanted)/trust|^2, in the space of measurements (M < S).

    Sliders that would leave their range are held at its end while the others take over their part.
    """
    low, high = _ranges(drawn.shape[1])
    x = np.clip(drawn, low, high)
    cost = _cost(batch, x, drawn, spread, wanted)
    share = np.ones(len(x))  # of the way to the goal: halved where it led uphill, as kinks of the sliders make it
    for _ in range(STEPS):
        y, jac = batch.jacobian(x)
        held = np.zeros(x.shape, bool)
        goal = x
        for _ in range(HOLDS):
            goal = np.where(held, np.clip(goal, low, high), _goal(x, y, jac, drawn, spread, wanted, held, goal))
            held |= (goal < low) | (goal > high)
        trial = np.clip(x + share[:, None] * np.clip(goal - x, -LONGEST_STEP, LONGEST_STEP), low, high)
        trial_cost = _cost(batch, trial, drawn, spread, wanted)
        better = trial_cost < cost
        x = np.where(better[:, None], trial, x)
        cost = np.where(better, trial_cost, cost)
        share = np.where(better, np.minimum(1.0, 2 * share), 0.5 * share)
    return x


def _cost(batch: _Batch, x: np.ndarray, drawn: np.ndarray, spread: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(N,) what `_solve` minimises."""
    with torch.no_grad():
        y = torch.stack(batch.measure(torch.as_tensor(x)), 1).numpy()
    return (((x - drawn) / spread) ** 2).sum(1) + (((y - wanted) / trust()) ** 2).sum(1)


def _goal(x, y, jac, drawn, spread, wanted, held, goal) -> np.ndarray:
    """Best sliders (N, S) of the linearised problem, with those in `held` fixed where `goal` has them."""
    start = np.where(held, goal, drawn)
    scaled = jac * np.where(held, 0.0, spread**2)[:, None, :]
    gap = wanted - y - np.einsum("nms,ns->nm", jac, start - x)
    step = np.linalg.solve(scaled @ jac.transpose(0, 2, 1) + np.diag(trust() ** 2), gap[..., None])
    return start + np.einsum("nms,nm->ns", scaled, step[..., 0])


def _ranges(count: int) -> tuple[np.ndarray, np.ndarray]:
    ends = [MACRO_RANGE.get(name, (0.0, 1.0)) for name in MACROS]
    low = np.full(count, -LOCAL_RANGE)
    high = np.full(count, LOCAL_RANGE)
    low[: len(MACROS)], high[: len(MACROS)] = zip(*ends, strict=True)
    return low, high
