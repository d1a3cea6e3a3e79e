"""Writes a learned body as the file that it was started from, both levels of detail included."""

from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.files import atomic_write
from habitus.io.archives import open_archive
from habitus.io.models.bodies import load_body, shipped_file
from habitus.io.models.details import project_form

_OF_THE_FILE = ("license", "version", "description")
"""What a file says of itself, not of the body: another body is another's."""
_REGRESSOR = ("joint_regressor_rows", "joint_regressor_cols", "joint_regressor_values")


def has_levels(source: str | Path) -> bool:
    """Whether a body's file, or a body that habitus brings along, has two levels of detail."""
    path = shipped_file(source)
    if path.suffix != ".npz" or not path.is_file():
        return False
    with open_archive(path) as file:
        return "coarse_vertices" in file


def save_like(body: BodyModel, source: str | Path, target: str | Path) -> None:
    """Write the full level of a body, learned from that of the file ``source``, under the project's
    own names.

    What is as it was in ``source`` is written as it stands there, to the bit; what is not, in the
    kinds of numbers that the source has (blend shapes in half precision, where it has those in it),
    compressed. The coarse level is the one of the source, on the same vertices: `load_body` gives
    it. Raises HabitusError where nothing can be written.
    """
    start = load_body(shipped_file(source), detail="full")
    before = project_form(start)
    after = project_form(body)
    with open_archive(shipped_file(source)) as file:
        arrays = {name: file[name] for name in file.names if name not in _OF_THE_FILE}
    changed = {
        key
        for key, value in after.items()
        if key not in before or not np.array_equal(before[key], value)
    }
    changed |= set(_REGRESSOR) if changed & set(_REGRESSOR) else set()
    for key in changed:
        arrays[key] = _in_the_kind_of(arrays.get(key), after[key])
    arrays = {key: value for key, value in arrays.items() if key in after or key not in before}
    with atomic_write(Path(target)) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def _in_the_kind_of(given: np.ndarray | None, value: np.ndarray) -> np.ndarray:
    kind = np.float32 if value.dtype.kind == "f" else value.dtype
    return value.astype(
        kind if given is None or given.dtype.kind != value.dtype.kind else given.dtype
    )
