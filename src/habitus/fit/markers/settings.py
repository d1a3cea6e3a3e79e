"""Settings of the marker fit: the papers' weights and schedule (MoSh sec. 6, thesis sec. 3.6; full
citations and the terms that the weights belong to in `habitus.fit.markers.energy`) and every
constant of what goes beyond them.

`MoshSettings` holds all of them, in one section for each step of the recipe. Lengths are metres,
times seconds, angles radians unless a field says otherwise. "Tuned" means: on the real captures and
their spoilt copies of `benchmarks/mosh_faults.py`, `benchmarks/mosh_fault_kinds.py` and
`benchmarks/mosh_verdicts.py`.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any, get_type_hints

from habitus.errors import HabitusError
from habitus.residuals.shape_stage import per_m2
from habitus.solve.sequence import SequenceOptions

SOFT_SPACE = "shape"
"""Default of what soft tissue moves along."""


@dataclass(frozen=True)
class ShapeWeights:
    """lambda of the shape stage (MoSh sec. 6); lengths in cm as in the paper."""

    data: float = 0.75
    """Of E_D, per cm^2."""
    surface: float = 100.0
    """Of E_S, per cm^2, at the paper's spread of 1 mm."""
    start: float = 0.25
    """Of E_I, per cm^2, at the paper's spread of 2 cm; annealed."""
    betas: float = 1.0
    """Of E_beta; annealed."""
    pose: float = 0.25
    """Of E_theta; annealed."""


@dataclass(frozen=True)
class PoseWeights:
    """lambda of the pose and soft-tissue stages (MoSh sec. 6); lengths in cm as in the paper,
    angles in radians.
    """

    data: float = ShapeWeights.data
    """Of E_D, per cm^2."""
    pose: float = 1.0
    """Of E_theta."""
    acceleration: float = 6.25
    """Of E_u, per rad^2; the second difference is that of successive frames, whatever their rate.
    """
    soft_tissue: float = 0.25
    """Of E_Delta."""


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

    frame_step: int = 16
    """Frames between those whose pose is chosen: the coarsest stride of the sequence solver."""
    pose_weights: tuple[float, ...] = (20.0, 1.0)
    """Annealing of the pose prior when single frames are solved from each plain pose."""
    sweeps: int = 12
    """Iterations of each of these solves, at most."""
    tolerance: float = 1e-2
    """Step (rad) at which each of these solves ends: enough to rank the plain poses."""
    off_trunk: float = 0.02
    """Weight in the alignment of the root of markers that are not on the trunk."""


@dataclass(frozen=True)
class GapSettings:
    """Missing markers: short gaps are interpolated, joints bridged through longer ones.

    Tuned on gaps cut into complete captures (`benchmarks/gap_filling.py`).
    """

    short: float = 0.1
    """Seconds: shorter gaps of a marker are interpolated by cubics."""
    velocity_persistence_s: tuple[float, float] = (0.03, 0.6)
    """Smallest and largest decay time (s) of the velocity at the edge of a longer gap; in between
    it is the spread of the values over their speed.
    """
    velocity_window_s: float = 0.05
    """Seconds over which a velocity at the edge of a gap is measured."""
    neighbour_frames: int = 300
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
    max_share: float = 0.2
    """Share of the samples that jump: where more do, frames are out of order or all is noise, and
    no pair is looked for. 0.01 in 19 sound captures, 0.93 with their frames shuffled."""
    samples: int = 1000
    """Frames of either order in which distances to other markers are compared, at most."""
    tolerance: float = 5e-3
    """Metres by which distances between markers vary in any case (skin, noise)."""
    rigid_share: float = 1 / 6
    """Share of the other markers, those that keep their distance best, that confirm an exchange."""
    crossed_share: float = 0.5
    """Squared deviations of these distances when exchanged over those as labelled, at most."""


