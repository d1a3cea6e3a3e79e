"""Missing markers: short gaps are interpolated, joints bridged through longer ones, and gaps of a
capture filled from its fit (MoSh sec. 10, "fixing occlusions").

The pose prior alone would let a limb sag to its mean pose within a few frames. Where too few of the
markers that a joint moves are seen, its rotation is bridged by the curve of least acceleration
under tension, x'''' = x'' / tau^2, from position and velocity on both sides: a velocity persists
for the time tau, then the curve is straight. tau is the time in which a joint usually covers its
range, so that a swinging limb keeps its velocity for less time than a walking body; it falls with
the length of the gap. Leading and trailing gaps hold.

The output fills a gap by the predicted marker plus the marker's offset from it, in the axes of its
triangle, interpolated between both ends of the gap, so that what is filled joins what was observed.
All constants are in `GapSettings`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from habitus.arrays import runs
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import GAPS, SUSPECTS, GapSettings
from habitus.observe.marker_prediction import MarkedBody, predict
from habitus.observe.markers import MarkerAttachment, predict_markers, triangle_bases
from habitus.parallel.blocks import by_column, mapped, with_columns
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix


class MarkerTargets(NamedTuple):
    """What predicted markers are fitted to: positions in metres (NaN where unknown) and weights,
    None for 1.
    """

    markers: Float[np.ndarray, "T M 3"]
    weights: Float[np.ndarray, "T M"] | None


def bridged(
    rig: MarkedBody,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    observed: Float[np.ndarray, "T M 3"],
    rate_hz: float,
    settings: GapSettings = GAPS,
    large_residual: float = SUSPECTS.large_residual,
) -> tuple[MarkerTargets, Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """Targets of every frame, and pose and trans to start from, from a fit of the seen markers.

    Residuals longer than ``large_residual`` (m) are not carried into gaps.
    """
    if _seen(observed).all():
        return MarkerTargets(observed, None), pose, trans
    filled = fill_short_gaps(observed, rate_hz, settings)
    seen = _seen(filled)
    known = known_joints(rig, pose, seen, settings)
    pose, trans = bridge_states(pose, trans, known, rate_hz, settings)
    hidden = np.where(seen.any(axis=0), settings.weight, 0.0)
    weights = mapped(lambda part: np.where(part, 1.0, hidden), seen)
    return MarkerTargets(stand_ins(rig, pose, trans, filled, large_residual), weights), pose, trans


def without(targets: MarkerTargets, markers: Sequence[int]) -> MarkerTargets:
    """The same targets with weight 0 for some markers (columns)."""
    if not len(markers):
        return targets
    kept = np.ones(targets.markers.shape[1])
    kept[list(markers)] = 0.0
    if targets.weights is None:
        weights = mapped(lambda part: np.tile(kept, (len(part), 1)), targets.markers)
    else:
        weights = mapped(lambda part: part * kept, targets.weights)
    return targets._replace(weights=weights)


def fill_short_gaps(
    observed: Float[np.ndarray, "T M 3"], rate_hz: float, settings: GapSettings = GAPS
) -> Float[np.ndarray, "T M 3"]:
    """Markers with their gaps of up to ``short`` seconds filled, by cubics through the samples on
    both sides (Akima).
    """
    seen = _seen(observed)
    gappy = np.flatnonzero(~seen.all(axis=0) & (seen.sum(axis=0) > 1))
    short = {
        int(marker): _short_gaps(seen[:, marker], settings.short * rate_hz) for marker in gappy
    }
    chosen = [marker for marker, inside in short.items() if len(inside)]
    if not chosen:
        return observed
    return with_columns(
        observed, chosen, lambda column, marker: _filled(column, seen[:, marker], short[marker])
    )


def _short_gaps(seen: Bool[np.ndarray, " T"], longest: float) -> np.ndarray:
    """Frames inside gaps of at most so many."""
    frames = np.flatnonzero(seen)
    width = np.diff(frames) - 1
    short = np.flatnonzero((width > 0) & (width <= longest))
    return np.concatenate(
        [np.arange(frames[k] + 1, frames[k + 1]) for k in short] or [np.zeros(0, int)]
    )


def _filled(
    column: Float[np.ndarray, "T 3"], seen: Bool[np.ndarray, " T"], inside: np.ndarray
) -> np.ndarray:
    frames = np.flatnonzero(seen)
    out = column.copy()
    from scipy.interpolate import Akima1DInterpolator  # slow to import; whole captures need none

    out[inside] = Akima1DInterpolator(frames, column[frames])(inside)
    return out


def _seen(markers: Float[np.ndarray, "T M 3"]) -> Bool[np.ndarray, "T M"]:
    return mapped(lambda part: np.isfinite(part[..., 0]), markers)


def known_joints(
    rig: MarkedBody,
    pose: Float[np.ndarray, "T J 3"],
    seen: Bool[np.ndarray, "T M"],
    settings: GapSettings = GAPS,
) -> Bool[np.ndarray, "T J"]:
    """In which frames enough markers are seen that each joint moves, of those that ever are.

    A joint that moves none counts as known: nothing is to be bridged.
    """
    usual = by_column(lambda rotations: np.median(rotations, axis=0), pose)
    moves = _leverage(rig, usual, settings.max_lever) * np.any(seen, axis=0)[:, None]
    whole = moves.sum(axis=0)
    return mapped(
        lambda part: (part @ moves >= settings.visible_share * whole) | (whole < 1e-6), seen
    )


def _leverage(
    rig: MarkedBody, pose: Float[np.ndarray, "J 3"], max_lever: float, step: float = 1e-3
) -> Float[np.ndarray, "M J"]:
    """How far each joint moves each marker, squared metres a squared radian, levers cut at
    ``max_lever``.
    """
    joints = len(pose)
    tried = np.repeat(pose[None], 3 * joints + 1, axis=0)
    tried[
        np.arange(3 * joints), np.repeat(np.arange(joints), 3), np.tile(np.arange(3), joints)
    ] += step
    markers = predict(rig, tried, np.zeros((len(tried), 3)))
    way = (
        np.sum((markers[:-1] - markers[-1]) ** 2, axis=2).reshape(joints, 3, -1).sum(axis=1)
        / step**2
    )
    return np.minimum(way.T, max_lever**2)


def bridge_states(
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    known: Bool[np.ndarray, "T J"],
    rate_hz: float,
    settings: GapSettings = GAPS,
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """Pose and trans with what is not known in them bridged; trans goes with the root."""
    unknown = np.flatnonzero(~known.all(axis=0)).tolist()
    turned = with_columns(
        pose,
        unknown,
        lambda column, joint: bridge_rotations(column, known[:, joint], rate_hz, settings),
    )
    return turned, bridge(trans, known[:, 0], rate_hz, settings)


def bridge(
    values: Float[np.ndarray, "T n"],
    known: Bool[np.ndarray, " T"],
    rate_hz: float = 0.0,
    settings: GapSettings = GAPS,
) -> Float[np.ndarray, "T n"]:
    """Values bridged where they are not known, in a straight line without a rate; held before the
    first known one and after the last.
    """
    out = values.copy()
    for first, last in runs(~known):
        if first > 0 and last < len(values):
            near = _near(known, first, last, rate_hz, settings)
            around = slice(
                max(0, first - settings.neighbour_frames), last + settings.neighbour_frames
            )
            reach = (
                _reach(values[around], known[around], (last - first) / rate_hz, rate_hz, settings)
                if rate_hz
                else 0.0
            )
            out[first:last] = _across(values[near], near, first, last, reach)
        elif known.any():
            out[first:last] = values[last if first == 0 else first - 1]
    return out


def bridge_rotations(
    rotvecs: Float[np.ndarray, "T 3"],
    known: Bool[np.ndarray, " T"],
    rate_hz: float = 0.0,
    settings: GapSettings = GAPS,
) -> Float[np.ndarray, "T 3"]:
    """The same of rotation vectors, each gap as seen from the frame before it: the short way
    round.
    """
    out = rotvecs.copy()
    for first, last in runs(~known):
        origin = rotvecs[first - 1 if first else min(last, len(rotvecs) - 1)]
        start = matrix_from_rotvec(origin)
        part = slice(max(0, first - settings.neighbour_frames), last + settings.neighbour_frames)
        relative = rotvec_from_matrix(start.T @ matrix_from_rotvec(rotvecs[part]))
        inside = slice(first - part.start, last - part.start)
        bridged = bridge(relative, known[part], rate_hz, settings)[inside]
        out[first:last] = rotvec_from_matrix(start @ matrix_from_rotvec(bridged))
    return out


def stand_ins(
    rig: MarkedBody,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    observed: Float[np.ndarray, "T M 3"],
    large_residual: float = SUSPECTS.large_residual,
) -> Float[np.ndarray, "T M 3"]:
    """Observed markers, the missing ones where a (bridged) body carries them.

    What a marker was off the body on both sides of its gap goes over from the one to the other, so
    that nothing jumps.
    """
    carried = predict(rig, pose, trans)
    seen = _seen(observed)
    gappy = np.flatnonzero(~seen.all(axis=0) & seen.any(axis=0)).tolist()
    off = mapped(lambda part, body: _plain_offsets(part, body, large_residual), observed, carried)
    off = with_columns(off, gappy, lambda column, marker: bridge(column, seen[:, marker]))
    return mapped(
        lambda there, places, body, beside: np.where(
            there[..., None], np.nan_to_num(places), body + beside
        ),
        *(seen, observed, carried, off),
    )


def _plain_offsets(observed: np.ndarray, carried: np.ndarray, large_residual: float) -> np.ndarray:
    """How far observed markers are off the body, 0 where missing or beyond ``large_residual``."""
    off = np.nan_to_num(observed - carried)
    off[np.linalg.norm(off, axis=2) > large_residual] = 0.0
    return off


def _near(
    known: Bool[np.ndarray, " T"], first: int, last: int, rate_hz: float, settings: GapSettings
) -> np.ndarray:
    """Frames on both sides of a gap, next to it and known throughout, to measure velocities by."""
    window = min(max(2, round(settings.velocity_window_s * rate_hz)), settings.neighbour_frames)
    before = known[max(0, first - window) : first][::-1]
    after = known[last : last + window]
    count = [len(side) if side.all() else int(np.argmin(side)) for side in (before, after)]
    return np.concatenate([np.arange(first - count[0], first), np.arange(last, last + count[1])])


def _across(
    values: np.ndarray, near: np.ndarray, first: int, last: int, reach: float
) -> np.ndarray:
    """Values (last - first, n) of the gap from those ``near`` it: a + b u + c exp(-u / reach) + d
    exp((u - n) / reach).

    u counts frames from the last before the gap; n is the first after it. Without reach it is the
    straight line.
    """
    u = np.arange(1.0, last - first + 1)
    end = float(last - first + 1)
    left = values[near < first]
    right = values[near >= last]
    line = left[-1] + (u / end)[:, None] * (right[0] - left[-1])
    if reach <= 0.0:
        return line
    k = 1.0 / reach
    fall = np.exp(-end / reach)
    rows = [[1, 0, 1, fall], [0, 1, -k, k * fall], [1, end, fall, 1], [0, 1, -k * fall, k]]
    given = np.stack([left[-1], _velocity(left, -1), right[0], _velocity(right, 0)])
    return np.stack([u**0, u, np.exp(-k * u), np.exp(k * (u - end))], axis=1) @ np.linalg.solve(
        rows, given
    )


def _reach(
    values: Float[np.ndarray, "F n"],
    known: Bool[np.ndarray, " F"],
    seconds: float,
    rate_hz: float,
    settings: GapSettings,
) -> float:
    """Frames for which a velocity lasts in a gap of so many seconds: spread over speed where values
    are known.
    """
    seen = values[known]
    pairs = known[1:] & known[:-1]
    spread = np.sqrt(np.mean(np.sum((seen - seen.mean(axis=0)) ** 2, axis=1)))
    steps = np.sum(np.diff(values, axis=0)[pairs] ** 2, axis=1)
    speed = rate_hz * np.sqrt(np.mean(steps)) if len(steps) else 0.0
    share = np.clip(1.0 / seconds**2, 0.0, 2.0)
    return (
        float(np.clip(share * spread / max(speed, 1e-9), *settings.velocity_persistence_s))
        * rate_hz
    )


def _velocity(values: Float[np.ndarray, "F n"], at: int) -> Float[np.ndarray, " n"]:
    """Slope at the first (0) or last (-1) of values that follow each other: of a parabola through
    four or more, of a line through fewer, 0 of a single one.
    """
    time = np.arange(len(values))
    degree = 2 if len(values) > 3 else min(1, len(values) - 1)
    return np.polyfit(time - time[at], values, degree)[-2] if degree else np.zeros(values.shape[1])


@dataclass(frozen=True)
class Gap:
    """A marker's frames ``first`` to ``last`` without a sample; ``why`` says why it stays empty, ""
    where it is filled.

    ``nearby`` is the median number of other markers that were seen meanwhile on the same part of
    the body or a part beside it: what is filled where that is 0 rests on the pose prior and the
    frames around.
    """

    label: str
    first: int
    last: int
    nearby: int
    why: str = ""

    @property
    def frames(self) -> int:
        """How many."""
        return self.last - self.first + 1


@dataclass(frozen=True, eq=False)
class Filling:
    """The markers with their gaps filled (T, M, 3), which samples these are (T, M), and every
    gap.
    """

    labels: tuple[str, ...]
    markers: Float[np.ndarray, "T M 3"]
    filled: Bool[np.ndarray, "T M"]
    gaps: tuple[Gap, ...]


def fill_gaps(
    fit: MarkerFit,
    observed: Float[np.ndarray, "T M 3"],
    left_out: Mapping[str, str] = MappingProxyType({}),
    settings: GapSettings = GAPS,
) -> Filling:
    """The gaps of ``observed``, in metres, the fit's frames and the order of its labels, filled
    where the fit knows.

    Empty stay frames with too few markers, gaps of markers under suspicion (what a label carries is
    not sure then), gaps whose ends do not lie on the body, and labels that are ``left_out`` for the
    reason given.
    """
    missing = ~np.isfinite(observed[..., 0])
    refused = _suspicious(fit) | dict(left_out)
    predicted, bases = _carried(fit)
    beside = _beside(fit)
    markers = np.array(observed)
    filled = np.zeros_like(missing)
    gaps = []
    for marker, label in enumerate(fit.labels):
        for first, stop in runs(missing[:, marker]):
            last = stop - 1
            gap = slice(first, stop)
            ends = [t for t in (first - 1, last + 1) if 0 <= t < len(observed)]
            near = int(np.median((~missing[gap][:, beside[marker]]).sum(1)))
            why = refused.get(label) or _refusal(fit, marker, gap, ends, settings.fill_weight)
            if not why:
                off = [
                    bases[t, marker].T @ (observed[t, marker] - predicted[t, marker]) for t in ends
                ]
                placed = (
                    predicted[gap, marker]
                    + (bases[gap, marker] @ _between(off, last - first + 1)[..., None])[..., 0]
                )
                known = ~fit.flagged_frames[gap]
                markers[gap, marker] = np.where(known[:, None], placed, np.nan)
                filled[gap, marker] = known
            gaps.append(Gap(label, first, last, near, why))
    return Filling(fit.labels, markers, filled, tuple(gaps))


def _suspicious(fit: MarkerFit) -> dict[str, str]:
    return {
        each.label: f"under suspicion: {each.reason}" for each in fit.suspects if not each.corrected
    }


def _refusal(fit: MarkerFit, marker: int, gap: slice, ends: list[int], least: float) -> str:
    if not ends:
        return "never seen"
    if fit.marker_weights[ends, marker].min() < least:
        return "the samples beside it do not lie on the body"
    return "too few markers are seen" if fit.flagged_frames[gap].all() else ""


def _between(ends: list[np.ndarray], frames: int) -> Float[np.ndarray, "G 3"]:
    """Offsets in a gap: on the straight way from one end's to the other's, or as at the only
    end.
    """
    share = np.arange(1, frames + 1)[:, None] / (frames + 1)
    return ends[0] + share * (ends[-1] - ends[0])


def _carried(fit: MarkerFit) -> tuple[np.ndarray, np.ndarray]:
    """Predicted markers (T, M, 3) and the axes of their triangles (T, M, 3, 3)."""
    used, corners = np.unique(fit.attachment.triangles, return_inverse=True)
    attachment = MarkerAttachment(corners.reshape(-1, 3), fit.attachment.coefficients)
    points = fit.points(used)
    return predict_markers(points, attachment), triangle_bases(points, attachment.triangles).basis


def _beside(fit: MarkerFit) -> Bool[np.ndarray, "M M"]:
    """Which other markers ride on the same joint as a marker, or on one next to it in the tree."""
    body = fit.body
    joint = body.strongest_joint[fit.attachment.triangles[:, 0]]
    parents = np.array(body.parents)
    one = joint[:, None]
    other = joint[None]
    near = (one == other) | (parents[one] == other) | (parents[other] == one)
    np.fill_diagonal(near, False)
    return near
