"""From a stream's points to the markers of one person: which point is which marker, in metres and
right-handed axes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_NONE = -1
_LOOK = 60
_SAME_M = 1e-5
_SIGNS = ((1.0, 1.0, 1.0), (-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, -1.0))
_FARTHEST = 9e6  # some systems' word for missing


@dataclass(frozen=True)
class Wiring:
    """Columns (N,) of a stream's points that hold each marker, -1 where none does, and their unit
    with signs (3,).
    """

    columns: Int[np.ndarray, " N"]
    factors: Float[np.ndarray, " 3"]

    def markers(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "N 3"]:
        """The markers (N, 3) of a frame in metres, NaN where missing."""
        if not len(points):
            return np.full((len(self.columns), 3), np.nan)
        markers = np.where((self.columns >= 0)[:, None], points[self.columns], np.nan)
        wrong = ~(np.abs(markers).max(axis=1) < _FARTHEST) | ~markers.any(axis=1)
        markers[wrong] = np.nan
        return markers * self.factors


def find_wiring(
    points: Float[np.ndarray, "T P 3"], markers: Float[np.ndarray, "T N 3"], metres: float
) -> Wiring:
    """Which points became which markers, told by the values, of the later half of the frames where
    these tell it.

    ``metres``: a unit of the stream. Whatever was done to the points when they were read (people
    parted, labels exchanged, a mirrored space righted), the frames to come are treated alike.
    """
    late = _agreement(points[len(points) // 2 :], markers[len(markers) // 2 :], metres)
    ever = _agreement(points, markers, metres)
    agreed = np.where(late[0].any(axis=1, keepdims=True), late[0], ever[0])
    columns = np.where(agreed.any(axis=1), agreed.argmax(axis=1), _NONE)
    return Wiring(columns, late[1] if late[0].sum() else ever[1])


def _agreement(
    points: np.ndarray, markers: np.ndarray, metres: float
) -> tuple[np.ndarray, np.ndarray]:
    """In how many of some frames each marker is each point (N, P), and the unit with its signs
    (3,).
    """
    some = np.linspace(0, len(points) - 1, min(_LOOK, len(points))).astype(int)
    tries = []
    for signs in _SIGNS:
        factors = metres * np.array(signs)
        off = np.abs(points[some][:, None] * factors - markers[some][:, :, None]).max(
            axis=3
        )  # (T, N, P)
        tries.append(((off < _SAME_M).sum(axis=0), factors))  # NaN compares false
    return max(tries, key=lambda each: each[0].sum())


def rewired(
    wiring: Wiring, before: tuple[str, ...], now: tuple[str, ...]
) -> tuple[Wiring, tuple[int, ...], tuple[str, ...]]:
    """The wiring of a stream that calls its points something else from now on; markers that are
    gone, labels that are new. A label that lacks its prefix, or has another, is taken for the same
    where no other is.
    """
    exact = {label: k for k, label in enumerate(now)}
    bare: dict[str, list[int]] = {}
    for k, label in enumerate(now):
        bare.setdefault(_bare(label), []).append(k)
    columns = wiring.columns.copy()
    gone = []
    used = set()
    for n, column in enumerate(wiring.columns.tolist()):
        label = before[column] if column >= 0 else ""
        others = bare.get(_bare(label), []) if label else []
        columns[n] = exact.get(label, others[0] if len(others) == 1 else _NONE)
        if columns[n] < 0 and column >= 0:
            gone.append(n)
        used.add(int(columns[n]))
    known = {_bare(label) for label in before}
    new = tuple(label for k, label in enumerate(now) if k not in used and _bare(label) not in known)
    return Wiring(columns, wiring.factors), tuple(gone), new


def _bare(label: str) -> str:
    return label.rpartition(":")[2]