@dataclass(frozen=True)
class SuspectSettings:
    """Markers that do not follow their label: swapped, fallen, ghosts, misplaced; noise."""

    large_residual: float = 0.06
    """Metres: larger residuals come neither from skin nor from the model. `rough_mean`,
    `swap_gain`, `min_jump`, `certain_residual`, `min_displacement` and `max_drift` are multiples of
    it.
    """
    min_noise: float = 2e-3
    """Metres: smallest noise of a marker; skin moves at least as much."""
    min_frames: int = 3
    """Frames: a marker that is wrong in fewer is no suspect."""
    min_share: float = 0.01
    """Share of its frames: a marker that is wrong in fewer is no suspect."""
    crossed_share: float = 0.5
    """Summed residuals of an exchanged pair, or distances to the layout's places, over those as
    labelled, at most."""
    rejected_weight: float = 0.25
    """Robust weight below which a sample is wrong: at 0.25 its residual is its scale."""
    constant_share: float = 0.8
    """Share of its frames (or of those after the first wrong one) from which on a marker is wrong
    always (or from then on)."""
    moved_share: float = 0.05
    """Share of its frames in which a marker that moved or fell is wrong, at least."""
    growth: float = 2.0
    """Residuals of a drift at the capture's end over those of its first wrong samples, at least."""
    swap_distance: float = 0.5
    """Metres: only pairs closer than this are tried as exchanged."""
    crossed_shift: float = 0.04
    """Metres by which exchanging two placements must shorten the distances to the layout's."""
    placement_spreads: float = 5.5
    """Of the layout's spread: a latent marker further from its place is another marker."""
    rough_ratio: float = 4.0
    """Mean residual of a marker over the median of all markers' means. Above it, and above
    `rough_mean`, ``rough_limit`` of `min_displacement` and `placement_spreads` makes a marker
    misplaced."""
    rough_limit: float = 0.5
    neighbours: int = 3
    """Markers at the nearest places with which a misplaced marker is tried as exchanged."""
    exchanges_tried: int = 8
    """Pairs that are tried as exchanged throughout, at most."""
    exchanged_cost: float = 0.8
    """Largest cost with such a pair exchanged, as a share of the cost as labelled."""

    @property
    def rough_mean(self) -> float:
        """Metres (0.015): smallest mean residual of a rough marker."""
        return self.large_residual / 4

    @property
    def swap_gain(self) -> float:
        """Metres (0.03) by which an exchange must shorten the summed residuals of a pair."""
        return self.large_residual / 2

    @property
    def min_jump(self) -> float:
        """Metres (0.03): smallest jump between frames with which a run of wrong samples begins."""
        return self.large_residual / 2

    @property
    def certain_residual(self) -> float:
        """Metres (0.12): median residual of a run of samples that is wrong without any jump."""
        return 2 * self.large_residual

    @property
    def min_displacement(self) -> float:
        """Metres (0.12): latent markers further from the layout's place may be misplaced."""
        return 2 * self.large_residual

    @property
    def max_drift(self) -> float:
        """Metres (0.18): growing residuals below it are called drift, above it a fall."""
        return 3 * self.large_residual


@dataclass(frozen=True)
class DriftSettings:
    """Markers that slide over the skin (`habitus.fit.markers.drift`)."""

    frames: int = 120
    """Frames, evenly spaced, that are examined, at most."""
    parts: int = 10
    """Intervals of the capture; a marker's residuals are reduced to the median of each."""
    min_parts: int = 6
    """Intervals with samples of a marker, at least."""
    candidate_trend: float = 0.018
    """Metres through the capture: a marker with a shorter trend is not examined."""
    min_trend: float = 0.035
    """Metres through the capture, measured without the marker: shorter is not called drift."""
    min_seconds: float = 1.0
    """No marker slides in shorter captures."""
    min_standard_errors: float = 5.0
    """Standard errors of a trend, at least; half of it makes a marker a candidate."""
    min_ratio: float = 1.3
    """Trend over that of any other marker, at least; the ``ignored_others`` largest do not count.
    """
    ignored_others: int = 2
    """Other markers that may have a longer trend: they may slide, too."""
    max_candidates: int = 8
    """Markers examined, at most; each costs one fit of single frames."""


@dataclass(frozen=True)
class WindowSettings:
    """Captures longer than ``MoshSettings.longest`` are solved in overlapping windows."""

    overlap: int = 240
    """Frames solved on either side of those kept, a multiple of ``grid``: a disturbance decays
    within some ten frames, and the coarsest level is solved for all windows at once."""
    grid: int = 48
    """Frames: windows begin at multiples, three times the solver's coarsest stride of 16, so that
    its sweeps over every third frame visit the same frames as in one solve of the whole."""
    search_steps: int = 20
    """Steps of ``grid`` in which a boundary is sought around which markers are seen."""


