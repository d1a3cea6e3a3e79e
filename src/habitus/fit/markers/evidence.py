"""Evidence on a marker fit, as numbers: errors, robust weights, shape, limbs without markers, tilt,
rate, and how fast what was fitted moves.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.arrays import runs
from habitus.body.skinning import descends
from habitus.fit.markers.solution import MarkerSolution
from habitus.parallel.blocks import drop_pages, mapped
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

SIDES = ("left", "right")
GRAVITY = 9.81  # m/s^2
_PAIRED_SEGMENTS = (
    ("shoulder", "elbow", 0.0271, 0.577),
    ("elbow", "wrist", 0.0162, 0.457),
    ("wrist", "wrist", 0.0061, 0.0),
    ("hip", "knee", 0.1416, 0.410),
    ("knee", "ankle", 0.0433, 0.446),
    ("ankle", "ankle", 0.0137, 0.0),
)
MASS_SEGMENTS = (
    ("pelvis", "neck", 0.4346, 0.5),
    ("neck", "head", 0.0694, 1.0),
    *((f"{s}_{a}", f"{s}_{b}", mass, at) for s in SIDES for a, b, mass, at in _PAIRED_SEGMENTS),
)
"""Segments of a body from joint to joint, share of its mass, and where between the two joints the
mass is: de Leva 1996, Journal of Biomechanics 29(9), table 4, men."""


@dataclass(frozen=True)
class EvidenceSettings:
    """How evidence is measured. Metres, seconds and shares of 0..1."""

    frames: int = 4000
    """Frames, evenly spaced, whose errors are measured, about; more take memory and change no
    verdict."""
    few_frames: int = 200
    """The same for motion, tilt and size, which take joints or pairs of markers in each frame."""
    pair_frames: int = 20
    """The same for distances between all pairs of markers."""
    min_weight: float = 0.5
    """Robust weight, of 1, below which a sample is distrusted."""
    seen_weight: float = 0.1
    """Robust weight from which on a sample determines where a limb is."""
    carried: float = 0.5
    """Share of a marker's skinning weights by which a joint, or what hangs from it, carries it."""
    straight: float = 0.987
    """Distance from ankles to neck over the way by knees, hips and pelvis, as a share of the same
    at rest: who stands has more.
    """
    standing: float = 0.1
    """Share of straight frames above which tilt is measured over these alone."""
    close: float = 0.15
    """Markers this close at rest, or on one part of the body, are a pair that stays together,"""
    torn: float = 0.4
    """is torn if it is observed this much further apart,"""
    level: float = 0.3
    """and torn level if the two are less than this apart in height."""
    motion_step: float = 0.02
    """Seconds of the differences that speeds and accelerations are taken from: noise of 1 mm leaves
    an acceleration of 6 m/s^2, and steps of a sprint last 0.1 s."""
    motion_samples: int = 400
    """Triples of frames from which the extremes of motion are taken, at most."""
    motion_percentile: float = 95.0
    """Of speeds and accelerations; single frames with wrong markers do not count."""
    extent_percentile: float = 90.0
    """Of the markers' distances from their middle, for the size: stray markers do not count."""

    def rows(self, num_frames: int) -> Int[np.ndarray, " F"]:
        """About ``few_frames`` of a capture's frames, evenly spaced."""
        return np.arange(0, num_frames, max(1, num_frames // self.few_frames))


EVIDENCE = EvidenceSettings()


class Motion(NamedTuple):
    """How fast a fit moves: `EvidenceSettings.motion_percentile` over steps of
    ``motion_step``.

    fall and force: of the centre of mass' acceleration downwards and in any direction, in g.
    Markers in m/s and m/s^2, joints against their parents in rad/s and rad/s^2, over all of them.
    """

    fall: float
    force: float
    marker_speed: float
    marker_acceleration: float
    joint_speed: float
    joint_acceleration: float


@dataclass(frozen=True)
class Evidence:
    """Numbers measured of one fit. Shares are 0..1; what cannot be measured is None.

    mean_mm, p95_mm: of the pose stage's errors; motion: how fast markers move against the body's
    middle, m/s, at the median. distrusted: share of samples that the robust loss counts for less
    than half. displaced: how far markers sit from the layout's places, in the layout's spreads, at
    the median. unseen: joint -> share of frames in which no marker sits on it or on what hangs from
    it; parents: joint -> the joint that it hangs from. tilt_deg: of the body against up, at the
    median; standing: only over frames of a straight body. size: of the observed markers as a
    multiple of the body's. torn: share of the pairs close together on the body that are observed
    far from each other; torn_level: number of these at one height. extremes: speeds and
    accelerations of the fit, None for fewer than three frames or a body without a person's joints.
    age, stature: the body's age, if it was brought to one (years), and how tall its mean person is
    (m). tried: what was done before.
    doubts: what was not decided of the markers' places.
    """

    mean_mm: float | None
    p95_mm: float | None
    motion: float
    distrusted: float
    beta_sd: float
    betas_rms: float
    displaced: float | None
    measurements: Mapping[str, float]
    age: float | None
    stature: float
    recorded: Mapping[str, float | str]
    unseen: Mapping[str, float]
    parents: Mapping[str, str]
    no_data: float
    gap_s: float
    confidence: float | None
    tilt_deg: float | None
    standing: bool
    size: float
    torn: float
    torn_level: float
    rate_hz: float
    speed: float
    suspects: float
    left_out: tuple[str, ...]
    markers: int
    up_axis: str
    tried: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    extremes: Motion | None = None


def evidence(fit: MarkerSolution, settings: EvidenceSettings = EVIDENCE) -> Evidence:
    """The evidence on a fit; of a long capture some frames speak for all."""
    rows = np.arange(0, fit.num_frames, max(1, fit.num_frames // settings.frames))
    observed = np.asarray(fit.observed_markers[rows])
    distance = 1e3 * np.linalg.norm(observed - fit.predicted_pose_stage[rows], axis=2)
    seen = np.isfinite(distance)
    weights = fit.marker_weights[rows]
    empty = mapped(
        lambda part: np.isnan(part[..., 0]).all(axis=1), np.asarray(fit.observed_markers)
    )
    predicted = np.where(seen[..., None], fit.predicted_pose_stage[rows], np.nan)
    tilt, standing = _tilt(fit, settings)
    torn, level = _torn(fit, observed, settings)
    names = fit.body.joint_names
    found = Evidence(
        mean_mm=float(distance[seen].mean()) if seen.any() else None,
        p95_mm=float(np.percentile(distance[seen], 95)) if seen.any() else None,
        motion=_motion(fit, settings),
        distrusted=float((weights[seen] < settings.min_weight).mean()) if seen.any() else 0.0,
        beta_sd=float(np.abs(fit.betas).max(initial=0.0)),
        betas_rms=float(np.sqrt(np.mean(np.square(fit.betas)))) if len(fit.betas) else 0.0,
        displaced=None if fit.displaced is None else float(np.median(fit.displaced)),
        measurements=fit.body.measure(fit.betas),
        age=fit.body.age,
        stature=float(np.ptp(fit.body.v_template[:, 1])),
        recorded=fit.recorded,
        unseen=_unseen(fit, seen & (weights > settings.seen_weight), settings),
        parents={names[k]: names[p] for k, p in enumerate(fit.body.parents) if p >= 0},
        no_data=float(np.mean(fit.flagged_frames)),
        gap_s=_longest(empty) / fit.rate_hz,
        confidence=fit.layout_confidence,
        tilt_deg=tilt,
        standing=standing,
        size=_extent(observed, settings) / max(_extent(predicted, settings), 1e-9),
        torn=torn,
        torn_level=level,
        rate_hz=fit.rate_hz,
        speed=_speed(fit),
        suspects=len({s.label for s in fit.suspects} & set(fit.labels)) / max(1, len(fit.labels)),
        left_out=fit.left_out,
        markers=len(fit.labels),
        up_axis=fit.up_axis,
        tried=fit.tried,
        doubts=fit.doubts,
        extremes=motion_extremes(fit, settings),
    )
    drop_pages(
        *(fit.observed_markers, fit.predicted_pose_stage, fit.marker_weights, fit.pose, fit.trans)
    )
    return found


def limbs_of(fit: MarkerSolution, settings: EvidenceSettings = EVIDENCE) -> Bool[np.ndarray, "M J"]:
    """Whether a marker sits on a joint's part of the body or on what hangs from it."""
    corners = fit.body.skinning_weights[fit.attachment.triangles].mean(axis=1)
    return corners @ descends(fit.body.parents).T > settings.carried


def _unseen(
    fit: MarkerSolution, trusted: Bool[np.ndarray, "T M"], settings: EvidenceSettings
) -> dict[str, float]:
    determined = trusted.astype(np.float32) @ limbs_of(fit, settings).astype(np.float32) > 0
    return {
        name: float(1.0 - share)
        for name, share in zip(fit.body.joint_names, determined.mean(axis=0), strict=True)
    }


def _motion(fit: MarkerSolution, settings: EvidenceSettings) -> float:
    """At the median (m/s), how fast predicted markers move against their middle."""
    first = np.arange(0, max(1, fit.num_frames - 1), max(1, fit.num_frames // settings.few_frames))
    if fit.num_frames < 2:
        return 0.0
    step = fit.predicted_pose_stage[first + 1] - fit.predicted_pose_stage[first]
    return (
        float(np.median(np.linalg.norm(step - step.mean(axis=1, keepdims=True), axis=2)))
        * fit.rate_hz
    )


def _speed(fit: MarkerSolution) -> float:
    if fit.num_frames < 2:
        return 0.0
    return float(np.median(np.linalg.norm(np.diff(fit.trans, axis=0), axis=1))) * fit.rate_hz


def motion_extremes(fit: MarkerSolution, settings: EvidenceSettings = EVIDENCE) -> Motion | None:
    """How fast a fit moves, from triples of frames spread over it."""
    step = max(1, round(settings.motion_step * fit.rate_hz))
    names = {name: k for k, name in enumerate(fit.body.joint_names)}
    known = all(name in names for first, second, *_ in MASS_SEGMENTS for name in (first, second))
    last = fit.num_frames - 2 * step
    if last < 1 or not known:
        return None
    starts = np.unique(
        np.linspace(0, last - 1, min(last, settings.motion_samples)).astype(np.int64)
    )
    rows = starts[:, None] + step * np.arange(3)
    rate = fit.rate_hz / step
    frames, where = np.unique(rows, return_inverse=True)
    joints = np.asarray(fit.joints(frames.tolist()))
    masses = np.array([mass for *_, mass, _ in MASS_SEGMENTS])
    middles = np.array(
        [
            (1.0 - at) * joints[:, names[first]] + at * joints[:, names[second]]
            for first, second, _, at in MASS_SEGMENTS
        ]
    )
    centre = np.average(middles, axis=0, weights=masses)[where.reshape(rows.shape)]
    pull = rate**2 / GRAVITY * (centre[:, 2] - 2 * centre[:, 1] + centre[:, 0])
    down = 1.0 if fit.up_axis.startswith("-") else -1.0
    markers = [np.asarray(fit.predicted_pose_stage[rows[:, k]]) for k in range(3)]
    moved = [rate * (markers[k + 1] - markers[k]) for k in range(2)]
    turn = matrix_from_rotvec(np.asarray(fit.pose[frames])[:, 1:])[where.reshape(rows.shape)]
    turned = [
        rate * rotvec_from_matrix(np.swapaxes(turn[:, k], -1, -2) @ turn[:, k + 1])
        for k in range(2)
    ]
    lengths = (
        np.linalg.norm(each, axis=-1)
        for each in (pull, moved[0], rate * (moved[1] - moved[0]), turned[0])
    )
    force, speed, acceleration, turning = (
        np.percentile(x, settings.motion_percentile) for x in lengths
    )
    spin = np.linalg.norm(rate * (turned[1] - turned[0]), axis=-1)
    return Motion(
        float(
            np.percentile(down * pull[:, "xyz".index(fit.up_axis[-1])], settings.motion_percentile)
        ),
        float(force),
        float(speed),
        float(acceleration),
        float(turning),
        float(np.percentile(spin, settings.motion_percentile)),
    )


def _longest(flags: Bool[np.ndarray, " T"]) -> int:
    """The length of the longest run of flags."""
    return max((last - first for first, last in runs(flags)), default=0)


def _tilt(fit: MarkerSolution, settings: EvidenceSettings) -> tuple[float | None, bool]:
    """Degrees between the capture's up and the way from the ankles to the neck; over straight
    bodies where there are.

    Nobody who stands straight leans far; bent bodies may.
    """
    names = {name: k for k, name in enumerate(fit.body.joint_names)}
    chain = [[f"{side}_{part}" for side in SIDES] for part in ("ankle", "knee", "hip")] + [
        ["pelvis"],
        ["neck"],
    ]
    if not all(name in names for part in chain for name in part):
        return None, False
    rows = settings.rows(fit.num_frames)
    rest = np.asarray(fit.body.rest_joints(fit.betas))
    joints = np.concatenate([np.asarray(fit.joints(rows.tolist())), rest[None]])
    points = np.stack(
        [joints[:, [names[name] for name in part]].mean(axis=1) for part in chain], axis=1
    )
    way = points[:, -1] - points[:, 0]
    lengths = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    shares = lengths / np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)
    way, length = way[:-1], lengths[:-1]
    sign = -1.0 if fit.up_axis.startswith("-") else 1.0
    axis = "xyz".index(fit.up_axis[-1])
    angle = np.degrees(np.arccos(np.clip(sign * way[:, axis] / length, -1, 1)))
    straight = shares[:-1] > settings.straight * shares[-1]
    standing = bool(straight.mean() > settings.standing)
    return float(np.median(angle[straight] if standing else angle)), standing


def _torn(
    fit: MarkerSolution, observed: Float[np.ndarray, "T M 3"], settings: EvidenceSettings
) -> tuple[float, float]:
    """Share of the pairs close together on one part of the body that are seen far apart; how many
    of these level.

    Two people stand beside each other, so what is torn between them is level; exchanged labels are
    at any height.
    """
    part = fit.body.skinning_weights[fit.attachment.triangles].mean(axis=1).argmax(axis=1)
    first, second = np.triu_indices(len(part), 1)
    rest = np.linalg.norm(fit.latent_markers[first] - fit.latent_markers[second], axis=1)
    near = (part[first] == part[second]) | (rest < settings.close)
    way = observed[:: max(1, len(observed) // settings.pair_frames)]
    way = way[:, first[near]] - way[:, second[near]]
    seen = np.isfinite(way[..., 0]).any(axis=0)
    if not seen.any():
        return 0.0, 0.0
    middle = np.nanmedian(np.abs(way[:, seen]), axis=0)
    apart = np.nanmedian(np.linalg.norm(way[:, seen], axis=2), axis=0)
    torn = apart > rest[near][seen] + settings.torn
    level = middle[torn, "xyz".index(fit.up_axis[-1])] < settings.level
    return float(torn.mean()), float(level.mean()) if torn.any() else 0.0


def _extent(points: Float[np.ndarray, "T M 3"], settings: EvidenceSettings) -> float:
    """Twice the distance (m) from the middle that holds most of a frame's markers, at the
    median over frames.
    """
    some = points[settings.rows(len(points))]
    some = some[np.isfinite(some[..., 0]).any(axis=1)]
    if not len(some):
        return 0.0
    distance = np.linalg.norm(some - np.nanmedian(some, axis=1, keepdims=True), axis=2)
    return 2.0 * float(np.median(np.nanpercentile(distance, settings.extent_percentile, axis=1)))
