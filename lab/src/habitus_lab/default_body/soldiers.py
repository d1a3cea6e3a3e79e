"""The soldiers of ANSUR II as bodies: for each the likeliest betas of a shape space with all their
measurements.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from habitus.body.measurement_names import DEFINITIONS
from habitus.body.model import BodyModel
from habitus.files import atomic_write
from habitus.io.models.bodies import load_body
from habitus_lab.repository import BODIES

NOISE = (
    0.15  # of a measurement's spread within a sex: how far survey and body may measure differently
)
STEPS = 2
BATCH = 50


@dataclass(frozen=True)
class Soldiers:
    """Measured people: values (N, M) in metres and kilograms in the order of `names` (as bodies
    call them), female (N,), age (N,) in years.
    """

    names: tuple[str, ...]
    values: np.ndarray
    female: np.ndarray
    age: np.ndarray

    def of(self, rows: np.ndarray) -> Soldiers:
        """Some of them."""
        return Soldiers(self.names, self.values[rows], self.female[rows], self.age[rows])


def asset(space: str) -> BodyModel:
    """A body of the project."""
    return load_body(space)


def read_soldiers(
    folder: Path, names: tuple[str, ...] = (), count: int | None = None, seed: int = 0
) -> Soldiers:
    """What the survey knows of the measurements that bodies have; ``count`` soldiers drawn at
    random, or all.
    """
    names = names or tuple(name for name, definition in DEFINITIONS.items() if definition.column)
    values = []
    female = []
    age = []
    for sex in ("FEMALE", "MALE"):
        with (Path(folder) / f"ANSUR_II_{sex}_Public.csv").open(
            encoding="latin-1", newline=""
        ) as lines:
            for row in csv.DictReader(lines):
                values.append(
                    [
                        float(row[DEFINITIONS[n].column]) * (0.1 if n == "mass_kg" else 0.001)
                        for n in names
                    ]
                )
                female.append(sex == "FEMALE")
                age.append(float(row["Age"]))
    found = Soldiers(names, np.array(values), np.array(female), np.array(age))
    if count is None:
        return found
    return found.of(np.sort(np.random.default_rng(seed).permutation(len(found.female))[:count]))


def measured(body: BodyModel, betas: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Measurements (N, M) of betas (N, B), some people at a time."""
    parts = [body.measure_people(betas[k : k + BATCH]) for k in range(0, len(betas), BATCH)]
    return np.column_stack([np.concatenate([part[name] for part in parts]) for name in names])


def slopes(body: BodyModel, names: tuple[str, ...], step: float = 0.2) -> np.ndarray:
    """How measurements change with betas at the mean person, (M, B)."""
    ends = step * np.concatenate([np.eye(body.num_betas), -np.eye(body.num_betas)])
    up, down = np.split(measured(body, ends, names), 2)
    return (up - down).T / (2 * step)


def soldiers_betas(body: BodyModel, soldiers: Soldiers) -> np.ndarray:
    """The likeliest betas (N, B): standard normal, measured to `NOISE`; what survey and body
    measure differently on average over both sexes (other rules, other postures) is taken out.
    """
    names = soldiers.names
    values = soldiers.values
    female = soldiers.female
    spread = np.sqrt(np.mean([values[group].var(0) for group in _sexes(female)], axis=0))
    scale = 1 / (NOISE * spread)
    slope = slopes(body, names)
    a = slope * scale[:, None]
    gain = np.linalg.solve(a.T @ a + np.eye(body.num_betas), a.T) * scale
    betas = np.zeros((len(values), body.num_betas))
    for step in range(1 + STEPS):
        off = values - measured(
            body, betas if step else betas[:1], names
        )  # all begin as the mean person
        rule = np.mean([off[group].mean(0) for group in _sexes(female)], axis=0)
        betas = (off - rule + betas @ slope.T) @ gain.T
    return betas


def _sexes(female: np.ndarray) -> list[np.ndarray]:
    return [group for group in (female, ~female) if group.any()]


def write_arrays(space: str, arrays: dict[str, np.ndarray]) -> None:
    """Put arrays into a body's file, beside what it holds."""
    path = BODIES / f"{space}.npz"
    with np.load(path) as file:
        held = {key: file[key] for key in file.files}
    with atomic_write(path) as temporary, temporary.open("wb") as out:
        np.savez_compressed(out, **(held | arrays))
