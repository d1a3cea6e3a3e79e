"""ANSUR II, told as measurements of people to rebuild: who they are, in metres and kilograms, and how often to draw
each.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MILLIMETRE = 0.001
# A plausible mix of civilian adults: log-normal BMI (median, log standard deviation); soldiers are leaner, younger.
CIVILIAN_BMI = {"female": (24.8, 0.20), "male": (25.8, 0.17)}
CIVILIAN_AGE = (18.0, 80.0)
OLDEST_SOLDIER = (
    50.0  # above this the survey is too thin: older people are drawn from its oldest, with an older age slider
)
MOST_DRAWN = 6.0  # no soldier counts for more than this many
WORLD_SPREAD = (
    0.03  # standard deviation of a person's overall size beyond the survey's: the world is wider than one army
)


@dataclass(frozen=True)
class People:
    """Measured people: values (N, M) in metres and kg in the order of `names`, female (N,), age in years (N,)."""

    names: tuple[str, ...]
    values: np.ndarray
    female: np.ndarray
    age: np.ndarray


def read_survey(folder: str | Path, names: tuple[str, ...]) -> People:
    """Both tables of the survey (latin-1, millimetres, `weightkg` in tenths of a kilogram)."""
    values, female, age = [], [], []
    for sex in ("FEMALE", "MALE"):
        path = Path(folder) / f"ANSUR_II_{sex}_Public.csv"
        if not path.is_file():
            raise FileNotFoundError(f"no {path.name} in {folder}; download the two public ANSUR II tables there")
        with path.open(encoding="latin-1", newline="") as lines:
            rows = list(csv.DictReader(lines))
        values += [[float(row[n]) * (0.1 if n == "weightkg" else MILLIMETRE) for n in names] for row in rows]
        female += [sex == "FEMALE"] * len(rows)
        age += [float(row["Age"]) for row in rows]
    return People(names, np.array(values), np.array(female), np.array(age))


def draw_civilians(people: People, count: int, rng: np.random.Generator) -> People:
    """`count` people, half of them women, with civilian ages and body-mass indices."""
    bmi = people.values[:, people.names.index("weightkg")] / people.values[:, people.names.index("stature")] ** 2
    picks, ages = [], []
    for female, share in ((True, count // 2), (False, count - count // 2)):
        pool = np.flatnonzero(people.female == female)
        median, spread = CIVILIAN_BMI["female" if female else "male"]
        log = np.log(bmi[pool])
        wanted = np.exp(-0.5 * ((log - np.log(median)) / spread) ** 2) / spread
        present = np.exp(-0.5 * ((log[:, None] - log[None]) / 0.04) ** 2).sum(1)
        weight = np.minimum(wanted / present, MOST_DRAWN * (wanted / present).mean())
        age = rng.uniform(*CIVILIAN_AGE, share)
        for years in age:
            near = weight * np.exp(-0.5 * ((people.age[pool] - min(years, OLDEST_SOLDIER)) / 5.0) ** 2)
            picks.append(rng.choice(pool, p=near / near.sum()))
        ages.append(age)
    chosen = np.array(picks)
    return People(people.names, people.values[chosen], people.female[chosen], np.concatenate(ages))
