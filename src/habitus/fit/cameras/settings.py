"""Settings of the fit to keypoints of calibrated cameras; metres, radians, seconds and pixels."""

from dataclasses import dataclass, field

from habitus.solve.sequence import SequenceOptions


@dataclass(frozen=True)
class PeopleSettings:
    """How people are matched between cameras and over time; chosen by hand on one public trial and
    made scenes.
    """

    min_common: int = 6
    """Keypoints that two detections of different cameras must share to be compared."""
    max_line_distance: float = 0.05
    """Median distance of keypoints from each other's epipolar lines, up to which two detections are
    one person's, as a share of the person's height in pixels."""
    max_prediction: float = 0.1
    """Mean distance of a detection's keypoints from where a person's last points predict them, each
    counted up to twice this, up to which it is that person's; a share of the same height."""
    max_step: float = 0.35
    """Metres between a person's middle in one frame and in the next that shows it."""
    max_gap: float = 1.0
    """Seconds that a person may be lost."""
    min_share: float = 0.2
    """Of all frames, in which a person must be seen."""
    min_views: int = 2
    """Cameras that must see a person in a frame for a track to go on; 1 for one camera."""


@dataclass(frozen=True)
class TriangulationSettings:
    """Points from several cameras."""

    max_error: float = 0.03
    """Reprojection error up to which a camera agrees with a point, as a share of the person's
    height in pixels."""
    max_point_error: float = 0.1
    """Metres (sd) of a triangulated point as a start,"""
    reach: float = 4.0
    """and the scale of its robust loss, in standard deviations."""


@dataclass(frozen=True)
class CameraSettings:
    """The recipe. Noise and places of keypoints are in `habitus.assets.keypoints.toml`."""

    people: PeopleSettings = PeopleSettings()
    triangulation: TriangulationSettings = TriangulationSettings()
    betas: int = 10
    """That are free: keypoints tell of lengths alone."""
    frames: int = 30
    """Of the shape stage, unlike each other."""
    reaches: tuple[float, ...] = (40.0, 12.0, 5.0)
    """Of Geman-McClure's loss, in standard deviations, of the shape stage's rounds."""
    reach: float = 5.0
    """Of the pose stage."""
    camera_bias: float = 0.006
    """Share of the person's height by which all that a camera sees is off in one direction, from
    which on cameras are corrected: they take definitions of keypoints for calibration otherwise.
    """
    rounds: int = 3
    """Of shape stage and pose stage, with noise, exchanges and time offsets found in between."""
    noise: float = 1.0
    """Factor of the noise of single detections: errors last over frames and are alike in several
    cameras, so that they do not count as independent."""
    angular_acceleration: float = 35.0
    """Standard deviation of a joint's, rad/s^2."""
    acceleration: float = 12.0
    """Of the body's place, m/s^2."""
    pose: float = 0.3
    """Factor of the pose prior."""
    camera_turn: float = 0.5
    """Standard deviation (degrees) of a camera's calibration,"""
    camera_shift: float = 0.02
    """and of its place (m)."""
    camera_scale: float = 0.001
    """Of the mean distance between cameras (m): it scales the person."""
    camera_noise: float = 1.5
    """Further factor of the noise in the shape stage, where cameras are free: definitions of
    keypoints must not be taken for calibration."""
    height_sd: float = 0.01
    """Of a height that is given (m)."""
    clock_steps: int = 3
    """In which clocks are found after each round."""
    max_offset: float = 0.1
    """Seconds that a camera's clock may be off."""
    options: SequenceOptions = field(default_factory=lambda: SequenceOptions(damping=10.0))


@dataclass(frozen=True)
class Known:
    """What is known beside the pixels. height: of the person (m); floor: its height along the
    world's upward axis (m); up: that axis, or "auto": from hips to shoulders.
    """

    height: float | None = None
    floor: float | None = None
    up: str = "auto"


NOTHING = Known()
CAMERAS = CameraSettings()
