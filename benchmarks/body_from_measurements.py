"""How near does a body from a few measurements come to what else was measured of the person?

    python benchmarks/body_from_measurements.py SURVEY_FOLDER [--people 200]

SURVEY_FOLDER holds the two public tables of ANSUR II. Of every sixth soldier, as they come, the
likeliest body with some measurements is made (`habitus.body_from_measurements`), and its other
measurements are held against the soldier's. RMSE of all of them, of women and of men, each beside
that of a linear regression with sex on the other soldiers; the mean errors; and how often the truth
lies within the spread that the body tells (68 % of the time would be right).
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import sys
from pathlib import Path

import numpy as np
from common import ROOT, machine, parser, write_json
from rich.console import Console
from rich.table import Table

import habitus
from habitus.fit.from_measurements import ESTIMATE, estimate_body

sys.path.insert(0, str(ROOT))
from habitus_lab.default_body.soldiers import Soldiers, measured, read_soldiers, slopes

GIVEN = (
    ("height_m", "mass_kg"),
    ("height_m", "mass_kg", "waist_circumference_m"),
    (
        "height_m",
        "mass_kg",
        "chest_circumference_m",
        "waist_circumference_m",
        "hip_circumference_m",
        "inseam_m",
    ),
)
JUDGED = (
    "chest_circumference_m",
    "waist_circumference_m",
    "hip_circumference_m",
    "thigh_circumference_m",
    "neck_circumference_m",
    "shoulder_breadth_m",
    "inseam_m",
    "arm_span_m",
    "waist_depth_m",
)
GOALS = {"chest_circumference_m": 33, "waist_circumference_m": 44, "hip_circumference_m": 29}
"""RMSE (mm) from height, mass and sex that the project set itself."""
HELD_OUT = 6
STEPS = 5
CHECKED = 2
MOST_OFF = 5.0


def bodies(space: str, soldiers: Soldiers, given: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Measurements (N, M) of the likeliest bodies, and their spreads (M,).

    As `estimate_body` finds them, for all people at once: with the slopes of the mean person
    throughout.
    """
    body = habitus.load_body(space)
    names = (*given, *JUDGED)
    values = soldiers.values[:, [soldiers.names.index(name) for name in given]]
    slope = slopes(body, names)
    count = len(given)
    noise = np.diag((ESTIMATE.precision * values.mean(axis=0)) ** 2)
    gain = np.linalg.solve(slope[:count] @ slope[:count].T + noise, slope[:count])
    mean = body.people_mean if body.people_mean is not None else np.zeros(body.num_betas)
    betas = np.tile(mean, (len(values), 1))
    for _ in range(STEPS):
        betas = (
            mean + (values - measured(body, betas, given) + (betas - mean) @ slope[:count].T) @ gain
        )
    open_ = np.eye(body.num_betas) - gain.T @ slope[:count]
    spread = np.sqrt(np.einsum("mb,bc,mc->m", slope[count:], open_, slope[count:]))
    for k in range(CHECKED):
        one = estimate_body(body, dict(zip(given, map(float, values[k]), strict=True)))
        off = 1e3 * (
            measured(body, betas[k : k + 1], JUDGED)[0]
            - [one.measurements[name] for name in JUDGED]
        )
        if np.abs(off).max() > MOST_OFF:
            raise SystemExit(f"{space} {k}: the quick way is off by {np.abs(off).max():.0f} mm")
    return measured(body, betas, JUDGED), spread


def regressed(soldiers: Soldiers, rows: np.ndarray, given: tuple[str, ...]) -> np.ndarray:
    """What a linear regression on all other soldiers of the sex says of these, (N, M)."""
    columns, wanted = ([soldiers.names.index(name) for name in names] for names in (given, JUDGED))
    x = np.column_stack([soldiers.values[:, columns], np.ones(len(soldiers.values))])
    rest = np.setdiff1d(np.arange(len(x)), rows)
    return x[rows] @ np.linalg.lstsq(x[rest], soldiers.values[rest][:, wanted], rcond=None)[0]


def judged(folder: Path, people: int | None, given: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Errors over held-out soldiers."""
    every = read_soldiers(folder)
    off = []
    plain = []
    told = []
    for space in ("female", "male"):
        mine = np.flatnonzero(every.female == (space == "female"))
        of_sex = every.of(mine)
        rows = np.flatnonzero(mine % HELD_OUT == HELD_OUT - 1)
        rows = np.sort(np.random.default_rng(0).permutation(rows)[:people])
        found, spread = bodies(space, of_sex.of(rows), given)
        truth = of_sex.values[rows][:, [every.names.index(name) for name in JUDGED]]
        off.append(1e3 * (found - truth))
        told.append(np.abs(found - truth) < spread)
        plain.append(1e3 * (regressed(of_sex, rows, given) - truth))
    result = {}
    for k, name in enumerate(JUDGED):
        if name in given:
            continue
        errors = [each[:, k] for each in off]
        line = [each[:, k] for each in plain]
        groups = {"all": slice(0, 2), "women": slice(0, 1), "men": slice(1, 2)}
        result[name] = {
            f"{who} {what}": float(np.sqrt(np.mean(np.concatenate(rows[group]) ** 2)))
            for who, group in groups.items()
            for what, rows in (("mm", errors), ("regression", line))
        } | {
            "women mean": float(errors[0].mean()),
            "men mean": float(errors[1].mean()),
            "within 1 sd": float(np.concatenate([part[:, k] for part in told]).mean()),
        }
    return result


def main() -> None:
    """Judge, print, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("folder", type=Path, metavar="SURVEY_FOLDER")
    arguments.add_argument("--people", type=int, help="so many of each sex (all)")
    options = arguments.parse_args()
    console = Console(width=150)
    found = {}
    for given in GIVEN:
        name = ", ".join(each.split("_")[0] for each in given)
        found[name] = rows = judged(options.folder, options.people, given)
        table = Table(title=f"bodies from sex, {name}; RMSE over held-out soldiers, mm")
        for head in ("", "goal", *next(iter(rows.values()))):
            table.add_column(head, justify="left" if not head else "right")
        for which, row in rows.items():
            goal = f"{GOALS[which]}" if which in GOALS and len(given) == 2 else ""
            table.add_row(
                which.removesuffix("_m"),
                goal,
                *(f"{value:.{2 if 'sd' in key else 1}f}" for key, value in row.items()),
            )
        console.print(table)
    write_json(options.out, {"machine": machine(), "given": found})


if __name__ == "__main__":
    main()
