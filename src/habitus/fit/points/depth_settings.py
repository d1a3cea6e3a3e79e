"""Settings of the fit to depth views: every constant with its unit and its reason.

The terms that the weights belong to, and full citations, are in `habitus.fit.points`. Constants
without another source were chosen by hand on simulated people before the noise of two sensors
(benchmarks/rgbd_people.py).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

from habitus.fit.offsets import OFFSETS
from habitus.fit.points.settings import HairSettings
from habitus.solve.minimize import Stage


@dataclass(frozen=True, kw_only=True)
class DepthStage(Stage):
    """Steps of the fit to depth views; `steps` correspondences are made in it.

    moves: "place" (translation and root), "pose" or "all". matching: "nearest" (the closest surface
    point in space) or "pixel" (the one at the same pixel). stride: of pixels in both directions.
    scales: Geman-McClure's, at the first step and the last, m: a pixel so far off weighs a quarter.
    It is the robust norm of thesis eq. 4.5, whose loss ends below the absolute value. scale_ratio:
    the scale is at least so many times the median distance of a view's pixels.
    scalp_weight: factor of the weight of drawn points where hair may grow, before hair is measured
    and, where it is thick, afterwards. At 1 the head grows until it fills the hair.
    """

    moves: str
    matching: str
    stride: int
    scales: tuple[float, float]
    scale_ratio: float = 0.0
    scalp_weight: float = 1.0


HAIR = HairSettings(hairline=0.5, least_thickness=0.007)
"""The lower half of a forehead, seen from the front, has no hair. Flat hair measures up to 6 mm."""

_shape_stage = partial(DepthStage, moves="all", scalp_weight=HAIR.weight)

STAGES = (
    DepthStage(3, moves="place", matching="nearest", stride=4, scales=(0.15, 0.15)),
    DepthStage(4, moves="pose", matching="nearest", stride=4, scales=(0.15, 0.10)),
    _shape_stage(2, matching="nearest", stride=4, scales=(0.10, 0.08)),
    _shape_stage(3, matching="pixel", stride=4, scales=(0.08, 0.06)),
    _shape_stage(6, matching="pixel", stride=2, scales=(0.06, 0.03)),
)
"""Nearest points forgive a start that is off but shrink girths under noise; the same pixel is
unbiased near it. The shape is fitted with hardly any of the scalp, as hair is not yet measured.
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
"""Parts of the names of joints that hardly bend when people stand."""

FOLDED = (70.0, 95.0, 50.0)
"""Degrees, in the order of `DepthSearchSettings.arms`: forearms before the belly."""


NOISE = 1.5e-3
"""Standard deviation of depth over its square (1 / m) where nothing gives it: Kinect v1's."""


@dataclass(frozen=True)
class SegmentationSettings:
    """How floor and person are found in a depth image; metres where no unit is given."""

    floor_tries: int = 300
    """Planes through three points: one that holds a quarter of the points is among them with a
    probability of 0.99."""
    floor_points: int = 4000
    """Points by which planes are scored."""
    floor_distance: float = 0.01
    """Within which a point counts as on the plane,"""
    floor_noise: float = 0.006
    """and this times its squared depth more (1 / m): four times `RgbdSettings.noise`."""
    max_tilt: float = 40.0
    """Degrees between a floor's normal and the camera's up axis."""
    min_floor_share: float = 0.02
    """Of the image's points on a plane that makes it a floor."""
    max_below: float = 0.02
    """Share of the points that may lie below a floor: mirrors and errors."""
    min_camera_height: float = 0.2
    """Of the camera above a floor: seats and tables are nearer."""
    min_floor_points: int = 500
    """Points of an image in which a floor is looked for."""
    min_pixels: int = 400
    """Of a person: with fewer, pose and shape are the priors'."""
    jump: float = 0.05
    """Difference of neighbouring pixels that separates two surfaces."""
    above_floor: float = 0.03
    """Height from which on a point is not of the floor."""
    max_height: float = 2.4
    """Height up to which a point may be a person's."""
    min_height: float = 0.9
    """Of a person's visible part, where all people of a view are asked for."""
    min_thickness: float = 0.03
    """Of a person's points (sd) off the plane through them: walls have less."""
    max_lowest: float = 1.0
    """Above the floor, of the lowest point of a person who is cut off or hidden below."""
    max_width: float = 2.2
    """Of a person with arms held out."""
    growths: int = 10
    """Times that the person grows by `growth_pixels` of like depth: arms are thin, and the opening
    that removes specks cut them off."""
    growth_pixels: int = 3
    limb_reach: float = 1.4
    """From the middle of a person to the end of a limb, across,"""
    limb_depth: float = 0.8
    """and along the view."""
    min_noise_difference: float = 0.02
    """Of a pixel from the empty room, from which on it is a person's, and `background_noises`."""
    background_noises: float = 6.0
    """The same in standard deviations of the noise."""
    grid_pixels: int = 24
    """Of the person in a grid, at least: with fewer its middle and nearest points are undefined."""
    margin: int = 60
    """Pixels around the person that are looked at, too: where the model may wrongly be."""


