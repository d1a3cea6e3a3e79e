"""The prior over placements as text: read back as it was written, and refused where it says
something else.
"""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.io.layouts.files import parse_placements, placements_text
from habitus.markers.placements import PlacementPrior, UsualPlace

length = st.integers(-4000, 4000).map(lambda tenths: tenths / 1e4)
usual = st.builds(
    UsualPlace,
    st.tuples(length, length, length),
    length,
    st.integers(1, 4000).map(lambda t: t / 1e4),
)
name = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), min_size=1, max_size=12
)


@settings(max_examples=8)
@given(
    st.dictionaries(name, usual, max_size=3),
    st.dictionaries(st.tuples(name, name), usual, max_size=3),
)
def test_read_back_as_written(places, labels):
    labels = {key: value for key, value in labels.items() if key[1] != "*"}
    prior = PlacementPrior(places, labels)
    assert parse_placements(placements_text(prior, "a head\nof two lines"), "x") == prior


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[asis", "not TOML"),
        ("asis = 3", "expected a table"),
        ("[asis]\nLFWT = { shift = [0, 0], off = 0, spread = 0.01, people = 1 }", "LFWT"),
        ("[asis]\nLFWT = { shift = [0, 0, 9.5], off = 0, spread = 0.01, people = 1 }", "below 0.5"),
        ("[asis]\nLFWT = { shift = [0, 0, nan], off = 0, spread = 0.01, people = 1 }", "below 0.5"),
        ("[asis]\nLFWT = { shift = [0, 0, 0], off = 0, spread = 0, people = 1 }", "above 0"),
        ("[asis]\nLFWT = { off = 0, spread = 0.01, people = 1 }", "expected off"),
        ("[asis]\nLFWT = { shift = [0, 0, 0], off = 0, more = 1 }", "expected off"),
    ],
)
def test_other_texts_are_refused(text, says):
    with pytest.raises(HabitusError, match=says):
        parse_placements(text, "x")
