"""How near does the volume of a body made from tapes come to that of the man weighed under water?

    python benchmarks/tailors.py BODYFAT_CSV [--people N] [--survey SURVEY_FOLDER]

BODYFAT_CSV is `data/bodyfat.csv` of github THOMASELOVE/431-data: men of Penrose, Nelson and Fisher
(1985) with density under water, weight, height and ten girths. A body of the male shape space is
made of each from height and girths, with and without the weight (`estimate_body`); its volume is
held against weight / density. A body's skin also encloses the air in the lungs, which a density
under water does not count: the functional residual capacity of men (Quanjer et al. 1993, 2.34
height + .009 age - 1.09 litres) is added to theirs. Errors without it are told, too.

Beside it: a linear regression on the other men (ten folds), which knows their volumes; and, with
the weight, weight over the men's mean density. Nothing here was fitted to the men.

With SURVEY_FOLDER, which holds the two public tables of ANSUR II, tailors' measurements of the mean
bodies are held against the survey's means, where it took the like; bodies were fitted to none of
these.

Definitions: abdomen is at the navel and the hip bones, as our waist; thigh just below the buttock's
fold, ours a quarter of the way from hip to knee; ankle at its least, ours 78 % of the way from knee
to ankle; biceps and forearm extended, ours relaxed; neck, chest, hip, knee and wrist as ours.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import machine, parser, write_json
from rich.console import Console
from rich.table import Table

import habitus
from habitus.errors import HabitusError
from habitus.fit.from_measurements import ESTIMATE, estimate_body

GIRTHS = {
    "Neck": "neck", "Chest": "chest", "Abdomen": "waist", "Hip": "hip", "Thigh": "thigh",
    "Knee": "knee", "Ankle": "ankle", "Biceps": "upper_arm", "Forearm": "forearm", "Wrist": "wrist",
}  # fmt: skip
POUND, INCH = 0.45359237, 0.0254
GIRTH_SD = 0.01
"""Of a girth, as a share: what two people differ who hold the same tape."""
HEIGHT_SD, MASS_SD = 0.01, 0.5  # m, kg
GOAL = 2.5  # percent
FOLDS = 10
RARE = ESTIMATE.max_sd
SURVEY = {
    "armpit_height_m": "axillaheight",
    "shoulder_length_m": "shoulderlength",
    "neck_base_circumference_m": "neckcircumferencebase",
    "across_back_m": "interscyeii",
    "arm_length_m": "sleeveoutseam",
    "back_neck_to_wrist_m": "sleevelengthspinewrist",
    "heel_ankle_circumference_m": "heelanklecircumference",
}
"""Measurements of the survey, in mm, that are like ours. Its spine to wrist is taken with raised arms
bent, its shoulder blades being apart then, as between the midscyes."""


def read_men(path: Path) -> dict[str, np.ndarray]:
    """Columns of the table: volume (m^3), height (m), mass (kg), age, girths (m) by our names."""
    rows = list(csv.DictReader(path.open(encoding="utf-8", newline="")))
    column = {
        name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name != "KagRow"
    }
    mass = column["Weight"] * POUND
    return {
        "volume": mass / (1000.0 * column["Density"]),
        "height": column["Height"] * INCH,
        "mass": mass,
        "age": column["Age"],
    } | {ours: 0.01 * column[theirs] for theirs, ours in GIRTHS.items()}


def air(men: dict[str, np.ndarray]) -> np.ndarray:
    """In the lungs after breathing out at rest (m^3)."""
    return 1e-3 * (2.34 * men["height"] + 0.009 * men["age"] - 1.09)


def bodies(men: dict[str, np.ndarray], with_mass: bool) -> tuple[np.ndarray, np.ndarray, int]:
    """Volumes (N,) of the men's bodies, their standard deviations, and how many men the estimate
    would have refused.
    """
    body = habitus.load_body("male")
    settings = replace(ESTIMATE, max_sd=np.inf)
    volumes, spreads, refused = [], [], 0
    for k in range(len(men["volume"])):
        given = {name: (men[name][k], GIRTH_SD * men[name][k]) for name in GIRTHS.values()}
        given["height"] = (men["height"][k], HEIGHT_SD)
        if with_mass:
            given["weight"] = (men["mass"][k], MASS_SD)
        try:
            found = estimate_body(body, given, settings)
        except HabitusError as error:
            raise SystemExit(f"man {k + 1}: {error}") from error
        refused += found.sd_from_mean > RARE
        volumes.append(found.measurements["volume_m3"])
        spreads.append(found.spread["volume_m3"])
    return np.array(volumes), np.array(spreads), refused


def regressed(men: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    """Volumes that a linear regression on the men of other folds says."""
    x = np.column_stack([*(men[name] for name in names), np.ones(len(men["volume"]))])
    fold = np.arange(len(x)) % FOLDS
    said = np.zeros(len(x))
    for k in range(FOLDS):
        line = np.linalg.lstsq(x[fold != k], men["volume"][fold != k], rcond=None)[0]
        said[fold == k] = x[fold == k] @ line
    return said


def errors(found: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Of volumes, in percent of the truth, and the correlation."""
    off = 100.0 * (found / truth - 1.0)
    return {
        "mean error %": float(np.abs(off).mean()),
        "bias %": float(off.mean()),
        "SD %": float(off.std(ddof=1)),
        "95 % within %": float(np.percentile(np.abs(off), 95)),
        "correlation": float(np.corrcoef(found, truth)[0, 1]),
    }


