"""OpenSim's marker sets: markers on the side and part that their bone names, and one clear line for
what is wrong.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.io.layouts.files import load_layout, match_layout
from habitus.io.layouts.opensim import bone_frame
from habitus.io.models.bodies import load_body


def text(*markers, tag="socket_parent_frame"):
    each = "".join(
        f'<Marker name="{name}"><{tag}>/bodyset/{bone}</{tag}><location>{place}</location></Marker>'
        for name, bone, place in markers
    )
    return f'<?xml version="1.0"?><OpenSimDocument><MarkerSet><objects>{each}</objects></MarkerSet></OpenSimDocument>'


def load(folder: Path, content: str, name: str = "set.xml"):
    (folder / name).write_text(content, encoding="utf-8")
    return load_layout(folder / name)


@pytest.fixture(scope="module")
def body():
    return load_body("default")


@pytest.mark.parametrize("tag", ["socket_parent_frame", "body"])
def test_markers_lie_where_their_bones_are(tmp_path, body, tag):
    bones = (
        "pelvis",
        "torso",
        "femur_r",
        "tibia_l",
        "calcn_r",
        "humerus_l",
        "radius_r",
        "hand_l",
        "head",
        "toes_l",
    )
    layout = load(
        tmp_path, text(*((f"M{k}", bone, "0 0 0") for k, bone in enumerate(bones)), tag=tag)
    )
    template = np.asarray(body.v_template)
    for marker, vertex in zip(layout.markers, layout.vertices(body), strict=True):
        bone = bones[int(marker.label[1:])]
        origin, axes = bone_frame(bone, body)
        assert np.linalg.norm(template[vertex] - origin) < 0.15
        side = {"l": 1, "r": -1}.get(bone[-1] if bone[-2] == "_" else "", 0)
        assert side == 0 or np.sign(template[vertex][0]) == side
        assert np.linalg.det(axes) > 0.3
    assert len(layout) + len(layout.left_out) == len(bones) and len(layout) >= 8


def test_left_is_the_mirror_image_of_right(body):
    for bone in ("femur", "tibia", "talus", "calcn", "toes", "humerus", "ulna", "radius", "hand"):
        place = np.array([0.02, -0.1, 0.05])
        mirror = np.array([-1.0, 1.0, 1.0])
        (left, one), (right, other) = (bone_frame(f"{bone}_{side}", body) for side in "lr")
        across = left + one @ (place * [1.0, 1.0, -1.0])
        np.testing.assert_allclose(across * mirror, right + other @ place, atol=0.005)


def test_ahead_up_and_right_are_ahead_up_and_right(body):
    _, axes = bone_frame("torso", body)
    assert axes[2, 0] > 0.5 and axes[1, 1] > 0.5 and axes[0, 2] < -0.5
    assert bone_frame("tail", body) is None and bone_frame("", body) is None


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "is not XML"),
        ("<a><b></a>", "is not XML"),
        (
            '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><x>&b;</x>',
            "declares the entity a",
        ),
        (
            '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><x>&a;</x>',
            "declares the entity a",
        ),
        ("<a>" * 500 + "</a>" * 500, "nested without end"),
        (text(("A", "pelvis", "0 0")), "marker A: location '0 0'; expected three numbers"),
        (text(("A", "pelvis", "0 nan 0")), "expected three numbers in metres"),
        (text(("A", "pelvis", "0 90 0")), "expected three numbers in metres"),
        (text(("A", "tail", "0 0 0")), "none of its markers has a place on a bone that is known"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, content, said):
    with pytest.raises(HabitusError, match=said) as raised:
        load(tmp_path, content)
    assert "\n" not in str(raised.value) and "set.xml" in str(raised.value)


@given(st.text(max_size=60), st.text(max_size=20), st.text(max_size=30))
@settings(max_examples=25, deadline=None)
def test_any_names_and_places_give_a_layout_or_one_line(tmp_path_factory, name, bone, place):
    from xml.sax.saxutils import escape, quoteattr

    folder = tmp_path_factory.mktemp("set")
    content = (
        f"<MarkerSet><Marker name={quoteattr(name)}><body>{escape(bone)}</body>"
        f"<location>{escape(place)}</location></Marker></MarkerSet>"
    )
    try:
        load(folder, content)
    except HabitusError as error:
        assert "\n" not in str(error)


def test_a_labs_own_set_is_read_and_matches_its_capture(shared):
    file = shared / "labelling" / "MarkerSet.xml"
    if not file.exists():
        pytest.skip("no marker set beside this checkout")
    layout = load_layout(file)
    body = load_body("default")
    across = np.asarray(body.v_template)[layout.vertices(body), 0]
    assert len(layout) == 62 and not layout.left_out
    for label, x in zip(layout.labels, across, strict=True):
        side = {"L": 1, "R": -1}.get(label[0], 0)
        assert side == 0 or label.startswith("LB") or np.sign(x) == side
    assert match_layout(layout.labels, layouts=[layout]).confidence == 1.0
