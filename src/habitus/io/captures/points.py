"""What every capture format is read into before it is judged: labels and points as the file has
them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class RawPoints:
    """The point trajectories of one file, in the file's own unit and axes, NaN where missing.

    ``groups`` holds the labels that the file itself declares to be something other than markers
    (label -> "ANGLES", …). ``up_claim`` is a signed axis such as "+z" that the file states in
    ``up_source``; ``up_usual`` is what files of its format mostly have. ``recorded`` is what the
    file records about the person, in metres and kilograms.
    """

    format: str
    labels: tuple[str, ...]
    points: Float[np.ndarray, "T N 3"]
    rate_hz: float | None
    unit: str | None = None
    up_claim: str | None = None
    up_source: str = ""
    up_usual: str = "+z"
    groups: Mapping[str, str] = field(default_factory=dict)
    subjects: tuple[str, ...] = ()
    recorded: Mapping[str, float | str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