def judged(men: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Errors of every way to say the volume."""
    under_water = men["volume"]
    truth = under_water + air(men)
    density = float(np.mean(men["mass"] / under_water))
    girths = ("height", *GIRTHS.values())
    result = {}
    for label, with_mass in (("height, girths", False), ("height, girths, weight", True)):
        found, spread, refused = bodies(men, with_mass)
        result[label] = errors(found, truth) | {
            "within 1 SD": float(np.mean(np.abs(found - truth) < spread)),
            "refused": float(refused),
        }
        result[f"{label}; lungs' air not added"] = errors(found, under_water)
        names = (*girths, "mass") if with_mass else girths
        result[f"{label}; linear regression"] = errors(regressed(men, names), under_water)
    result["weight over the mean density"] = errors(men["mass"] / density, under_water)
    return result


def against_survey(folder: Path) -> dict[str, dict[str, float]]:
    """The survey's means and those of the mean bodies, cm."""
    found: dict[str, dict[str, float]] = {name: {} for name in SURVEY}
    for sex in ("female", "male"):
        body = habitus.load_body(sex)
        mine = body.measure(body.people_mean)
        with (folder / f"ANSUR_II_{sex.upper()}_Public.csv").open(encoding="latin-1") as lines:
            rows = list(csv.DictReader(lines))
        for name, column in SURVEY.items():
            survey = float(np.mean([float(row[column]) for row in rows])) / 10.0
            found[name] |= {f"{sex} survey": survey, f"{sex} body": 100.0 * mine[name]}
    return found


def main() -> None:
    """Judge, print, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("table", type=Path, metavar="BODYFAT_CSV")
    arguments.add_argument("--people", type=int, help="the first so many (all)")
    arguments.add_argument("--survey", type=Path, metavar="SURVEY_FOLDER")
    options = arguments.parse_args()
    men = {name: values[: options.people] for name, values in read_men(options.table).items()}
    found = judged(men)
    table = Table(title=f"volume of {len(men['volume'])} men; goal: mean error {GOAL} %")
    heads = tuple(next(iter(found.values())))
    for head in ("from", *heads):
        table.add_column(head, justify="left" if head == "from" else "right")
    for name, row in found.items():
        cells = (
            f"{row[key]:.3f}" if key == "correlation" else f"{row[key]:.2f}" if key in row else ""
            for key in heads
        )
        table.add_row(name, *cells)
    Console(width=150).print(table)
    survey = {} if options.survey is None else against_survey(options.survey)
    if survey:
        table = Table(title="means, cm")
        for head in ("", *next(iter(survey.values()))):
            table.add_column(head, justify="right" if head else "left")
        for name, row in survey.items():
            table.add_row(name.removesuffix("_m"), *(f"{value:.1f}" for value in row.values()))
        Console(width=150).print(table)
    write_json(
        options.out,
        {"machine": machine(), "men": len(men["volume"]), "errors": found, "survey": survey},
    )


if __name__ == "__main__":
    main()
