"""A letter or word that all labels share without a separator is no part of their names."""

import pytest

from habitus.errors import HabitusError
from habitus.io.layouts.files import load_layout, match_layout
from habitus.markers.labels import without_shared

LABELS = tuple(marker.label for marker in load_layout("cmu-41").markers)


@pytest.mark.parametrize("spell", ["X{}", "Subj1{}", "{}Q", "{}marker", "L{}", "R{}", "Left{}"])
def test_what_all_labels_share_is_left_off(spell):
    plain = match_layout(LABELS)
    match = match_layout([spell.format(label) for label in LABELS])
    assert (
        match.layout.name == plain.layout.name == "cmu-41" and match.confidence == plain.confidence
    )
    assert [m.place for m in match.layout.markers] == [m.place for m in plain.layout.markers]
    assert match.layout.labels == tuple(spell.format(label) for label in LABELS)
    assert any("without what they share" in warning for warning in match.warnings)


def test_a_few_labels_without_it_stay_as_they_are():
    match = match_layout([*(f"X{label}" for label in LABELS[:-3]), *LABELS[-3:], "junk"])
    assert match.matched == (*(f"X{label}" for label in LABELS[:-3]), *LABELS[-3:])
    assert "junk" in match.left_out


@pytest.mark.parametrize("side", ["L", "R"])
def test_labels_of_one_side_keep_it(side):
    own = [label for label in LABELS if label.startswith(side)]
    match = match_layout(own)
    assert match.matched == tuple(own) and not any("share" in warning for warning in match.warnings)


def test_the_message_names_what_labels_share():
    with pytest.raises(HabitusError, match="nearly all labels read Zq…"):
        match_layout([f"Zq{k}" for k in "abcdefgh"])


@pytest.mark.parametrize("labels", [(), ("",), ("A",), ("A", "A"), ("", "B", "BC")])
def test_odd_labels_are_read_too(labels):
    assert all(len(plain) == len(labels) for _, plain in without_shared(labels))
