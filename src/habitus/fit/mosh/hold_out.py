"""Held-out markers: left out of everything, then predicted at the layout's default place (MoSh 8.1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from habitus.fit.mosh.result import HeldOut, MarkerFit
from habitus.fit.mosh.shape import place
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach, default_markers
from habitus.parallel.blocks import distances


@dataclass(frozen=True)
class HeldMarkers:
    """Markers that a fit did not see: their default places, and one (T, H, 3) array of observations a recording."""

    layout: MarkerLayout
    observed: tuple[np.ndarray, ...]


def held_out_errors(fit: MarkerFit, layout: MarkerLayout, observed: np.ndarray) -> HeldOut:
    """Distances from ``observed`` (T, H, 3) to the default places v_i(betas) on the fitted body, both stages."""
    placement = place(layout, fit.body)
    latent = default_markers(fit.body, fit.betas, placement.vertices, placement.distance)
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
