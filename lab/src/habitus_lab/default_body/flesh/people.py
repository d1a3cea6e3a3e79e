"""Whom to simulate: the mean person first, then people spread from thin to fat, some of them young
or old.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from habitus.body.model import BodyModel

DRAWN = 240  # people that the spread ones are chosen from
FIRST_END = 30  # number of the first of `ends`
LARGEST = 2.6  # no beta beyond
AGES = (
    None,
    None,
    20,
    None,
    40,
    None,
    60,
    None,
    None,
    80,
)  # None: the space's own mean age, about 50


@dataclass(frozen=True, eq=False)
class Shape:
    """A person: name, betas (B,), age in years (None: that of the body's template), and m^3 over
    height squared.
    """

    name: str
    betas: np.ndarray
    age: float | None
    stoutness: float

    def rest(self, body: BodyModel) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) and joints (J, 3)."""
        aged = body if self.age is None else body.at_age(self.age)
        return aged.rest_vertices(self.betas), aged.rest_joints(self.betas)


def people(body: BodyModel, sex: str, count: int, seed: int) -> list[Shape]:
    """`count` people of a body: the mean one, then betas drawn from N(0, I), evenly spaced by
    stoutness.
    """
    rng = np.random.default_rng([seed, sorted(("female", "male")).index(sex)])
    betas = np.clip(rng.normal(size=(DRAWN, body.num_betas)), -LARGEST, LARGEST)
    stout = _stoutness(body, np.vstack([betas, np.zeros(body.num_betas)]))
    order = np.argsort(stout[:-1])
    chosen = (
        order[(np.linspace(0.02, 0.98, count - 1) * DRAWN).astype(int)] if count > 1 else order[:0]
    )
    spread = chosen[_alternating(len(chosen))]
    found = [Shape(f"{sex}00", np.zeros(body.num_betas), None, stout[-1])]
    return found + [
        Shape(f"{sex}{k:02d}", betas[row], AGES[(k - 1) % len(AGES)], stout[row])
        for k, row in enumerate(spread, start=1)
    ]


def ends(body: BodyModel, sex: str) -> list[Shape]:
    """Four people two standard deviations along betas 1 and 2, either way: folds depend on these,
    and people drawn at random reach so far in few.
    """
    betas = np.zeros((4, body.num_betas))
    betas[[0, 1], 0] = betas[[2, 3], 1] = (2.0, -2.0)
    stout = _stoutness(body, betas)
    return [Shape(f"{sex}{FIRST_END + k}", betas[k], None, stout[k]) for k in range(4)]


def _stoutness(body: BodyModel, betas: np.ndarray) -> np.ndarray:
    """(N,) volume over the square of the height."""
    faces = body.faces
    found = []
    for row in betas:
        vertices = body.v_template + body.shapedirs @ row
        a, b, c = vertices[faces].transpose(1, 0, 2)
        found.append((a * np.cross(b, c)).sum() / 6 / np.ptp(vertices[:, 1]) ** 2)
    return np.array(found)


def _alternating(count: int) -> np.ndarray:
    """0..count in an order of which every beginning is spread over all: by reversed binary
    digits.
    """
    bits = max(1, int(np.ceil(np.log2(max(2, count)))))
    back = [int(format(k, f"0{bits}b")[::-1], 2) for k in range(2**bits)]
    return np.array([k for k in back if k < count])
