"""Dynamic blend shapes and their regressor in body files."""

import os
from pathlib import Path

import numpy as np

from habitus.body.dynamics import Dynamics, DynamicsRegressor
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.io.archives import NpzArchive
from habitus.io.models.arrays import ModelArrays


def read_dynamics(arrays: ModelArrays, vertices: int) -> Dynamics | None:
    """Dynamic blend shapes and their regressor, where the file has them."""
    if "dynamicsdirs" not in arrays:
        return None
    directions = arrays.number("dynamicsdirs", vertices, 3, None)
    count = directions.shape[2]
    drive = arrays.number("dynamics_drive", None, count, None)
    blocks = len(drive)
    controls = drive.shape[2]
    reach = arrays.number("dynamics_reach", 2, blocks - 1) if blocks > 1 else np.zeros((2, 0))
    regressor = DynamicsRegressor(
        history=arrays.number("dynamics_history", blocks, 2, count, count),
        drive=drive,
        joints=arrays.text("dynamics_joints"),
        rate_hz=float(arrays.number("dynamics_rate")),
        limits=arrays.number("dynamics_limits", controls),
        reach=reach,
        controls=arrays.text("dynamics_controls")[0],
    )
    return Dynamics(directions, regressor)


def dynamics_form(dynamics: Dynamics | None) -> dict[str, np.ndarray]:
    """The arrays that `read_dynamics` reads."""
    if dynamics is None:
        return {}
    known = dynamics.regressor
    named = {
        "history": known.history,
        "drive": known.drive,
        "limits": known.limits,
        "reach": known.reach,
    }
    named |= {
        "joints": np.array(known.joints),
        "rate": np.array(known.rate_hz),
        "controls": np.array(known.controls),
    }
    return {"dynamicsdirs": dynamics.directions} | {
        f"dynamics_{name}": array for name, array in named.items()
    }


def add_dynamics(source: str | os.PathLike[str], dynamics: Dynamics, target: Path) -> None:
    """Copy a body's ``.npz`` under the project's own names with these dynamics, in the place of any
    that it has.

    All else stays as it is, both levels of detail included; the dynamics are those of the full one.
    Blend shapes are kept in float32. Raises HabitusError where the file is of another mesh.
    """
    with Path(source).open("rb") as file:
        archive = NpzArchive(file)
        arrays = {
            name: archive.read(name) for name in archive.names if not name.startswith("dynamics")
        }
    if len(arrays["v_template"]) != len(dynamics.directions):
        raise HabitusError(
            f"{source}: {len(arrays['v_template'])} vertices; expected the "
            f"{len(dynamics.directions)} of the dynamics"
        )
    arrays |= dynamics_form(dynamics) | {"dynamicsdirs": dynamics.directions.astype(np.float32)}
    with atomic_write(target) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def has_levels(source: str | os.PathLike[str]) -> bool:
    """Whether a body's file is an ``.npz`` with two levels of detail."""
    with Path(source).open("rb") as file:
        if file.read(2) != b"PK":
            return False
        file.seek(0)
        return "coarse_vertices" in NpzArchive(file)
