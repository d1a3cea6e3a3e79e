"""Settings of the fit to scans: every constant with its unit and its reason.

The terms that the weights belong to, and full citations, are in `habitus.fit.points`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from habitus.fit.offsets import OFFSETS, OffsetSettings
from habitus.fit.points.scan_colour_settings import SCAN_COLOURS, ScanColourSettings
from habitus.solve.least_squares import Tolerances
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


_DETAILED = ScanStage(
    4,
    points=40_000,
    scale=0.01,
    noise=0.0025,
    least_noise=0.0012,
    renewed_signs=True,
    smoothness=2,
    own_offsets=0.5,
    until=Tolerances(cost=1e-4),
)
_CHOICE = replace(_DETAILED, steps=2, scale=0.02, renewed_signs=False)


@dataclass(frozen=True)
class CleaningSettings:
    """How a scan is prepared. Chosen by hand on scans of several sources; lengths as shares of the
    scan's extent where no unit is given.
    """

    min_extent: float = 0.5
    """Metres; smaller is no person in this unit."""
    max_extent: float = 2.7
    min_points: int = 1000
    max_points: int = 40_000
    """Points that are fitted: more change the surface by less than the scanner's noise."""
    floor_share: float = 0.08
    """Of all points that a plane must hold to be the floor."""
    floor_thickness: float = 0.006
    floor_tries: int = 200
    island_link: float = 0.03
    """Points so close are one piece."""
    island_reach: float = 0.06
    """Pieces so close to the largest are the person's, if they have `island_share` of its points.
    """
    island_share: float = 0.004
    normal_neighbours: int = 16
    """Number of neighbours through which a plane is fitted, for points without normals."""
    normal_radius: float = 0.008
    """Smallest standard deviation (m) of the Gaussian that weights these neighbours by distance."""
    normal_nearest: int = 2
    """Index of the neighbour whose distance is the standard deviation where it is larger (0: the
    point itself)."""
    sign_neighbours: int = 8
    """Of a point, to which the sign of its normal may be carried."""
    outside_points: int = 3000
    """Points that decide which side of them all is outside,"""
    outside_neighbours: int = 24
    """and neighbours each of them is compared with: more than a fold, less than a limb."""


@dataclass(frozen=True)
class SearchSettings:
    """The search for pose and translation from nothing: poses x headings, limbs, refinement.

    Set on 60 simulated people in ten poses (benchmarks/register_scans.py) as the least that finds
    them all. Lengths in metres.
    """

    headings: int = 12
    drawn_poses: int = 60
    """Poses of the bank that are drawn from the pose prior, beside the plain ones."""
    drawn_spread: float = 0.8
    """Standard deviation of the drawn poses, as a share of the pose prior's."""
    triangles: int = 1000
    """Of the body, that are compared with the scan."""
    scored_points: int = 160
    """Of the scan, by which all poses and headings are scored."""
    checked: int = 200
    """Best candidates that are scored from model to scan, too."""
    same_pose: int = 2
    """Candidates with the same pose of the bank that are kept, at most."""
    same_heading: int = 3
    """Candidates with the same heading that are kept, at most."""
    kept: int = 12
    """Candidates that are kept and run through the ``rough`` stages, at most."""
    refined: int = 3
    """Candidates that run through the ``fine`` stages, at most."""
    max_misfit: float = 0.07
    """Metres: with a larger best misfit further candidates are tried. Sound fits lie below."""
    lost_distance: float = 0.1
    """From the best candidate, beyond which a point of the scan is lost,"""
    max_lost: float = 0.004
    """and the share of lost points above which further candidates are tried: less than a hand."""
    widening: int = 2
    """Factor of ``checked``, ``same_pose``, ``same_heading`` and ``kept`` in the wider search."""
    arms_and_legs: int = 4
    """The first limbs of the guesser, tried before any step."""
    max_misfit_ratio: float = 1.4
    """Misfit over the best candidate's, beyond which a candidate is dropped before ``fine``."""
    scan_points: int = 4000
    """Points of the scan that misfits are computed from, at most."""
    compared_points: int = 300
    """Points of the scan, about, by which the poses of a limb are compared."""
    limb_distance: float = 0.025
    """From the rest of the body at which a point may be a limb's."""
    max_distance: float = 0.12
    """At which distances are capped."""
    model_share: float = 0.5
    """Weight of the distance from model to scan beside that from scan to model."""
    prior_share: float = 0.0005
    """Share of ``max_distance`` that one unit of the priors' energy adds to the misfit."""
    rough: tuple[ScanStage, ...] = (
        ScanStage(3, points=500, scale=0.3, noise=0.03, slide=1.0, betas=1),
        ScanStage(4, points=700, scale=0.2, noise=0.02, slide=0.5, betas=3, pose=0.5),
    )
    fine: tuple[ScanStage, ...] = (
        ScanStage(4, points=1000, scale=0.12, noise=0.01, slide=0.3, betas=6, pose=0.3),
        ScanStage(3, points=1500, scale=0.08, noise=0.01, slide=0.2, betas=10, pose=0.5),
    )
    candidates: int = 2
    """Starts that are fitted in full."""
    distinct: float = 0.12
    """Distance between joints from which on two candidates are different poses."""
    max_person_betas: float = 2.8
    """Root mean square of a start's betas beyond which, with ``max_person_distance``, a scan is
    taken for no person's, and not fitted."""
    max_person_distance: float = 0.008
    """Median distance of the scan from such a start."""
    followed_points: int = 5000
    """Points by which it is decided whether a scan of a sequence starts from the one before."""
    followed_distance: float = 0.05
    """Metres from the previous body within which such a point is close."""
    followed_share: float = 0.9
    """Share of these points that must be close."""


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
    """Standard deviations of a joint by itself beyond which its limb is placed anew: no joint of
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
    """From the surface, of a point of a lost piece: beyond wrinkles."""
    lost_radius: float = 0.06
    """Of the ball that holds a lost piece: smaller than a hand."""
    lost_fingers: float = 0.01
    """Share of a scan that is lost at a posed hand up to which no limb is searched; a hand is .5 %.
    """
    lost_mouth: float = 0.02
    """The same at the head; the inside of an open mouth is 1.1 %, a head 6 %."""
    lost_balls: int = 1000
    """Balls that are tried, about."""
    area_neighbours: int = 8
    """Neighbours of a point within which it stands for an area."""
    area_quantile: float = 0.95
    """Of the distances to the last of them, beyond which none counts: a stray point is no area."""


@dataclass(frozen=True)
class SurfaceStage:
    """One solve of the free surface."""

    stiffness: float
    """mu of `free_surface`, the weight of the plate."""
    scale: float
    """Geman-McClure's, metres."""


