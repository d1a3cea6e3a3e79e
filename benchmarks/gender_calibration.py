"""How sure may P(female) be? The default body's classifier held against people who were really measured.

    python benchmarks/gender_calibration.py SURVEY_FOLDER

SURVEY_FOLDER holds the two public tables of ANSUR II. Of each person the betas are found that give the body their
measurements (linearised, with the shape prior). A line from the classifier's score to the log odds of being a woman is
fitted on every other person, and both answers are judged on the rest, also with the betas' error after a fit to markers
(``--error``). Prints the line (`habitus.body.gender` holds it), accuracy, Brier score, and how often those are women of
whom the classifier said so with so much confidence.
"""

import argparse
import csv
from itertools import pairwise
from pathlib import Path

import numpy as np
from common import write_json
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.gender import female_probability
from habitus.body.model import BodyModel

COLUMNS = {
    "height_m": "stature",
    "arm_span_m": "span",
    "inseam_m": "crotchheight",
    "foot_length_m": "footlength",
    "chest_circumference_m": "chestcircumference",
    "waist_circumference_m": "waistcircumference",
    "hip_circumference_m": "buttockcircumference",
    "neck_circumference_m": "neckcircumference",
    "head_circumference_m": "headcircumference",
    "thigh_circumference_m": "thighcircumference",
    "calf_circumference_m": "calfcircumference",
    "ankle_circumference_m": "anklecircumference",
    "wrist_circumference_m": "wristcircumference",
    "mass_kg": "weightkg",
}
SHARE_OF_SD = 0.15  # of a measurement's spread: how far survey and body may measure differently
BINS = (0.0, 0.02, 0.1, 0.3, 0.7, 0.9, 0.98, 1.0)


def people(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Measurements (N, K) in metres and kilograms, and who is a woman (N,)."""
    values, female = [], []
    for sex in ("FEMALE", "MALE"):
        with (folder / f"ANSUR_II_{sex}_Public.csv").open(encoding="latin-1", newline="") as lines:
            for row in csv.DictReader(lines):
                values.append([float(row[n]) * (0.1 if n == "weightkg" else 0.001) for n in COLUMNS.values()])
                female.append(sex == "FEMALE")
    return np.array(values), np.array(female)


def betas_of(body: BodyModel, values: np.ndarray, female: np.ndarray) -> np.ndarray:
    """The likeliest betas (N, B) of bodies with these measurements, definitions brought to one mean."""
    slopes = np.stack([(_measured(body, e) - _measured(body, -e)) / 2 for e in np.eye(body.num_betas)], axis=1)
    sexes = 0.5 * (values[female].mean(axis=0) + values[~female].mean(axis=0))  # the body's mean is half women
    noise = SHARE_OF_SD * values.std(axis=0)
    a, b = slopes / noise[:, None], (values - sexes) / noise
    return np.linalg.solve(a.T @ a + np.eye(body.num_betas), a.T @ b.T).T


def _measured(body: BodyModel, betas: np.ndarray) -> np.ndarray:
    found = body.measure(betas)
    return np.array([found[name] for name in COLUMNS])


def line(score: np.ndarray, female: np.ndarray) -> tuple[float, float]:
    """Slope and offset of the log odds over the score, by Newton's method; both sexes count alike."""
    x, w = np.stack([score, np.ones_like(score)], axis=1), np.zeros(2)
    weight = np.where(female, 0.5 / female.mean(), 0.5 / (1 - female.mean()))
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(x @ w, -30, 30)))
        hessian = (x * (weight * p * (1 - p))[:, None]).T @ x
        w = w + np.linalg.solve(hessian, x.T @ (weight * (female - p)))
    return float(w[0]), float(w[1])


def judged(name: str, p: np.ndarray, female: np.ndarray) -> dict:
    """Accuracy, Brier score, mean log loss, and the share of women where so much was said."""
    bins = np.digitize(p, BINS[1:-1])
    return {
        "name": name,
        "accuracy": float(((p > 0.5) == female).mean()),
        "brier": float(np.mean((p - female) ** 2)),
        "log_loss": float(-np.mean(np.log(np.clip(np.where(female, p, 1 - p), 1e-12, 1)))),
        "women": [float(female[bins == k].mean()) if (bins == k).any() else None for k in range(len(BINS) - 1)],
        "said": [float(p[bins == k].mean()) if (bins == k).any() else None for k in range(len(BINS) - 1)],
    }


def main() -> None:
    """Fit the line, judge, print, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="SURVEY_FOLDER")
    parser.add_argument("--error", type=float, default=0.5, help="sd of a fit's betas")
    parser.add_argument("--out", type=Path, default=Path("gender_calibration.json"))
    options = parser.parse_args()
    body = habitus.load_body("default")
    assert body.female_direction is not None
    weights, bias = body.female_direction
    values, female = people(options.folder)
    betas = betas_of(body, values, female)
    learn = np.arange(len(betas)) % 2 == 0
    slope, offset = line(betas[learn] @ weights + bias, female[learn])
    test, truth, rng = betas[~learn], female[~learn], np.random.default_rng(0)
    fitted = test + options.error * rng.normal(size=test.shape)
    rows = []
    for name, shapes, error in (("exact betas", test, 0.0), ("betas with a fit's error", fitted, options.error)):
        raw = 1 / (1 + np.exp(-np.clip(shapes @ weights + bias, -500, 500)))
        told = np.array([female_probability(body, b, error) for b in shapes])
        rows += [judged(f"bare score, {name}", raw, truth), judged(f"calibrated, {name}", told, truth)]
    shown = Table(title=f"P(female) on held-out people; line: slope {slope:.3f}, offset {offset:+.3f}")
    for head in ("", "accuracy", "Brier", "log loss", *(f"{a:g}-{b:g}" for a, b in pairwise(BINS))):
        shown.add_column(head)
    for r in rows:
        women = ["–" if x is None else f"{x:.3f}" for x in r["women"]]
        shown.add_row(r["name"], f"{r['accuracy']:.3f}", f"{r['brier']:.4f}", f"{r['log_loss']:.4f}", *women)
    Console(width=170).print(shown)
    write_json(options.out, {"slope": slope, "offset": offset, "error": options.error, "rows": rows})


if __name__ == "__main__":
    main()
