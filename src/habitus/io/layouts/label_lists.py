"""Lists of labels as layouts: Vicon's ``.vsk``, ``.vst`` and ``.mkr``, QTM's label lists. Layouts
that come along know where the labels sit; what these files say of places is of one subject's own
segments and is not used.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from xml.etree.ElementTree import Element

from habitus.errors import HabitusError, listed
from habitus.io.names import plain_name
from habitus.markers.layouts import MarkerLayout
from habitus.markers.matching import FEWEST_MARKERS, interpreted

_TAGS = ("marker", "label", "trajectory")
_MARKUP = re.compile(r"^(!|#|;|//|\[)")  # headings and remarks
_LINKS = re.compile(r"[,=]")  # sticks between markers and segments of them
_UNKNOWN = "no layout that comes along knows this label; say where it sits in a layout of your own"


def labels_in_tree(root: Element) -> tuple[str, ...]:
    """Labels of an XML file: names of its markers, labels or trajectories, as attributes or
    elements, in order.
    """
    found = []
    for element in root.iter():
        if str(element.tag).rsplit("}", 1)[-1].lower() in _TAGS:
            named = [value for key, value in element.attrib.items() if key.lower() == "name"]
            named += [child.text or "" for child in element if str(child.tag).lower() == "name"]
            found.append(plain_name(named[0]) if named else "")
    return tuple(dict.fromkeys(label for label in found if label))


def labels_in_lines(text: str) -> tuple[str, ...]:
    """Labels of a text: the first word of each line, but for headings, remarks, and lines that link
    markers.
    """
    found = []
    for line in text.lstrip("\ufeff").splitlines():
        words = re.split(r"[\t;]| {2,}", line.strip())
        if words[0] and not _MARKUP.match(words[0]) and not _LINKS.search(words[0]):
            found.append(plain_name(words[0]))
    return tuple(dict.fromkeys(label for label in found if label))


def layout_of_labels(
    labels: Sequence[str], name: str, where: str, known: Sequence[MarkerLayout]
) -> MarkerLayout:
    """The labels at the places that known layouts have for them as a set; the others left out, with
    the reason.

    Raises HabitusError where fewer than six are known.
    """
    meaning = interpreted(labels, known)
    if len(meaning.found) < FEWEST_MARKERS:
        raise HabitusError(
            f"layout file {where}: {len(meaning.found)} of its {len(labels)} labels "
            f"({listed(labels) or 'none'}) are "
            f"known to any layout; expected at least {FEWEST_MARKERS}; let --layout discover find "
            "where they sit"
        )
    markers = tuple(
        replace(marker, label=labels[column], aliases=(), optional=False)
        for column, marker in sorted(meaning.found.items())
    )
    used = {marker.label for marker in markers}
    left_out = {
        label: meaning.left_out.get(label, _UNKNOWN) for label in labels if label not in used
    }
    title = f"Label list, places as in {meaning.best.layout.name}"
    return MarkerLayout(name, markers, title, left_out=left_out)
