"""Markers that do not follow their label: labels exchanged for a time or throughout, fallen, ghost
and misplaced markers; each marker's noise.

Exchanges are found twice: before any fit, where two markers jump at once, each to the other's
predicted position, and their distances from all other markers confirm it (`find_flips`); and after
the first fit, from residuals (`find_swaps`). Constants are in `SuspectSettings` and `FlipSettings`.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from habitus.arrays import runs
from habitus.fit.markers.settings import FLIPS, SUSPECTS, FlipSettings, SuspectSettings
from habitus.parallel.blocks import blocks, by_column, columns, drop_pages, empty_array, mapped
from habitus.solve.terms import geman_mcclure_weight

MAD_TO_SD = 1.0 / np.sqrt(2.3660)  # median of a chi-squared variable with three degrees of freedom
QUARTER_TO_SD = 1.0 / np.sqrt(1.2125)  # and its lower quartile
_BLOCK = 1024  # frames of pairs at once: bounds memory, changes no result


@dataclass(frozen=True)
class Suspect:
    """A marker under suspicion: label, why, in how many frames, and whether it was put right before
    the fit.
    """

    label: str
    reason: str
    frames: int
    corrected: bool = False


def marker_noise(distance: np.ndarray, settings: SuspectSettings = SUSPECTS) -> np.ndarray:
    """(M,) robust noise sd per axis, metres, from residual lengths (T, M) with NaN where missing.

    From the median; of a marker that is far off for most of the time, from the lower quartile.
    """
    out = np.full(distance.shape[1], settings.min_noise)
    seen = np.isfinite(distance).any(axis=0)
    quarter, middle = by_column(_quarter_and_half, distance)[seen].T
    noise = np.where(middle > settings.large_residual, QUARTER_TO_SD * quarter, MAD_TO_SD * middle)
    out[seen] = np.maximum(noise, settings.min_noise)
    return out


def _quarter_and_half(distance: np.ndarray) -> np.ndarray:
    return (
        np.nanquantile(distance, [0.25, 0.5]) if np.isfinite(distance).any() else np.full(2, np.nan)
    )


def lengths(off: np.ndarray) -> np.ndarray:
    """(T, M) lengths of residuals (T, M, 3)."""
    return mapped(lambda part: np.linalg.norm(part, axis=2), off)


def find_swaps(
    observed: np.ndarray, predicted: np.ndarray, settings: SuspectSettings = SUSPECTS
) -> list[tuple[int, int, np.ndarray]]:
    """Pairs of markers that fit far better with their labels exchanged: (i, j, frames (T,) bool),
    worst first.

    observed and predicted (T, M, 3), metres. A pair counts in a frame when exchanging it lowers the
    summed distance by more than ``swap_gain`` and to less than ``crossed_share``. Pairs further
    apart than ``swap_distance`` are not examined.
    """
    mean = by_column(lambda places: np.nanmedian(places, axis=0), predicted)
    distances = np.linalg.norm(mean[:, None] - mean[None], axis=2)
    first, second = np.nonzero(np.triu(distances < settings.swap_distance, 1))
    better = empty_array((len(observed), len(first)), bool)
    counts = np.zeros(len(first), dtype=np.int64)
    for part in blocks(len(observed), _BLOCK):
        better[part] = _crossed(observed[part], predicted[part], first, second, settings)
        counts += better[part].sum(axis=0)
        drop_pages(better, observed, predicted)
    pairs = [
        (int(first[k]), int(second[k]), better[:, k].copy())
        for k in np.flatnonzero(counts >= settings.min_frames)
    ]
    return _disjoint(sorted(pairs, key=lambda swap: -int(swap[2].sum())))


def _crossed(
    observed: np.ndarray,
    predicted: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    settings: SuspectSettings,
) -> np.ndarray:
    """(T, P) where the markers of each pair fit far better exchanged."""
    own = np.linalg.norm(observed - predicted, axis=2)
    better = np.zeros((len(observed), len(first)), bool)
    frames, pairs = np.nonzero(
        own[:, first] + own[:, second] > settings.swap_gain
    )  # NaN compares false; most pairs fit well
    i = first[pairs]
    j = second[pairs]
    crossed = np.linalg.norm(observed[frames, i] - predicted[frames, j], axis=1)
    crossed += np.linalg.norm(observed[frames, j] - predicted[frames, i], axis=1)
    straight = own[frames, i] + own[frames, j]
    better[frames, pairs] = (crossed < settings.crossed_share * straight) & (
        straight - crossed > settings.swap_gain
    )
    return better


def _disjoint(swaps: list[tuple[int, int, np.ndarray]]) -> list[tuple[int, int, np.ndarray]]:
    """Swaps without those that touch a marker of a stronger one in the same frames."""
    kept: list[tuple[int, int, np.ndarray]] = []
    for i, j, frames in swaps:
        if not any({i, j} & {a, b} and (frames & others).any() for a, b, others in kept):
            kept.append((i, j, frames))
    return kept


def undo_swaps(observed: np.ndarray, swaps: list[tuple[int, int, np.ndarray]]) -> np.ndarray:
    """The observed markers with each swapped pair exchanged back in its frames."""
    out = mapped(np.array, observed)
    for i, j, frames in swaps:
        out[frames, i], out[frames, j] = observed[frames, j], observed[frames, i]
        drop_pages(out, observed)
    return out


def put_back(
    labels: tuple[str, ...], swaps: Sequence[tuple[int, int, np.ndarray]]
) -> list[Suspect]:
    """Both markers of each exchanged pair, as corrected."""
    return [
        Suspect(labels[a], f"swapped with {labels[b]}; exchanged back", int(frames.sum()), True)
        for i, j, frames in swaps
        for a, b in ((i, j), (j, i))
    ]


def suspects(
    labels: tuple[str, ...],
    off: np.ndarray,
    scale: np.ndarray,
    swaps: list,
    drifts: Sequence[tuple[int, float]] = (),
    settings: SuspectSettings = SUSPECTS,
) -> tuple[Suspect, ...]:
    """What looks wrong, from residuals (T, M, 3) in metres, the robust scales (M,), pairs put back
    (`find_swaps`), and markers that slide, with how far (m).
    """
    swapped = put_back(labels, swaps)
    distance = lengths(off)
    for marker, way in drifts:
        reason = f"drift: slid {1e3 * way:.0f} mm over the skin through the capture"
        swapped.append(Suspect(labels[marker], reason, int(np.isfinite(distance[:, marker]).sum())))
    sliding = {marker for marker, _ in drifts}
    for k, (label, away, size) in enumerate(
        zip(labels, columns(off), columns(distance), strict=True)
    ):
        seen = np.isfinite(size)
        rejected = geman_mcclure_weight(size, scale[k]) < settings.rejected_weight
        bad = _beyond_doubt(away, size, rejected & seen, settings)
        if k in sliding or bad.sum() < max(settings.min_frames, settings.min_share * seen.sum()):
            continue
        swapped.append(Suspect(label, _reason(size, bad, seen, settings), int(bad.sum())))
    return tuple(swapped)


def _beyond_doubt(
    off: np.ndarray, distance: np.ndarray, bad: np.ndarray, settings: SuspectSettings
) -> np.ndarray:
    """Of the frames in which a marker lies far off those that its own movement does not explain.

    A run of frames stays if the marker is very far off in it, or came or went at a jump, or for
    most of the capture: skin and models err smoothly.
    """
    frames = np.flatnonzero(np.isfinite(distance))
    if 2 * bad.sum() > len(frames):
        return bad
    out = np.zeros_like(bad)
    doubted = bad[frames]
    for first, last in runs(doubted):
        run = frames[first:last]
        ends = [off[frames[k]] - off[frames[k - 1]] for k in (first, last) if 0 < k < len(frames)]
        jump = max((np.linalg.norm(end) for end in ends), default=np.inf)
        size = np.median(distance[run])
        out[run] = size > settings.certain_residual or jump > max(settings.min_jump, size / 2)
    return out


def _reason(
    distance: np.ndarray, bad: np.ndarray, seen: np.ndarray, settings: SuspectSettings
) -> str:
    share = bad.sum() / seen.sum()
    size = f"{1e3 * np.median(distance[bad]):.0f} mm off in {share:.0%} of its frames"
    if share > settings.constant_share:
        return f"wrong label or far from the layout's place: {size}"
    first = np.flatnonzero(bad)[0]
    after = seen.copy()
    after[:first] = False
    if bad[after].mean() > settings.constant_share and share > settings.moved_share:
        last = distance[seen][-max(3, seen.sum() // 10) :]
        early = distance[bad][: max(3, bad.sum() // 10)]
        growing = np.median(distance[bad]) < settings.max_drift
        growing &= np.nanmedian(last) > settings.growth * np.nanmedian(early)
        return f"{'drifted' if growing else 'moved or fell'} from frame {first} on: {size}"
    return f"ghost or mislabelled for a time: {size}"


def far_placements(
    latent: np.ndarray,
    start: np.ndarray,
    spread: np.ndarray,
    distance: np.ndarray,
    settings: SuspectSettings = SUSPECTS,
) -> tuple[int, ...]:
    """Markers whose latent places (M, 3) are too far from the layout's ``start`` (M, 3) to be the
    ones it means.

    Half as far is too far where the residual lengths (F, M), NaN where missing, are long beside
    other markers'. spread (M,): of the layout's places, metres.
    """
    away = np.linalg.norm(latent - start, axis=1)
    seen = np.isfinite(distance)
    mean = np.where(seen, distance, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    rough = (mean > settings.rough_mean) & (mean > settings.rough_ratio * np.median(mean))
    limit = np.where(rough, settings.rough_limit, 1.0)
    return tuple(
        np.flatnonzero(
            (away > limit * settings.min_displacement)
            & (away > limit * settings.placement_spreads * spread)
        ).tolist()
    )


def crossed_placements(
    latent: np.ndarray, start: np.ndarray, settings: SuspectSettings = SUSPECTS
) -> tuple[tuple[int, int], ...]:
    """Pairs of labels exchanged throughout: their latent markers (M, 3) sit at each other's places
    ``start`` (M, 3).

    A pair counts when exchanging it shortens the summed way from the layout's places by more than
    ``crossed_shift`` and to less than ``crossed_share``.
    """
    own = np.linalg.norm(latent - start, axis=1)
    way = np.linalg.norm(latent[:, None] - start[None], axis=2)
    straight = own[:, None] + own[None]
    crossed = way + way.T
    better = np.triu(
        (crossed < settings.crossed_share * straight)
        & (straight - crossed > settings.crossed_shift),
        1,
    )
    pairs = sorted(zip(*np.nonzero(better), strict=True), key=lambda p: crossed[p] - straight[p])
    chosen: list[tuple[int, int]] = []
    for i, j in pairs:
        if not any({i, j} & set(pair) for pair in chosen):
            chosen.append((int(i), int(j)))
    return tuple(chosen)


def exchange_gains(
    observed: Float[np.ndarray, "F M 3"], predicted: Float[np.ndarray, "F M 3"]
) -> Float[np.ndarray, "M M"]:
    """By how much (m) exchanging each pair of labels shortens the pair's summed residuals, on
    average over the frames in which both are seen; -inf where there are none, and on the diagonal.
    """
    way = np.linalg.norm(observed[:, :, None] - predicted[:, None], axis=3)
    own = np.diagonal(way, axis1=1, axis2=2)
    gain = own[:, :, None] + own[:, None] - way - way.transpose(0, 2, 1)
    seen = np.isfinite(gain)
    count = seen.sum(axis=0)
    mean = np.where(seen, gain, 0.0).sum(axis=0) / np.maximum(count, 1)
    return np.where((count > 0) & ~np.eye(len(mean), dtype=bool), mean, -np.inf)


def exchange(observed: np.ndarray, pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    """Markers (T, M, 3) with the columns of each pair exchanged."""
    order = np.arange(observed.shape[1])
    for i, j in pairs:
        order[[i, j]] = order[[j, i]]
    return mapped(lambda part: part[:, order], observed)


class _Jump(NamedTuple):
    marker: int
    frame: int
    place: np.ndarray
    expected: np.ndarray
    speed: np.ndarray


def find_flips(
    observed: Float[np.ndarray, "T M 3"], settings: FlipSettings = FLIPS
) -> list[tuple[int, int, Bool[np.ndarray, " T"]]]:
    """Pairs that carry each other's label for the smaller part of the capture: (i, j, frames (T,)
    bool).

    observed (T, M, 3), metres, NaN where missing.
    """
    turns: dict[tuple[int, int], list[int]] = {}
    jumps = _jumps(observed, settings)
    if len(jumps) > settings.max_share * observed.shape[0] * observed.shape[1]:
        return []
    for first, second in _crossings(jumps, settings):
        pair = (min(first.marker, second.marker), max(first.marker, second.marker))
        turns.setdefault(pair, []).append(max(first.frame, second.frame))
    parts = (
        (*pair, _smaller_part(len(observed), at, settings.min_frames)) for pair, at in turns.items()
    )
    return [
        (i, j, frames)
        for i, j, frames in parts
        if frames.any() and _confirmed(observed, i, j, frames, settings)
    ]


def _crossings(jumps: list[_Jump], settings: FlipSettings) -> list[tuple[_Jump, _Jump]]:
    """Pairs of jumps that cross, each jump in one pair at most, the surest first."""
    jumps = sorted(jumps, key=lambda jump: jump.frame)
    likely = []
    for k, first in enumerate(jumps):
        for n in range(k + 1, len(jumps)):
            second = jumps[n]
            if second.frame - first.frame > settings.max_gap:
                break
            if (
                first.marker != second.marker
                and (share := _relative_misfit(first, second)) < settings.ratio
            ):
                likely.append((share, k, n))
    used: set[int] = set()
    return [
        (jumps[k], jumps[n])
        for _, k, n in sorted(likely)
        if not {k, n} & used and not used.update((k, n))
    ]


def _jumps(observed: np.ndarray, settings: FlipSettings) -> list[_Jump]:
    jumps = []
    for marker, column in enumerate(columns(observed)):
        frames = np.flatnonzero(np.isfinite(column[:, 0]))
        if len(frames) < 4:
            continue
        places = column[frames]
        steps = np.diff(frames)
        speed = np.diff(places, axis=0) / steps[:, None]
        speed[steps > settings.max_gap] = 0.0
        expected = places[1:-1] + speed[:-1] * steps[1:, None]
        off = np.linalg.norm(places[2:] - expected, axis=1)
        at = np.flatnonzero((off > settings.jump) & (steps[1:] <= settings.max_gap))
        rows = zip(frames[at + 2].tolist(), places[at + 2], expected[at], speed[at], strict=True)
        jumps += [_Jump(marker, *row) for row in rows]
    return jumps


def _relative_misfit(first: _Jump, second: _Jump) -> float:
    """How far each is from where the other would have been, as a share of how far both are off
    their own way.
    """
    late = second.frame - first.frame
    there = np.linalg.norm(first.place - (second.expected - late * second.speed))
    back = np.linalg.norm(second.place - (first.expected + late * first.speed))
    own = np.linalg.norm(first.place - first.expected) + np.linalg.norm(
        second.place - second.expected
    )
    return float((there + back) / own)


def _confirmed(
    observed: np.ndarray, i: int, j: int, frames: np.ndarray, settings: FlipSettings
) -> bool:
    """Whether the pair's distances from what goes with it are in these frames far more the usual
    ones if exchanged.
    """
    others = np.delete(np.arange(observed.shape[1]), [i, j])
    sides = [np.flatnonzero(frames == side) for side in (True, False)]
    some = np.sort(np.concatenate([side[:: -(-len(side) // settings.samples)] for side in sides]))
    whole = observed
    observed = observed[some]
    frames = frames[some]
    drop_pages(whole)
    way = np.linalg.norm(observed[:, [i, j], None] - observed[:, None, others], axis=3)
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # a marker that is never seen beside the pair
        usual = np.nanmedian(way[~frames], axis=0)
        spread = np.nanmedian(np.abs(way[~frames] - usual), axis=0) + settings.tolerance
        rigid = np.argsort(spread.sum(axis=0))[: max(4, int(len(others) * settings.rigid_share))]
        off = [((way[frames][:, order] - usual) / spread)[..., rigid] for order in ([0, 1], [1, 0])]
        own, crossed = (np.nanmedian(each**2) for each in off)
    return bool(crossed < settings.crossed_share * own)


def _smaller_part(frames: int, turns: list[int], min_frames: int) -> np.ndarray:
    """Frames between every other turn, those that are fewer."""
    chosen = np.cumsum(np.bincount(turns, minlength=frames)) % 2 == 1
    chosen = chosen if 2 * chosen.sum() <= frames else ~chosen
    return chosen if chosen.sum() >= min_frames else np.zeros(frames, dtype=bool)
