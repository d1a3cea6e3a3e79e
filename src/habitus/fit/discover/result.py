"""What a discovery found: a layout, how sure each place is, and what is not decided."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from habitus.markers.layouts import MarkerLayout


@dataclass(frozen=True)
class Discovery:
    """A layout found by fitting.

    layout: of the labels that sit on the body, each with a ``confidence``: how likely it sits
    within 5 cm of its place. left_out: label -> why. doubts: what is not decided or speaks against
    it all, a sentence each. notes: what else a person should know. companions: label -> the labels
    that keep their distance to it, which sit on the same part. margin: how much more the best other
    reading of the capture costs, as a share; None where there was none to try.
    """

    layout: MarkerLayout
    left_out: Mapping[str, str] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    companions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    margin: float | None = None
    mean_mm: float = 0.0
