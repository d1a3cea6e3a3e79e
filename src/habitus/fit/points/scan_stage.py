"""Steps of the fit to scans that are all alike."""

import math
from dataclasses import dataclass

from habitus.solve.minimize import Stage

ALL_BETAS = 1000
"""More than any body has."""


@dataclass(frozen=True, kw_only=True)
class ScanStage(Stage):
    """Steps of the fit of a body to scans, all alike; `steps` correspondences are made in it.

    The weights are those of the table in `habitus.fit.points`.
    """

    points: int
    """Of each scan that are used, at most."""
    scale: float
    """Geman-McClure's, metres: a point so far off weighs a quarter."""
    noise: float
    """Standard deviation of a point, metres."""
    slide: float = 0.0
    """Weight of point to point over point to plane. 0: surfaces may slide along each other."""
    betas: int = ALL_BETAS
    """The first so many are free."""
    pose: float = 1.0
    """Factor of the pose prior."""
    shape: float = 1.0
    """Factor of the shape prior."""
    least_noise: float = math.inf
    """Metres, down to which the noise falls with the square root of the share of ``points`` that a
    scan has: neighbouring points have finer forms of the skin in common, so that each of few
    determines more. Infinite: it does not fall."""
    scalp_weight: float = 1.0
    """Factor of the weight of points where hair may grow, without skin offsets. At 1 the head grows
    until it fills the hair; below 1, before the pose is known, a sparse scan may fit better
    backwards."""
    own_offsets: float = 1.0
    """Sd of the skin offsets that each scan of a person has by itself, in that of all; what remains
    is one field that all scans of the person share. 1: they share none."""
    renewed_signs: bool = False
    """Whether the signs of estimated normals are determined again in each step, from the surface.
    Signs that come with the scan (`Cloud.signed`) are kept. Off before the last stages and in the
    steps that choose the body: there the surface is still too inaccurate at ears, hands and feet.
    """
    smoothness: int = 1
    """Of the random field of skin offsets. With 2 pose and shape of the right body are closer to
    the truth, but the wrong body explains a scan more often."""

    def noise_of(self, count: int) -> float:
        """Noise (m) of each of ``count`` points."""
        fallen = self.noise * min(1.0, count / self.points) ** 0.5
        return min(self.noise, max(self.least_noise, fallen))
