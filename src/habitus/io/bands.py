"""Reference curves of a laboratory: mean and standard deviation over a gait cycle, as CSV."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.gait.cycles import POINTS
from habitus.io.limits import read_text_file
from habitus.types import PathLike


def read_bands(path: PathLike) -> Mapping[str, Float[np.ndarray, "101 2"]]:
    """Reference curves, mean and standard deviation, by name. Raises HabitusError."""
    rows = list(csv.DictReader(read_text_file(Path(path)).splitlines()))
    heads = list(rows[0]) if rows else []
    names = [head.removesuffix("_mean") for head in heads if (head or "").endswith("_mean")]
    if not names or "percent" not in heads or any(f"{name}_sd" not in heads for name in names):
        raise HabitusError(
            f"{path}: its columns are {', '.join(map(str, heads[:8])) or 'none'}; expected "
            "percent, and NAME_mean and NAME_sd of each curve, such as knee_flexion_mean"
        )
    try:
        at = np.array([float(row["percent"]) for row in rows])
        found = {
            name: np.array([[float(r[f"{name}_mean"]), float(r[f"{name}_sd"])] for r in rows])
            for name in names
        }
    except (TypeError, ValueError) as error:
        raise HabitusError(f"{path}: {error}; expected numbers in every row") from error
    if len(at) < 2 or (np.diff(at) <= 0).any() or not np.isfinite(at).all():
        raise HabitusError(f"{path}: percent does not rise from row to row; expected 0 to 100")
    grid = np.linspace(0.0, 100.0, POINTS)
    return {
        name: np.stack([np.interp(grid, at, column) for column in values.T], 1)
        for name, values in found.items()
    }
