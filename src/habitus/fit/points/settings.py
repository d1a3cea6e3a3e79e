"""Settings of the fits to scans and to depth views: every constant with its unit and its reason."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from habitus.fit.offsets import OFFSETS, OffsetSettings
from habitus.solve.alternate import Stage
from habitus.solve.least_squares import Tolerances

ALL_BETAS = 1000
"""More than any body has."""


@dataclass(frozen=True, kw_only=True)
class DepthStage(Stage):
    """Steps of the fit to depth views; `steps` correspondences are made in it.

    moves: "place" (translation and root), "pose" or "all". matching: "nearest" (the closest surface
    point in space) or "pixel" (the one at the same pixel). stride: of pixels in both directions.
    scales: Geman-McClure's, at the first step and the last, m: a pixel so far off weighs a quarter.
    It is the robust norm of T eq. 4.5, whose loss ends below the absolute value.
    """

    moves: str
    matching: str
    stride: int
    scales: tuple[float, float]


STAGES = (
    DepthStage(3, moves="place", matching="nearest", stride=4, scales=(0.15, 0.15)),
    DepthStage(4, moves="pose", matching="nearest", stride=4, scales=(0.15, 0.10)),
    DepthStage(2, moves="all", matching="nearest", stride=4, scales=(0.10, 0.08)),
    DepthStage(3, moves="all", matching="pixel", stride=4, scales=(0.08, 0.06)),
    DepthStage(6, moves="all", matching="pixel", stride=2, scales=(0.06, 0.03)),
)
"""Nearest points forgive a start that is off but shrink girths under noise; the same pixel is
unbiased near it.
"""

STIFF = (
    "knee",
    "spine1",
    "spine2",
    "spine3",
    "collar",
    "wrist",
    "foot",
    "ankle",
    "hand",
    "head",
    "neck",
)


FOLDED = (70.0, 95.0, 50.0)
"""Forearms before the belly."""


@dataclass(frozen=True)
class RgbdSettings:
    """What the fit weighs (T 4.6.1). Metres and radians.

    depth: E_D's share of each full-size pixel's certainty, as neighbouring pixels err alike. shape,
    pose: of E_S (a beta of 1) and E_P, whose spreads are ``pose_sd`` and, of joints that hardly
    bend when people stand, ``stiff_sd``. outline: of pixels of the model before background that was
    seen. colour: E_C's share of each full-size pixel's certainty; rim: times that, where the
    surface turns away; colour_levels: full-size pixels along the side of one of the pyramid's, for
    each step with colour. floor, floor_sd: E_F. slide: share of point to point while the nearest
    point is sought. noise: sd of depth over its square, where the views do not tell it; model_sd:
    what no body of the model explains. skin: spread of the skin's offset from the model, in
    `registration.offset_stage`'s; skin_reach: metres from where on it is alike no more;
    skin_places: how many values tell it; skin_depth: E_D's share once the offset explains what
    neighbours have in common; skin_steps: by depth, before those with colour. max_step: the
    most that a number changes in a step (m, rad, sd). damping: Levenberg-Marquardt's at the start,
    relative to the diagonal. clothes, hair: metres
    that tight clothes and flat hair under a cap lie on the skin, which are taken off. arms, turns:
    tried at the start: how arms are held, in degrees (below the level, bent at the elbow, turned
    inwards about the upper arm), and how far the person is turned from facing the camera.
    """

    stages: tuple[DepthStage, ...] = STAGES
    depth: float = 0.02
    shape: float = 1.0
    pose: float = 2.0
    pose_sd: float = 0.2
    stiff_sd: float = 0.1
    outline: float = 0.2
    outline_sd: float = 0.01
    colour: float = 0.02
    rim: float = 3.0
    colour_levels: tuple[int, ...] = (4, 4, 2, 2)
    floor: float = 2.0
    floor_sd: float = 0.01
    slide: float = 0.1
    noise: float = 1.5e-3
    model_sd: float = 0.003
    arms: tuple[tuple[float, float, float], ...] = (
        (10.0, 0.0, 0.0),
        (45.0, 0.0, 0.0),
        (72.0, 0.0, 0.0),
        FOLDED,
    )
    skin: float = 0.75
    skin_reach: float = 0.19
    skin_places: int = 120
    skin_depth: float = 0.1
    skin_steps: int = 4
    max_step: Mapping[str, float] = field(
        default_factory=lambda: {"trans": 0.5, "pose": 0.4, "betas": 1.5}
    )
    damping: float = 1e-6
    clothes: float = 0.001
    hair: float = 0.003
    turns: tuple[float, ...] = (0.0, 45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)


STANDARD = RgbdSettings()


@dataclass(frozen=True, kw_only=True)
class ScanStage(Stage):
    """Steps of the fit of a body to scans, all alike; `steps` correspondences are made in it.

    points: of each scan. scale: Geman-McClure's, m: a point so far off weighs a quarter. noise: sd
    of a point, m. slide: weight of point to point beside point to plane, which alone lets surfaces
    slide. betas: the first so many are free. pose, shape: factors of the priors.
    """

    points: int
    scale: float
    noise: float
    slide: float = 0.0
    betas: int = ALL_BETAS
    pose: float = 1.0
    shape: float = 1.0


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


@dataclass(frozen=True)
class SearchSettings:
    """The search for pose and translation from nothing: poses x headings, limbs, refinement.

    Set on 60 simulated people in ten poses (benchmarks/register_scans.py) as the least that finds
    them all. Lengths in metres.
    """

    headings: int = 12
    drawn_poses: int = 60
    """Poses of the bank drawn from the pose prior, beside the plain ones,"""
    drawn_spread: float = 0.8
    """with this share of its standard deviation."""
    triangles: int = 1000
    """Of the body, that are compared with the scan."""
    scored_points: int = 160
    """Of the scan, by which all poses and headings are scored."""
    checked: int = 200
    """Best candidates that are scored from model to scan, too."""
    same_pose: int = 2
    """Candidates with one pose of the bank that go on at most,"""
    same_heading: int = 3
    """and with one heading,"""
    kept: int = 12
    """and in all."""
    refined: int = 3
    max_misfit: float = 0.07
    """Above the misfit of people: the search then is widened"""
    widening: int = 2
    """so many times."""
    arms_and_legs: int = 4
    """The first limbs of the guesser, tried before any step."""
    hopeless: float = 1.4
    """Misfit relative to the best at which a candidate is dropped."""
    scan_points: int = 4000
    compared_points: int = 300
    limb_distance: float = 0.025
    """From the rest of the body at which a point may be a limb's."""
    max_distance: float = 0.12
    """At which distances are capped."""
    model_share: float = 0.5
    """Weight of the distance from model to scan beside that from scan to model."""
    per_nat: float = 0.0005
    """Mean distance worth one unit of the priors' energy."""
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
    followed_points: int = 5000
    followed_distance: float = 0.05
    followed_share: float = 0.9
    """A scan goes on from the one before where so large a share of so many points is so close."""


