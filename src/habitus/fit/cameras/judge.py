"""What a fit to keypoints is worth: how far pixels are off, whether cameras agree, whether the
person is one. Lengths in pixels are shares of the person's height in the image.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from habitus.body.prior import prior_of
from habitus.fit.cameras.solution import CameraSolution
from habitus.fit.verdict import (
    COMMON_SENTENCES,
    DOUBTFUL,
    GOOD,
    Bound,
    Reason,
    Verdict,
    above,
    below,
    percent,
    shape_reasons,
    solver_reasons,
    weigh,
    worst,
)


@dataclass(frozen=True)
class CameraLimits:
    """Chosen on made scenes and their spoilt copies, beside one real trial (median .9 %)."""

    median: Bound = Bound(0.014, 0.03)
    """Of the errors of all detections."""
    camera: Bound = Bound(2.0, 5.0)
    """Of one camera's median over the median of the others."""
    lost: Bound = Bound(0.2, 0.5)
    """Share of the detections that are further off than `far`."""
    far: float = 0.05
    covered: Bound = Bound(0.75, 0.4)
    """Share of keypoints and frames that two cameras or more see."""
    turn: Bound = Bound(1.0, 3.0)
    """Degrees by which a camera was corrected,"""
    shift: Bound = Bound(0.05, 0.15)
    """and metres."""
    late: Bound = Bound(1.5, 1e9)
    """Frames by which a camera's clock is late."""
    height: Bound = Bound(0.03, 0.08)
    """Metres between the body's height and the one given."""
    stature: tuple[float, float] = (0.5, 2.3)
    """Heights of people (m)."""
    acceleration: Bound = Bound(40.0, 120.0)
    """Root mean square, m/s^2."""
    pose: Bound = Bound(2.2, 4.0)
    """Of the pose prior, root mean square in standard deviations, of the median frame."""
    largest_beta: Bound = Bound(4.0, 1e9)
    beta_rms: Bound = Bound(2.0, 1e9)


LIMITS = CameraLimits()


def judge_cameras(fit: CameraSolution, limits: CameraLimits = LIMITS) -> Verdict:
    """The verdict on a fit."""
    checks = (_solver, _residuals, _calibration, _coverage, _person, _motion)
    return weigh(checks, fit, limits, SENTENCES)


def _solver(fit: CameraSolution, limits: CameraLimits) -> Iterator[Reason]:
    return solver_reasons(fit.status)


def _shares(fit: CameraSolution) -> np.ndarray:
    return fit.errors_px / np.maximum(fit.size_px, 1.0)[..., None]


def _residuals(fit: CameraSolution, limits: CameraLimits) -> Iterator[Reason]:
    shares = _shares(fit)
    seen = np.isfinite(shares) | ((fit.confidence > 0.0) & np.isfinite(fit.observed).all(-1))
    median = float(np.median(np.where(np.isfinite(shares), shares, 1.0)[seen]))
    if (level := above(median, limits.median)) != GOOD:
        pixels = float(np.nanmedian(fit.errors_px))
        yield Reason(level, "median", {"share": percent(median, 1), "pixels": pixels})
    lost = float((np.where(np.isfinite(shares), shares, 1.0)[seen] > limits.far).mean())
    if (level := above(lost, limits.lost)) != GOOD:
        yield Reason(level, "lost", {"share": percent(lost), "far": percent(limits.far)})
    cameras = [own[np.isfinite(own)] for own in np.moveaxis(shares, 1, 0)]
    medians = np.array([np.median(own) if len(own) else np.nan for own in cameras])
    for c, own in enumerate(medians):
        others = np.delete(medians, c)
        if not np.isfinite(others).any() or not np.isfinite(own):
            continue
        ratio = float(own / max(np.nanmedian(others), 0.003))
        if (level := above(ratio, limits.camera)) != GOOD:
            name = fit.cameras.names[c] if fit.cameras else str(c)
            yield Reason(level, "camera", {"name": name, "ratio": ratio})


