"""What files tell of registrations besides their vertices: poses, places, shape coefficients, rest
surfaces.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.mesh.known import Known

KEYS = ("pose", "poses", "trans", "betas", "rest")
KnownArrays = Mapping[str, np.ndarray]
"""The arrays of one path by `KEYS`: rows of registrations, and ``rest`` (S, V, 3) of its subjects
as they appear. ``poses`` is AMASS' word for ``pose``.
"""


def checked(
    arrays: Mapping[str, np.ndarray], subjects: Sequence[str], vertices: int, where: str
) -> KnownArrays:
    """The arrays as numbers in the shapes that they should have; one person's betas may be given
    once.

    Raises HabitusError where they have other shapes.
    """
    count = len(subjects)
    people = len(dict.fromkeys(subjects))
    shapes = {
        "pose": (count, None, 3),
        "trans": (count, 3),
        "betas": (count, None),
        "rest": (people, vertices, 3),
    }
    valid = {}
    for key, array in arrays.items():
        key = "pose" if key == "poses" else key
        if key == "pose" and array.ndim == 2 and array.shape[-1] % 3 == 0:
            array = array.reshape(len(array), -1, 3)
        if key == "betas" and array.ndim == people == 1:
            array = np.tile(array, (count, 1))
        want = shapes[key]
        alike = array.ndim == len(want) and all(
            n in (None, m) for n, m in zip(want, array.shape, strict=True)
        )
        if not alike or array.dtype.kind not in "fiu":
            text = ", ".join("*" if n is None else str(n) for n in want)
            raise HabitusError(
                f"{where}: its {key} is {array.dtype} of shape {array.shape}; expected numbers "
                f"({text})"
            )
        valid[key] = np.array(array, np.float64)
    return valid


def joined_known(
    paths: Sequence[KnownArrays], subjects: Sequence[Sequence[str]], factor: Float[np.ndarray, " N"]
) -> Known | None:
    """What is known of several paths, one after the other, in metres; None where nothing is.

    ``factor`` takes the lengths of each registration to metres. Raises HabitusError where paths
    differ in how many joints or shape coefficients there are.
    """
    if not any(paths):
        return None
    counts = [len(words) for words in subjects]
    rows = {
        key: _joined([arrays.get(key) for arrays in paths], counts, key)
        for key in ("pose", "trans", "betas")
    }
    if rows["trans"] is not None:
        rows["trans"] = rows["trans"] * factor[:, None]
    rest = {}
    first = 0
    for arrays, words in zip(paths, subjects, strict=True):
        for k, subject in enumerate(dict.fromkeys(words) if "rest" in arrays else ()):
            rest[subject] = arrays["rest"][k] * factor[first + list(words).index(subject)]
        first += len(words)
    return Known(**rows, rest=MappingProxyType(rest))


def _joined(
    arrays: Sequence[np.ndarray | None], counts: Sequence[int], key: str
) -> np.ndarray | None:
    shapes = {array.shape[1:] for array in arrays if array is not None}
    if not shapes:
        return None
    if len(shapes) > 1:
        raise HabitusError(
            f"the datasets' {key} have shapes (*, {sorted(shapes)}); expected one shape in all of "
            "them"
        )
    (last,) = shapes
    filled = [
        np.full((n, *last), np.nan) if a is None else a for a, n in zip(arrays, counts, strict=True)
    ]
    return np.concatenate(filled)


def known_form(known: Known | None, subjects: Sequence[str]) -> dict[str, np.ndarray]:
    """The arrays that are read back, for a file; rest surfaces only where they are known of all
    subjects.
    """
    if known is None:
        return {}
    arrays = known.arrays()
    if known.rest and all(subject in known.rest for subject in subjects):
        arrays["rest"] = np.stack([known.rest[subject] for subject in subjects])
    return arrays