@dataclass(frozen=True)
class LiveSettings:
    """Causal fits, frame after frame (MoSh sec. 6)."""

    close: float = 3e-2
    """A Gauss-Newton step this short (rad, RMS) leaves an error of its square: no second one."""
    velocity_decay: float = 0.95
    """Of the velocity from frame to frame while too few markers are seen."""
    gone: float = 0.5
    """Seconds without enough markers after which the person has left."""
    wait_s: float = 0.2
    """Seconds to wait for more markers before a start, and of a bad fit before a restart."""
    astray: float = 0.06
    """Metres: a fit is bad where half of the markers are further from the body."""
    better: float = 0.7
    """Of the cost: a restart is taken below this share of the current one."""
    complete: float = 0.5
    """Share of the markers with which a person begins at once and a verdict is not doubtful."""


@dataclass(frozen=True)
class RetrySettings:
    """Further attempts at a fit that failed."""

    max_left_out: float = 0.4
    """Of the labels: where more are wrong the rest cannot be trusted either."""
    min_weight: float = 0.5
    """Robust weight, of 1, below which a sample is distrusted."""
    distrusted: float = 0.5
    """Share of its samples above which a distrusted label is left out."""
    shape_stages: int = 2
    """Further shape stages, at most: each costs up to three times that of a sound capture, since
    none of its steps converges early."""
    frames: int = 600
    """Frames from the capture's middle by which an attempt is judged."""
    return_distance: float = 0.06
    """Metres from the layout's place: a label left out comes back if its marker is closer."""


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
    """Settings of a marker fit: weights, schedule, and a section for each step of the recipe."""

    shape: ShapeWeights = field(default_factory=ShapeWeights)
    pose: PoseWeights = field(default_factory=PoseWeights)
    annealing: tuple[float, ...] = (40.0, 20.0, 10.0, 4.0, 2.0, 1.0)
    """Factors of the shape stage's prior weights (start, betas, pose), step by step (MoSh sec. 6).
    """
    shape_scale: float = 0.3
    """Metres: Geman-McClure scale of the shape stage at step 1; at step k it is shape_scale / k, at
    least ``robust_scale[1]``. Not from the paper: poses are still rough in the first steps."""
    hopeless: float = 0.10
    """Metres: the shape stage ends early where half of the markers are further from the body after
    two steps of the annealing, and nothing more is tried. Sound captures have 0.011 there at most,
    those with a third of the labels wrong 0.07, and with all of them wrong 0.24."""
    hopeless_step: int = 2
    """Steps of the annealing from which on that is checked: the first leaves poses rough."""
    tallest: float = 2.8
    """Metres: of anybody. A taller body ends the shape stage in the same way: a wrong unit."""
    hopeless_sweeps: int = 3
    """Sweeps, at most, of the coarsest and the finest level after that: poses of a body that is not
    the person's do not converge in the usual 30, and only show how far off it is."""
    rough: float = 0.02
    """Metres: the last step is solved once, and roughly, where half of the markers are further from
    the body before it: no sound fit comes of it, and to settle it took most of the time of captures
    that fail. Sound captures have at most 0.011."""
    last_repeats: int = 3
    """Times that the last step is solved, in which triangles and robust weights settle."""
    shape_iterations: int = 20
    """Dogleg iterations of a step, at most."""
    shape_tolerances: tuple[float, float] = (1e-3, 3e-5)
    """Relative decrease of the cost at which steps, and the last step, end."""
    frames: int = 12
    """How many frames the shape stage uses."""
    frame_choice: str = "spread"
    """How they are chosen: "spread" (poses as different as possible) or the paper's "random"."""
    start_markers: str = "trunk"
    """Markers that align the root in these frames: those of the "trunk" or "all"."""
    soft_tissue: bool = True
    """Whether the soft-tissue stage follows the pose stage."""
    soft_space: str = SOFT_SPACE
    """What soft tissue moves along (`habitus.body.soft_tissue`): "shape" (MoSh sec. 6),
    "dynamics" (SMPL sec. 6) or "both".
    """
    causal: bool = False
    """Each frame is solved from itself and the two before it, as for live use; without it all
    frames are solved together. After a causal fit no exchanged labels and no drift are
    looked for, and no gaps bridged.
    """
    robust_scale: tuple[float, float] = (0.03, 0.10)
    """Smallest and largest Geman-McClure scale of a marker, metres. The largest holds until the
    marker's noise is known."""
    noise_factor: float = 5.0
    """Geman-McClure scale of a marker in its noise sds, before it is clipped to ``robust_scale``.
    """
    longest: int = 10_000
    """Frames solved at once; longer captures are solved in windows that overlap."""
    seed: int = 0
    """Of the random choice of frames and of the pairs of markers that describe a pose."""
    outliers: OutlierSettings = field(default_factory=OutlierSettings)
    flips: FlipSettings = field(default_factory=FlipSettings)
    spread_frames: FrameSettings = field(default_factory=FrameSettings)
    """For ``frame_choice`` "spread"."""
    start: StartSettings = field(default_factory=StartSettings)
    gaps: GapSettings = field(default_factory=GapSettings)
    suspects: SuspectSettings = field(default_factory=SuspectSettings)
    drift: DriftSettings = field(default_factory=DriftSettings)
    windows: WindowSettings = field(default_factory=WindowSettings)
    live: LiveSettings = field(default_factory=LiveSettings)
    retry: RetrySettings = field(default_factory=RetrySettings)


