"""Measurements from shape (T 4.6): linear regressors from betas to what a survey measured, as the
thesis reports them.

    python -m habitus_lab.default_body.measurement_regressors --ansur SURVEY_FOLDER [--betas 20] [--people
    1500]

For each sex, of the sex's own body: soldiers' betas are those of the likeliest bodies with all
their measurements (`soldiers.py`); the regressors are fitted (ridge) on five sixths of the soldiers
and judged on the others. Prints for each measurement the RMSE and the explained variance of the
regressor from betas, of the body's own measurement (its tape, calipers, yardstick; the mean
difference of the rules taken out), and of guessing the mean.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from .soldiers import asset, measured, read_soldiers, soldiers_betas

HELD_OUT = 6  # every sixth soldier
RIDGE = 1.0  # against so many people's worth of standard normal betas


def fit_regressors(betas: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (M, B) and means (M,): measurements are about betas @ weights.T + means."""
    centre = betas.mean(0)
    mean = values.mean(0)
    x = betas - centre
    weights = np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ (values - mean)).T
    return weights, mean - weights @ centre


def report(space: str, folder: Path, count: int, people: int | None) -> dict[str, dict[str, float]]:
    """RMSE (mm, kg) and explained variance of each measurement over held-out soldiers of one
    sex.
    """
    body = asset(space)
    soldiers = read_soldiers(folder)
    mine = np.flatnonzero(soldiers.female == (space == "female"))
    if people is not None:
        mine = np.sort(np.random.default_rng(0).permutation(mine)[:people])
    soldiers = soldiers.of(mine)
    out = mine % HELD_OUT == HELD_OUT - 1
    betas = soldiers_betas(body, soldiers)
    few = np.pad(betas[:, :count], ((0, 0), (0, body.num_betas - count)))
    own = measured(body, few, soldiers.names)
    own += (soldiers.values - own)[~out].mean(0)
    weights, mean = fit_regressors(betas[~out, :count], soldiers.values[~out])
    predicted = betas[:, :count] @ weights.T + mean
    guess = np.broadcast_to(soldiers.values[~out].mean(0), predicted.shape)
    found = {}
    for k, name in enumerate(soldiers.names):
        truth = soldiers.values[out, k]
        scale = 1.0 if name.endswith("_kg") else 1000.0
        rms = [
            scale * np.sqrt(np.mean((each[out, k] - truth) ** 2))
            for each in (predicted, own, guess)
        ]
        found[name] = {
            "regressor": rms[0],
            "body": rms[1],
            "mean": rms[2],
            "explained": 1 - (rms[0] / rms[2]) ** 2,
        }
    return found


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ansur", type=Path, required=True)
    parser.add_argument("--betas", type=int, default=20)
    parser.add_argument("--people", type=int, help="only so many soldiers of each sex")
    parser.add_argument("--numbers", type=Path)
    options = parser.parse_args()
    found = {
        sex: report(sex, options.ansur, options.betas, options.people) for sex in ("female", "male")
    }
    print(
        f"| measurement, {options.betas} betas | women: RMSE | explained | body's own | mean | "
        "men: RMSE | explained |",
        end="",
    )
    print(" body's own | mean |\n|---|" + "---|" * 8)
    for name in found["female"]:
        cells = [name.removesuffix("_m").removesuffix("_kg").replace("_", " ")]
        for row in (found["female"][name], found["male"][name]):
            cells += [
                f"{row['regressor']:.1f}",
                f"{100 * row['explained']:.0f} %",
                f"{row['body']:.1f}",
                f"{row['mean']:.1f}",
            ]
        print("| " + " | ".join(cells) + " |")
    if options.numbers:
        options.numbers.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
