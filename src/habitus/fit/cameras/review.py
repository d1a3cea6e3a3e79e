"""What is known of one person's detections, and what a round of the fit adds to it: sides that a
camera exchanged are put back, noise, clocks and cameras that are off are estimated.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.fit.cameras.settings import CameraSettings
from habitus.observe.keypoints import KeypointRig

SIDES = (
    ("hip", "knee", "ankle", "heel", "big_toe", "small_toe", "foot_index"),
    ("shoulder", "elbow", "wrist", "pinky", "index", "thumb"),
    ("eye", "ear", "eye_inner", "eye_outer", "mouth"),
)
"""Keypoints whose sides a detector exchanges together."""
NOISE_RANGE = (0.5, 3.0)
"""Of estimated noise, in those of the table."""
EXCHANGE = 0.5
"""An exchange is undone where it leaves so much of the robust cost."""
MIN_HEIGHT_PX = 20.0
SAMPLE = 5000
"""Frames, at most, by which noise, clocks and what cameras are off are estimated."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What is known of one person's detections: pixels (T, C, K, 2), confidence (T, C, K), the
    person's height in pixels (T, C), noise as a factor of the table's (C, K), seconds that each
    camera's clock is late (C,), and samples whose sides were put back (T, C).
    """

    pixels: Float[np.ndarray, "T C K 2"]
    confidence: Float[np.ndarray, "T C K"]
    size: Float[np.ndarray, "T C"]
    noise: Float[np.ndarray, "C K"]
    late: Float[np.ndarray, " C"]
    exchanged: Bool[np.ndarray, "T C"]


class Expected(NamedTuple):
    """The body's keypoints in the frames ``rows``: pixels and speeds (px/s), (R, C, K, 2)."""

    rows: Int[np.ndarray, " R"]
    pixels: Float[np.ndarray, "R C K 2"]
    speed: Float[np.ndarray, "R C K 2"]


