"""How sure may P(female) be? The neutral body's classifiers held against soldiers, and against
trials of one subject.

    python benchmarks/gender_calibration.py SURVEY_FOLDER [--people 6068] [--captures
    ../shared/mocap]

SURVEY_FOLDER holds the two public tables of ANSUR II. Soldiers are held out five-fold: for each
number of betas the machine is fitted to the others (`lab/src/habitus_lab/default_body/gender.py`) and judged on
them: accuracy, expected calibration error (ten bins), and how often it leaves the sex undecided.
The same with betas that a fit to markers would leave (``--error`` each), told so and not told so.
Then pairs of captures of one subject are fitted with the neutral body, each by itself, and
P(female) is printed with and without the spread of the betas that the markers leave.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import sys
from pathlib import Path

import numpy as np
from common import CAPTURES, ROOT, machine, parser, write_json
from mosh_accuracy import PAIRS
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.gender import female_probability, said_of
from habitus.results.save import fit_female_probability

sys.path.insert(0, str(ROOT))
from habitus_lab.default_body.gender import calibrated, expected_calibration_error, judged
from habitus_lab.default_body.soldiers import read_soldiers, soldiers_betas

COUNTS = (5, 10, 15, 20, 24)
FOLDS = 5


def with_errors(betas: np.ndarray, female: np.ndarray, error: float) -> dict[str, float]:
    """Calibration error of people held out, whose betas are off by so much: told of it, and not
    told.
    """
    rng = np.random.default_rng(0)
    fold = rng.integers(0, FOLDS, len(betas))
    off = error * rng.normal(size=betas.shape)
    score = np.zeros(len(betas))
    spread = np.zeros(len(betas))
    for k in range(FOLDS):
        found = calibrated(betas[fold != k], female[fold != k])
        mine = fold == k
        score[mine] = (betas + off)[mine] @ found.weights + found.bias
        spread[mine] = error * np.linalg.norm(found.weights)
    told = 1 / (1 + np.exp(-np.clip(score / np.sqrt(1 + np.pi / 8 * spread**2), -40, 40)))
    untold = 1 / (1 + np.exp(-np.clip(score, -40, 40)))
    return {
        "told": expected_calibration_error(told, female),
        "not told": expected_calibration_error(untold, female),
    }


def of_captures(folder: Path) -> dict[str, dict[str, float | str]]:
    """P(female) of each capture of a pair, from betas taken for exact, and as sure as its markers
    allow.
    """
    body = habitus.load_body("neutral")
    found = {}
    for name in [name for pair in PAIRS for name in pair]:
        if (path := folder / f"{name}.c3d").exists():
            fit = habitus.Mosh(soft_tissue=False).fit(path, body)
            told = fit_female_probability(fit)
            found[name] = {
                "exact": female_probability(body, fit.betas, 0.0),
                "told": told,
                "says": said_of(told),
            }
    return found


def main() -> None:
    """Judge, print, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("folder", type=Path, metavar="SURVEY_FOLDER")
    arguments.add_argument("--people", type=int)
    arguments.add_argument("--error", type=float, default=0.5, help="sd of a fit's betas")
    arguments.add_argument("--captures", type=Path, default=CAPTURES)
    options = arguments.parse_args()
    body = habitus.load_body("neutral")
    soldiers = read_soldiers(options.folder, count=options.people)
    betas = soldiers_betas(body, soldiers)
    female = soldiers.female
    console = Console(width=130)
    rows = {count: judged(betas[:, :count], female) for count in COUNTS if count <= body.num_betas}
    table = Table(title="sex of soldiers held out, by the number of betas")
    for head in ("betas", *next(iter(rows.values()))):
        table.add_column(head.replace("_", " "), justify="right")
    for count, row in rows.items():
        table.add_row(str(count), *(f"{value:.3f}" for value in row.values()))
    console.print(table)
    noisy = with_errors(betas, female, options.error)
    console.print(f"calibration error of betas off by {options.error}: {noisy}")
    captures = of_captures(options.captures) if options.captures.is_dir() else {}
    for name, row in captures.items():
        console.print(
            f"{name:22} exact {row['exact']:.2f}  told {row['told']:.2f}  {row['says']}",
            highlight=False,
        )
    facts = {"machine": machine(), "soldiers": rows, "betas_off": noisy, "captures": captures}
    write_json(options.out, facts)


if __name__ == "__main__":
    main()
