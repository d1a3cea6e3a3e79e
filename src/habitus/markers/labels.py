"""One spelling for marker labels: L_IAS, L.IAS, LIAS and LeftIAS are the same label."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import takewhile

_SIDE_WORD = re.compile(r"^(left|right)[ _.\-]*(?=\w)", re.IGNORECASE)
_SIDE_SUFFIX = re.compile(r"^(.+)[ _.\-](left|right|l|r)$", re.IGNORECASE)
_SEPARATORS = re.compile(r"[ _.\-]+")
_PROTOCOL = re.compile(r"^(IOR|CGM\d?|CAST|SPORTS|PIG)_", re.IGNORECASE)
_NEARLY_ALL = 0.8
_LONGEST = 64  # share of the labels; characters
_FRAGMENT = re.compile(r"^(.*\D)-\d{1,2}$")


def normalised(label: str) -> str:
    """A label without case, separators and prefixes, its side as a leading L or R (``Left IAS`` ->
    ``LIAS``).
    """
    text = label.rsplit(":", 1)[-1].strip()
    text = re.sub(r"^Q_(?=\w)", "", text, flags=re.IGNORECASE)
    text = _SIDE_WORD.sub(lambda found: found[1][0], text)
    return _SEPARATORS.sub("", text).upper()


def spellings(label: str) -> tuple[str, ...]:
    """The normalised forms to look a label up by, best first.

    A combined label (``A__IOR_B__CGM_C``) gives each of its parts; a trailing side (``IAS_L``) is
    also tried in front.
    """
    text = label.rsplit(":", 1)[-1].strip()
    forms: list[str] = []
    for part in [text, *text.split("__")] if "__" in text else [text]:
        bare = _PROTOCOL.sub("", part)
        forms += [normalised(part), normalised(bare)]
        suffixed = _SIDE_SUFFIX.match(bare)
        if suffixed:
            forms.append(suffixed[2][0].upper() + normalised(suffixed[1]))
    return tuple(dict.fromkeys(form for form in forms if form))


def fragment_of(label: str) -> str | None:
    """The label whose second fragment this is (``RBAC-1`` -> ``RBAC``), or None."""
    found = _FRAGMENT.match(label.strip())
    return found[1] if found else None


def without_shared(labels: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Readings of labels that nearly all begin or end alike: what they share ("X…", "…_1") and the
    labels without it.

    The longest shared beginnings come first; a label that lacks what the others share stays as it
    is.
    """
    for end in (False, True):
        turned = [label[::-1] if end else label for label in labels]
        for part in _shared(turned):
            plain = tuple(text[len(part) :] if text.startswith(part) else text for text in turned)
            yield (
                (f"…{part[::-1]}", tuple(text[::-1] for text in plain))
                if end
                else (f"{part}…", plain)
            )


def _shared(labels: Sequence[str]) -> list[str]:
    """Beginnings that `_NEARLY_ALL` labels share, the longest first; none of them a whole label."""
    counts = [
        Counter(label[:length] for label in labels if len(label) > length)
        for length in range(1, _LONGEST)
    ]
    best = [count.most_common(1)[0] for count in counts if count]
    return [
        part for part, count in takewhile(lambda one: one[1] >= _NEARLY_ALL * len(labels), best)
    ][::-1]
