"""A layout that was found is a file that reads back as the same layout, with what a person must
know on top.
"""

import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.fit.discover.result import Discovery
from habitus.io.layouts.draft import discovered_layout_text
from habitus.io.layouts.files import load_layout
from habitus.io.layouts.toml import parse_layout
from habitus.io.names import plain_name
from habitus.markers.layouts import Marker, MarkerLayout

PLACES = (
    {"landmark": "left_asis"},
    {"between": ("left_acromion", "left_elbow_lateral", 0.4)},
    {"vertex": 17},
)
markers = st.builds(
    lambda place, sure: (
        {"distance": 0.0125, "distance_spread": 0.006, "place_spread": 0.04, "confidence": sure}
        | place
    ),
    st.sampled_from(PLACES),
    st.floats(0, 1).map(lambda x: round(x, 2)),
)
labels = st.text(min_size=1, max_size=12).map(plain_name).filter(lambda x: x and "[" not in x)


@given(st.dictionaries(labels, markers, min_size=1, max_size=6), st.text(max_size=20))
@settings(max_examples=25, deadline=None)
def test_what_is_written_is_read_back(found, capture):
    layout = MarkerLayout(
        "discovered", tuple(Marker(k, **v) for k, v in found.items()), num_vertices=99
    )
    mates = {label: tuple(found)[:2] for label in found}
    text = discovered_layout_text(
        Discovery(layout, {"GONE": "never seen"}, ("Left\nor right?",), companions=mates), capture
    )
    read = parse_layout(text, "found.toml", load_layout)
    assert sorted(read.markers, key=lambda m: m.label) == sorted(
        layout.markers, key=lambda m: m.label
    )
    assert read.left_out == {"GONE": "never seen"} and read.num_vertices == 99
    assert "# NOT SURE: Left" in text and tomllib.loads(text)["name"].startswith("discovered in")
    sure = [marker.confidence for marker in read.markers]
    assert sure == sorted(sure)


@pytest.mark.parametrize("value", ["2", "-0.1", "true", '"high"', "nan"])
def test_a_confidence_that_is_none_is_refused(value):
    with pytest.raises(HabitusError, match=r"confidence = .*expected a number from 0 to 1"):
        parse_layout(
            f'name = "x"\n[markers]\nA = {{ place = "c7", confidence = {value} }}',
            "x.toml",
            load_layout,
        )