def _calibration(fit: CameraSolution, limits: CameraLimits) -> Iterator[Reason]:
    names = fit.cameras.names if fit.cameras else ()
    for name, correction in zip(names, fit.corrections, strict=True):
        turn = float(np.degrees(np.linalg.norm(correction[:3])))
        shift = float(np.linalg.norm(correction[3:]))
        level = worst([above(turn, limits.turn), above(shift, limits.shift)])
        if level != GOOD:
            yield Reason(level, "corrected", {"name": name, "turn": turn, "shift": 100 * shift})
    for name, late in zip(names, fit.late, strict=True):
        frames = float(late * fit.rate_hz)
        if above(abs(frames), limits.late) != GOOD:
            word = "late" if frames > 0 else "early"
            yield Reason(DOUBTFUL, "late", {"name": name, "frames": abs(frames), "word": word})


def _coverage(fit: CameraSolution, limits: CameraLimits) -> Iterator[Reason]:
    if fit.confidence.shape[1] == 1:
        given = "" if fit.given_height is not None else "size and "
        yield Reason(DOUBTFUL, "alone", {"given": given})
        return
    covered = float(((fit.confidence > 0.0).sum(1) >= 2).mean())
    if (level := below(covered, limits.covered)) != GOOD:
        yield Reason(level, "covered", {"share": percent(covered)})


def _person(fit: CameraSolution, limits: CameraLimits) -> Iterator[Reason]:
    if not limits.stature[0] <= fit.height <= limits.stature[1]:
        yield Reason("failed", "stature", {"height": fit.height})
    if fit.given_height is not None:
        off = abs(fit.height - fit.given_height)
        if (level := above(off, limits.height)) != GOOD:
            values = {"height": 100 * fit.height, "given": 100 * fit.given_height}
            yield Reason(level, "height", values)
    betas = np.asarray(fit.betas)[:10]
    yield from shape_reasons(
        float(np.abs(betas).max(initial=0.0)),
        float(np.sqrt(np.mean(betas**2))) if len(betas) else 0.0,
        limits.largest_beta,
        limits.beta_rms,
    )


def _motion(fit: CameraSolution, limits: CameraLimits) -> Iterator[Reason]:
    if (level := above(fit.acceleration, limits.acceleration)) != GOOD:
        yield Reason(level, "acceleration", {"value": fit.acceleration})
    prior = prior_of(fit.body).for_joints(fit.body.joint_names)
    off = (fit.pose[:, 1:].reshape(len(fit.pose), -1) - prior.mean) @ prior.whitening.T
    typical = float(np.median(np.sqrt(np.mean(off**2, axis=1))))
    if (level := above(typical, limits.pose)) != GOOD:
        yield Reason(level, "pose", {"value": typical})


SENTENCES: Mapping[str, str] = MappingProxyType(
    {
        "median": "The median detection is {share} of the person's height ({pixels:.1f} px) from "
        "the body's keypoint.",
        "lost": "{share} of the detections are more than {far} of the person's height from the "
        "body.",
        "camera": "Camera {name} disagrees with the others: its median error is {ratio:.1f} "
        "times theirs.",
        "corrected": "Camera {name} was corrected by {turn:.1f} degrees and {shift:.1f} cm; "
        "calibrate again.",
        "late": "Camera {name} is {frames:.1f} frames {word}, which was corrected; "
        "synchronise the cameras.",
        "covered": "Two cameras or more see only {share} of the keypoints.",
        "stature": "The body is {height:.2f} m tall; people are .5 to 2.3 m: the calibration may "
        "be in another unit.",
        "alone": "One camera leaves depth open: {given}distance, turns towards the camera and what "
        "it does not see come from the priors.",
        "height": "The body is {height:.0f} cm tall; {given:.0f} cm were given.",
        "acceleration": "Joints accelerate by {value:.0f} m/s^2 (RMS); the motion trembles.",
        "pose": "Poses are {value:.1f} standard deviations (RMS) from usual ones.",
        **COMMON_SENTENCES,
    }
)
