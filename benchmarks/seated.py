"""How accurate are seated dimensions of a body made from standing measurements?

    python benchmarks/seated.py SURVEY_FOLDER [--people 100]

SURVEY_FOLDER holds the two public tables of ANSUR II. For ``--people`` of every sixth soldier of each
sex the most likely body is made from all standing measurements of the survey and seated
(`habitus.body.seated`); its seated dimensions are compared with the soldier's: mean error, standard deviation, RMSE (mm), correlation, and the RMSE of a linear
regression of the seated measure on the same standing ones over the other soldiers of the sex. A
measure counts as good where the RMSE of both sexes is at most 15 mm.

The one constant of the posture, how far the seat is below the hips' centres (`SEAT`, a share of
stature), is fitted here, too, on as many soldiers none of whom is judged: to the mean error of
sitting height, eye height, elbow height and thigh clearance. Shape spaces were trained on the
survey's standing measures, so that soldiers are held out of the fit of `SEAT` and of the
regression, not of the spaces.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import csv
import sys
from pathlib import Path

import numpy as np
from common import ROOT, machine, parser, write_json
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.measurement_names import DEFINITIONS
from habitus.body.seated import SEAT, SEATED

sys.path.insert(0, str(ROOT))
from habitus_lab.default_body.soldiers import read_soldiers, soldiers_betas

HELD_OUT = 6
GOOD = 15.0  # mm
ON_SEAT = (
    "sitting_height_m",
    "eye_height_sitting_m",
    "elbow_rest_height_m",
    "thigh_clearance_m",
)
STANDING = tuple(
    name for name, what in DEFINITIONS.items() if what.column and name != "sitting_height_m"
)
JUDGED = tuple(name for name, what in SEATED.items() if what.column)


def seated_truth(folder: Path) -> np.ndarray:
    """The survey's seated measures (N, M; m), women first, as `read_soldiers` has them."""
    rows = []
    for sex in ("FEMALE", "MALE"):
        path = folder / f"ANSUR_II_{sex}_Public.csv"
        with path.open(encoding="latin-1", newline="") as lines:
            for row in csv.DictReader(lines):
                rows.append([1e-3 * float(row[SEATED[name].column]) for name in JUDGED])
    return np.array(rows)


def judge(folder: Path, people: int) -> dict[str, dict[str, dict[str, float]]]:
    """Errors (mm) of each seated measure by sex, and the SEAT that these soldiers would have."""
    every, truth = read_soldiers(folder, STANDING), seated_truth(folder)
    found: dict[str, dict[str, dict[str, float]]] = {}
    for sex in ("female", "male"):
        mine = np.flatnonzero(every.female == (sex == "female"))
        rng = np.random.default_rng(0)
        groups = [
            np.sort(rng.permutation(np.flatnonzero(mine % HELD_OUT == rest))[:people])
            for rest in (HELD_OUT - 1, 0)
        ]  # judged, and those on whom SEAT is fitted
        body = habitus.load_body(sex)
        off = []
        for group in groups:
            rows = mine[group]
            betas = soldiers_betas(body, every.of(rows))
            seated = [body.measure(b, posture="seated") for b in betas]
            values = np.array([[each[name] for name in JUDGED] for each in seated])
            off.append(values - truth[rows])
        stature = every.values[mine[groups[1]], every.names.index("height_m")]
        more = off[1][:, [JUDGED.index(name) for name in ON_SEAT]].mean(axis=1)
        regressed = _regressed(every.values[mine], truth[mine], groups[0]) - truth[mine[groups[0]]]
        found[sex] = {"SEAT": {"fitted": SEAT - float(np.mean(more / stature)), "used": SEAT}} | {
            name: {
                "mean": 1e3 * float(off[0][:, k].mean()),
                "sd": 1e3 * float(off[0][:, k].std()),
                "rmse": 1e3 * float(np.sqrt(np.mean(off[0][:, k] ** 2))),
                "correlation": float(
                    np.corrcoef(
                        off[0][:, k] + truth[mine[groups[0]], k], truth[mine[groups[0]], k]
                    )[0, 1]
                ),
                "regression": 1e3 * float(np.sqrt(np.mean(regressed[:, k] ** 2))),
                "survey sd": 1e3 * float(truth[mine, k].std()),
            }
            for k, name in enumerate(JUDGED)
        }
    return found


def _regressed(standing: np.ndarray, seated: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Predictions (N, M; m) of a linear regression on all other soldiers."""
    x = np.column_stack([standing, np.ones(len(standing))])
    rest = np.setdiff1d(np.arange(len(x)), rows)
    return x[rows] @ np.linalg.lstsq(x[rest], seated[rest], rcond=None)[0]


def main() -> None:
    """Judge, print, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("folder", type=Path, metavar="SURVEY_FOLDER")
    arguments.add_argument("--people", type=int, default=100, help="so many of each sex")
    options = arguments.parse_args()
    found = judge(options.folder, options.people)
    console = Console(width=150)
    for sex, rows in found.items():
        sink = rows["SEAT"]
        console.print(f"{sex}: SEAT {sink['used']:.4f} is used, {sink['fitted']:.4f} fits others")
        table = Table(title=f"{sex}, {options.people} people, mm")
        for head in ("", *rows[JUDGED[0]]):
            table.add_column(head, justify="left" if not head else "right")
        for name in JUDGED:
            cells = (f"{v:.{2 if key == 'correlation' else 1}f}" for key, v in rows[name].items())
            table.add_row(name.removesuffix("_m"), *cells)
        console.print(table)
    good = [n for n in JUDGED if max(rows[n]["rmse"] for rows in found.values()) <= GOOD]
    console.print(f"RMSE of at most {GOOD:g} mm in both sexes: {', '.join(good) or 'none'}")
    write_json(options.out, {"machine": machine(), "people": options.people, "found": found})


if __name__ == "__main__":
    main()
