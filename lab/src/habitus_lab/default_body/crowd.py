"""Bodies of many people: their measuring points, and in the T-pose their vertices and joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .measure import MEASURES, Tapes
from .people import Sliders
from .sliders import MorphSpace
from .survey import People
from .tpose import RestPose

BATCH = 100
HELD_OUT = 6  # every sixth soldier is kept for checking


@dataclass(frozen=True)
class Crowd:
    """People in the T-pose, and what the survey says of them."""

    vertices: np.ndarray  # (N, V, 3) float32
    joints: np.ndarray  # (N, 55, 3)
    # (N, P, 3) float32: their measuring points, in the survey's postures, as the tapes of their sex
    # need them; zeros fill up
    points: np.ndarray
    values: np.ndarray  # (N, M) the survey's measurements
    female: np.ndarray  # (N,)
    soldier: np.ndarray  # (N,) row in the survey

    def __getitem__(self, rows: np.ndarray) -> Crowd:
        parts = (self.vertices, self.joints, self.points, self.values, self.female, self.soldier)
        return Crowd(*(part[rows] for part in parts))

    def measured(self, tapes: dict[bool, Tapes]) -> np.ndarray:
        """(N, M) their measurements, each by the tapes of the own sex (True: women)."""
        return measured(self.points, self.female, tapes)

    def split(self) -> tuple[Crowd, Crowd]:
        """Those to learn from and those held out: every sixth soldier, however often drawn."""
        out = self.soldier % HELD_OUT == HELD_OUT - 1
        return self[~out], self[out]


def apose(morphs: MorphSpace, sliders: Sliders) -> Iterator[np.ndarray]:
    """Batches of points (n, P, 3) as MakeHuman rests them, or as `morphs` takes them from there."""
    for start in range(0, len(sliders.races), BATCH):
        part = slice(start, start + BATCH)
        macro = {name: value[part] for name, value in sliders.macro.items()}
        yield morphs.bodies(macro, sliders.races[part], sliders.local[part])


def tposed(morphs: MorphSpace, rest: RestPose, sliders: Sliders) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N,V,3) float32 and joints (N,55,3) of all people in the T-pose, pelvis at the
    origin.

    `morphs` spans `rest.points`: morphs.at(rest.points) of those over the base mesh.
    """
    vertices, joints = zip(*(rest(points) for points in apose(morphs, sliders)), strict=True)
    return np.concatenate(vertices), np.concatenate(joints)


def measured(points: np.ndarray, female: np.ndarray, tapes: dict[bool, Tapes]) -> np.ndarray:
    """(N, M) measurements of bodies' points (N, P, 3) as `Crowd` has them."""
    flat = points.reshape(len(points), -1)
    values = np.zeros((len(points), len(MEASURES)))
    for woman, own in tapes.items():
        rows = np.flatnonzero(female == woman)
        if len(rows):
            some = flat[rows]
            values[rows] = own.values(lambda where, some=some: some[:, where])
    return values


def gather(
    morphs: MorphSpace,
    rest: RestPose,
    tapes: dict[bool, Tapes],
    sliders: Sliders,
    people: People,
    size: np.ndarray,
) -> Crowd:
    """Everybody, larger or smaller as a whole by `size` (N,): what the survey measured grows
    along.
    """
    vertices, joints = tposed(morphs.at(rest.points), rest, sliders)
    points = _measuring_points(morphs, tapes, sliders, people.female)
    scale = size[:, None, None]
    vertices *= scale.astype(np.float32)
    points *= scale.astype(np.float32)
    power = np.where(np.array(MEASURES) == "weightkg", 3, 1)
    return Crowd(
        vertices,
        joints * scale,
        points,
        people.values * size[:, None] ** power,
        people.female,
        people.soldier,
    )


def _measuring_points(
    morphs: MorphSpace, tapes: dict[bool, Tapes], sliders: Sliders, female: np.ndarray
) -> np.ndarray:
    """(N, P, 3) as `Crowd` has them."""
    found = np.zeros((len(female), max(t.matrix.shape[0] // 3 for t in tapes.values()), 3))
    for woman, own in tapes.items():
        rows = np.flatnonzero(female == woman)
        if len(rows):
            some = np.concatenate(list(apose(own.over(morphs), sliders.of(rows))))
            found[rows, : some.shape[1]] = some
    return found.astype(np.float32)