@dataclass(frozen=True)
class SequenceSettings:
    """Weights of the pose and soft-tissue stages' terms (table in `habitus.fit.markers.energy`) in
    metres and radians, and how to solve.
    """

    data: float = per_m2(PoseWeights.data)
    """Of E_D, per m^2."""
    pose: float = PoseWeights.pose
    """Of E_theta."""
    acceleration: float = PoseWeights.acceleration
    """Of E_u, per rad^2. 0 for independent frames: it also switches off the other two
    accelerations, the solver's coarse levels and its over-relaxation."""
    trans_acceleration: float = 10.0
    """Per m^2: carries trans over frames without markers, and is too weak to matter elsewhere. Not
    from the paper."""
    soft_tissue: float = PoseWeights.soft_tissue
    """Of E_Delta."""
    soft_tissue_acceleration: float = 0.0
    """Of the second difference of soft tissue; no recipe sets it. Not from the paper."""
    options: SequenceOptions = field(default_factory=SequenceOptions)
    """Of the solver."""


def sequence_settings(
    settings: MoshSettings, warm: bool = False, hopeless: bool = False
) -> SequenceSettings:
    """The paper's weights in metres; ``warm`` starts are corrected, with little damping;
    ``hopeless`` ones are solved in a few sweeps.
    """
    weights = settings.pose
    options = SequenceOptions()
    if warm:
        options = SequenceOptions((4, 1), coarse_sweeps=4, damping=1.0, corrects=True)
    if hopeless:
        few = settings.hopeless_sweeps
        options = replace(options, coarse_sweeps=few, sweeps=few)
    own = (per_m2(weights.data), weights.pose, weights.acceleration)
    return SequenceSettings(*own, soft_tissue=weights.soft_tissue, options=options)


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

    A weight multiplies half the squared residual; 0 switches a term off. acceleration = 0 makes
    every frame a problem of its own: it also drops the term trans_acceleration, the solver's coarse
    levels and its over-relaxation. Raises HabitusError for a weight that is negative or not finite.
    """

    data: float = ShapeWeights.data
    """E_D, predicted against observed markers (MoSh eq. 3): every stage."""
    surface: float = ShapeWeights.surface
    """E_S, the latent markers' distance from the skin (MoSh eq. 4): shape stage."""
    start: float = ShapeWeights.start
    """E_I, the latent markers' places in the layout (MoSh eq. 5): shape stage, annealed."""
    betas: float = ShapeWeights.betas
    """E_beta, the shape prior (MoSh eq. 6): shape stage, annealed."""
    shape_pose: float = ShapeWeights.pose
    """E_theta, the pose prior (MoSh eq. 7): shape stage, annealed."""
    pose: float = PoseWeights.pose
    """E_theta, the pose prior (MoSh eq. 7): pose and soft-tissue stages."""
    acceleration: float = PoseWeights.acceleration
    """E_u, the change of the pose's velocity between frames (MoSh eq. 8): pose and soft-tissue
    stages.
    """
    soft_tissue: float = PoseWeights.soft_tissue
    """E_Delta, the soft tissue's offsets of the betas (MoSh eq. 10): soft-tissue stage."""

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