def reviewed(
    sight: Sight,
    expected: Float[np.ndarray, "T C K 2"],
    keypoints: KeypointRig,
    rate_hz: float,
    settings: CameraSettings,
    free: bool,
    correct: bool,
) -> tuple[Sight, bool]:
    """Detections after a round, sides put back, and whether cameras become unknowns (``correct``:
    they may). Noise and clocks are estimated once the cameras agree.
    """
    sight = sides_put_back(sight, expected, keypoints, settings)
    rows = np.arange(1, len(expected) - 1, -(-len(expected) // SAMPLE))
    if not len(rows):
        rows = np.arange(len(expected))
    speed = (
        0.5
        * rate_hz
        * (expected[np.minimum(rows + 1, len(expected) - 1)] - expected[np.maximum(rows - 1, 0)])
    )
    known = Expected(rows, expected[rows], speed)
    biased = bool(np.max(camera_bias(sight, known, rate_hz)) > settings.camera_bias)
    if correct and biased and not free:
        return sight, True
    sight = replace(sight, noise=estimated_noise(sight, known, keypoints))
    for _ in range(settings.clock_steps):
        sight = replace(sight, late=estimated_lateness(sight, known, rate_hz, settings))
    return sight, False


def of_frames(sight: Sight, rows: slice | np.ndarray) -> Sight:
    """Some frames of it."""
    names = ("pixels", "confidence", "size", "exchanged")
    return replace(sight, **{name: getattr(sight, name)[rows] for name in names})


def information(sight: Sight, keypoints: KeypointRig, factor: float) -> Float[np.ndarray, "T C K"]:
    """1 / px^2 of each detection: by keypoint, camera, the person's size and the confidence."""
    sd = factor * keypoints.noise * sight.noise * np.maximum(sight.size, MIN_HEIGHT_PX)[..., None]
    return np.where(sight.confidence > 0.0, np.maximum(sight.confidence, 0.05), 0.0) / sd**2


def shifted(
    sight: Sight, rate_hz: float, rows: Int[np.ndarray, " R"] | slice = slice(None)
) -> Float[np.ndarray, "R C K 2"]:
    """The pixels at the times of the frames ``rows``: each camera's, as late as its clock, between
    its frames.
    """
    frames = len(sight.pixels)
    out = sight.pixels[rows].copy()
    for c, late in enumerate(sight.late):
        if late == 0.0:
            continue
        at = np.arange(frames)[rows] + late * rate_hz
        low = np.clip(np.floor(at).astype(int), 0, frames - 1)
        high = np.minimum(low + 1, frames - 1)
        share = (at - low)[:, None, None]
        between = (1.0 - share) * sight.pixels[low, c] + share * sight.pixels[high, c]
        between[(at < 0) | (at > frames - 1)] = np.nan
        out[:, c] = between
    return out


def sides_put_back(
    sight: Sight,
    expected: Float[np.ndarray, "T C K 2"],
    keypoints: KeypointRig,
    settings: CameraSettings,
) -> Sight:
    """Left and right exchanged back where a camera's detections fit much better that way."""
    names, weights = keypoints.names, information(sight, keypoints, settings.noise)
    pixels, sure = sight.pixels.copy(), sight.confidence.copy()
    exchanged = sight.exchanged.copy()
    for group in SIDES:
        pairs = [
            (names.index(f"left_{one}"), names.index(f"right_{one}"))
            for one in group
            if f"left_{one}" in names and f"right_{one}" in names
        ]
        if not pairs:
            continue
        left, right = (np.array(each) for each in zip(*pairs, strict=True))
        here = np.concatenate([left, right])
        there = np.concatenate([right, left])
        as_is = _robust(weights[..., here], expected[..., here, :] - pixels[..., here, :], settings)
        other = _robust(
            weights[..., there], expected[..., here, :] - pixels[..., there, :], settings
        )
        swap = (other < EXCHANGE * as_is) & (as_is > len(here))
        t, c = np.nonzero(swap)
        pixels[t[:, None], c[:, None], here] = sight.pixels[t[:, None], c[:, None], there]
        sure[t[:, None], c[:, None], here] = sight.confidence[t[:, None], c[:, None], there]
        exchanged |= swap
    return replace(sight, pixels=pixels, confidence=sure, exchanged=exchanged)


def _robust(weights: np.ndarray, off: np.ndarray, settings: CameraSettings) -> np.ndarray:
    """Sum over keypoints of Geman-McClure's loss, in squared standard deviations."""
    squared = weights * np.nan_to_num((off**2).sum(-1), nan=0.0)
    return (squared / (1.0 + squared / settings.reach**2)).sum(-1)


def camera_bias(sight: Sight, expected: Expected, rate_hz: float) -> Float[np.ndarray, " C"]:
    """By how much all that a camera sees is off in one direction, as a share of the person's
    height: medians over frames and keypoints.
    """
    rows = expected.rows
    off = (shifted(sight, rate_hz, rows) - expected.pixels) / np.maximum(
        sight.size[rows], MIN_HEIGHT_PX
    )[..., None, None]
    bias = np.zeros(off.shape[1])
    for c in range(off.shape[1]):
        seen = off[:, c][(sight.confidence[rows, c] > 0.0) & np.isfinite(off[:, c]).all(-1)]
        bias[c] = np.linalg.norm(np.median(seen, axis=0)) if len(seen) else 0.0
    return bias


def estimated_noise(
    sight: Sight, expected: Expected, keypoints: KeypointRig
) -> Float[np.ndarray, "C K"]:
    """Of each keypoint in each camera, as a factor of the table's: by the median distance."""
    sight = of_frames(sight, expected.rows)
    as_said = replace(sight, noise=np.ones_like(sight.noise))
    sd = 1.0 / np.sqrt(np.maximum(information(as_said, keypoints, 1.0), 1e-12))
    off = np.linalg.norm(expected.pixels - sight.pixels, axis=-1) / sd
    off = np.where(sight.confidence > 0.0, off, np.nan)
    off = np.where(
        np.isfinite(off), off, np.inf
    )  # the median of what was seen: infinities sort last
    count = (off < np.inf).sum(0)
    ordered = np.sort(off, axis=0)
    middle = np.take_along_axis(ordered, (np.maximum(count - 1, 0) // 2)[None], 0)[0]
    typical = np.where(count > 0, middle / 1.18, 1.0)  # of a plane's distance, in its sd
    return np.clip(typical, *NOISE_RANGE)


def estimated_lateness(
    sight: Sight, expected: Expected, rate_hz: float, settings: CameraSettings
) -> Float[np.ndarray, " C"]:
    """Seconds by which each camera's clock is late, by the speeds of what it sees; their mean is 0.

    What a camera is off on the whole is taken out before; what is no larger than its error, or than
    a quarter of a frame, is none.
    """
    rows, speed = expected.rows, expected.speed
    off = shifted(sight, rate_hz, rows) - expected.pixels
    scale = np.maximum(sight.size[rows], MIN_HEIGHT_PX)[..., None]
    late = sight.late.copy()
    for c in range(len(late)):
        seen = np.isfinite(off[:, c]).all(-1) & (sight.confidence[rows, c] > 0.0)
        seen &= np.isfinite(speed[:, c]).all(-1)
        if not seen.any():
            continue
        own, moving = off[:, c] - np.median(off[:, c][seen], axis=0), speed[:, c]
        moving = moving - np.median(moving[seen], axis=0)
        squared = np.where(seen, np.nan_to_num((own**2).sum(-1)), 0.0)
        weight = seen / (1.0 + squared / (0.05 * scale[:, c]) ** 2) ** 2
        along = float((weight * np.nan_to_num((own * moving).sum(-1))).sum())
        square = float((weight * np.nan_to_num((moving**2).sum(-1))).sum())
        spread = float((weight * squared).sum() / max(weight.sum(), 1e-9))
        change = -along / max(square, 1e-9)  # a late camera shows what was before
        # detections err alike for some frames: a tenth of them count as independent
        error = np.sqrt(10.0 * spread / max(square, 1e-9))
        whole = late[c] + change
        late[c] = whole if abs(whole) > max(3.0 * error, 0.25 / rate_hz) else 0.0
    late = late - np.median(late)
    return np.clip(late, -settings.max_offset, settings.max_offset)
