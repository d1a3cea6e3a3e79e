"""Settings of a discovery (`habitus.fit.discover.recipe`). Lengths are metres.

Tuned on captures whose labels were replaced by numbers (`benchmarks/discover.py`).
"""

from dataclasses import dataclass, field

from habitus.fit.markers.settings import MoshSettings, SequenceSettings

Schedule = tuple[tuple[float, float], ...]
"""Rounds of (sigma in metres, weight of the pose prior)."""


def _together() -> Schedule:
    sigmas = (0.12, 0.10, 0.08, 0.06, 0.05, 0.04)
    weights = ((20.0, 10.0), (6.0, 6.0), (4.0, 4.0), (3.0, 3.0), (2.0, 2.0), (2.0, 2.0))
    return tuple((s, w) for s, each in zip(sigmas, weights, strict=True) for w in each)


@dataclass(frozen=True)
class SkinSettings:
    """Places on the skin that may carry a marker, and what is known of them before a fit."""

    distance: float = 0.0125
    """From the skin to the centre of a marker of which nothing is known: half of an adhesive
    marker, and its base."""
    finger: float = 0.04
    """A vertex this near to a finger's landmark, and nearer than to others of the arm, is the
    finger's."""
    sole_height: float = 0.06
    """Above the lowest vertex: nobody walks on markers, so that no place is below it"""
    sole_normal: float = -0.6
    """where the skin's normal has less than this along up."""
    known_spread: float = 0.05
    """Standard deviation of a known label's place,"""
    stray: float = 0.02
    """and the chance that it is elsewhere."""
    layout_spread: float = 0.025
    """Standard deviation of a marker about a layout's place."""
    popularity: float = 8.0
    """How many times likelier a place is that all layouts have than one that none has."""


@dataclass(frozen=True)
class DescriptionSettings:
    """A discovered layout in words: confidences, rigid neighbours, sides that labels state."""

    reach: float = 0.05
    """A confidence is the chance that a marker sits within this of its place."""
    place_spread: float = 0.04
    """Of each place, as the layout states it."""
    poor: float = 0.0075
    """Mean error in the frames used from which on a discovery is doubtful: right readings left
    0.001 to 0.0066 on real captures."""
    rigid: float = 0.004
    """Spread of a distance within one part, skin moving over bone included."""
    moved: float = 0.02
    """A label half of whose distances spread less than this has no companions: nobody moved."""
    companions: int = 4
    """Of a label, at most: the most rigid tell most."""
    min_pairs: int = 3
    """Pairs from which on the names of a set are believed to state sides."""
    middle: float = 0.03
    """From the middle of the body: a place further off is on a side."""


@dataclass(frozen=True)
class DiscoverSettings:
    """Settings of a discovery, step by step."""

    min_labels: int = 12
    """Fewer do not distinguish a body from a turned one."""
    frames: int = 12
    """Spread poses that all steps use."""
    heights: tuple[float, ...] = (0.91, 1.04)
    """Bodies that are tried, as shares of the mean person's height."""
    coarse: int = 150
    fine: int = 1200
    """Places on the skin in steps 1 and 2, and in step 3."""
    start_frames: int = 3
    """Frames in which single bodies are sought: those in which the markers extend furthest."""
    single: Schedule = (
        (0.15, 100.0),
        (0.12, 50.0),
        (0.12, 20.0),
        (0.12, 6.0),
        (0.09, 4.0),
        (0.07, 3.0),
        (0.06, 2.0),
    )
    """Annealing in single frames."""
    together: Schedule = field(default_factory=_together)
    """Annealing in all frames together."""
    outlier: float = 3.5
    """Sigmas: a label further from every place than about this may sit nowhere."""
    min_weight: float = 0.02
    """Share of all labels, summed, below which a place has none."""
    data: float = SequenceSettings.data
    """Weight (per m^2) of squared distances where places are known well (MoSh eq. 3); over the
    weight of the pose prior in each round."""
    cost_share: float = 0.1
    """Of ``data``, in the cost that ranks bodies: a body that is not this person's errs in all
    labels alike."""
    sweeps: int = 3
    """Of the poses' solve in each round of a schedule: the posteriors change next anyway."""
    frame_sweeps: int = 6
    """Of the solves of all frames from the plain poses, which have one round for each of"""
    frame_prior: tuple[float, ...] = (20.0, 2.0)
    """the weights of the pose prior there."""
    tolerance: float = 1e-2
    """Step (rad) at which these solves end: enough to rank bodies."""
    kept: int = 8
    distinct: float = 0.04
    """Bodies of single frames that go on; they place labels further apart than this on average."""
    other_reading: float = 0.15
    """Mean distance of places from which on a candidate is another reading of the capture."""
    alike: int = 3
    """Candidates of the same reading that go through a first round of step 3."""
    close: float = 0.6
    """Cost a label, in step 2, within which another reading is pursued."""
    decided: float = 0.3
    """Share of its cost by which every other reading must cost more."""
    place_spreads: tuple[float, ...] = (0.06, 0.06, 0.04, 0.04)
    """Uncertainty of places in step 3, round by round."""
    distance_spread: float = 0.006
    """How unsure a marker's distance from the skin is, where nothing is known of it."""
    place_sigma: float = 0.02
    """Misfit (sd) of a place on a body of the right shape, by which the best place is chosen,"""
    certainty_sigma: float = 0.025
    """and by which confidences are stated: with it they are right as often as they say."""
    off_body: float = 0.08
    """A label further from the body than this is no marker on its skin."""
    fit: MoshSettings = field(default_factory=lambda: MoshSettings(annealing=(4.0, 2.0, 1.0)))
    """Of the shape stage; starts are good, so the annealing is short."""
    skin: SkinSettings = field(default_factory=SkinSettings)
    description: DescriptionSettings = field(default_factory=DescriptionSettings)


DISCOVER = DiscoverSettings()
