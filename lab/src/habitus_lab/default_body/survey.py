"""ANSUR II, told as measurements of people to rebuild: who they are, in metres and kilograms, and
whom to take.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

MILLIMETRE = 0.001
# A plausible mix of civilian adults: log-normal BMI (median, log standard deviation); soldiers are
# leaner, younger.
CIVILIAN_BMI = {True: (24.8, 0.20), False: (25.8, 0.17)}  # women, men
CIVILIAN_AGE = (18.0, 80.0)
# metres the breast lies before the midline at its level (mean, standard deviation), and what a BMI
# unit adds: the survey has no bust without breasts, and chests of the right girth and depth can be
# flat
PROMINENCE = {True: (0.028, 0.008), False: (0.011, 0.002)}
PROMINENCE_PER_BMI = {True: 0.001, False: 0.0002}
# metres: menton to sellion and tragion to vertex overlap by this much; heads are then 218 and 232 mm
# high on average (women, men)
SELLION_ABOVE_TRAGION = 0.0217
MIDTHIGH_SHARE = 0.90  # girth half-way down the thigh over that at the buttock's fold: no column
# girth of the natural waist over that at the navel, women and men: no column. The survey of 1988 had
# both (.91 and .97, from memory); the ring here need not lie at the narrowest place
NATURAL_WAIST_SHARE = {"Female": 0.90, "Male": 0.965}
# years by which a soldier's place among the ages is blurred before it becomes a civilian's age
AGE_NOISE = 8.0
MOST_DRAWN = 2.5  # no soldier is wanted more often than this
# standard deviation of a person's overall size beyond the survey's: statures then vary as
# civilians' do
WORLD_SPREAD = 0.02


@dataclass(frozen=True)
class People:
    """Measured people: values (N, M) in metres and kg in the order of `names`, female (N,), age in
    years (N,), and the survey's row of each (N,): a soldier's name.
    """

    names: tuple[str, ...]
    values: np.ndarray
    female: np.ndarray
    age: np.ndarray
    soldier: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> People:
        return People(
            self.names, self.values[rows], self.female[rows], self.age[rows], self.soldier[rows]
        )

    @property
    def bmi(self) -> np.ndarray:
        """(N,) kg per square metre."""
        return (
            self.values[:, self.names.index("weightkg")]
            / self.values[:, self.names.index("stature")] ** 2
        )


def read_survey(folder: str | Path, names: tuple[str, ...]) -> People:
    """Both tables of the survey (latin-1, millimetres, `weightkg` in tenths of a kilogram); nan
    where no column is.
    """
    values = []
    female = []
    age = []
    for sex in ("FEMALE", "MALE"):
        path = Path(folder) / f"ANSUR_II_{sex}_Public.csv"
        if not path.is_file():
            raise FileNotFoundError(
                f"no {path.name} in {folder}; download the two public ANSUR II tables there"
            )
        with path.open(encoding="latin-1", newline="") as lines:
            rows = list(csv.DictReader(lines))
        values += [
            [_value(row, n) * (0.1 if n == "weightkg" else MILLIMETRE) for n in names]
            for row in rows
        ]
        female += [sex == "FEMALE"] * len(rows)
        age += [float(row["Age"]) for row in rows]
    return People(names, np.array(values), np.array(female), np.array(age), np.arange(len(age)))


def _value(row: dict[str, str], name: str) -> float:
    """A column of a row, or what follows from others of it; nan where neither is known."""
    if name == "headheight":
        height = float(row["mentonsellionlength"]) + float(row["tragiontopofhead"])
        return height - SELLION_ABOVE_TRAGION / MILLIMETRE
    if name == "midthighcircumference":
        return MIDTHIGH_SHARE * float(row["thighcircumference"])
    if name == "naturalwaistcircumference":
        return NATURAL_WAIST_SHARE[row["Gender"]] * float(row["waistcircumference"])
    return float(row.get(name, np.nan))


def draw_civilians(people: People, count: int, rng: np.random.Generator) -> People:
    """`count` people, half of them women, with civilian body-mass indices and ages."""
    chosen = [
        _draw_sex(people[np.flatnonzero(people.female == woman)], share, rng)
        for woman, share in ((True, count // 2), (False, count - count // 2))
    ]
    return People(
        people.names,
        *(
            np.concatenate([getattr(c, name) for c in chosen])
            for name in ("values", "female", "age", "soldier")
        ),
    )


def _draw_sex(pool: People, count: int, rng: np.random.Generator) -> People:
    """Systematic draw by body-mass index: a soldier wanted w times comes floor(w) or ceil(w) times.

    Ages keep their order (older soldiers become older civilians, blurred), stretched to the
    civilian mix.
    """
    median, spread = CIVILIAN_BMI[bool(pool.female[0])]
    log = np.log(pool.bmi)
    aim = np.exp(-0.5 * ((log - np.log(median)) / spread) ** 2)
    present = np.exp(-0.5 * ((log[:, None] - log[None]) / 0.04) ** 2).sum(1)
    wanted = aim / present
    for _ in range(20):
        wanted = np.minimum(wanted * count / wanted.sum(), MOST_DRAWN)
    order = np.argsort(log)  # systematic along the index itself: its quantiles come out as wanted
    ticks = (np.arange(count) + rng.random()) * wanted.sum() / count
    picks = order[np.minimum(np.searchsorted(np.cumsum(wanted[order]), ticks), len(order) - 1)]
    rank = np.argsort(np.argsort(pool.age[picks] + rng.normal(0, AGE_NOISE, count)))
    age = CIVILIAN_AGE[0] + (CIVILIAN_AGE[1] - CIVILIAN_AGE[0]) * (rank + 0.5) / count
    drawn = People(pool.names, pool.values[picks], pool.female[picks], age, pool.soldier[picks])
    return _with_breasts(drawn, rng) if "breastprominence" in pool.names else drawn


def _with_breasts(people: People, rng: np.random.Generator) -> People:
    """What the survey leaves out, drawn for people of one sex."""
    woman = bool(people.female[0])
    mean, spread = PROMINENCE[woman]
    more = PROMINENCE_PER_BMI[woman] * (people.bmi - CIVILIAN_BMI[woman][0])
    values = people.values.copy()
    values[:, people.names.index("breastprominence")] = (
        mean + more + spread * rng.normal(size=len(people.age))
    )
    return replace(people, values=values)
