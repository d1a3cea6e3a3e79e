"""Settings of the marker fit: the papers' weights and schedule (M 6, T 3.6) and every constant of
what goes beyond them.

`MoshSettings` holds all of them, in one section for each step of the recipe. Lengths are metres,
times seconds, angles radians unless a field says otherwise. "Tuned" means: on the real captures and
their spoilt copies of `benchmarks/mosh_faults.py`, `benchmarks/mosh_fault_kinds.py` and
`benchmarks/mosh_verdicts.py`.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any, get_type_hints

from habitus.errors import HabitusError
from habitus.residuals.shape_stage import PER_CM2
from habitus.solve.sequence.solver import SequenceOptions

SOFT_SPACE = "shape"
"""Default of what soft tissue moves along."""


@dataclass(frozen=True)
class ShapeWeights:
    """lambda of the shape stage (M 6); lengths in cm as in the paper."""

    data: float = 0.75
    surface: float = 100.0
    start: float = 0.25
    betas: float = 1.0
    pose: float = 0.25


@dataclass(frozen=True)
class PoseWeights:
    """lambda of the pose and soft-tissue stages (M 6); lengths in cm as in the paper, angles in
    radians.
    """

    data: float = 0.75
    pose: float = 1.0
    acceleration: float = 6.25
    soft_tissue: float = 0.25


@dataclass(frozen=True)
class OutlierSettings:
    """Samples too far from the other markers of their frame to be of the same person."""

    distance: float = 5.0
    """From the frame's median marker: no person is half as large."""
    ratio: float = 6.0
    """In median distances of the frame's markers, so that no unit of length is assumed."""


@dataclass(frozen=True)
class FrameSettings:
    """Choice of the shape stage's frames by spread poses."""

    pairs: int = 150
    """Random pairs of markers whose distances describe a pose; more change no choice."""
    candidates: int = 600
    """Frames that are compared; bounds the work on long captures."""
    completeness: float = 0.5
    """Quantile of the share of seen markers below which frames are not used."""
    views: int = 3
    """Frames in which each marker is seen at least, where the capture allows it."""


@dataclass(frozen=True)
class StartSettings:
    """Initialisation of poses from plain poses (`habitus.fit.markers.start`)."""

    look_step: int = 16
    """Frames between those whose pose is chosen: the coarsest stride of the sequence solver."""
    pose_weights: tuple[float, ...] = (20.0, 1.0)
    """Annealing of the pose prior when single frames are solved from each plain pose."""
    sweeps: int = 12
    tolerance: float = 1e-2
    """Of these rough solves (rad): enough to rank the plain poses."""
    off_trunk: float = 0.02
    """Weight in the alignment of the root of markers that are not on the trunk."""


@dataclass(frozen=True)
class GapSettings:
    """Missing markers: short gaps are interpolated, joints bridged through longer ones.

    Tuned on gaps cut into complete captures (`benchmarks/gap_filling.py`).
    """

    short: float = 0.1
    """Seconds: shorter gaps of a marker are interpolated by cubics."""
    velocity_time: tuple[float, float] = (0.03, 0.6)
    """Smallest and largest time (s) for which a velocity at the edge of a gap persists."""
    look: float = 0.05
    """Seconds over which a velocity at the edge of a gap is measured."""
    look_frames: int = 300
    """Frames on either side that the persistence of velocities is estimated from, at most."""
    visible_share: float = 0.2
    """Of the markers that a joint moves: with fewer its rotation is bridged."""
    max_lever: float = 0.15
    """Metres: a marker further from a joint determines its rotation no better."""
    weight: float = 0.25
    """Of the marker that stands in for a missing one, against 1 of an observed one."""
    fill_weight: float = 0.5
    """Robust weight of the samples beside a gap below which it is not filled in the output."""


@dataclass(frozen=True)
class FlipSettings:
    """Labels that two markers exchange from one frame to the next, found before any fit."""

    jump: float = 0.03
    """Metres off the predicted position, at least."""
    ratio: float = 0.35
    """Distance from the other marker's prediction over the distance from the own, at most."""
    max_gap: int = 6
    """Frames that a marker may be hidden before it jumps, and by which two jumps may differ."""
    min_frames: int = 3
    """Shorter exchanges are left to the robust loss."""
    samples: int = 1000
    """Frames of either order that the distances to other markers are compared in; bounds the work
    on long captures."""
    tolerance: float = 5e-3
    """Metres by which distances between markers vary in any case (skin, noise)."""


@dataclass(frozen=True)
class SuspectSettings:
    """Markers that do not follow their label: swapped, fallen, ghosts, misplaced; noise."""

    gross: float = 0.06
    """Metres: larger residuals come neither from skin nor from the model."""
    min_noise: float = 2e-3
    """Metres: smallest noise of a marker; skin moves at least as much."""
    min_frames: int = 3
    min_share: float = 0.01
    """Of its frames: a marker that is wrong in fewer is no suspect."""
    swap_distance: float = 0.5
    """Metres: only pairs closer than this are tried as exchanged."""
    crossed_shift: float = 0.04
    """Metres by which exchanging two placements must shorten the distances to the layout's."""
    placement_spreads: float = 5.5
    """Of the layout's spread: a latent marker further from its place is another marker."""
    rough_ratio: float = 4.0
    """In median residuals of all markers: beyond it half the distance from the place suffices."""


