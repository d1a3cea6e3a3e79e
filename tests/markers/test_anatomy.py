"""What a label says of its height, side and depth is true of the place that layouts give it."""

import pytest

from habitus.io.layouts.files import shipped_layouts
from habitus.io.models.bodies import load_body
from habitus.markers.labels import place_of

SHIPPED = shipped_layouts()


@pytest.fixture(scope="module")
def body():
    return load_body("default")


@pytest.mark.parametrize("layout", SHIPPED, ids=lambda layout: layout.name)
def test_labels_say_where_layouts_put_them(layout, body):
    sole = body.v_template[:, 1].min()
    crown = body.v_template[:, 1].max()
    for marker, (left, up, front) in zip(
        layout.markers, body.v_template[layout.vertices(body)], strict=True
    ):
        if place := place_of(marker.label):
            assert abs(6.0 * (up - sole) / (crown - sole) - place.height) < 1.1, marker.label
            assert place.side in (-1, 0, 1) and place.depth in (-1, 0, 1)
            assert place.side * left >= 0.0 and place.depth * front > -0.02, marker.label


@pytest.mark.parametrize("label", ["", "LTHI", "Marker_7", "L", "__", "*12"])
def test_labels_that_say_nothing_of_height_have_no_place(label):
    assert place_of(label) is None
