"""Virtual markers: what a marker system would record of a body in motion, with any layout (M
10).
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.body.motion import Moving
from habitus.observe.markers import MarkerAttachment, attach, default_markers, predict_markers
from habitus.population.captures import Faults, lost_samples, misplace

CLEAN = Faults(placement=0.0, noise=0.0, missing=0.0)
"""Markers exactly where the layout puts them, all seen."""


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
    found = (
        markers + rng.normal(scale=faults.noise, size=markers.shape)
        if faults.noise
        else markers.copy()
    )
    found[lost_samples(found.shape[:2], faults, rng)] = np.nan
    return found
