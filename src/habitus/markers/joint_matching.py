"""Several captures of one person in one session: one layout, judged by all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.markers.exchanges import Correction, exchange_text
from habitus.markers.labels import normalised
from habitus.markers.layouts import MarkerLayout
from habitus.markers.matching import LayoutMatch, best_match
from habitus.parallel.blocks import blocks, drop_pages, empty_array

GAP = (
    30  # frames of nothing between captures, so that none is taken for the continuation of another
)

Key = tuple[str, int]


def match_together(
    captures: Sequence[tuple[Sequence[str], Float[np.ndarray, "_ _ 3"]]],
    candidates: Sequence[MarkerLayout],
) -> tuple[LayoutMatch, ...]:
    """One match for each of several captures of the same person in the same session: same places
    and distances in all.

    What one capture cannot tell (a standing trial bends no elbow), another can; a pair that is
    exchanged in some captures only is put back in those.
    """
    keys = [_unique_keys(labels) for labels, _ in captures]
    union = {
        key: label
        for (labels, _), own in zip(captures, keys, strict=True)
        for key, label in zip(own, labels, strict=True)
    }
    names = list(union)
    starts = np.cumsum([0, *(len(markers) + GAP for _, markers in captures)])
    together = empty_array((int(starts[-1]), len(names), 3))
    for (_, markers), own, start in zip(captures, keys, starts[:-1], strict=True):
        columns = [names.index(key) for key in own]
        for part in blocks(len(markers) + GAP):
            some = together[start + part.start : start + part.stop]
            some[:] = np.nan
            some[: max(len(markers) - part.start, 0), columns] = markers[part]
            drop_pages(together, markers)
    joint = best_match(tuple(union.values()), candidates, together)
    return tuple(
        _part_of(joint, names, labels, own, slice(start, start + len(markers)))
        for (labels, markers), own, start in zip(captures, keys, starts[:-1], strict=True)
    )


def _unique_keys(labels: Sequence[str]) -> list[Key]:
    """Normalised labels, told apart by their count where a capture has one twice."""
    counts: dict[str, int] = {}
    keys = []
    for label in labels:
        name = normalised(label)
        keys.append((name, counts.get(name, 0)))
        counts[name] = counts.get(name, 0) + 1
    return keys


def _part_of(
    joint: LayoutMatch, names: Sequence[Key], labels: Sequence[str], own: Sequence[Key], part: slice
) -> LayoutMatch:
    """One capture's share of a joint match: its labels and columns, and the frames that are its
    own.
    """
    here = {names.index(key): column for column, key in enumerate(own)}
    kept = [index for index, column in enumerate(joint.columns) if int(column) in here]
    columns = np.array([here[int(joint.columns[index])] for index in kept], dtype=np.int64)
    pairs = list(zip(kept, columns, strict=True))
    markers = tuple(
        replace(joint.layout.markers[index], label=labels[column]) for index, column in pairs
    )
    matched: tuple[str, ...] = tuple(labels[int(column)] for column in columns)
    cut = (
        _cut(one, {index: k for k, index in enumerate(kept)}, matched, part)
        for one in joint.corrections
    )
    corrections = tuple(one for one in cut if one is not None)
    told = {correction.text for correction in joint.corrections}
    lacking = [
        m for index, m in enumerate(joint.layout.markers) if index not in kept and not m.optional
    ]
    return replace(
        joint,
        layout=replace(joint.layout, markers=markers),
        columns=columns,
        matched=matched,
        unmatched_labels=tuple(
            label for column, label in enumerate(labels) if column not in columns
        ),
        missing_labels=(*joint.missing_labels, *(marker.aliases[0] for marker in lacking)),
        left_out={label: why for label, why in joint.left_out.items() if label in labels},
        corrections=corrections,
        warnings=(
            *(text for text in joint.warnings if text not in told),
            *(correction.text for correction in corrections if not correction.quiet),
        ),
    )


def _cut(
    correction: Correction, places: Mapping[int, int], labels: Sequence[str], part: slice
) -> Correction | None:
    """A correction as far as it concerns one capture, or None."""
    exchange = correction.exchange
    if exchange is None:
        return correction
    frames = exchange.frames[part]
    if exchange.first not in places or exchange.second not in places or not frames.any():
        return None
    first = places[exchange.first]
    second = places[exchange.second]
    text = exchange_text(labels[first], labels[second], frames)
    return replace(
        correction, text=text, exchange=replace(exchange, first=first, second=second, frames=frames)
    )
