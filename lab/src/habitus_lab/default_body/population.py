"""The mean person of each shape space, as the survey measured people: where bodies from
measurements begin.

    python -m habitus_lab.default_body.population --ansur SURVEY_FOLDER [--write]

Soldiers were fitted in the survey's postures (`measure.py`); the finished body's tapes
(`habitus.body.tapes`) lie on the T-pose, where men's chests are 30 mm wider around than with arms
down, and its hands end elsewhere. The template is the mean of the civilians that were drawn; the
betas of a mean person who measures by the body's tapes what civilians drawn from the soldiers do
(`survey.py`; without every sixth soldier, for `benchmarks/body_from_measurements.py`) are small: the
likeliest ones with the measurements that survey and body take by one rule. ``--write`` puts them
into the files.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel

from .soldiers import Soldiers, asset, measured, read_soldiers, slopes, write_arrays
from .survey import draw_civilians, read_survey

PEOPLE = 1200
HELD_OUT = 6  # every sixth soldier
NOISE = 0.25  # of a measurement's spread: how near the mean person comes to the mean
STEPS = 5
ALIKE = (
    "height_m",
    "mass_kg",
    "inseam_m",
    "arm_span_m",
    "shoulder_breadth_m",
    "chest_circumference_m",
    "chest_depth_m",
    "waist_circumference_m",
    "waist_breadth_m",
    "waist_depth_m",
    "hip_circumference_m",
    "hip_breadth_m",
    "hip_depth_m",
    "thigh_circumference_m",
    "neck_circumference_m",
    "calf_circumference_m",
    "ankle_circumference_m",
    "wrist_circumference_m",
    "foot_length_m",
    "hand_length_m",
)


def draw(folder: Path, seed: int = 0) -> Soldiers:
    """Civilians out of soldiers, half of them women, none of those held out."""
    every = read_soldiers(folder, ALIKE)
    survey = read_survey(folder, ("stature", "weightkg"))
    kept = np.flatnonzero(np.arange(len(every.female)) % HELD_OUT != HELD_OUT - 1)
    return every.of(draw_civilians(survey[kept], PEOPLE, np.random.default_rng(seed)).soldier)


def mean_person(body: BodyModel, people: Soldiers) -> np.ndarray:
    """Betas (B,) of the likeliest body that measures what these people do on average."""
    wanted = people.values.mean(0)
    noise = NOISE * people.values.std(0)
    slope = slopes(body, people.names)
    betas = np.zeros(body.num_betas)
    gain = np.linalg.solve(slope @ slope.T + np.diag(noise**2), slope).T
    for _ in range(STEPS):
        betas = gain @ (wanted - measured(body, betas[None], people.names)[0] + slope @ betas)
    return betas


def main() -> None:
    """Print what moves, and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ansur", type=Path, required=True)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    everybody = draw(options.ansur)
    for space in ("female", "male", "neutral"):
        people = everybody.of(
            np.flatnonzero((everybody.female == (space == "female")) | (space == "neutral"))
        )
        body = asset(space)
        mean = mean_person(body, people)
        print(f"{space}: {np.round(mean, 2)}")
        before, after = measured(body, np.stack([0 * mean, mean]), people.names)
        for name, *row in zip(people.names, before, after, people.values.mean(0), strict=True):
            row = [(1 if name.endswith("_kg") else 1000) * value for value in row]
            print(
                f"  {name:24} template {row[0]:7.1f}, mean person {row[1]:7.1f}, survey "
                f"{row[2]:7.1f}"
            )
        if options.write:
            write_arrays(space, {"people_mean": mean})


if __name__ == "__main__":
    main()
