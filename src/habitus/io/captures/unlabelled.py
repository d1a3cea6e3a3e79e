"""Captures as points without names: what their labels say is not read, only that angles and the
like are no points.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.io.captures.people import computed_labels
from habitus.io.captures.read import read_raw
from habitus.io.captures.trajectories import Tracks, hide_far, hide_placeholders
from habitus.io.names import shown_stem
from habitus.io.units import METRES, find_axes, find_unit


@dataclass(frozen=True)
class UnlabelledCapture:
    """The points of a capture: T frames, N trajectories or whatever columns the file has.

    ``points`` are metres in the capture's own world frame, NaN where missing; ``columns`` says
    which of the file's they are; ``unit`` is the unit of length of the file's numbers.
    """

    name: str
    points: Float[np.ndarray, "T N 3"]
    columns: tuple[int, ...]
    rate_hz: float
    up_axis: str
    unit: str
    format: str
    warnings: tuple[str, ...] = ()


def read_unlabelled(path: str | os.PathLike[str], fps: float | None = None) -> UnlabelledCapture:
    """All physical points of a capture file, whatever they are called.

    ``fps`` overrides the file's frame rate. Raises HabitusError as
    `habitus.io.captures.read.read_captures`.
    """
    path = Path(path)
    raw, rate = read_raw(path, fps)
    declared = {
        bare: group
        for label, group in raw.groups.items()
        for bare in (label, label.rpartition(":")[2])
    }
    computed = computed_labels(raw.labels, declared)
    columns = [k for k, label in enumerate(raw.labels) if label not in computed]
    points = hide_placeholders(raw.points[:, columns])
    if not np.isfinite(points).any():
        raise HabitusError(
            f"{path.name}: holds no points that are ever seen; export visible markers"
        )
    names = tuple(f"*{k}" for k in range(len(columns)))
    unit, warning = find_unit(names, points, raw.unit)
    tracks = hide_far(Tracks(names, points * METRES[unit]))
    axes = find_axes(names, tracks.points, raw.up_claim, raw.up_usual)
    warnings = (*raw.warnings, *([warning] if warning else []), *tracks.warnings)
    return UnlabelledCapture(
        shown_stem(path), tracks.points, tuple(columns), rate, axes.up, unit, raw.format, warnings
    )