SEGMENTATION = SegmentationSettings()


@dataclass(frozen=True)
class DepthSearchSettings:
    """The multi-start search of each view: turns x arms, or keypoints; metres and radians where no
    unit is given.
    """

    turns: tuple[float, ...] = (0.0, 45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)
    """Degrees from facing the camera."""
    arms: tuple[tuple[float, float, float], ...] = (
        (10.0, 0.0, 0.0),
        (45.0, 0.0, 0.0),
        (72.0, 0.0, 0.0),
        FOLDED,
    )
    """Degrees: below the level, bent at the elbow, turned inwards about the upper arm."""
    leg_spread: float = 7.0
    """Degrees of each leg outwards, as people stand."""
    side_turns: tuple[float, ...] = (0.0, 30.0, -30.0)
    """Degrees about a turn that was given, or that another view has."""
    stride: int = 8
    """Of pixels, for the placement of candidates."""
    coarse: tuple[tuple[int, DepthStage], ...] = (
        (12, DepthStage(2, moves="pose", matching="nearest", stride=8, scales=(0.3, 0.2))),
        (4, DepthStage(4, moves="pose", matching="nearest", stride=8, scales=(0.2, 0.15))),
    )
    """How many candidates go on, and the steps that they then make."""
    fine: DepthStage = DepthStage(4, moves="pose", matching="nearest", stride=4, scales=(0.15, 0.1))
    """Steps after which front and back are compared."""
    facing: float = 0.003
    """Misfit that is added for who turns their back: front and back differ by nose and toes."""
    rival_misfit: float = 1.3
    """Ratio of the misfits of the best start that faces the other way and of the best start, up to
    which both are fitted and the fit of lower cost is kept."""
    max_misfit_distance: float = 0.15
    """At which distances of the misfit are capped."""
    middle_steps: int = 2
    """Moves of the model's drawn middle onto the observed one."""
    planar_steps: int = 3
    """Steps in which the whole body turns and moves, before its joints do."""
    max_planar_step: float = 0.3
    """Of turn (rad) and place (m)."""
    planar_scale: float = 0.3
    """Geman-McClure's, metres: the body may be a step away."""
    planar_damping: float = 1e-3
    """Levenberg-Marquardt's at the start: the turn of a round body is hardly determined."""
    heights: tuple[float, float] = (1.3, 2.15)
    """Of adults: another height in a view is not believed."""
    max_beta: float = 2.5
    """Change of a beta, at most, that makes the body as tall as the person."""
    joint_depths: Mapping[str, float] = field(
        default_factory=lambda: {
            "shoulder": 0.06,
            "elbow": 0.04,
            "wrist": 0.03,
            "hip": 0.09,
            "knee": 0.06,
            "ankle": 0.05,
        }
    )
    """Of joints behind the skin that is seen."""
    min_confidence: float = 0.3
    """Of a keypoint that is used."""
    keypoint_pixels: float = 6.0
    """Distance of depth pixels from a keypoint, in colour pixels, that give its depth."""
    min_keypoints: int = 6
    """With depth, in one view, that replace the search."""
    keypoint_steps: int = 15
    keypoint_joint_sd: float = 0.5
    """Of joints about the T-pose (rad): wide, as keypoints determine the pose."""
    keypoint_sd: float = 0.03
    """Of a keypoint's joint, metres."""
    max_joint_step: float = 0.6
    """Of a rotation vector in one step: beyond it linearised rotations are wrong."""


@dataclass(frozen=True)
class DepthLimbSettings:
    """Limbs that two views have elsewhere, or that leave pixels unexplained, placed again;
    metres.
    """

    max_difference: float = 0.15
    """Between a limb's joint in two views, seen from the pelvis: beyond it the limb is tried
    again."""
    max_turn: float = 60.0
    """Degrees between the rotations of a limb's joint in two views, relative to the pelvis: beyond
    it the limb is fitted again. 26 is the most of 38 right fits; a half-turned forearm has 110."""
    max_unexplained: float = 0.01
    """Share of a person's pixels far from the body, beyond which both arms are tried again."""
    turns: tuple[float, ...] = (0.0, 30.0, -30.0, 180.0)
    """Degrees from a view's own turn, at which the whole pose of another view is tried: 180 for a
    person who was fitted facing away."""
    passes: int = 2
    """Over all views: a limb that one view finds helps the others."""
    kept: int = 2
    """Poses of a limb that run through the fine stage."""
    improvement: float = 0.97
    """Share of its misfit to which another pose must bring a view to be taken."""
    pixels: int = 2000
    """Of the person, that are used, about; a quarter of them in coarse steps."""
    fine: DepthStage = DepthStage(
        6, moves="pose", matching="nearest", stride=1, scales=(0.12, 0.05)
    )
    """Steps of the best poses; their stride follows from ``pixels``."""


