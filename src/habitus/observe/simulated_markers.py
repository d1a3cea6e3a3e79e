"""Simulated captures: what a marker system would record of a known body with any layout (M 10),
with the faults that real captures have.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.mesh.proximity import signed_distance
from habitus.observe.markers import MarkerAttachment, attach, default_markers, predict_markers


@dataclass(frozen=True)
class Faults:
    """Faults of a capture: placement and noise (sd, metres), share of samples lost in gaps of
    ``gap`` frames.

    swapped: two markers whose labels are exchanged, from which frame, up to which.
    """

    placement: float = 0.01
    noise: float = 0.001
    missing: float = 0.03
    gap: int = 12
    swapped: tuple[int, int, int, int] | None = None


CLEAN = Faults(placement=0.0, noise=0.0, missing=0.0)
"""Markers exactly where the layout puts them, all seen."""


@dataclass(frozen=True)
class SyntheticCapture:
    """Markers as recorded (T, M, 3) with NaN gaps, and the truth behind them."""

    observed: Float[np.ndarray, "T M 3"]
    latent_markers: Float[np.ndarray, "M 3"]
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]


def smooth_motion(
    mean: Float[np.ndarray, " n"],
    sd: Float[np.ndarray, " n"],
    frames: int,
    rate_hz: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """A band-limited random motion about a mean pose: pose (T, J, 3) with a turning root, and trans
    (T, 3), y up.
    """
    seconds = np.arange(frames) / rate_hz
    frequency = rng.uniform(0.1, 0.6, size=(3, len(mean)))
    phase = rng.uniform(0, 2 * np.pi, size=(3, len(mean)))
    waves = np.sin(2 * np.pi * frequency[:, :, None] * seconds + phase[..., None]).sum(
        axis=0
    ).T / np.sqrt(1.5)
    joints = (mean + 0.7 * sd * waves).reshape(frames, -1, 3)
    turn = 0.4 * seconds
    sway = np.sin(2 * np.pi * 0.3 * seconds)
    root = np.stack([0.1 * sway, turn, 0.05 * sway], axis=1)
    trans = np.stack(
        [0.8 * np.sin(0.4 * seconds), 1.0 + 0.03 * sway, 0.8 * np.cos(0.4 * seconds)], axis=1
    )
    return np.concatenate([root[:, None], joints], axis=1), trans


def misplace(
    body: BodyModel,
    betas: np.ndarray,
    places: np.ndarray,
    distance: np.ndarray,
    error: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "M 3"]:
    """Latent markers put on by hand: default places moved along the skin by ``error`` (sd), at
    their distance.
    """
    vertices = body.rest_vertices(betas)
    moved = default_markers(body, betas, places, distance) + rng.normal(
        scale=error, size=(len(places), 3)
    )
    for _ in range(3):
        near = signed_distance(moved, vertices, body.faces)
        moved = moved + (distance - near.distance)[:, None] * near.direction
    return moved


def simulate_capture(
    body: BodyModel,
    betas: np.ndarray,
    pose: np.ndarray,
    trans: np.ndarray,
    places: np.ndarray,
    distance: np.ndarray,
    faults: Faults,
    rng: np.random.Generator,
) -> SyntheticCapture:
    """Markers of M ``places`` (template vertices) on a moving body, recorded with ``faults``."""
    latent = misplace(body, betas, places, distance, faults.placement, rng)
    attachment = attach(latent, body.rest_vertices(betas), body.faces)
    used, corners = np.unique(attachment.triangles, return_inverse=True)
    surface = body(betas, pose, trans, vertices=used).vertices
    compact = type(attachment)(corners.reshape(-1, 3), attachment.coefficients)
    observed = predict_markers(surface, compact)
    observed += rng.normal(scale=faults.noise, size=observed.shape)
    if faults.swapped is not None:
        i, j, first, last = faults.swapped
        observed[first:last, [i, j]] = observed[first:last, [j, i]]
    observed[lost_samples(observed.shape[:2], faults, rng)] = np.nan
    return SyntheticCapture(observed, latent, betas, pose, trans)


def lost_samples(
    shape: tuple[int, int], faults: Faults, rng: np.random.Generator
) -> Bool[np.ndarray, "T M"]:
    """Which samples (T, M) are lost, in gaps."""
    lost = np.zeros(shape, dtype=bool)
    for _ in range(int(faults.missing * shape[0] * shape[1] / max(faults.gap, 1))):
        start = rng.integers(shape[0])
        marker = rng.integers(shape[1])
        lost[start : start + faults.gap, marker] = True
    return lost


def layout_attachment(
    moving: Moving,
    places: Int[np.ndarray, " M"],
    distance: Float[np.ndarray, " M"],
    placement: float,
    rng: np.random.Generator,
) -> MarkerAttachment:
    """A layout's markers on a person, at ``places`` (vertices) and ``distance`` from the skin (m).

    ``placement`` (m, sd) moves them along the skin, as hands do that put them on.
    """
    given = moving.body, moving.betas, places, distance
    latent = misplace(*given, placement, rng) if placement else default_markers(*given)
    return attach(latent, moving.body.rest_vertices(moving.betas), moving.body.faces)


def carried_markers(moving: Moving, attachment: MarkerAttachment) -> Float[np.ndarray, "T M 3"]:
    """Markers (m) that ride on the skin in every frame, soft tissue included (M equation 2)."""
    used, corners = np.unique(attachment.triangles, return_inverse=True)
    return predict_markers(
        moving.points(used), MarkerAttachment(corners.reshape(-1, 3), attachment.coefficients)
    )


def recorded(
    markers: Float[np.ndarray, "T M 3"], faults: Faults, rng: np.random.Generator
) -> Float[np.ndarray, "T M 3"]:
    """The same with noise on every sample, and gaps (NaN)."""
    recorded = (
        markers + rng.normal(scale=faults.noise, size=markers.shape)
        if faults.noise
        else markers.copy()
    )
    recorded[lost_samples(recorded.shape[:2], faults, rng)] = np.nan
    return recorded
