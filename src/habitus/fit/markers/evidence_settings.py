"""Settings of what is measured of a finished marker fit: evidence for its verdict
(`habitus.fit.markers.evidence`), and uncertainty (`habitus.fit.markers.result`). Limits of the
evidence are in `habitus.fit.markers.judge`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int


@dataclass(frozen=True)
class EvidenceSettings:
    """How evidence is measured. Metres, seconds and shares of 0..1."""

    frames: int = 4000
    """Frames, evenly spaced, whose errors are measured, about; more take memory and change no
    verdict."""
    few_frames: int = 200
    """The same for motion, tilt and size, which take joints or pairs of markers in each frame."""
    pair_frames: int = 20
    """The same for distances between all pairs of markers."""
    min_weight: float = 0.5
    """Robust weight, of 1, below which a sample is distrusted."""
    seen_weight: float = 0.1
    """Robust weight from which on a sample determines where a limb is."""
    carried: float = 0.5
    """Share of a marker's skinning weights by which a joint, or what hangs from it, carries it."""
    straight: float = 0.97
    """Distance from ankles to neck over the way by knees, hips and pelvis: who stands has more."""
    standing: float = 0.1
    """Share of straight frames above which tilt is measured over these alone."""
    close: float = 0.15
    """Markers this close at rest, or on one part of the body, are a pair that stays together,"""
    torn: float = 0.4
    """is torn if it is observed this much further apart,"""
    level: float = 0.3
    """and torn level if the two are less than this apart in height."""
    motion_step: float = 0.02
    """Seconds of the differences that speeds and accelerations are taken from: noise of 1 mm leaves
    an acceleration of 6 m/s^2, and steps of a sprint last 0.1 s."""
    motion_samples: int = 400
    """Triples of frames from which the extremes of motion are taken, at most."""
    motion_percentile: float = 95.0
    """Of speeds and accelerations; single frames with wrong markers do not count."""
    extent_percentile: float = 90.0
    """Of the markers' distances from their middle, for the size: stray markers do not count."""

    def rows(self, num_frames: int) -> Int[np.ndarray, " F"]:
        """About ``few_frames`` of a capture's frames, evenly spaced."""
        return np.arange(0, num_frames, max(1, num_frames // self.few_frames))


@dataclass(frozen=True)
class UncertaintySettings:
    """How far betas and segments are determined by the markers."""

    spans: int = 24
    """Spans of time in which segments are looked at, at most: each costs a solve of all joints."""
    place: float = 0.015
    """Standard deviation (m) of a marker's place on a real body about its place on the fitted one:
    hands that placed it, flesh, and a shape space that knows no body exactly."""
    trusted: float = 0.5
    """Robust weight, of 1, from which on a marker counts as seen."""
    root_sd: float = 10.0
    """Radians and metres by which the whole body may be turned and moved: as good as free."""
    pose_sd: float = 1.0
    """Radians and metres by which pose and trans may make up for a change of betas: wide, but no
    joint turns further."""
    probes: int = 3
    """Points of the skin, far apart, that stand for a joint's segment: enough for any turn."""
    min_weight: float = 0.4
    """Skinning weight of a joint at such a point, at least."""
    guessed: float = 0.06
    """Metres: a segment whose skin is known no better (standard deviation) is guessed."""


EVIDENCE = EvidenceSettings()
UNCERTAINTY = UncertaintySettings()