@dataclass(frozen=True)
class AppearanceSettings:
    """Light, albedo and the colour camera's shift (thesis sec. 4.6.1), in linear light, 0
    to 1.
    """

    min_difference: float = 12.0
    """Bytes of sRGB from the empty room, from which on a pixel is the person's,"""
    difference_medians: float = 5.0
    """and in medians of that difference over the image."""
    shift_steps: int = 5
    blur: float = 1.5
    """Pixels (sd) by which outlines are blurred: as far as an outline may be off."""
    reduction: float = 0.5
    """Of the image in which outlines are compared."""
    camera_shift_sd: float = 0.008
    """Metres by which a calibration of the colour camera may be off."""
    outline: float = 0.01
    """Weight of a pixel of the outlines' difference: neighbours along an outline err together."""
    min_overlap: float = 0.6
    """Intersection over union of outlines: with less, something else differs from the room."""
    max_shift_sds: float = 3.0
    """A larger shift is no calibration error, and is not used."""
    min_samples: int = 200
    """Coloured vertices from which light and albedo are solved."""
    grey_steps: int = 8
    channel_steps: int = 4
    """Of each channel, which starts from the grey light."""
    damping: float = 1e-6
    """Levenberg-Marquardt's at the start, relative to the diagonal."""
    max_log_step: float = 1.0
    """Largest change of a log albedo in one step."""
    smooth_sd: float = 0.05
    """Of the difference of log albedo between neighbouring vertices (thesis eq. 4.7)."""
    edge: float = 0.2
    """Such a difference that weighs a quarter: seams of clothing."""
    light_sd: tuple[float, float, float] = (0.01, 0.5, 0.25)
    """Of the light's harmonics of order 0, 1 and 2 about white light from everywhere."""
    tint_sd: tuple[float, float, float] = (0.01, 0.01, 0.01)
    """Of a channel's light about the grey one's: tint is the albedo's."""
    noise: float = 0.02
    """Standard deviation of colours."""
    outlier: float = 0.15
    """Difference of colours that weighs a quarter."""
    rim_outlier: float = 0.6
    """The same at the rim: there a large difference says that the outline is off."""
    rim_cosine: float = 0.15
    """Between view and normal: below it a pixel belongs to the rim."""
    min_cosine: float = 0.25
    """Between view and normal of a vertex whose colour is used."""
    hidden: float = 0.02
    """Metres behind the drawn surface at which a vertex is hidden."""
    min_colour: float = 0.004
    """Light below which all is black."""
    max_colour: float = 0.995
    """Light above which a pixel is overexposed."""
    saturated: int = 254
    """The same in bytes of sRGB."""
    min_shade: float = 0.05
    """Light on a surface, whatever nine harmonics say, where light and albedo are solved,"""
    min_drawn_shade: float = 0.02
    """and where a person is drawn."""
    min_albedo: float = 0.003
    max_albedo: float = 3.0
    """Beyond 1, as the scale of albedo is unobservable."""
    margin: int = 24
    """Full-size pixels around the person that are looked at."""
    albedo_damping: float = 0.01
    """Of log albedo where it is eliminated from the whole energy: unseen vertices are singular."""
    vertex_weight: float = 0.03
    """Of the vertices' albedo in a texel, beside 1 of its own colour seen face on."""
    min_texture_shade: float = 0.1
    """Light on a texel, at least, by which its colour is divided."""
    hair_margin: float = 0.02
    """Metres around a scalp with thick hair within which colours are not compared: the outline of
    hair is unknown."""
    brightest: float = 0.92
    """Albedo that the brightest of a texture gets, as the scale of albedo is unobservable."""


APPEARANCE = AppearanceSettings()