@dataclass(frozen=True)
class SurfaceSettings:
    """The free surface; lengths in metres. Chosen on scans of simulated people by the error of the
    surface, in holes too.
    """

    plate: float = 9e-7
    """l^4 of `free_surface`, m^4: the plate bends over l = 3.1 cm at stiffness mu = 1."""
    level: float = 0.03
    """r of `free_surface`, metres, over which an offset levels out where there is no scan."""
    decay: float = 0.6
    """R of `free_surface`, metres, over which an offset returns to the model."""
    crease: float = 0.1
    """b of `free_surface`: weight of the plate of the offset vector over that of its length."""
    fine_mesh: float = 0.012
    """Where triangles are smaller (fingers, toes, face), the plate is stiffer in proportion."""
    min_cosine: float = 0.5
    """Between normals of a correspondence."""
    points: int = 20_000
    """Of a scan that its free surface is fitted to, at most."""
    stages: tuple[SurfaceStage, ...] = (
        SurfaceStage(0.1, 0.02),
        SurfaceStage(0.01, 0.01),
        SurfaceStage(0.003, 0.01),
    )
    stretched: float = 0.0018
    """Distance of a twentieth of the scan's points that calls for offsets in all directions,"""
    stretched_share: float = 0.0025
    """and share of the scan that lies together off the surface, that does: a cleft, genitals,
    fingers; half of what is a doubt."""
    off_distance: float = 0.003
    """Median distance from the surface, of the scan's points around a vertex, up to which it is
    held then; from twice that on it is free."""
    off_neighbours: int = 12
    """Points around a vertex, for that: a few strays among them free nothing."""
    stretched_stages: tuple[SurfaceStage, ...] = (
        SurfaceStage(0.1, 0.03),
        SurfaceStage(0.01, 0.02),
        SurfaceStage(0.003, 0.01),
    )
    cut_shrinkage: float = 0.7
    """Share of an offset that is kept, each round, where the surface cuts itself."""
    cut_rings: int = 1
    """Vertices within so many edges of a cut are drawn back half as far."""
    cut_rounds: int = 20
    """Rounds, at most."""
    covering: float = 0.004
    """From a vertex within which a point of the scan covers it, however dense the scan is,"""
    covering_spacings: float = 2.0
    """and the same in median distances of the scan's points."""


@dataclass(frozen=True)
class ClothesSettings:
    """What a scanned person wears (`habitus.fit.points.clothes`); metres. Chosen by hand, tried on
    benchmarks/clothed_people.py.
    """

    thickness: float = 0.0
    """Of tight clothes on trunk and thighs."""
    hair: float = 0.0
    """Thickness of flat hair."""
    ease: float = 0.0
    """Mean distance by which cloth hangs off the skin: everywhere but on head, hands, feet and the
    joints of ``bare``."""
    bare: tuple[str, ...] = ("neck",)
    hair_ease: float = 0.0
    """The same of hair."""
    points: int = 1500
    """All points of hanging cloth count as so many at most: neighbours hang alike."""
    touching: float = 0.003
    """Distance from the surface up to which a point is no hanging cloth."""
    aside: float = 0.5
    """Cosine between normals of scan and surface below which a point is."""
    furthest: float = 0.12
    """Distance beyond which it is neither."""

    @property
    def covers_hair(self) -> bool:
        """Whether these settings describe hair."""
        return self.hair > 0.0 or self.hair_ease > 0.0


