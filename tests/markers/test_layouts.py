"""Laws of layouts: places resolve, sides mirror, labels are unique, spellings are one."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.io.layouts.files import shipped_layouts
from habitus.markers.checks import other_side
from habitus.markers.labels import fragment_of, normalised, spellings
from habitus.markers.layouts import Marker, MarkerLayout

SHIPPED = shipped_layouts()
each_layout = pytest.mark.parametrize("layout", SHIPPED, ids=lambda layout: layout.name)


@dataclass(frozen=True)
class Cube:
    """A body of eight vertices."""

    name: str = "cube"
    landmarks: dict = field(default_factory=lambda: {"left_a": 7, "left_b": 3, "middle": 0})
    v_template: np.ndarray = field(
        default_factory=lambda: np.indices((2, 2, 2)).reshape(3, 8).T.astype(float)
    )


@pytest.fixture(scope="module")
def body():
    from habitus.io.models.bodies import load_body

    try:
        return load_body("default")
    except HabitusError as error:
        pytest.skip(f"the default body is not there: {error}")


# -- shipped layouts on the default body -----------------------------------------------------------


@each_layout
def test_every_place_is_on_the_body(layout, body):
    vertices = layout.vertices(body)
    assert vertices.shape == (len(layout),)
    assert vertices.min() >= 0 and vertices.max() < len(body.v_template)


@each_layout
def test_mirrored_places_are_mirrored_vertices(layout, body):
    template = np.asarray(body.v_template)
    mirrored = replace(layout, markers=tuple(other_side(marker) for marker in layout.markers))
    apart = template[layout.vertices(body)] * [-1.0, 1.0, 1.0] - template[mirrored.vertices(body)]
    assert np.abs(apart).max() < 0.006


@each_layout
def test_left_labels_are_on_the_left(layout, body):
    places = np.asarray(body.v_template)[layout.vertices(body)]
    for marker, place in zip(layout.markers, places, strict=True):
        side = {name.partition("_")[0] for name in marker.landmarks}
        assert not (side == {"left"} and place[0] < 0.005), marker
        assert not (side == {"right"} and place[0] > -0.005), marker
        assert not (not side & {"left", "right"} and abs(place[0]) > 0.01), marker


@each_layout
def test_labels_and_places_agree_on_the_side(layout):
    """A label that has a twin on the other side sits on the side that its name says, its twin at
    the mirrored place.
    """
    for marker in layout.markers:
        twin = "R" + marker.label[1:]
        if marker.label[0] in "Ll" and twin in layout.labels:
            assert marker.place.startswith("left_"), marker
            if layout.name != "kit-mmm" or marker.label != "LBAK":
                assert other_side(marker).place == layout[twin].place


def test_thumb_side_and_outer_sides(body):
    """Radial is the thumb side, lateral the outer one, on the template (arms out, palms down:
    thumbs ahead).
    """
    at = {name: np.asarray(body.v_template)[index] for name, index in body.landmarks.items()}
    for side in ("left", "right"):
        ahead = at[f"{side}_wrist_radial"] - at[f"{side}_wrist_ulnar"]
        thumb = at[f"{side}_thumb_tip"] - at[f"{side}_pinky_tip"]
        assert ahead @ thumb > 0
        for joint in ("knee", "ankle"):
            assert abs(at[f"{side}_{joint}_lateral"][0]) > abs(at[f"{side}_{joint}_medial"][0])
        assert abs(at[f"{side}_mt5_head"][0]) > abs(at[f"{side}_mt1_head"][0])
        for name in ("shoulder", "head"):
            front = f"{side}_{name}_front"
            back = f"{side}_{name}_back"
            if name == "head":
                front = f"{side}_front_head"
                back = f"{side}_back_head"
            assert at[front][2] > at[back][2]


# -- layouts ---------------------------------------------------------------------------------------


def test_labels_are_unique():
    with pytest.raises(HabitusError, match="occurs twice"):
        MarkerLayout("x", (Marker("A", landmark="left_a"), Marker("A", landmark="left_b")))


def test_missing_landmarks_are_listed():
    layout = MarkerLayout(
        "x",
        (Marker("A", landmark="nose"), Marker("B", landmark="left_a"), Marker("C", landmark="ear")),
    )
    with pytest.raises(HabitusError, match="no landmark ear, nose"):
        layout.vertices(Cube())


def test_vertex_ids_serve_their_own_body_only():
    ids = MarkerLayout("ids", (Marker("A", vertex=5), Marker("B", vertex=2)), num_vertices=8)
    assert list(ids.vertices(Cube())) == [5, 2]
    with pytest.raises(HabitusError, match="6890 vertices, but body cube has 8"):
        replace(ids, num_vertices=6890).vertices(Cube())
    with pytest.raises(HabitusError, match="vertex 9"):
        MarkerLayout("ids", (Marker("A", vertex=9),), num_vertices=8).vertices(Cube())
    both = MarkerLayout("both", (Marker("A", vertex=5, landmark="left_a"),), num_vertices=6890)
    assert list(both.vertices(Cube())) == [7]
    assert list(replace(both, num_vertices=8).vertices(Cube())) == [5]


@given(st.floats(0.0, 1.0))
def test_a_blend_goes_from_one_landmark_to_the_other(share):
    vertex = MarkerLayout("x", (Marker("A", between=("left_a", "middle", share)),)).vertices(
        Cube()
    )[0]
    assert vertex == (7 if share < 0.5 else 0) or share == 0.5


def test_spreads_and_distances_are_metres_in_order():
    layout = MarkerLayout(
        "x",
        (Marker("A", landmark="a"), Marker("B", landmark="b", distance=0.05, place_spread=0.06)),
    )
    assert np.array_equal(layout.distances(), [0.0095, 0.05])
    assert np.array_equal(layout.distance_spreads(), [0.001, 0.001])
    assert np.array_equal(layout.place_spreads(), [0.02, 0.06])
    assert layout.restricted_to(("B",)).labels == ("B",)


@settings(deadline=None)
@given(st.sampled_from([marker for layout in SHIPPED for marker in layout.markers]))
def test_mirroring_twice_changes_nothing(marker):
    assert other_side(other_side(marker)) == marker


# -- labels ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "label",
    ["L_IAS", "L.IAS", "LIAS", "LeftIAS", "Left IAS", "l_ias", "S1:LIAS", "Q_LIAS", "L-IAS"],
)
def test_spellings_of_one_label(label):
    assert normalised(label) == "LIAS"


def test_combined_labels_offer_each_part():
    assert set(spellings("C_7__IOR_CV7__CGM_C7__CAST_CV7")) >= {"C7", "CV7"}
    assert spellings("IAS_L")[-1] == "LIAS"


@given(st.text(min_size=1, max_size=20))
def test_normalising_is_idempotent_and_never_fails(label):
    once = normalised(label)
    assert once == once.upper().strip() or once
    assert all(spellings(label)) and (
        fragment_of(label) is None or label.strip().startswith(fragment_of(label))
    )


@given(st.sampled_from([label for layout in SHIPPED for label in layout.labels]))
def test_case_and_separators_say_nothing(label):
    assert (
        normalised(label.lower())
        == normalised(label)
        == normalised(label.replace("_", "."))
        == normalised(label.upper())
    )
