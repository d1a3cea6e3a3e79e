"""Held-out markers: left out of everything, then predicted where the prior over placements expects
them (MoSh 8.1).

MoSh expects them at the layout's place. Here the same hands put on all markers of a person: what a
marker's twin on the other side was found off its place, the marker is expected to be off its own,
as far as people's sides are alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.fit.markers.energy import place
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.solution import HeldOut
from habitus.markers.layouts import MarkerLayout
from habitus.markers.placements import PlacementPrior
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach, default_markers
from habitus.parallel.blocks import distances


@dataclass(frozen=True)
class HeldMarkers:
    """Markers that a fit did not see: their default places, and one (T, H, 3) array of observations
    a recording.

    others: those that the fit saw, where labels alone put them.
    """

    layout: MarkerLayout
    observed: tuple[np.ndarray, ...]
    others: MarkerLayout | None = None


def expected_offsets(
    fit: MarkerFit, held: HeldMarkers, prior: PlacementPrior
) -> Float[np.ndarray, "H 3"]:
    """How far from the layout's places the held-out markers are expected, metres on the fitted body
    at rest.

    Told by where the fit found the others (`PlacementPrior.expected`).
    """
    if held.others is None:
        return np.zeros((len(held.layout), 3))
    known = held.others.restricted_to(
        tuple(label for label in fit.labels if label in held.others.labels)
    )
    placement = place(known, fit.body)
    placed = fit.latent_markers[[fit.labels.index(label) for label in known.labels]]
    start = default_markers(fit.body, fit.betas, placement.vertices, placement.distance)
    return prior.expected(known, placed - start, held.layout)


def held_out_errors(
    fit: MarkerFit,
    layout: MarkerLayout,
    observed: np.ndarray,
    offsets: Float[np.ndarray, "H 3"] | float = 0.0,
) -> HeldOut:
    """Distances from ``observed`` (T, H, 3) to the default places v_i(betas) on the fitted body,
    both stages.

    offsets: what is expected beside these places (`expected_offsets`), metres at rest.
    """
    placement = place(layout, fit.body)
    latent = offsets + default_markers(fit.body, fit.betas, placement.vertices, placement.distance)
    at = attach(latent, fit.body.rest_vertices(fit.betas), fit.body.faces)
    rig = marked_body(fit.body, fit.betas, at, fit.soft_space)
    posed = distances(predict(rig, *fit.pose_stage), observed)
    if fit.soft_tissue is None:
        return HeldOut(layout.labels, posed, None)
    soft = distances(predict(rig, fit.pose, fit.trans, fit.soft_coefficients), observed)
    return HeldOut(layout.labels, posed, soft)


def merged(parts: Sequence[HeldOut]) -> HeldOut:
    """The errors of several folds side by side."""
    soft = [part.soft_tissue for part in parts if part.soft_tissue is not None]
    return HeldOut(
        tuple(label for part in parts for label in part.labels),
        np.concatenate([part.pose for part in parts], axis=1),
        np.concatenate(soft, axis=1) if len(soft) == len(parts) else None,
    )