@dataclass(frozen=True)
class LimbSettings:
    """Hands, feet and arms turned, lost limbs searched again; chosen by hand; metres and rad."""

    radius: float = 0.13
    """Of a hand or foot, within which points are its own."""
    min_points: int = 40
    max_points: int = 500
    other_points: int = 500
    max_distance: float = 0.03
    """At which distances of a hand's points are capped."""
    free_sd: float = 0.6
    """Of the wrist or ankle that is tried,"""
    held_sd: float = 0.03
    """and of all other joints, about where they are."""
    stages: tuple[ScanStage, ...] = (
        ScanStage(5, points=1000, scale=0.05, noise=0.005, slide=0.2, betas=0),
        ScanStage(3, points=1000, scale=0.02, noise=0.005, slide=0.1, betas=0),
    )
    per_nat: float = 0.0003
    """Mean distance of a hand's points worth one unit of the pose prior's energy."""
    rounds: int = 2
    """Searches for lost limbs."""
    whole_limbs: int = 5
    """Arms, legs and head: the first of the guesser's limbs."""
    margin: float = 0.1
    """A limb so much further from the lost piece than the closest one is tried, too."""
    quick: tuple[ScanStage, ...] = (ScanStage(2, points=6000, scale=0.03, noise=0.004),)
    checked_points: int = 20_000
    improvement: float = 0.7
    """Of the lost share, that may be left for a limb to count as found."""


@dataclass(frozen=True)
class SurfaceStage:
    """One solve of the free surface: stiffness of the plate, Geman-McClure's scale (m)."""

    stiffness: float
    scale: float


