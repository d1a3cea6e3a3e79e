"""Whose label is it: subject prefixes found, taken off, and the people of one file told apart."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from habitus.io.captures.labels import is_unlabelled

_SIDE = re.compile(r"(q_)?(l|r|left|right|lt|rt)", re.IGNORECASE)
_NO_NAME = {"", "Q", "unlabeled", "unlabelled"}
_LEAST_MARKERS = 8
_SAMPLE = 500


@dataclass(frozen=True)
class Owner:
    """A subject's name (None where the file names nobody) and the columns and bare labels that are
    theirs.
    """

    name: str | None
    columns: tuple[int, ...]
    labels: tuple[str, ...]


def split_subjects(labels: Sequence[str], named: Sequence[str] = ()) -> tuple[Owner, ...]:
    """One owner per subject prefix, the one with most labels first; ``named`` are the subjects the
    file itself names.

    Labels without a prefix go to the only subject; where there are several they are nobody's and
    are left out.
    """
    prefixes = [_prefix(label, named) for label in labels]
    people = _people(Counter(prefix for prefix in prefixes if prefix))
    if not people:
        prefixes, people = _underscored(labels)
    if not people:
        return (_single(labels, named),)
    if len(people) == 1:
        bare = tuple(_bare(label, people[0]) for label in labels)
        return (Owner(_name(people[0]), tuple(range(len(labels))), bare),)
    return tuple(_owner(person, labels, prefixes) for person in people)


def _owner(person: str, labels: Sequence[str], prefixes: Sequence[str]) -> Owner:
    columns = tuple(i for i, prefix in enumerate(prefixes) if prefix == person)
    return Owner(_name(person), columns, tuple(_bare(labels[i], person) for i in columns))


def _name(prefix: str) -> str | None:
    name = prefix.strip(" _:.")
    return None if name in _NO_NAME else name


def _bare(label: str, prefix: str) -> str:
    return label.removeprefix(prefix).strip() or label.strip()


def _people(counts: Counter[str]) -> list[str]:
    """The prefixes that are people rather than props: those with a good share of the markers of the
    largest.
    """
    most = max(counts.values(), default=0)
    least = max(_LEAST_MARKERS, most // 4)
    return [prefix for prefix, count in counts.most_common() if count == most or count >= least]


def _prefix(label: str, named: Sequence[str]) -> str:
    """The part of a label that names a subject, with its separator; "" where there is none."""
    head, colon, rest = label.rpartition(":")
    if colon and rest.strip() and head.strip().lower() not in _NO_NAME:
        return head + colon
    for name in named:
        for separator in "_ .":
            if name and label.startswith(name + separator) and len(label) > len(name) + 1:
                return name + separator
    return ""


def _underscored(labels: Sequence[str]) -> tuple[list[str], list[str]]:
    """People told apart by ``Name_LABEL``: nearly all labels have such a head, and the heads share
    their labels.
    """
    heads = [label.split("_", 1)[0] + "_" if "_" in label.strip("_") else "" for label in labels]
    counts = Counter(heads)
    people = [
        head
        for head, count in counts.items()
        if head and count >= _LEAST_MARKERS and not _SIDE.fullmatch(head[:-1])
    ]
    if len(people) < 2 or sum(counts[head] for head in people) < 0.9 * len(labels):
        return heads, []
    sets = [
        {label.removeprefix(head) for label, own in zip(labels, heads, strict=True) if own == head}
        for head in people
    ]
    shared = set.intersection(*sets)
    alike = len(shared) >= 0.6 * max(map(len, sets)) and not all(
        is_unlabelled(label) for label in shared
    )
    return heads, sorted(people, key=lambda head: -counts[head]) if alike else []


def _single(labels: Sequence[str], named: Sequence[str]) -> Owner:
    """Everything is one person's; a prefix such as ``Karlie_`` that nearly all labels share is
    taken off.
    """
    prefix = _common_prefix(labels)
    name = _name(prefix) or (named[0] if len(named) == 1 else None)
    return Owner(name, tuple(range(len(labels))), tuple(_bare(label, prefix) for label in labels))


def _common_prefix(labels: Sequence[str]) -> str:
    """The longest ``Name_`` that nine in ten labels share, that is no side and leaves names, not
    numbers.
    """
    candidates: Counter[str] = Counter()
    labels = labels[:: 1 + len(labels) // _SAMPLE]
    for label in labels:
        ends = [match.end() for match in re.finditer(r"(?<!_)[_ ](?!_)", label)]
        candidates.update(label[:end] for end in ends if not is_unlabelled(label[end:]))
    least = max(_LEAST_MARKERS, 0.9 * len(labels))
    good = [
        prefix
        for prefix, count in candidates.items()
        if count >= least and not _SIDE.fullmatch(prefix[:-1])
    ]
    return max(good, key=len, default="")
