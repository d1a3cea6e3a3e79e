"""MoSh's weights as one flat set of numbers, and the stages that each of them belongs to (M 6, T
3.6).
"""

import math
from dataclasses import dataclass, fields

from habitus.errors import HabitusError
from habitus.fit.markers.settings import PoseWeights, ShapeWeights


@dataclass(frozen=True)
class MoshWeights:
    """Weights (lambda) of MoSh's energy terms, as the papers state them: lengths in cm, angles in
    radians.

    A weight multiplies the squared residual; 0 switches a term off. Raises HabitusError for a
    weight that is negative or not finite.
    """

    data: float = 0.75
    """E_D, predicted against observed markers (M eq. 3): every stage."""
    surface: float = 100.0
    """E_S, the latent markers' distance from the skin (M eq. 4): shape stage."""
    start: float = 0.25
    """E_I, the latent markers' places in the layout (M eq. 5): shape stage, annealed."""
    betas: float = 1.0
    """E_beta, the shape prior (M eq. 6): shape stage, annealed."""
    shape_pose: float = 0.25
    """E_theta, the pose prior (M eq. 7): shape stage, annealed."""
    pose: float = 1.0
    """E_theta, the pose prior (M eq. 7): pose and soft-tissue stages."""
    acceleration: float = 6.25
    """E_u, the change of the pose's velocity between frames (M eq. 8): pose and soft-tissue stages.
    """
    soft_tissue: float = 0.25
    """E_Delta, the soft tissue's offsets of the betas (M eq. 10): soft-tissue stage."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value >= 0):
                raise HabitusError(
                    f"the weight {field.name} is {value!r}; expected a finite number of 0 or more"
                )

    @property
    def shape_stage(self) -> ShapeWeights:
        """Those of the shape stage."""
        return ShapeWeights(self.data, self.surface, self.start, self.betas, self.shape_pose)

    @property
    def pose_stage(self) -> PoseWeights:
        """Those of the pose stage and the soft-tissue stage."""
        return PoseWeights(self.data, self.pose, self.acceleration, self.soft_tissue)