@dataclass(frozen=True)
class SurfaceSettings:
    """The free surface; lengths in metres. Chosen on scans of simulated people by the error of the
    surface, in holes too.
    """

    plate: float = 1e-3 * 0.03**2
    """l^4, m^4: the plate bends over some 3 cm."""
    level: float = 0.03
    """r, over which an offset levels out where there is no scan."""
    decay: float = 0.6
    """R, over which it returns to the model."""
    crease: float = 0.1
    """Weight of the offset's plate as a vector beside that of its length."""
    fine_mesh: float = 0.012
    """Where triangles are smaller (fingers, toes, face), the plate is stiffer in proportion."""
    min_cosine: float = 0.5
    points: int = 20_000
    stages: tuple[SurfaceStage, ...] = (
        SurfaceStage(0.1, 0.02),
        SurfaceStage(0.01, 0.01),
        SurfaceStage(0.003, 0.01),
    )
    stretched: float = 0.0018
    """Distance of a twentieth of the scan's points that calls for offsets in all directions."""
    stretched_stages: tuple[SurfaceStage, ...] = (
        SurfaceStage(0.1, 0.03),
        SurfaceStage(0.01, 0.02),
        SurfaceStage(0.003, 0.01),
    )
    cut_shrinkage: float = 0.7
    """What is left of an offset, each round, where the surface cuts itself;"""
    cut_rings: int = 1
    """vertices so many edges around go back half as far;"""
    cut_rounds: int = 20


@dataclass(frozen=True)
class ScanColourSettings:
    """Agreement of the colours of several scans; chosen by benchmarks/register_textures.py. Metres,
    linear light.
    """

    dark: float = 0.004
    """Light below which all is black."""
    noise: float = 0.008
    """Sd of a camera's pixels."""
    certain: float = 0.1
    """Noise of a tone that halves its weight."""
    scale: float = 0.006
    """Geman-McClure's, of coloured points from the surface."""
    min_cosine: float = 0.4
    smoothings: int = 3
    """Times that the texture is averaged over neighbouring nodes."""
    light_rounds: int = 3
    """Alternations of light and texture."""
    light_ridge: float = 0.01
    """Weight of no light at all against that of all points."""
    gain_pieces: int = 2
    gain_smoothings: int = 20
    """Of the gain that no harmonic explains, on a grid with so many pieces an edge."""
    passes: int = 2
    """Of Barnes' scheme: without these a tone is that of the middle of some points."""
    min_points: float = 0.1
    """Coloured points for each node from which on its tone counts,"""
    min_share: float = 0.6
    """and their share of what other scans have there."""
    compared: float = 0.5
    """Confidence of a tone from which on it is compared."""
    grain: float = 22.0
    """Pieces of a grid for each independent tone of a texture averaged so often."""
    max_points: int = 200_000
    pieces: int = 4
    """Pieces an edge of the texture that is returned."""
    slide_sd: float = 0.001
    slide_range: float = 0.12
    """Of the field by which a surface slides beside the model's."""
    skin_slide_sd: float = 0.002
    """By which the model's skin slides on the person's, whatever its pose."""
    effective_points: float = 1500.0
    """All coloured points of a scan count as so many for the model."""
    model_points: int = 15_000
    surface_points: int = 60_000
    coarse: tuple[int, ...] = (2, 4)
    """Pieces an edge of the grids for pose and shape,"""
    fine: tuple[int, ...] = (4, 4)
    """and for surfaces."""


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
        ScanStage(3, points=40_000, scale=0.02, noise=0.0025, until=Tolerances(cost=1e-4)),
    )
    """All scans together, with skin offsets. The noise is that of a point which the offset does not
    explain: of the scanner, and of finer forms of the skin.
    """
    damping: float = 1e-4
    """Levenberg-Marquardt's at the start, relative to the diagonal."""
    max_joint_step: float = 0.6
    """Of a rotation vector in one step: beyond it linearised rotations are wrong."""
    effective_points: float = 1500.0
    """All points of a scan count as so many at most: what is left of a scan is not independent
    noise.
    """
    model_min_cosine: float = 0.3
    """Between normals of a correspondence, without offsets,"""
    offset_min_cosine: float = 0.5
    """and with them."""
    orientation_distance: float = 0.03
    """From the model within which it decides the sign of a scan's normals."""
    shape_change: float = 0.5
    """Sd of betas between frames of a sequence, in those of people."""
    offset_change: float = 0.8
    """Sd of skin offsets between frames, in that of the offsets."""
    matched_distance: float = 0.05
    """From the surface within which a point counts as the body's, with normals within"""
    matched_cosine: float = 0.3
    similar_bodies: float = 0.005
    """Sd (m) within which another body's vertices are put on the first one's."""
    offsets: OffsetSettings = OFFSETS
    cleaning: CleaningSettings = CleaningSettings()
    search: SearchSettings = SearchSettings()
    limbs: LimbSettings = LimbSettings()
    surface: SurfaceSettings = SurfaceSettings()
    colours: ScanColourSettings = ScanColourSettings()


SCANS = ScanSettings()
