"""The result of a discovery in words: places, how certain they are, what is undecided, which labels
keep their distance, and which sides the labels' names state.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import listed
from habitus.fit.discover.places import Seated, within
from habitus.fit.discover.result import Discovery
from habitus.fit.discover.settings import DISCOVER, DescriptionSettings, DiscoverSettings
from habitus.fit.discover.skin import Skin
from habitus.markers.layouts import Marker, MarkerLayout, place_in_words


def describe(
    body: BodyModel,
    labels: Sequence[str],
    frames: Float[np.ndarray, "F M 3"],
    seated: Seated,
    skin: Skin,
    margin: float | None,
    known: Mapping[str, Marker],
    left_out: Mapping[str, str],
    settings: DiscoverSettings = DISCOVER,
) -> Discovery:
    """Step 4: the layout in words, and what is not decided."""
    template = np.asarray(body.v_template, dtype=float)
    words = settings.description
    sure = within(seated, skin, template, words.reach)
    undecided = margin is not None and margin < settings.decided
    across = template[seated.vertices, 0]
    markers = tuple(
        replace(
            place_in_words(body, int(vertex)),
            label=label,
            distance=skin.distance,
            distance_spread=settings.distance_spread,
            place_spread=words.place_spread,
            confidence=round(float(confidence) * (0.5 if undecided else 1.0), 2),
        )
        for label, vertex, confidence in zip(labels, seated.vertices, sure, strict=True)
    )
    mean = float(np.nanmean(seated.errors))
    groups = {
        label: tuple(labels[k] for k in group)
        for label, group in zip(labels, companions(frames, words), strict=True)
        if group
    }
    named = agreement(named_sides(labels, words), across, words)
    doubts = (
        *_undecided(margin, named, settings.decided),
        *_contradicted(named, undecided),
        *_poor(mean, words.poor),
    )
    notes = tuple(_notes(body, labels, seated, known, left_out, 2 * words.reach))
    title = "Discovered by fitting"
    layout = MarkerLayout("discovered", markers, title, num_vertices=len(template))
    return Discovery(layout, left_out, doubts, notes, groups, margin, 1e3 * mean)


def _undecided(margin: float | None, named: float | None, decided: float) -> list[str]:
    if margin is None or margin >= decided:
        return []
    how = f"another reading of the capture costs only {100 * abs(margin):.0f} % more"
    if named is not None and named > 0.5:
        return [
            f"Left and right, or front and back, are taken from the labels' names: {how}; bending "
            "joints would decide it."
        ]
    return [
        f"Left and right, or front and back, are not decided: {how}; a capture with bending "
        "joints would decide it."
    ]


def _contradicted(named: float | None, undecided: bool) -> list[str]:
    if named is None or named > 0.5 or undecided:
        return []
    return [
        f"The labels' names say the other side for {100 * (1 - named):.0f} % of the markers: "
        "mirrored, or misnamed?"
    ]


def _poor(mean: float, limit: float) -> list[str]:
    return (
        []
        if mean < limit
        else [f"The places found explain the markers poorly ({1e3 * mean:.0f} mm)."]
    )


def _notes(
    body: BodyModel,
    labels: Sequence[str],
    seated: Seated,
    known: Mapping[str, Marker],
    left_out: Mapping[str, str],
    far: float,
) -> Iterator[str]:
    template = np.asarray(body.v_template, dtype=float)
    if left_out:
        yield "labels left out: " + listed(
            [f"{label} ({why})" for label, why in left_out.items()], 4, "; "
        )
    for label, vertex in zip(labels, seated.vertices, strict=True):
        if label in known:
            usual = MarkerLayout("known", (replace(known[label], label=label),)).vertices(body)[0]
            distance = float(np.linalg.norm(template[usual] - template[vertex]))
            if distance > far:
                yield (
                    f"{label} usually means {known[label].place}; it was found "
                    f"{100 * distance:.0f} cm from there"
                )


def companions(
    markers: Float[np.ndarray, "F M 3"], settings: DescriptionSettings = DISCOVER.description
) -> list[tuple[int, ...]]:
    """For each label the columns of those that keep their distance to it, the most rigid first;
    none where most do.
    """
    count = markers.shape[1]
    spread = np.full((count, count), np.inf)
    for column in range(count):
        distances = np.linalg.norm(markers - markers[:, column : column + 1], axis=2)
        seen = np.isfinite(distances).sum(axis=0)
        some = seen >= 3
        spread[column, some] = np.nanstd(distances[:, some], axis=0)
    np.fill_diagonal(spread, np.inf)
    groups = []
    for row in spread:
        known = row[np.isfinite(row)]
        moved = len(known) > 0 and float(np.median(known)) > settings.moved
        order = np.argsort(row, kind="stable")[: settings.companions]
        groups.append(tuple(int(k) for k in order if row[k] < settings.rigid) if moved else ())
    return groups


_WORDS = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("L", "R"), ("l", "r"))


def named_sides(
    labels: Sequence[str], settings: DescriptionSettings = DISCOVER.description
) -> Float[np.ndarray, " M"]:
    """1 for labels that say left, -1 for right, 0 for what says nothing: only one of a pair
    (``LTHI``, ``RTHI``) does.

    All 0 where fewer than ``min_pairs`` pairs are named so.
    """
    known = set(labels)
    sides = np.zeros(len(labels))
    for column, label in enumerate(labels):
        for side, (mine, other) in ((s, pair[::s]) for pair in _WORDS for s in (1, -1)):
            if any(
                _exchanged(label, mine, other, start) in known for start in _starts(label, mine)
            ):
                sides[column] = side
                break
    return sides if (sides != 0).sum() >= 2 * settings.min_pairs else np.zeros(len(labels))


def agreement(
    sides: Float[np.ndarray, " M"],
    across: Float[np.ndarray, " M"],
    settings: DescriptionSettings = DISCOVER.description,
) -> float | None:
    """Share of the named labels whose place (its x on the template, m) lies on the side they name;
    None where too few are named so.
    """
    clear = (sides != 0) & (np.abs(across) > settings.middle)
    if clear.sum() < 2 * settings.min_pairs:
        return None
    return float(np.mean(np.sign(across[clear]) == sides[clear]))


def _starts(label: str, part: str) -> list[int]:
    return [k for k in range(len(label)) if label.startswith(part, k)]


def _exchanged(label: str, mine: str, other: str, start: int) -> str:
    return label[:start] + other + label[start + len(mine) :]
