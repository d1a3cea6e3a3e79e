"""Data sets with faults, to test that checks find them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from habitus.errors import HabitusError
from habitus.mesh.registrations import Vertices
from habitus_lab.population.registrations import Planted

MILLIMETRES = 1000.0


@dataclass(frozen=True, eq=False)
class _Changed:
    """Vertices (N, V, 3) of which one registration is changed when read."""

    source: Vertices
    index: int
    change: Callable[[np.ndarray], np.ndarray]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.source.shape

    def __getitem__(self, rows: Any) -> np.ndarray:
        ids = np.arange(self.shape[0])[rows]
        read = np.array(self.source[rows])
        if ids.ndim == 0:
            return self.change(read) if ids == self.index else read
        for k in np.flatnonzero(ids == self.index):
            read[k] = self.change(read[k])
        return read


def _hole(vertices: np.ndarray) -> np.ndarray:
    return np.where(np.arange(len(vertices))[:, None] == len(vertices) // 2, np.nan, vertices)


def _torn(vertices: np.ndarray) -> np.ndarray:
    """A tenth of the vertices far off."""
    off = np.random.default_rng(0).permutation(len(vertices))[: len(vertices) // 10]
    vertices = vertices.copy()
    vertices[off] += np.random.default_rng(1).normal(0, 0.5, (len(off), 3))
    return vertices


def _shuffled(vertices: np.ndarray) -> np.ndarray:
    """The vertices in another order than the faces expect."""
    return vertices[np.random.default_rng(0).permutation(len(vertices))]


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "hole": _hole,
    "torn": _torn,
    "shuffled": _shuffled,
    "millimetres": lambda vertices: vertices * MILLIMETRES,
}
FAULTS = (*CHANGES, "mislabelled", "unposed")


def spoil(planted: Planted, kind: str, index: int) -> Planted:
    """The data set with a fault.

    ``kind`` "hole" (a vertex that is not a number), "torn" (a tenth of the vertices far off),
    "shuffled" (vertices in another order), "millimetres" and "mislabelled" (said to be the next
    person of its set) are about registration ``index``; "unposed" keeps joint ``index`` at rest
    throughout. Raises HabitusError for another kind, or where there is no such registration, joint
    or next person.
    """
    if kind not in FAULTS:
        raise HabitusError(f"fault {kind!r} asked for; expected one of {', '.join(FAULTS)}")
    data = planted.registrations
    most = planted.pose.shape[1] if kind == "unposed" else len(planted.pose)
    if not 0 <= index < most:
        raise HabitusError(f"fault {kind!r} asked for at {index}; expected 0 to {most - 1}")
    if kind == "unposed":
        pose = planted.pose.copy()
        pose[:, index] = 0.0
        clean = replace(planted.clean, pose=pose)
        data = replace(data, vertices=replace(clean, sigma=planted.sigma))
        return replace(planted, registrations=data, clean=clean, pose=pose)
    if kind == "mislabelled":
        others = data.where(set=data.set[index]).subjects
        if len(others) < 2:
            raise HabitusError(
                f"{data.name[index]} cannot be mislabelled: its set has no other person"
            )
        wrong = others[(others.index(data.subject[index]) + 1) % len(others)]
        subject = (*data.subject[:index], wrong, *data.subject[index + 1 :])
        return replace(planted, registrations=replace(data, subject=subject))
    changed = _Changed(data.vertices, index, CHANGES[kind])
    return replace(planted, registrations=replace(data, vertices=changed))
