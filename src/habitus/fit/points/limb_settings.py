"""Settings of the search for poses by the ends of limbs, and of limbs searched again."""

from dataclasses import dataclass

from habitus.fit.points.scan_stage import ScanStage


@dataclass(frozen=True)
class LimbEndSettings:
    """Poses by the ends of the limbs (`habitus.fit.points.limb_ends`); lengths in metres. Chosen by
    hand, tried on twenty people in poses of real motions (benchmarks/wide_people.py --motions).
    """

    points: int = 2500
    """Of a scan, among which its ends are found."""
    neighbours: int = 10
    min_cosine: float = -0.2
    """Between normals, above which neighbours are connected: limbs that face each other are not."""
    sources: int = 60
    """Points from which distances over the surface are averaged."""
    reach: float = 0.22
    """Geodesic distance from an end within which it is the local maximum."""
    most_ends: int = 8
    middle_share: float = 0.05
    """Share of the surface that is its middle,"""
    middle_step: int = 20
    """and the step through the body's vertices there."""
    namings: int = 24
    """Assignments of ends to head, hands and feet that are tried."""
    missing_distance: float = 0.05
    """Penalty for an end that is not found, as a mean error (m) of the distances between ends,"""
    missing: float = 20.0
    """and as an energy of the state."""
    kept: int = 8
    """Starts, at most."""
    end_sd: float = 0.03
    """Of an end about its target: fists are shorter than hands."""
    middle_sd: float = 0.06
    """The same of the middle."""
    stages: tuple[ScanStage, ...] = (ScanStage(8, points=0, scale=0.1, noise=0.03, betas=1),)
    """With the ends alone,"""
    cloud_stages: tuple[ScanStage, ...] = (
        ScanStage(5, points=700, scale=0.3, noise=0.03, slide=0.5, betas=3),
        ScanStage(4, points=700, scale=0.2, noise=0.03, slide=0.3, betas=3),
    )
    """and with all of the scan."""


@dataclass(frozen=True)
class LimbSettings:
    """Limbs turned, hands posed, lost limbs searched again; chosen by hand; metres and rad."""

    radius: float = 0.13
    """Of a hand or foot, within which points are its own."""
    min_points: int = 40
    max_points: int = 500
    other_points: int = 500
    max_distance: float = 0.03
    """At which distances of a hand's points are capped."""
    free_sd: float = 0.6
    """Prior sd (rad) of the wrist or ankle that is tried, about its pose."""
    held_sd: float = 0.03
    """Prior sd (rad) of all other joints meanwhile, about their pose."""
    stages: tuple[ScanStage, ...] = (
        ScanStage(5, points=1000, scale=0.05, noise=0.005, slide=0.2, betas=0),
        ScanStage(3, points=1000, scale=0.02, noise=0.005, slide=0.1, betas=0),
    )
    hand_stages: tuple[ScanStage, ...] = (
        ScanStage(3, points=1000, scale=0.05, noise=0.005, slide=0.2, betas=0),
        ScanStage(4, points=1000, scale=0.02, noise=0.005, slide=0.1, betas=0),
    )
    """The same for hands."""
    hands_refined: int = 7
    """Of the poses of a hand, those of which more than the first misfit is looked at."""
    prior_distance: float = 0.0003
    """Metres that one unit of the pose prior's energy adds to the mean distance of a hand's points.
    """
    rounds: int = 2
    """Searches for lost limbs."""
    whole_limbs: int = 5
    """Arms, legs and head: the first of the guesser's limbs."""
    unusual: float = 5.0
    """Standard deviations of a joint by itself beyond which its limb is searched again: no joint of
    643 frames of ten captures is beyond 4.5; collars of arms turned about themselves are at 6 to
    14."""
    twisted: float = 3.0
    """The same of a forearm with its hand, twisted about the forearm (`limbs.forearm_twists`): no
    more than 1.9 in 1159 frames of six captures, 3.6 and 4.3 of two that are half a turn off.
    """
    most_twisted: float = 4.0
    """The same (110 degrees), beyond which no hand is tried palm or back up, and forearms are
    turned back after the fit."""
    margin: float = 0.1
    """A limb so much further from the lost piece than the closest one is tried, too."""
    quick: tuple[ScanStage, ...] = (ScanStage(2, points=6000, scale=0.03, noise=0.004),)
    checked_points: int = 20_000
    improvement: float = 0.7
    """Of the lost share, that may be left for a limb to count as found."""
    lost_distance: float = 0.006
    """From the surface, of a point of a lost piece: beyond wrinkles;"""
    lost_in_folds: float = 0.015
    """on trunk, arms and legs, in the verdict: a squatting woman's surface, right within 2.7 mm, is
    6 to 14 mm off between belly and thighs, on 1.1 % of the scan."""
    lost_radius: float = 0.06
    """Of the ball that holds a lost piece: smaller than a hand."""
    lost_fingers: float = 0.01
    """Share of a scan that is lost at a posed hand up to which no limb is searched; a hand is .5 %.
    """
    lost_mouth: float = 0.02
    """The same at the head; the inside of an open mouth is 1.1 %, a head 7 %."""
    lost_balls: int = 1000
    """Balls that are tried, about."""
    area_neighbours: int = 8
    """Neighbours of a point within which it stands for an area."""
    area_quantile: float = 0.95
    """Of the distances to the last of them, beyond which none counts: a stray point is no area."""


LIMB_ENDS = LimbEndSettings()
LIMBS = LimbSettings()
