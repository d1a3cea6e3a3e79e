"""Settings of labelling: every constant of the recipe (`habitus.fit.labels.recipe`).

Tuned on captures whose labels were hidden (`benchmarks/labelling.py`, `labelling_people.py`).
Lengths are metres.
"""

from dataclasses import dataclass, field

from habitus.fit.markers.settings import MoshSettings


@dataclass(frozen=True)
class TrackletSettings:
    """Links of points from frame to frame: only where no other point is nearly as near."""

    gate: float = 0.02
    """From the predicted point, at least; at low rates what 1.5 m/s of error makes of a frame."""
    speed: float = 5.0
    """Metres a second of a point whose motion is not known yet."""
    max_gap: int = 4
    """Frames that a point may be hidden."""
    ratio: float = 1.6
    """Times further that the second-nearest point must be."""


@dataclass(frozen=True)
class RegistrationSettings:
    """A body registered to single frames of unlabelled points: multi-start, then annealing."""

    headings: int = 8
    """About the up axis; 45 degrees are within the first round's reach."""
    soft: tuple[tuple[float, float, int], ...] = (
        (0.15, 100.0, 99),
        (0.12, 50.0, 99),
        (0.12, 20.0, 16),
        (0.12, 6.0, 99),
        (0.09, 4.0, 6),
        (0.07, 3.0, 99),
        (0.05, 2.0, 99),
        (0.04, 1.0, 4),
    )
    """Rounds of soft assignment: its spread, the weight of the pose prior, and how many hypotheses
    of a frame go on."""
    firm: tuple[float, ...] = (0.20, 0.16, 0.12, 0.12)
    """Gates of the one-to-one matches that follow."""
    sweeps: int = 3
    """Damped Gauss-Newton steps a round."""
    tolerance: float = 1e-2
    """Last step (rad, RMS) below which a frame has converged: that of the marker fit's starts."""
    tolerance: float = 1e-2
    """Last step (rad, metres; RMS) below which a frame has converged."""
    outlier: float = 0.011
    """exp(-d^2 / 2 spread^2) of a point that belongs to no marker: 3 spreads."""
    ranking_gate: float = 0.25
    """Of the matches that rank hypotheses."""


@dataclass(frozen=True)
class ExchangeSettings:
    """Exchanges of labels of close markers, each judged by poses solved for it."""

    distance: float = 0.16
    """Between markers that may be confused, at the median of the frames."""
    sweeps: int = 6
    """Damped Gauss-Newton steps from the poses without the exchange."""
    rounds: int = 4
    """Of exchanges, at most; each may make others worth while."""
    certainty: float = 2.0
    """Per unit of a frame's mean cost that an exchange adds: the logit of the label."""


@dataclass(frozen=True)
class VoteSettings:
    """Votes of registered frames on the label of each tracklet, and confidences."""

    rounds: int = 4
    """Of votes and trust in the seeds that agree with them."""
    clear: float = 0.6
    """Share of a tracklet's votes that its label must have."""
    shape_seeds: int = 10
    """Frames that the shape is estimated from."""
    min_spread: float = 0.012
    """Smallest standard deviation of a marker about its prediction."""
    nothing: float = 0.0024787521766663585
    """exp(-6): likelihood that a point is no marker."""
    likely: float = 0.5
    """Confidence below which a label is refused."""
    farthest: float = 12.0
    """Half the squared distance in spreads above which a single point's label is refused."""
    max_distance: float = 0.30
    """At which distances from markers are cut: larger than any gate."""


@dataclass(frozen=True)
class ClusterSettings:
    """Markers that a layout has at one place, told from each other by where they sit."""

    starts: int = 5
    """Frames whose points are tried as the places to begin with."""
    rounds: int = 10
    """Of points to markers and places to medians, at most; it ends where these stay."""
    reach: float = 0.2
    """From a cluster's place: points without a label there are its own. Chosen by hand: about twice
    the width of a plate."""


@dataclass(frozen=True)
class PeopleSettings:
    """Points of several people, clustered by where these stand on the ground."""

    start_frames: int = 24
    """Frames of which tracking begins at the one with the best separated clusters."""
    rounds: int = 8
    """Of k-medians a frame, at most; it ends where the centres stay."""


@dataclass(frozen=True)
class LabelSettings:
    """Settings of labelling, a section for each step; fit: of the shape stage and the poses."""

    doubtful: float = 0.9
    """Confidence below which a label is reported as doubtful."""
    heights: tuple[float, ...] = (1.25, 1.45, 1.6, 1.75, 1.9)
    """Bodies that single frames are tried on."""
    sizing_frames: int = 8
    """Frames that the height is found from."""
    seeds: int = 24
    """Frames that are registered by themselves and vote."""
    exchange_frames: int = 30
    """Frames in which exchanges of close markers are tried."""
    people_rounds: int = 2
    """Of labels for several people, whose points are clustered again by the fitted bodies."""
    shape_rounds: int = 2
    """Of shape and exchanges, at most."""
    gates: tuple[float, ...] = (0.20, 0.15)
    """A tracklet further from every marker has no label, round by round."""
    layout_frames: int = 4
    """Frames that each shipped layout is tried on, where none is given."""
    layout_size: tuple[float, float] = (0.6, 1.5)
    """Markers of a layout over points of a frame, within which it is tried."""
    layout_margin: float = 0.10
    """Share by which the next layout must cost more for a choice that is certain."""
    min_points: int = 6
    """In the fullest frame."""
    place_weight: float = 800.0
    """Per m^2, of markers at the layout's places, whose spread is 2 cm and more."""
    unlabelled_weight: float = 2500.0
    """Per m^2, of markers at places that were estimated: 1/(2 cm)^2."""
    tracklets: TrackletSettings = field(default_factory=TrackletSettings)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    exchanges: ExchangeSettings = field(default_factory=ExchangeSettings)
    votes: VoteSettings = field(default_factory=VoteSettings)
    clusters: ClusterSettings = field(default_factory=ClusterSettings)
    people: PeopleSettings = field(default_factory=PeopleSettings)
    fit: MoshSettings = field(default_factory=MoshSettings)


TRACKLETS = TrackletSettings()
REGISTRATION = RegistrationSettings()
EXCHANGES = ExchangeSettings()
VOTES = VoteSettings()
CLUSTERS = ClusterSettings()
PEOPLE = PeopleSettings()
LABELS = LabelSettings()
