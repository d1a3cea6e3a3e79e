"""Whose label is it: subject prefixes found, taken off, and the people of one file told apart."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

_SIDES = re.compile(r"(l|r|left|right|lt|rt|q_l|q_r)[ _.:]?", re.IGNORECASE)
_LEAST_MARKERS = 8


@dataclass(frozen=True)
class Owner:
    """A subject's name (None where the file names nobody) and the columns and bare labels that are theirs."""

    name: str | None
    columns: tuple[int, ...]
    labels: tuple[str, ...]


def split_subjects(labels: Sequence[str], named: Sequence[str] = ()) -> tuple[Owner, ...]:
    """One owner per subject prefix, the one with most labels first; ``named`` are the subjects the file itself names.

    Labels without a prefix go to the only subject; where there are several they are nobody's and are left out.
    """
    prefixes = [_prefix(label, named) for label in labels]
    counts = Counter(prefix for prefix in prefixes if prefix)
    people = _people(counts)
    if not people:
        return (_single(labels, named),)
    if len(people) == 1:
        only = people[0]
        rest = tuple(
            _bare(label, prefix if prefix == only else "") for label, prefix in zip(labels, prefixes, strict=True)
        )
        return (Owner(only.strip(" _:"), tuple(range(len(labels))), rest),)
    return tuple(
        Owner(
            person.strip(" _:"),
            tuple(i for i, prefix in enumerate(prefixes) if prefix == person),
            tuple(label[len(person) :] for label, prefix in zip(labels, prefixes, strict=True) if prefix == person),
        )
        for person in people
    )


def _people(counts: Counter[str]) -> list[str]:
    """The prefixes that are people rather than props: those with a good share of the markers of the largest."""
    if not counts:
        return []
    most = counts.most_common(1)[0][1]
    return [
        prefix for prefix, count in counts.most_common() if count == most or count >= max(_LEAST_MARKERS, most // 4)
    ]


def _prefix(label: str, named: Sequence[str]) -> str:
    """The part of a label that names a subject, with its separator; "" where there is none."""
    head, colon, rest = label.rpartition(":")
    if colon and head and rest.strip():
        return head + colon
    for name in named:
        for separator in "_ .":
            if name and label.startswith(name + separator) and len(label) > len(name) + 1:
                return name + separator
    return ""


def _bare(label: str, prefix: str) -> str:
    return label[len(prefix) :].strip() or label


def _single(labels: Sequence[str], named: Sequence[str]) -> Owner:
    """Everything is one person's; a prefix such as ``Karlie_`` that (nearly) all labels share is taken off."""
    prefix = _common_prefix([label for label in labels if label])
    bare = tuple(_bare(label, prefix) if prefix and label.startswith(prefix) else label.strip() for label in labels)
    name = prefix.strip(" _.") or (named[0] if len(named) == 1 else "")
    return Owner(name if name and name != "Q" else None, tuple(range(len(labels))), bare)


def _common_prefix(labels: Sequence[str]) -> str:
    """The longest ``Name_`` that at least nine in ten labels share and that is no side of the body."""
    candidates: Counter[str] = Counter()
    for label in labels:
        for match in re.finditer(r"[_ ]", label):
            if 0 < match.end() < len(label) and label[match.end() - 2 : match.end() + 1].count("_") < 2:
                candidates[label[: match.end()]] += 1
    good = [
        prefix
        for prefix, count in candidates.items()
        if count >= max(_LEAST_MARKERS, 0.9 * len(labels)) and not _SIDES.fullmatch(prefix) and "__" not in prefix
    ]
    return max(good, key=len, default="")