CLOTHES: Mapping[str, ClothesSettings] = MappingProxyType(
    {
        "none": ClothesSettings(),
        "tight": ClothesSettings(thickness=0.001, hair=0.003),
        "loose": ClothesSettings(thickness=0.001, hair=0.003, ease=0.025, hair_ease=0.01),
    }
)
"""By the name of `habitus register --clothes`."""


@dataclass(frozen=True)
class HairSettings:
    """Hair of a scan that is registered as it is (`habitus.fit.points.clothes`); metres. Chosen on
    seven people of benchmarks/wide_people.py.
    """

    hairline: float = 0.3
    """Share of the way from the head's joint to its top from which hair may grow in front."""
    weight: float = 0.01
    """`ScanStage.scalp_weight` once the pose is known."""
    points: int = 10_000
    """Of a scan from which the thickness is measured, at most:"""
    least_scalp: float = 0.9
    """those where hair may grow so surely (0..1)."""
    most_thickness: float = 0.08
    """Points further from the model are no hair."""
    least_thickness: float = 0.01
    """Thinner hair counts as none: models that measure some of it on bald people differ by as much.
    """


@dataclass(frozen=True)
class ScanSettings:
    """All constants of `habitus.register_scans`; lengths in metres, angles in rad."""

    stages: tuple[ScanStage, ...] = (
        ScanStage(4, points=2000, scale=0.08, noise=0.01, slide=0.2, betas=10),
        ScanStage(5, points=3000, scale=0.05, noise=0.005, slide=0.1, betas=24),
    )
    """Each scan by itself, after the search."""
    offset_stages: tuple[ScanStage, ...] = (
        ScanStage(3, points=8000, scale=0.05, noise=0.01),
        ScanStage(2, points=16_000, scale=0.03, noise=0.004),
    )
    """All scans together, with skin offsets, by each body. The noise is that of a point which the
    offset does not explain: of the scanner, and of finer forms of the skin.
    """
    last_stages: tuple[ScanStage, ...] = (
        _DETAILED,
        replace(_DETAILED, steps=3, scale=0.005, noise=0.0015, least_noise=0.0008),
        replace(_DETAILED, steps=2, scale=0.003, noise=0.001, least_noise=0.0006),
    )
    """The same by the body that was chosen, in full detail. Noise and scale of the first throughout
    leave 33 people of benchmarks/wide_people.py 1.2 times as far from the truth; with the last
    one's noise throughout fewer of them are right (3 mm)."""
    choice_stage: ScanStage = _CHOICE
    """Steps after which one of two bodies is chosen, and noise and scale of the energies that are
    compared before. With a smaller scale the wrong body's worst points cost too little."""
    scale_ratio: float = 3.0
    """With skin offsets a stage's scale is at least so many times the median distance of the
    points, two standard deviations of their noise: a noisy scan keeps its points."""
    damping: float = 1e-4
    """Levenberg-Marquardt's at the start, relative to the diagonal."""
    max_joint_step: float = 0.6
    """Of a rotation vector in one step: beyond it linearised rotations are wrong."""
    effective_points: float = 1500.0
    """All points of a scan count as so many at most: what is left of a scan is not independent
    noise.
    """
    model_min_cosine: float = 0.3
    """Between normals of a correspondence, without skin offsets."""
    offset_min_cosine: float = 0.5
    """Between normals of a correspondence, with skin offsets."""
    orientation_distance: float = 0.03
    """From the model within which it decides the sign of a scan's normals."""
    shape_change: float = 0.5
    """Sd of betas between frames of a sequence, in those of people."""
    offset_change: float = 0.8
    """Sd of skin offsets between frames, in that of the offsets."""
    matched_distance: float = 0.05
    """Metres from the surface within which a point counts as the body's."""
    matched_cosine: float = 0.3
    """Between normals, from which on a point counts as the body's."""
    one_person: float = 0.02
    """Metres (RMS) by which the shape of a scan by itself may be off the median of a person's
    scans: beyond it the scan is registered by itself. Six right scans of two people in extreme
    poses are off by 2 to 9 mm, two with a wrong arm by 32 and 74."""
    similar_bodies: float = 0.005
    """Sd (m) within which another body's vertices are put on the first one's."""
    offsets: OffsetSettings = OFFSETS
    cleaning: CleaningSettings = CleaningSettings()
    search: SearchSettings = SearchSettings()
    ends: LimbEndSettings = LimbEndSettings()
    limbs: LimbSettings = LimbSettings()
    surface: SurfaceSettings = SurfaceSettings()
    clothes: ClothesSettings = CLOTHES["none"]
    hair: HairSettings = HairSettings()
    colours: ScanColourSettings = SCAN_COLOURS

    @property
    def all_offset_stages(self) -> tuple[ScanStage, ...]:
        """All stages with skin offsets."""
        return *self.offset_stages, *self.last_stages


SCANS = ScanSettings()
