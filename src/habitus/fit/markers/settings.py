"""What a marker fit may be told: MoSh's weights and schedule (MoSh 6, thesis 3.6), and the robust
terms beyond it.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from habitus.errors import HabitusError
from habitus.residuals.shape_stage import PER_CM2
from habitus.solve.sequence.solver import SequenceOptions

SOFT_SPACE = "shape"
"""What soft tissue moves along where nobody says otherwise."""


@dataclass(frozen=True)
class ShapeWeights:
    """lambda of the shape stage; lengths in cm as in the paper."""

    data: float = 0.75
    surface: float = 100.0
    start: float = 0.25
    betas: float = 1.0
    pose: float = 0.25


@dataclass(frozen=True)
class PoseWeights:
    """lambda of the pose and soft-tissue stages; lengths in cm as in the paper, angles in
    radians.
    """

    data: float = 0.75
    pose: float = 1.0
    acceleration: float = 6.25
    soft_tissue: float = 0.25


@dataclass(frozen=True)
class MoshSettings:
    """Settings of a marker fit. ``annealing`` multiplies the prior weights (start, betas, pose)
    step by step.

    frames: how many frames the shape stage sees; frame_choice: "spread" or the paper's "random".
    start_markers: which align the root in the shape stage's frames, those of the "trunk" or "all".
    robust_scale: (smallest, largest) Geman-McClure scale of a marker in metres; noise_factor: scale
    in noise sds. longest: how many frames are solved at once; longer captures are solved in windows
    that overlap. soft_space: what soft tissue moves along (`habitus.observe.soft_space`): "shape"
    (M 6), "dynamics" (S 6) or "both".
    """

    shape: ShapeWeights = field(default_factory=ShapeWeights)
    pose: PoseWeights = field(default_factory=PoseWeights)
    annealing: tuple[float, ...] = (40.0, 20.0, 10.0, 4.0, 2.0, 1.0)
    frames: int = 12
    frame_choice: str = "spread"
    start_markers: str = "trunk"
    soft_tissue: bool = True
    soft_space: str = SOFT_SPACE
    causal: bool = False
    robust_scale: tuple[float, float] = (0.03, 0.10)
    noise_factor: float = 5.0
    longest: int = 10_000
    seed: int = 0


@dataclass(frozen=True)
class SequenceSettings:
    """Weights of the pose and soft-tissue stages' terms (M 6) in metres and radians, and how to
    solve.

    acceleration is 0 for frames that have nothing to do with each other. trans_acceleration (per
    m^2) carries trans over frames without markers; it is too weak to matter elsewhere.
    """

    data: float = 7500.0
    pose: float = 1.0
    acceleration: float = 6.25
    trans_acceleration: float = 10.0
    soft_tissue: float = 0.25
    soft_tissue_acceleration: float = 0.0
    options: SequenceOptions = field(default_factory=SequenceOptions)


def sequence_settings(settings: MoshSettings, warm: bool = False) -> SequenceSettings:
    """The paper's weights in metres; ``warm`` starts are solved at the finest level at once, with
    little damping.
    """
    lam = settings.pose
    options = SequenceOptions(strides=(1,), damping=1.0) if warm else SequenceOptions()
    return SequenceSettings(
        PER_CM2 * lam.data, lam.pose, lam.acceleration, soft_tissue=lam.soft_tissue, options=options
    )


def settings_from(values: Mapping[str, Any]) -> MoshSettings:
    """Settings from what ``dataclasses.asdict`` made of them; what is not there has its default."""
    known = {
        field.name: values[field.name] for field in fields(MoshSettings) if field.name in values
    }
    known |= {name: tuple(known[name]) for name in ("annealing", "robust_scale") if name in known}
    stages = {"shape": ShapeWeights, "pose": PoseWeights}
    return MoshSettings(
        **known | {name: kind(**known[name]) for name, kind in stages.items() if name in known}
    )


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
        for name, value in asdict(self).items():
            if not (isinstance(value, int | float) and math.isfinite(value) and value >= 0):
                raise HabitusError(
                    f"the weight {name} is {value!r}; expected a finite number of 0 or more"
                )

    @property
    def shape_stage(self) -> ShapeWeights:
        """Those of the shape stage."""
        return ShapeWeights(self.data, self.surface, self.start, self.betas, self.shape_pose)

    @property
    def pose_stage(self) -> PoseWeights:
        """Those of the pose stage and the soft-tissue stage."""
        return PoseWeights(self.data, self.pose, self.acceleration, self.soft_tissue)
