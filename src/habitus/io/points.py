"""What every capture format is read into before it is judged: labels and points as the file has them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class RawPoints:
    """The point trajectories of one file, in the file's own unit and axes, NaN where missing.

    ``groups`` says which labels the file itself declares to be something other than markers (label -> "ANGLES", …);
    ``up_claim`` is a signed axis such as "+z" with ``up_source`` saying where the file claims it; ``recorded`` maps a
    subject's name (or "" for all) to what the file records about the person, in metres and kilograms.
    """

    format: str
    labels: tuple[str, ...]
    points: Float[np.ndarray, "T N 3"]
    rate_hz: float | None
    unit: str | None = None
    up_claim: str | None = None
    up_source: str = ""
    groups: Mapping[str, str] = field(default_factory=dict)
    subjects: tuple[str, ...] = ()
    recorded: Mapping[str, Mapping[str, float | str]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
