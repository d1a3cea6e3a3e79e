"""Pose blend shapes of which most are zero: for each vertex those of the few joints that drive it
(S 5.2).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.kernels.jit import jit_noalloc

PER_JOINT = 9
"""Features of a joint: the entries of R - I."""
SPARSE = 0.5
"""Up to this share of joints and vertices that have to do with each other it pays to leave the
others out.
"""
LEAST = 256
"""Fewer vertices are not worth it."""


@dataclass(frozen=True, eq=False)
class LocalShapes:
    """The joints that drive vertex i are ``driver[start[i] : start[i + 1]]``; each moves it by
    ``value`` (m), nine features after each other, times their x, y and z. ``driver`` counts those
    of the body's `drivers`.
    """

    start: Int[np.ndarray, " N1"]
    driver: Int[np.ndarray, " G"]
    value: Float[np.ndarray, "G 27"]

    def add(
        self,
        rest: Float[np.ndarray, "b 3n"],
        features: Float[np.ndarray, "b F"],
        begin: int,
        end: int,
        *,
        side_by_side: bool,
    ) -> None:
        """Add what the features of b bodies move the vertices begin..end by; ``side_by_side``: of
        rest.T's memory.
        """
        if side_by_side:
            lines = np.ascontiguousarray(features.T)
            _add_side_by_side(rest.T, lines, self.start, self.driver, self.value, begin, end)
        else:
            _add(rest, features, self.start, self.driver, self.value, begin, end)


def local_shapes(
    posedirs: Float[np.ndarray, "N 3 F"] | None, per_joint: int, blocks: int
) -> LocalShapes | None:
    """The same blend shapes without the zeros; None where it does not pay: few vertices, few zeros,
    other features.

    ``blocks`` is how many times the features are there: once, and once for each shape coefficient
    they depend on.
    """
    if posedirs is None or per_joint != PER_JOINT or blocks != 1 or len(posedirs) < LEAST:
        return None
    shapes = without_zeros(posedirs)
    return None if len(shapes.driver) > SPARSE * posedirs.size / (3 * PER_JOINT) else shapes


def without_zeros(posedirs: Float[np.ndarray, "N 3 F"]) -> LocalShapes:
    """Blend shapes driven by entries of R - I, however few their zeros."""
    by_joint = posedirs.reshape(len(posedirs), 3, -1, PER_JOINT)
    drives = by_joint.any((1, 3))
    vertex, driver = np.nonzero(drives)
    start = np.concatenate([[0], np.cumsum(drives.sum(1))])
    value = by_joint[vertex, :, driver].transpose(0, 2, 1).reshape(-1, 3 * PER_JOINT)
    return LocalShapes(start.astype(np.int64), driver.astype(np.int64), np.ascontiguousarray(value))


@jit_noalloc
def _add(rest, features, start, driver, value, begin, end):
    """Body by body."""
    tile = end - begin
    for s in range(len(rest)):
        for i in range(begin, end):
            x = y = z = rest[s, i - begin] * 0.0
            for g in range(start[i], start[i + 1]):
                first = 9 * driver[g]
                row = value[g]
                for e in range(9):
                    f = features[s, first + e]
                    x += row[3 * e] * f
                    y += row[3 * e + 1] * f
                    z += row[3 * e + 2] * f
            rest[s, i - begin] += x
            rest[s, i - begin + tile] += y
            rest[s, i - begin + 2 * tile] += z


@jit_noalloc
def _add_side_by_side(rest, features, start, driver, value, begin, end):
    """Vertex by vertex for all bodies, three features at a time, which registers have room for."""
    tile = end - begin
    bodies = rest.shape[1]
    for i in range(begin, end):
        x = rest[i - begin]
        y = rest[i - begin + tile]
        z = rest[i - begin + 2 * tile]
        for g in range(start[i], start[i + 1]):
            first = 9 * driver[g]
            row = value[g]
            for e in range(0, 9, 3):
                a = features[first + e]
                b = features[first + e + 1]
                c = features[first + e + 2]
                ax = row[3 * e]
                ay = row[3 * e + 1]
                az = row[3 * e + 2]
                bx = row[3 * e + 3]
                by = row[3 * e + 4]
                bz = row[3 * e + 5]
                cx = row[3 * e + 6]
                cy = row[3 * e + 7]
                cz = row[3 * e + 8]
                for s in range(bodies):
                    f = a[s]
                    h = b[s]
                    k = c[s]
                    x[s] += ax * f + bx * h + cx * k
                    y[s] += ay * f + by * h + cy * k
                    z[s] += az * f + bz * h + cz * k