@dataclass(frozen=True)
class DriftSettings:
    """Markers that slide over the skin (`habitus.fit.markers.drift`)."""

    frames: int = 120
    parts: int = 10
    min_parts: int = 6
    """Frames looked at, intervals they are averaged in, and intervals with samples, at least."""
    likely: float = 0.018
    far: float = 0.035
    """Metres: shorter trends are not examined, or not called drift."""
    min_seconds: float = 1.0
    """No marker slides in shorter captures."""
    steady: float = 5.0
    """Standard errors of a trend, at least."""
    alone: float = 1.3
    company: int = 2
    """Times the trend of any other marker, but for the ``company`` largest of them."""
    tries: int = 8
    """Markers examined, at most; each costs one fit of single frames."""


@dataclass(frozen=True)
class WindowSettings:
    """Captures longer than ``MoshSettings.longest`` are solved in overlapping windows."""

    overlap: int = 240
    """Frames solved on either side of those kept, a multiple of ``grid``: a disturbance decays
    within some ten frames, and the coarsest level is solved for all windows at once."""
    grid: int = 48
    """Windows begin at multiples: three colours on the solver's coarsest stride of 16."""
    look: int = 20
    """Steps of ``grid`` in which a boundary is sought around which markers are seen."""


@dataclass(frozen=True)
class LiveSettings:
    """Causal fits, frame after frame (M 6)."""

    close: float = 3e-2
    """A Gauss-Newton step this short (rad, RMS) leaves an error of its square: no second one."""
    velocity_decay: float = 0.95
    """Of the velocity from frame to frame while too few markers are seen."""
    gone: float = 0.5
    """Seconds without enough markers after which the person has left."""
    look: float = 0.2
    """Seconds to wait for more markers before a start, and of a bad fit before a restart."""
    astray: float = 0.06
    """Metres: a fit is bad where half of the markers are further from the body."""
    better: float = 0.7
    """Of the cost: a restart is taken below this share of the current one."""


@dataclass(frozen=True)
class RetrySettings:
    """Further attempts at a fit that failed."""

    max_left_out: float = 0.4
    """Of the labels: where more are wrong the rest cannot be trusted either."""
    near: float = 0.06
    """Metres from the layout's place: a label left out comes back if its marker is nearer."""


GAPS = GapSettings()
FLIPS = FlipSettings()
SUSPECTS = SuspectSettings()
DRIFT = DriftSettings()
FRAME_CHOICE = FrameSettings()
START = StartSettings()
OUTLIERS = OutlierSettings()
WINDOWS = WindowSettings()
LIVE = LiveSettings()


@dataclass(frozen=True)
class MoshSettings:
    """Settings of a marker fit. ``annealing`` multiplies the prior weights (start, betas, pose)
    step by step.

    frames: how many frames the shape stage sees; frame_choice: "spread" or the paper's "random".
    start_markers: which align the root in the shape stage's frames, those of the "trunk" or "all".
    robust_scale: (smallest, largest) Geman-McClure scale of a marker in metres; noise_factor: scale
    in noise sds. longest: how many frames are solved at once; longer captures are solved in windows
    that overlap. soft_space: what soft tissue moves along (`habitus.observe.soft_space`): "shape"
    (M 6), "dynamics" (S 6) or "both". The other fields are sections, one for each step.
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
    outliers: OutlierSettings = field(default_factory=OutlierSettings)
    flips: FlipSettings = field(default_factory=FlipSettings)
    spread_frames: FrameSettings = field(default_factory=FrameSettings)
    start: StartSettings = field(default_factory=StartSettings)
    gaps: GapSettings = field(default_factory=GapSettings)
    suspects: SuspectSettings = field(default_factory=SuspectSettings)
    drift: DriftSettings = field(default_factory=DriftSettings)
    windows: WindowSettings = field(default_factory=WindowSettings)
    live: LiveSettings = field(default_factory=LiveSettings)
    retry: RetrySettings = field(default_factory=RetrySettings)


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
    """Settings from what ``dataclasses.asdict`` made of them; a missing field has its default."""
    return _restored(MoshSettings, values)


def _restored(kind: type, values: Mapping[str, Any]) -> Any:
    """A dataclass from a mapping of its fields, sections and tuples restored."""
    hints = get_type_hints(kind)
    known = {}
    for each in fields(kind):
        if each.name in values:
            value = values[each.name]
            section = is_dataclass(hints[each.name])
            known[each.name] = (
                _restored(hints[each.name], value)
                if section
                else tuple(value)
                if isinstance(value, list)
                else value
            )
    return kind(**known)


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
