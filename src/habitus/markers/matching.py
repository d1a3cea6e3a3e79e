"""Which layout do a capture's labels belong to? Decided by the whole set of labels, since one label
means many places.

``SHN`` is the outer shank in one set and the front of the shin in another, so no label is looked up
alone: each candidate layout explains a share of the capture's labels, is itself complete to some
share, and has its own labels. Several captures of one person in one session get one layout, judged
by all of them (`match_together`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError, listed
from habitus.markers.checks import checked
from habitus.markers.geometry import Correction, exchange_columns, exchange_text
from habitus.markers.labels import fragment_of, normalised, spellings, without_shared
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.parallel.blocks import blocks, drop_pages, empty_array, mapped

MIN_MARKERS = 6
LEAST_CONFIDENCE = 0.35
_ALIAS = 0.85  # an alias is weaker evidence for a set than its own spelling
_UNDERSTOOD = 0.5  # share of the labels that mean something: no need to leave off what they share
_RIVAL = 0.3  # a layout whose score is this much lower is no rival


@dataclass(frozen=True)
class LayoutMatch:
    """What `match_layout` found.

    layout: the chosen layout restricted to the M' labels found, in capture order, spelled as the
    capture spells them. columns: (M',) their indices into the capture's labels. matched,
    unmatched_labels: the capture's labels that are used and that are not; left_out: of these, label
    -> why. missing_labels: labels of the layout that the capture lacks (extras aside). confidence:
    0..1, how sure the choice is. corrections: what the geometry changed in the layout. warnings:
    what a person should know, corrections among it. runner_up: name of the next best layout.
    """

    layout: MarkerLayout
    columns: Int[np.ndarray, " M"]
    matched: tuple[str, ...]
    unmatched_labels: tuple[str, ...]
    missing_labels: tuple[str, ...]
    confidence: float
    warnings: tuple[str, ...] = ()
    corrections: tuple[Correction, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    runner_up: str | None = None

    def select(self, markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "T N 3"]:
        """A copy of the capture's markers in the layout's order, exchanged labels put back where
        the geometry told.
        """
        chosen = mapped(lambda part: np.array(part[:, self.columns]), markers)
        for correction in self.corrections:
            if correction.exchange is not None:
                exchange_columns(chosen, correction.exchange)
        return chosen


@dataclass(frozen=True)
class _Explained:
    """One candidate: capture column -> (marker, quality), and how well it explains the capture."""

    layout: MarkerLayout
    markers: Mapping[int, tuple[Marker, float]]
    score: float
    evidence: float  # 0..1: how much of the layout itself is there


def best_match(
    labels: Sequence[str],
    candidates: Sequence[MarkerLayout],
    markers: Float[np.ndarray, "T M 3"] | None = None,
) -> LayoutMatch:
    """The candidate that explains the labels best (see
    ``habitus.io.layouts.files.match_layout``).
    """
    meaning = interpreted(labels, candidates)
    named = [label for label in labels if label not in meaning.left_out]
    confidence = _confidence(meaning, len(meaning.markers) / max(1, len(named)))
    _refuse_if_unsure(labels, meaning, confidence)
    match = _as_match(labels, meaning, confidence)
    return match if markers is None else _against_geometry(match, markers)


def _against_geometry(match: LayoutMatch, markers: Float[np.ndarray, "T M 3"]) -> LayoutMatch:
    chosen = mapped(
        lambda part: np.asarray(part, dtype=float)[:, match.columns], np.asarray(markers)
    )
    layout, corrections = checked(match.layout, chosen)
    warnings = tuple(correction.text for correction in corrections if not correction.quiet)
    return replace(
        match, layout=layout, corrections=corrections, warnings=match.warnings + warnings
    )


def explain(labels: Sequence[str], layout: MarkerLayout) -> _Explained:
    """How well one layout explains the labels: which column is which marker, and a score to rank
    layouts by.
    """
    assigned_labels = assigned(labels, layout)
    known = {normalised(label) for label in layout.left_out}
    named = [label for label in labels if not known & set(spellings(label))]
    core = [marker.label for marker in layout.markers if not marker.optional]
    present = {marker.label for marker, _ in assigned_labels.values()}
    own = {marker.label for marker, quality in assigned_labels.values() if quality == 1.0}
    complete = sum(label in present for label in core) / max(1, len(core))
    special = [label in own for label in layout.fingerprint]
    marked = sum(special) / len(special) if special else complete
    explained = sum(quality for _, quality in assigned_labels.values()) / max(1, len(named))
    return _Explained(
        layout,
        assigned_labels,
        explained + 0.5 * complete + 0.5 * marked,
        0.4 + 0.4 * marked + 0.2 * complete,
    )


def assigned(labels: Sequence[str], layout: MarkerLayout) -> dict[int, tuple[Marker, float]]:
    """Column -> (marker, quality) for the labels that this layout knows; a marker is used once, by
    its best label.
    """
    lookup = _lookup(layout)
    bases = {normalised(label) for label in labels}
    offers: dict[str, tuple[int, int, Marker]] = {}
    for column, label in enumerate(labels):
        base = fragment_of(label)
        forms = spellings(label)
        if base is not None and normalised(base) not in bases:
            forms += spellings(base)
        hit = next((lookup[form] for form in forms if form in lookup), None)
        if hit is not None:
            marker, rank = hit
            if marker.label not in offers or rank < offers[marker.label][0]:
                offers[marker.label] = (rank, column, marker)
    pairs = {
        column: (marker, 1.0 if rank == 0 else _ALIAS) for rank, column, marker in offers.values()
    }
    return dict(sorted(pairs.items()))


def _lookup(layout: MarkerLayout) -> dict[str, tuple[Marker, int]]:
    """Normalised name -> marker and rank (0 its own label, then the aliases in order)."""
    table: dict[str, tuple[Marker, int]] = {}
    for marker in layout.markers:
        for rank, name in enumerate((marker.label, *marker.aliases)):
            key = normalised(name)
            if key not in table or rank < table[key][1]:
                table[key] = (marker, rank)
    return table


@dataclass(frozen=True)
class _Meaning:
    """The best layout, its rivals, each column's marker, labels that are no markers, and why others
    are not used.

    shared: what nearly all labels begin or end with and what was left off to read them, "" for
    nothing.
    """

    best: _Explained
    rivals: Sequence[_Explained]
    markers: Mapping[int, Marker]
    left_out: Mapping[str, str]
    doubts: Mapping[str, str]
    shared: str = ""


def interpreted(labels: Sequence[str], candidates: Sequence[MarkerLayout]) -> _Meaning:
    """What each label means, sure or not: by the layout that explains the labels best, the rest by
    the others.

    Where few mean anything, a letter or word that nearly all share (``XLFHD``, ``XRFHD``) is left
    off, if that helps.
    """
    if not candidates:
        raise HabitusError("no layout to match against; expected at least one")
    best = _interpreted(labels, candidates)
    if len(best.markers) >= _UNDERSTOOD * len(labels):
        return best
    for shared, plain in without_shared(labels):
        other = _interpreted(plain, candidates)
        if len(other.markers) > max(2 * len(best.markers), MIN_MARKERS - 1):
            names = dict(zip(plain, labels, strict=True))
            left_out = {names[label]: why for label, why in other.left_out.items()}
            doubts = {names[label]: why for label, why in other.doubts.items()}
            best = replace(other, left_out=left_out, doubts=doubts, shared=shared)
    return best


def _interpreted(labels: Sequence[str], candidates: Sequence[MarkerLayout]) -> _Meaning:
    ranked = sorted(
        (explain(labels, layout) for layout in candidates),
        key=lambda one: (-one.score, one.layout.name),
    )
    best = ranked[0]
    rivals = ranked[1:]
    left_out = _left_out(labels, best)
    extras, doubts = _extras(labels, best, rivals, left_out)
    markers = {column: marker for column, (marker, _) in best.markers.items()} | extras
    return _Meaning(best, rivals, markers, left_out, doubts)


def _left_out(labels: Sequence[str], best: _Explained) -> dict[str, str]:
    reasons = {normalised(label): why for label, why in best.layout.left_out.items()}
    left_out = {}
    for column, label in enumerate(labels):
        why = next((reasons[form] for form in spellings(label) if form in reasons), None)
        if why is not None and column not in best.markers:
            left_out[label] = why
    return left_out


def _extras(
    labels: Sequence[str],
    best: _Explained,
    rivals: Sequence[_Explained],
    left_out: Mapping[str, str],
) -> tuple[dict[int, Marker], dict[str, str]]:
    """Labels that the best layout lacks but all others that know them place alike; and why the rest
    is not used.
    """
    tables = [(rival.layout.name, _lookup(rival.layout)) for rival in rivals]
    taken = {marker.place for marker, _ in best.markers.values() if marker.place_spread < 0.03}
    extras: dict[int, Marker] = {}
    doubts: dict[str, str] = {}
    for column, label in enumerate(labels):
        if column in best.markers or label in left_out:
            continue
        meanings = _meanings(label, tables)
        places = {marker.place for marker, _ in meanings}
        if len(places) == 1 and not places & taken:
            extras[column] = meanings[0][0]
            taken |= {place for place in places if meanings[0][0].place_spread < 0.03}
        elif len(places) == 1:
            doubts[label] = f"another marker is already at {places.pop()}"
        elif places:
            doubts[label] = (
                f"means different places in {listed(sorted({name for _, name in meanings}), 2)}"
            )
        else:
            doubts[label] = "unknown label"
    return extras, doubts


def _meanings(
    label: str, tables: Sequence[tuple[str, Mapping[str, tuple[Marker, int]]]]
) -> list[tuple[Marker, str]]:
    """(marker, layout name) of every layout that knows a label; those that spell it so themselves
    go before aliases.
    """
    hits = []
    for name, table in tables:
        hit = next((table[form] for form in spellings(label) if form in table), None)
        if hit is not None:
            hits.append((hit[0], name, hit[1]))
    own = [hit for hit in hits if hit[2] == 0]
    return [(marker, name) for marker, name, _ in (own or hits)]


def _confidence(meaning: _Meaning, used: float) -> float:
    """Share of labels used, times how much of the set is there, less where a near rival says other
    places.
    """
    best = meaning.best
    doubt = 0.0
    for rival in meaning.rivals:
        near = 1.0 - (best.score - rival.score) / _RIVAL
        if near > 0 and best.markers:
            other = {column: marker.place for column, (marker, _) in rival.markers.items()}
            places = {column: marker.place for column, (marker, _) in best.markers.items()}
            differing = sum(other.get(column, place) != place for column, place in places.items())
            doubt = max(doubt, near * differing / len(best.markers))
    return round(float(np.clip(used * best.evidence * (1.0 - doubt), 0.0, 1.0)), 3)


def _refuse_if_unsure(labels: Sequence[str], meaning: _Meaning, confidence: float) -> None:
    name = meaning.best.layout.name
    count = len(meaning.markers)
    single = not meaning.rivals
    arrived = ", ".join(labels[:10]) + (f", … ({len(labels)} in all)" if len(labels) > 10 else "")
    alike = next((shared for shared, _ in without_shared(labels)), "")
    help_ = (
        f"nearly all labels read {alike}: rename them if that is no part of their names; "
        if alike
        else ""
    )
    help_ += "give --layout NAME, or run `habitus layout new` to write a layout for these labels"
    if count < MIN_MARKERS:
        raise HabitusError(
            f"only {count} of {len(labels)} labels ({arrived or 'none'}) are known to "
            f"{f'layout {name}' if single else 'any layout'}; expected at least {MIN_MARKERS}; "
            f"{help_}"
        )
    if confidence < LEAST_CONFIDENCE and not single:
        raise HabitusError(
            f"unsure which marker set this is: {name} explains {count} of {len(labels)} labels "
            f"(confidence {confidence:.2f}); the labels are {arrived}; {help_}"
        )


def _as_match(labels: Sequence[str], meaning: _Meaning, confidence: float) -> LayoutMatch:
    best = meaning.best
    markers = meaning.markers
    left_out = {**meaning.left_out, **meaning.doubts}
    columns = sorted(markers)
    used = tuple(
        replace(markers[c], label=labels[c], aliases=(markers[c].label, *markers[c].aliases))
        for c in columns
    )
    present = {marker.label for marker, _ in best.markers.values()}
    unmatched = tuple(label for column, label in enumerate(labels) if column not in markers)
    borrowed = [labels[column] for column in columns if column not in best.markers]
    warnings = []
    if meaning.shared:
        warnings.append(f"labels read without what they share: {meaning.shared}")
    if borrowed:
        warnings.append(
            f"labels that {best.layout.name} lacks, taken from other sets: {listed(borrowed)}"
        )
    if left_out:
        warnings.append(
            "labels left out: "
            + listed([f"{label} ({why})" for label, why in left_out.items()], 4, "; ")
        )
    return LayoutMatch(
        layout=replace(best.layout, markers=used),
        columns=np.array(columns, dtype=np.int64),
        matched=tuple(labels[column] for column in columns),
        unmatched_labels=unmatched,
        missing_labels=tuple(
            m.label for m in best.layout.markers if not m.optional and m.label not in present
        ),
        confidence=confidence,
        warnings=tuple(warnings),
        left_out=left_out,
        runner_up=meaning.rivals[0].layout.name if meaning.rivals else None,
    )


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
    reported = {correction.text for correction in joint.corrections}
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
            *(text for text in joint.warnings if text not in reported),
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
