"""Reference curves of a laboratory over a gait cycle, mean and standard deviation: from a CSV file
or from a folder of its own results.
"""

import csv
import re
import warnings
from collections.abc import Mapping
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError, listed, shown
from habitus.gait.cycles import POINTS
from habitus.io.limits import check_count, read_text_file
from habitus.types import PathLike

MAX_BYTES, MAX_CURVES, MAX_VALUE = 10_000_000, 500, 1e6
CYCLES = "cycles.csv"
LEAST_RESULTS, MOST_RESULTS = 3, 2000
UNIT = re.compile(r"_(deg|N_kg|Nm_kg|W_kg)(_not_validated)?$")
"""Endings of columns in cycles.csv."""


def read_bands(path: PathLike) -> Mapping[str, Float[np.ndarray, "101 2"]]:
    """Reference curves over 0 to 100 %, mean and standard deviation, by name.

    path: a CSV with the columns percent, and NAME_mean and NAME_sd of each curve; or a folder with
    at least three results of ``habitus gait`` in it: the mean over results, each the mean of its
    strides of both sides, and the standard deviation between them. Raises HabitusError.
    """
    return _of_results(Path(path)) if Path(path).is_dir() else _of_table(Path(path))


def _of_results(folder: Path) -> Mapping[str, Float[np.ndarray, "101 2"]]:
    files = sorted(islice(folder.glob(f"*/{CYCLES}"), MOST_RESULTS + 1))
    if not LEAST_RESULTS <= len(files) <= MOST_RESULTS:
        raise HabitusError(
            f"{folder}: {len(files)} folders with {CYCLES} in it; expected {LEAST_RESULTS} to "
            f"{MOST_RESULTS} results of habitus gait"
        )
    means: dict[str, list[np.ndarray]] = {}
    for file in files:
        for name, mean in _mean_curves(file).items():
            means.setdefault(name, []).append(mean)
    stacked = {name: np.stack(some) for name, some in means.items() if len(some) >= LEAST_RESULTS}
    return {
        name: np.stack([each.mean(axis=0), each.std(axis=0, ddof=1)], axis=1)
        for name, each in stacked.items()
    }


def _mean_curves(path: Path) -> dict[str, Float[np.ndarray, " 101"]]:
    """The mean over the strides of a result's cycles.csv, of curves known at every percent."""
    try:
        head, *rows = list(csv.reader(read_text_file(path, MAX_BYTES).splitlines())) or [[]]
        table = np.array([[float(cell or "nan") for cell in row[2:]] for row in rows])
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise HabitusError(f"{path}: {shown(error)}; expected {CYCLES} of habitus gait") from error
    if head[:3] != ["side", "stride", "percent"] or table.shape != (len(rows), len(head) - 2):
        raise HabitusError(f"{path}: is not {CYCLES} of habitus gait: its columns differ")
    check_count(len(head), MAX_CURVES, f"{path}: curves")
    if (np.abs(table) >= MAX_VALUE).any():
        raise HabitusError(f"{path}: numbers beyond {MAX_VALUE:g}; expected angles, moments, …")
    whole = np.arange(POINTS)
    strides = [table[table[:, 0] == percent, 1:] for percent in whole]
    if min(map(len, strides), default=0) == 0:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a curve that no stride has stays NaN
        curves = np.array([np.nanmean(rows, axis=0) for rows in strides])
    names = [UNIT.sub("", text) for text in head[3:]]
    known = np.asarray(np.isfinite(curves).all(axis=0))
    return {name: curves[:, k] for k, name in enumerate(names) if known[k]}


def _of_table(path: Path) -> Mapping[str, Float[np.ndarray, "101 2"]]:
    try:
        rows = list(csv.DictReader(read_text_file(path, MAX_BYTES).splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise HabitusError(f"{path}: {error}; expected a table as CSV, in UTF-8") from error
    heads = [head for head in (rows[0] if rows else ()) if isinstance(head, str)]
    names = [head.removesuffix("_mean") for head in heads if head.endswith("_mean")]
    check_count(len(names), MAX_CURVES, f"{path}: curves")
    if not names or "percent" not in heads or any(f"{name}_sd" not in heads for name in names):
        raise HabitusError(
            f"{path}: its columns are {listed(heads) or 'none'}; expected percent, and NAME_mean "
            "and NAME_sd of each curve, such as knee_flexion_mean"
        )
    columns = ["percent", *(f"{name}_{part}" for name in names for part in ("mean", "sd"))]
    try:
        table = np.array([[float(row[column]) for column in columns] for row in rows])
    except (TypeError, ValueError) as error:
        raise HabitusError(f"{path}: {shown(error)}; expected numbers in every row") from error
    if not (np.abs(table) < MAX_VALUE).all():
        raise HabitusError(f"{path}: holds {np.abs(table).max():g}; expected angles, moments, …")
    if len(table) < 2 or (np.diff(table[:, 0]) <= 0.0).any():
        raise HabitusError(f"{path}: percent does not rise from row to row; expected 0 to 100")
    grid = np.linspace(0.0, 100.0, POINTS)
    curves = np.stack([np.interp(grid, table[:, 0], column) for column in table.T[1:]], 1)
    return {name: curves[:, 2 * k : 2 * k + 2] for k, name in enumerate(names)}
