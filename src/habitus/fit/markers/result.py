"""The result of a marker fit: its solution with the verdict and the uncertainty of each segment.

Two measures of how well a fit is determined: the covariance of its betas, and the standard
deviation of each joint segment's position where few markers are seen and the pose prior decides.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior, prior_of
from habitus.fit.markers.judge import judge
from habitus.fit.markers.solution import (
    UNCERTAINTY,
    Guessed,
    MarkerSolution,
    UncertaintySettings,
)
from habitus.fit.verdict import Verdict
from habitus.mesh.proximity import farthest_points
from habitus.observe.marker_prediction import BodyMarkers
from habitus.observe.markers import marker_jacobian
from habitus.parallel.blocks import drop_pages

_BATCH = 8  # patterns of markers at once: bounds memory, changes no result


def guess(
    fit: MarkerSolution, prior: PosePrior, settings: UncertaintySettings = UNCERTAINTY
) -> Guessed:
    """What markers tell of each segment, over at most ``spans`` spans of time; ``prior``
    is the body's.
    """
    if not fit.labels:
        return Guessed(np.zeros(1, np.int64), np.full((1, fit.body.num_joints), np.inf))
    frames = len(fit.pose)
    spans = min(frames, settings.spans)
    edges = np.unique(np.linspace(0, frames, spans, endpoint=False).astype(np.int64))
    return Guessed(edges, segment_spread(fit, prior, edges, settings))


def segment_spread(
    fit: MarkerSolution,
    prior: PosePrior,
    edges: Int[np.ndarray, " F"],
    settings: UncertaintySettings = UNCERTAINTY,
) -> Float[np.ndarray, "F J"]:
    """How well the skin of each joint's segment is known (m), in the spans of frames that begin at
    ``edges``.

    The standard deviation of its place given the markers that are seen and trusted in some frame of
    the span, each off by ``place`` and its noise, and the prior over poses; shape is taken as it
    is. Spans that see the same markers share one number, from the
    pose in the middle of the first of them.
    """
    trusted = _trusted(fit, edges, settings.trusted)
    patterns, first, which = np.unique(trusted, axis=0, return_index=True, return_inverse=True)
    frames = (edges + np.diff(np.append(edges, len(fit.pose))) // 2)[first]
    noise = np.nan_to_num(np.asarray(fit.marker_noise, np.float64), nan=settings.place)
    rows, owners = _probes(fit.body, settings)
    precision = _precision(prior.for_joints(fit.body.joint_names).precision, settings.root_sd)
    spread = np.zeros((len(patterns), fit.body.num_joints))
    for start in range(0, len(patterns), _BATCH):
        part = slice(start, start + _BATCH)
        markers, probes = _moved(fit, fit.pose[frames[part]], fit.trans[frames[part]], rows)
        weight = np.repeat(patterns[part] / (settings.place**2 + noise**2), 3, axis=1)[..., None]
        known = precision + markers.swapaxes(1, 2) @ (weight * markers)
        left = np.linalg.solve(known, probes.swapaxes(1, 2))
        square = np.sum(probes * left.swapaxes(1, 2), axis=2).reshape(len(known), -1, 3).sum(2)
        for joint in np.unique(owners):
            spread[part, joint] = np.sqrt(square[:, owners == joint].mean(1))
    return spread[which.reshape(-1)]


def _trusted(fit: MarkerSolution, edges: np.ndarray, min_weight: float) -> Bool[np.ndarray, "F M"]:
    """Which markers are seen and trusted in some frame of each span."""
    spans = zip(edges, [*edges[1:], len(fit.pose)], strict=True)
    weights = fit.marker_weights
    observed = fit.observed_markers
    trusted = []
    for a, b in spans:
        trusted.append(((weights[a:b] >= min_weight) & np.isfinite(observed[a:b, :, 0])).any(0))
        drop_pages(weights, observed)
    return np.array(trusted, bool)


def _moved(
    fit: MarkerSolution,
    pose: Float[np.ndarray, "f J 3"],
    trans: Float[np.ndarray, "f 3"],
    rows: Int[np.ndarray, " P"],
) -> tuple[Float[np.ndarray, "f R N"], Float[np.ndarray, "f S N"]]:
    """How markers, and vertices, move with pose and place."""
    markers = marker_jacobian(fit.body, fit.attachment, fit.betas, pose, trans).by_pose
    probes = np.asarray(
        surface_jacobian(fit.body, fit.betas, pose, trans, vertices=rows).vertices_pose
    )
    both = (_with_trans(points.reshape(*points.shape[:3], -1)) for points in (markers, probes))
    first, second = (points.reshape(len(pose), -1, points.shape[-1]) for points in both)
    return first, second


def _precision(inner: Float[np.ndarray, "n n"], root_sd: float) -> Float[np.ndarray, "N N"]:
    """The prior's, with the root's turn before and the place behind, both as good as free."""
    size = len(inner) + 6
    whole = np.eye(size) / root_sd**2
    whole[3:-3, 3:-3] = inner
    return whole


def _with_trans(by_pose: Float[np.ndarray, "F M 3 n"]) -> Float[np.ndarray, "F M 3 N"]:
    return np.concatenate(
        [by_pose, np.broadcast_to(np.eye(3), (*by_pose.shape[:2], 3, 3))], axis=-1
    )


def _probes(
    body: BodyModel, settings: UncertaintySettings
) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]:
    """Vertices far apart on each joint's segment, and whose they are; none of a joint that carries
    no skin.
    """
    rows = []
    owners = []
    weight = np.zeros((body.num_vertices, body.num_joints))
    np.add.at(
        weight, (np.arange(body.num_vertices)[:, None], body.skinning_index), body.skinning_value
    )
    for joint in range(body.num_joints):
        own = np.flatnonzero(
            (weight[:, joint] >= settings.min_weight) & (weight.argmax(1) == joint)
        )
        if len(own):
            points = np.asarray(body.v_template)[own]
            first = int(np.linalg.norm(points - points.mean(0), axis=1).argmax())
            rows += own[farthest_points(points, settings.probes, first)].tolist()
            owners += [joint] * (len(rows) - len(owners))
    return np.array(rows, np.int64), np.array(owners, np.int64)


def betas_covariance(
    fit: MarkerSolution, settings: UncertaintySettings = UNCERTAINTY
) -> Float[np.ndarray, "B B"]:
    """The betas' posterior covariance (B, B): standard normal, seen through markers in one frame of
    free pose.

    Markers are off their places by ``place`` and by their noise. Frames do not make this less, as a
    marker is off alike in all of them; so the frame that sees most markers stands for all.
    """
    count = len(fit.betas)
    frame = int(np.argmax(fit.visible.sum(axis=1)))
    seen = fit.visible[frame] & np.isfinite(fit.marker_noise)
    rig = BodyMarkers(fit.body, fit.betas, fit.attachment)
    with_pose = rig.jacobian(fit.pose[[frame]], fit.trans[[frame]])
    shape = with_pose.by_betas[0][seen].reshape(-1, count)
    moved = np.concatenate(
        [with_pose.by_pose[0][seen].reshape(len(shape), -1), np.tile(np.eye(3), (seen.sum(), 1))], 1
    )
    weight = np.repeat(1.0 / np.sqrt(settings.place**2 + fit.marker_noise[seen] ** 2), 3)[:, None]
    shape = weight * shape
    moved = weight * moved
    both = moved.T @ shape
    left = shape.T @ shape - both.T @ np.linalg.solve(
        moved.T @ moved + np.eye(moved.shape[1]) / settings.pose_sd**2, both
    )
    return np.linalg.inv(np.eye(count) + 0.5 * (left + left.T))


COMPUTED = ("verdict", "guessed", "_pose_errors", "_soft_tissue_errors")
"""Of a fit, when first asked for."""


@dataclass(frozen=True)
class MarkerFit(MarkerSolution):
    """A body in motion, estimated from the markers of one capture, and how good the estimate is."""

    @cached_property
    def verdict(self) -> Verdict:
        """``level`` (good, doubtful or failed) and ``reasons``, a sentence each."""
        return judge(self)

    @cached_property
    def guessed(self) -> Guessed:
        """How well each joint's segment is known, over spans of time."""
        return guess(self, prior_of(self.body))

    def annotated(self, **changes: Any) -> "MarkerFit":
        """A copy with other warnings, times, held-out errors or notes on the body's choice.
        `verdict`, `guessed` and `errors` do not depend on these and are not computed again.
        """
        copy = replace(self, **changes)
        known = {key: vars(self)[key] for key in COMPUTED if key in vars(self)}
        vars(copy).update(known)
        return copy