@dataclass(frozen=True)
class RgbdSettings:
    """Weights and constants of the fit to depth views (thesis sec. 4.6.1). Metres and radians."""

    stages: tuple[DepthStage, ...] = STAGES
    depth: float = 0.02
    """Of E_D: share of each full-size pixel's certainty, as the errors of neighbouring pixels are
    alike."""
    shape: float = 1.0
    """Of E_S, the prior of betas, per squared standard deviation."""
    pose: float = 2.0
    """Of E_P, the pose prior, per squared deviation in ``pose_sd`` or ``stiff_sd``."""
    pose_sd: float = 0.2
    """Standard deviation of joints in E_P, rad."""
    stiff_sd: float = 0.1
    """Standard deviation in E_P of joints that hardly bend when people stand (`STIFF`), rad."""
    outline: float = 0.2
    """Of each full-size pixel in which the model covers background that was seen."""
    outline_sd: float = 0.01
    """Standard deviation of the distance of such a point from the silhouette, metres."""
    colour: float = 0.02
    """Of E_C and E_Q: share of each full-size pixel's certainty; 0.02 as for depth."""
    rim: float = 3.0
    """Factor of E_C in pixels where the surface turns away: they show where it ends."""
    colour_levels: tuple[int, ...] = (4, 4, 2, 2)
    """Full-size pixels along the side of one of the pyramid's, for each step with colour; () for a
    fit by depth alone."""
    floor: float = 2.0
    """Of E_F, for all vertices of the soles together."""
    floor_sd: float = 0.01
    """Standard deviation of the soles' height above the floor, metres."""
    slide: float = 0.1
    """Weight of point to point over point to plane in E_D with "nearest" matching."""
    noise: float = NOISE
    """Standard deviation of depth over its square (1 / m), where the views do not give it."""
    model_sd: float = 0.003
    """Metres (sd) of the surface that no body of the model explains."""
    skin: float = 1.25
    """Standard deviation of the skin offset, as a factor of `habitus.fit.offsets.offset_spread`."""
    skin_reach: float = OFFSETS.range
    """Metres at which the correlation of two skin offsets is 0.14 (`OffsetSettings.range`)."""
    skin_places: int = 400
    """Vertices whose values determine the field of skin offsets, at most. With 120 the
    field is too smooth, and betas absorb the rest of the skin."""
    skin_depth: float = 0.1
    """``depth`` in the steps with skin offsets: what neighbours have in common is explained then.
    """
    skin_stride: int = 2
    """Full-size pixels along the side of one that is used with skin offsets: half the resolution of
    an Azure Kinect; chosen by hand for speed.
    """
    skin_scale: float = 0.012
    """Geman-McClure's scale with skin offsets, which explain what the body does not, at least:"""
    skin_scale_ratio: float = 3.0
    """it is so many times the median distance of a view's pixels, where these are noisier."""
    skin_steps: int = 4
    """Steps with skin offsets by depth alone: of each body that is tried, and again before those
    with colour."""
    max_step: Mapping[str, float] = field(
        default_factory=lambda: {"trans": 0.5, "pose": 0.4, "betas": 1.5}
    )
    """Largest change of a number of each unknown in one step: metres, rad, standard deviations."""
    damping: float = 1e-6
    """Levenberg-Marquardt's at the start, relative to the diagonal."""
    clothes: float = 0.001
    """Thickness in metres of tight clothes on trunk and thighs, which is taken off."""
    hair: float = 0.003
    """Thickness in metres of flat hair under a cap, which is taken off,"""
    measured_hair: HairSettings | None = HAIR
    """and how thicker hair is measured; None: it is not."""
    clothed: tuple[str, ...] = ("pelvis", "spine1", "spine2", "spine3", "hip", "collar")
    """Joints, of both sides, whose skin the tight clothes cover."""
    hairline: float = HAIR.hairline
    """Share of the way from the head's joint to its top from which hair grows in front."""
    min_cosine: float = 0.3
    """Between ray and surface, at which the noise of depth is evaluated at least."""
    seen_through: float = 0.08
    """Metres of what was seen behind the model, from which on the model cannot be there."""
    min_outline_scale: float = 0.05
    """Geman-McClure's of the outline, at least: it is searched across more than its noise."""
    floor_scale: float = 0.02
    """Metres off the floor at which a sole weighs a quarter: a heel may be lifted."""
    explained_distance: float = 0.05
    """Metres from the body at which a pixel of the person is not explained by it."""
    end_distance: float = 0.03
    """The same of head, hands and feet, in the verdict."""
    judged_stride: int = 2
    """Of the pixels by which a fit is judged."""
    segmentation: SegmentationSettings = SEGMENTATION
    search: DepthSearchSettings = DepthSearchSettings()
    limbs: DepthLimbSettings = DepthLimbSettings()
    appearance: AppearanceSettings = APPEARANCE


STANDARD = RgbdSettings()
