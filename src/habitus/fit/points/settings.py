"""Settings of the fit to scans: every constant with its unit and its reason.

The terms that the weights belong to, and full citations, are in `habitus.fit.points`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from habitus.fit.offsets import OFFSETS, OffsetSettings
from habitus.fit.points.limb_settings import LIMB_ENDS, LIMBS, LimbEndSettings, LimbSettings
from habitus.fit.points.scan_colour_settings import SCAN_COLOURS, ScanColourSettings
from habitus.fit.points.scan_stage import ScanStage
from habitus.solve.least_squares import Tolerances

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
    island_reach: float = 0.09
    """Pieces so close to the largest are the person's, if they have `island_share` of its points: a
    hand beyond a forearm of which 10 cm were not seen.
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
    """Hair that scans and depth views show as it is (`habitus.fit.points.clothes`); metres. Chosen
    on seven scans of benchmarks/wide_people.py.
    """

    hairline: float = 0.3
    """Share of the way from the head's joint to its top from which hair may grow in front."""
    weight: float = 0.01
    """`ScanStage.scalp_weight` once the pose is known; for depth, `DepthStage.scalp_weight`."""
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
    """Steps after which one of two bodies is chosen; its noise and scale are those of all energies
    that are compared. With a smaller scale the points farthest off the wrong body cost too little.
    """
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
    ends: LimbEndSettings = LIMB_ENDS
    limbs: LimbSettings = LIMBS
    surface: SurfaceSettings = SurfaceSettings()
    clothes: ClothesSettings = CLOTHES["none"]
    hair: HairSettings = HairSettings()
    colours: ScanColourSettings = SCAN_COLOURS

    @property
    def all_offset_stages(self) -> tuple[ScanStage, ...]:
        """All stages with skin offsets."""
        return *self.offset_stages, *self.last_stages


SCANS = ScanSettings()
