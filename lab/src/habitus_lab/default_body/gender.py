"""Who is a woman, from shape: linear support vector machines on the neutral betas, one for each
number of them (M 8.3).

    python -m habitus_lab.default_body.gender --ansur SURVEY_FOLDER [--write] [--people 6068] [--numbers
    gender.json]

Soldiers' betas are those of the likeliest bodies with all their measurements (`soldiers.py`). Each
classifier is fitted with squared hinge loss, both sexes counting alike; a line through its scores
on people it was not fitted to (ten folds, by soldier) turns them into log odds and is folded into
weights and bias. ``--write`` puts ``gender_weights`` (B, B; row n - 1 is for the first n betas) and
``gender_bias`` (B,) into the neutral body's file.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from .soldiers import asset, read_soldiers, soldiers_betas, write_arrays

FOLDS = 10
STIFFNESS = 1.0  # of the weights against the mean loss of 100 people
BINS = 10
SURE = (0.2, 0.8)


@dataclass(frozen=True)
class Classifier:
    """Log odds of being a woman are weights . betas + bias."""

    weights: np.ndarray
    bias: float

    def probability(self, betas: np.ndarray) -> np.ndarray:
        """P(female) of betas (N, n)."""
        return 1 / (1 + np.exp(-np.clip(betas @ self.weights + self.bias, -500, 500)))


def fit_svm(betas: np.ndarray, female: np.ndarray) -> Classifier:
    """A linear support vector machine with squared hinge loss on betas (N, n); both sexes count
    alike.
    """
    x = np.column_stack([betas, np.ones(len(betas))])
    y = np.where(female, 1.0, -1.0)
    counts = 0.5 / np.where(female, female.mean(), 1 - female.mean()) / len(female)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        short = np.maximum(1 - y * (x @ w), 0)
        ridge = STIFFNESS / 100 * np.append(w[:-1], 0)
        return float(counts @ short**2 + 0.5 * ridge @ w), -2 * x.T @ (counts * y * short) + ridge

    found = minimize(
        loss,
        np.zeros(x.shape[1]),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 500, "gtol": 1e-9},
    )
    return Classifier(found.x[:-1], float(found.x[-1]))


def fit_line(score: np.ndarray, female: np.ndarray) -> tuple[float, float]:
    """Slope and offset of the log odds over a score, by Newton's method; both sexes count alike."""
    x = np.column_stack([score, np.ones_like(score)])
    w = np.zeros(2)
    counts = 0.5 / np.where(female, female.mean(), 1 - female.mean())
    for _ in range(60):
        p = 1 / (1 + np.exp(-np.clip(x @ w, -40, 40)))
        hessian = (x * (counts * p * (1 - p))[:, None]).T @ x + 1e-9 * np.eye(2)
        w = w + np.linalg.solve(hessian, x.T @ (counts * (female - p)))
    return float(w[0]), float(w[1])


def calibrated(betas: np.ndarray, female: np.ndarray, seed: int = 0) -> Classifier:
    """The machine fitted to all, its score turned into log odds by people that it had not seen."""
    fold = np.random.default_rng(seed).integers(0, FOLDS, len(betas))
    score = np.zeros(len(betas))
    for k in range(FOLDS):
        part = fit_svm(betas[fold != k], female[fold != k])
        score[fold == k] = betas[fold == k] @ part.weights + part.bias
    slope, offset = fit_line(score, female)
    whole = fit_svm(betas, female)
    return Classifier(slope * whole.weights, slope * whole.bias + offset)


def expected_calibration_error(p: np.ndarray, female: np.ndarray, bins: int = BINS) -> float:
    """How far what was said lies from what was true, over bins of what was said, weighed by how
    often it was.
    """
    counts = 0.5 / np.where(female, female.mean(), 1 - female.mean()) / len(female)
    place = np.minimum((p * bins).astype(int), bins - 1)
    return float(
        sum(abs(np.sum(counts[place == k] * (p - female)[place == k])) for k in range(bins))
    )


def judged(betas: np.ndarray, female: np.ndarray, seed: int = 1) -> dict[str, float]:
    """Accuracy (both sexes alike), calibration and how often nothing is said, of people held out
    five-fold.
    """
    fold = np.random.default_rng(seed).integers(0, 5, len(betas))
    p = np.zeros(len(betas))
    for k in range(5):
        p[fold == k] = calibrated(betas[fold != k], female[fold != k]).probability(betas[fold == k])
    right = (p > 0.5) == female
    certain = (p < SURE[0]) | (p > SURE[1])
    return {
        "accuracy": float(0.5 * (right[female].mean() + right[~female].mean())),
        "women": float(right[female].mean()),
        "men": float(right[~female].mean()),
        "calibration_error": expected_calibration_error(p, female),
        "cannot_tell": float(1 - certain.mean()),
        "accuracy_where_told": float(right[certain].mean()),
    }


def main() -> None:
    """Fit, judge, print, and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ansur", type=Path, required=True)
    parser.add_argument("--people", type=int, help="only so many soldiers, drawn at random")
    parser.add_argument(
        "--write", action="store_true", help="put the classifiers into the neutral body's file"
    )
    parser.add_argument("--numbers", type=Path)
    options = parser.parse_args()
    body = asset("neutral")
    soldiers = read_soldiers(options.ansur, count=options.people)
    betas = soldiers_betas(body, soldiers)
    female = soldiers.female
    count = body.num_betas
    weights = np.zeros((count, count))
    bias = np.zeros(count)
    numbers = {}
    for n in range(1, count + 1):
        found = calibrated(betas[:, :n], female)
        weights[n - 1, :n], bias[n - 1] = found.weights, found.bias
        if n in (2, 5, 8, 10, 15, 20, count):
            numbers[n] = judged(betas[:, :n], female)
            said = "  ".join(f"{key} {value:.3f}" for key, value in numbers[n].items())
            print(f"{n:3d} betas  {said}", flush=True)
    if options.numbers:
        options.numbers.write_text(json.dumps(numbers, indent=2) + "\n")
    if options.write:
        write_arrays(
            "neutral",
            {"gender_weights": weights.astype(np.float32), "gender_bias": bias.astype(np.float32)},
        )


if __name__ == "__main__":
    main()
