"""Reference curves of a laboratory: mean and standard deviation over a gait cycle, as CSV."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError, listed, shown
from habitus.gait.cycles import POINTS
from habitus.io.limits import check_count, read_text_file
from habitus.types import PathLike

MAX_BYTES, MAX_CURVES, MAX_VALUE = 10_000_000, 500, 1e6


def read_bands(path: PathLike) -> Mapping[str, Float[np.ndarray, "101 2"]]:
    """Reference curves over 0 to 100 %, mean and standard deviation, by name: a CSV with the
    columns percent, and NAME_mean and NAME_sd of each curve. Raises HabitusError.
    """
    try:
        rows = list(csv.DictReader(read_text_file(Path(path), MAX_BYTES).splitlines()))
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
