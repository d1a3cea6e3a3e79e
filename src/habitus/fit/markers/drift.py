"""Drift: markers that slide over the skin through a capture, while their latent places stay at the
mean.

A marker's residual in its limb's own axes has no trend while it stays where it is, except for what
skin and pose do to it. A trend is called drift when it is long (``min_trend``), steady against its
own scatter (``min_standard_errors``) and longer than other markers' (``min_ratio``), measured from
poses that were fitted without the marker. The limits are `DriftSettings`.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.skinning import world_motions
from habitus.fit.markers.sequence import SequenceResult, fit_sequence
from habitus.fit.markers.settings import DRIFT, SUSPECTS, DriftSettings, SequenceSettings
from habitus.observe.marker_prediction import MarkedBody, predict
from habitus.observe.markers import MarkerAttachment
from habitus.rotations import matrix_from_rotvec


class Drift(NamedTuple):
    """A marker's column, and how far (m) it slid over its limb."""

    marker: int
    distance: float


def find_drifts(
    body: BodyModel,
    attachment: MarkerAttachment,
    rig: MarkedBody,
    observed: Float[np.ndarray, "T M 3"],
    scale: Float[np.ndarray, " M"],
    rate_hz: float,
    prior: PosePrior,
    posed: SequenceResult,
    settings: SequenceSettings,
    limits: DriftSettings = DRIFT,
    large_residual: float = SUSPECTS.large_residual,
) -> tuple[Drift, ...]:
    """Markers that slide, longest way first; observed in metres, NaN where missing; scale of the
    robust loss (m).

    In captures of less than ``min_seconds`` none does.
    """
    if len(observed) < max(2 * limits.parts, limits.min_seconds * rate_hz):
        return ()
    some = np.unique(np.linspace(0, len(observed) - 1, limits.frames).astype(int))
    pose = posed.pose[some]
    trans = posed.trans[some]
    markers = np.ascontiguousarray(observed[some])
    limbs = limb_of(body, attachment)
    uncoupled = replace(settings, acceleration=0.0)

    def trends_without(left_out: list[int]) -> tuple[np.ndarray, np.ndarray]:
        weights = np.ones(markers.shape[:2])
        weights[:, left_out] = 0.0
        solution = fit_sequence(rig, markers, weights, scale, prior, pose, trans, uncoupled)
        off = markers - predict(rig, solution.pose, solution.trans)
        in_limb = np.einsum("tmji,tmj->tmi", limb_axes(body, solution.pose)[:, limbs], off)
        return trends(in_limb, limits, large_residual)

    return _one_by_one(trends_without, len(limbs), limits)


def _one_by_one(
    trends_without: Callable[[list[int]], tuple[np.ndarray, np.ndarray]],
    count: int,
    limits: DriftSettings,
) -> tuple[Drift, ...]:
    """Leave the most likely marker out; its trend then tells whether it slides or was pulled by one
    that does.
    """
    drifts: list[Drift] = []
    cleared = np.zeros(count, dtype=bool)
    way, steady = trends_without([])
    for _ in range(limits.max_candidates):
        out = [drift.marker for drift in drifts]
        open_to_doubt = np.where((steady > 0.5 * limits.min_standard_errors) & ~cleared, way, 0.0)
        open_to_doubt[out] = 0.0
        worst = int(np.argmax(open_to_doubt))
        if open_to_doubt[worst] < limits.candidate_trend:
            break
        alone, sure = trends_without([*out, worst])
        others = np.sort(np.delete(alone, [*out, worst]))[::-1]
        if (
            alone[worst]
            > max(
                limits.min_trend,
                limits.min_ratio * others[limits.ignored_others :].max(initial=0.0),
            )
            and sure[worst] > limits.min_standard_errors
        ):
            drifts.append(Drift(worst, float(alone[worst])))
            way = alone
            steady = sure
        else:
            cleared[worst] = True
    return tuple(sorted(drifts, key=lambda drift: -drift.distance))


def trends(
    off: Float[np.ndarray, "T M 3"],
    limits: DriftSettings = DRIFT,
    large_residual: float = SUSPECTS.large_residual,
) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, " M"]]:
    """How far each marker's residual (in its limb's axes, metres, NaN where missing) goes through
    all frames, and that in standard errors. 0 where a marker is far off in many frames, or hardly
    seen.
    """
    parts = np.array_split(np.arange(len(off)), limits.parts)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a part without samples is NaN
        middle = np.stack([np.nanmedian(off[part], axis=0) for part in parts])
        rough = np.nanmean(np.linalg.norm(off, axis=2) > large_residual, axis=0)
    seen = np.isfinite(middle[..., 0])
    count = np.maximum(seen.sum(axis=0), 1)
    time = np.where(seen, np.linspace(-0.5, 0.5, limits.parts)[:, None], 0.0)
    time = np.where(seen, time - time.sum(axis=0) / count, 0.0)
    values = np.where(seen[..., None], middle, 0.0)
    values = np.where(seen[..., None], values - values.sum(axis=0) / count[:, None], 0.0)
    spread = np.maximum(np.sum(time**2, axis=0), 1e-9)
    slope = np.einsum("pm,pmk->mk", time, values) / spread[:, None]
    left = np.sum((values - time[..., None] * slope) ** 2, axis=(0, 2)) / np.maximum(
        3 * (count - 2), 1
    )
    way = np.where((count >= limits.min_parts) & (rough < 0.3), np.linalg.norm(slope, axis=1), 0.0)
    return way, way / np.maximum(np.sqrt(left / spread), 1e-4)


def limb_of(body: BodyModel, attachment: MarkerAttachment) -> np.ndarray:
    """(M,) the joint that moves each marker's triangle most."""
    joints = body.skinning_index[attachment.triangles].reshape(attachment.num_markers, -1)
    values = body.skinning_value[attachment.triangles].reshape(attachment.num_markers, -1)
    share = np.zeros((attachment.num_markers, body.num_joints))
    np.add.at(share, (np.arange(len(joints))[:, None], joints), values)
    return np.argmax(share, axis=1)


def limb_axes(body: BodyModel, pose: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, "T J 3 3"]:
    """World rotation of each joint's limb."""
    return world_motions(matrix_from_rotvec(pose), np.zeros((*pose.shape[:2], 3)), body.parents)[
        ..., :3
    ]
