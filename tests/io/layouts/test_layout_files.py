"""Layout files: what is written is read back, what is wrong is said in one line, real captures find
their layouts.
"""

import contextlib
import json
import random
import re
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.io.captures.read import read_capture
from habitus.io.layouts.draft import draft_layout
from habitus.io.layouts.files import (
    list_layouts,
    load_layout,
    match_layout,
    match_layouts,
    save_layout,
    shipped_layouts,
)
from habitus.io.layouts.toml import layout_text, parse_layout, sides
from habitus.io.names import plain_name
from habitus.markers.labels import normalised
from habitus.markers.layouts import Marker, MarkerLayout

each_layout = pytest.mark.parametrize("layout", shipped_layouts(), ids=lambda layout: layout.name)


def parse(text):
    return parse_layout(text, "test.toml", load_layout)


# -- shipped files ---------------------------------------------------------------------------------


def test_names_are_file_names_and_no_two_layouts_share_one():
    assert tuple(layout.name for layout in shipped_layouts()) == list_layouts()
    names = [name for layout in shipped_layouts() for name in (layout.name, *layout.also_known_as)]
    assert len(names) == len(set(names))
    for name in names:
        assert name in {load_layout(name).name, *load_layout(name).also_known_as}


@each_layout
def test_no_name_in_a_layout_means_two_markers(layout):
    owner = {}
    for marker in layout.markers:
        for name in {normalised(name) for name in (marker.label, *marker.aliases)}:
            assert owner.setdefault(name, marker.label) == marker.label
    assert not {normalised(label) for label in layout.left_out} & set(owner)
    assert set(layout.fingerprint) <= set(layout.labels)
    assert layout.title and layout.sources and len(layout.fingerprint) >= 3


@each_layout
def test_lengths_are_plausible(layout):
    assert np.all((layout.distances() >= 0.005) & (layout.distances() <= 0.06))
    assert np.all((layout.distance_spreads() >= 0.001) & (layout.distance_spreads() <= 0.03))
    assert np.all((layout.place_spreads() >= 0.02) & (layout.place_spreads() <= 0.08))


@each_layout
def test_a_layout_s_own_labels_are_matched_to_it(layout):
    labels = [marker.label for marker in layout.markers if not marker.optional]
    match = match_layout(labels)
    assert match.layout.name == layout.name
    assert match.confidence > 0.8 and not match.missing_labels and not match.unmatched_labels
    assert [marker.place for marker in match.layout.markers] == [
        layout[label].place for label in labels
    ]


@each_layout
@pytest.mark.parametrize("seed", range(3))
def test_matching_does_not_depend_on_order_case_or_prefix(layout, seed):
    labels = [marker.label for marker in layout.markers if not marker.optional]
    expected = {normalised(m.label): m.place for m in match_layout(labels).layout.markers}
    rng = random.Random(seed)
    rng.shuffle(labels)
    changed = [rng.choice([str.upper, str.lower, str])(label) for label in labels]
    match = match_layout([f"Subject {seed}:{label}" for label in changed])
    assert match.layout.name == layout.name
    assert {normalised(marker.label): marker.place for marker in match.layout.markers} == expected
    assert list(match.columns) == sorted(match.columns) and len(match.columns) == len(labels)


@each_layout
def test_a_few_missing_and_unknown_labels_do_not_matter(layout):
    labels = [marker.label for marker in layout.markers if not marker.optional][2:]
    match = match_layout([*labels, "prop one", "Racket#2"])
    assert match.layout.name == layout.name and match.confidence > 0.7
    assert match.unmatched_labels == ("prop one", "Racket#2") and set(match.left_out) == set(
        match.unmatched_labels
    )
    assert len(match.missing_labels) == 2


@each_layout
def test_shipped_layouts_survive_writing(layout, tmp_path):
    save_layout(layout, tmp_path / "copy.toml")
    assert load_layout(tmp_path / "copy.toml") == layout


# -- any file --------------------------------------------------------------------------------------

words = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="[]|"), min_size=1, max_size=12
)
words = words.map(plain_name).filter(bool)
anything = st.text(st.characters(codec=None, categories=None), min_size=1, max_size=12)
spreads = st.floats(1e-4, 0.4, allow_nan=False)
markers = st.builds(
    Marker,
    label=words,
    aliases=st.lists(words, max_size=3).map(tuple),
    landmark=words,
    distance=st.floats(0.0, 0.4),
    distance_spread=spreads,
    place_spread=spreads,
    direction=st.none() | st.tuples(st.floats(0.1, 1), st.floats(-1, 1), st.floats(-1, 1)),
    optional=st.booleans(),
)
blends = st.builds(Marker, label=words, between=st.tuples(words, words, st.floats(0, 1)))
numbered = st.builds(Marker, label=words, vertex=st.integers(0, 10**6))


@given(
    st.lists(markers | blends | numbered, min_size=1, max_size=6, unique_by=lambda m: m.label),
    words,
)
def test_round_trip(chosen, name):
    layout = MarkerLayout(
        name, tuple(chosen), title="t", description="d", sources=("s",), num_vertices=7
    )
    assert parse(layout_text(layout)) == layout


@given(st.lists(anything, min_size=1, max_size=5, unique_by=plain_name), anything)
def test_any_text_can_be_written_and_is_read_in_its_safe_spelling(labels, name):
    labels = [label for label in labels if not any(letter in label for letter in "[]|")]
    labels = [label for label in labels if plain_name(label) not in ("", "A")]
    layout = MarkerLayout(
        name, (Marker("A", vertex=1), *(Marker(label, vertex=2) for label in labels))
    )
    again = parse(layout_text(layout))
    assert again.name == plain_name(name)
    assert [marker.label for marker in again.markers] == [
        plain_name(marker.label) for marker in layout.markers
    ]


@settings(max_examples=25, deadline=None)
@given(st.lists(anything, min_size=1, max_size=8), anything)
def test_a_draft_is_a_valid_layout_whatever_the_labels(labels, name):
    known = ["LFHD", "RFHD", "LBHD", "RBHD", "C7", "CLAV", "STRN", "LSHO", "RSHO", "LANK", "RANK"]
    labels = [*known, *(label for label in labels if plain_name(label) not in known)]
    text = draft_layout(name, name, labels, np.zeros((2, len(labels), 3)), shipped_layouts())
    drafted = parse(text)
    assert drafted.name == plain_name(name) and {"C7", "LFHD"} <= {
        marker.label for marker in drafted.markers
    }


def test_a_hostile_name_is_harmless(tmp_path):
    (tmp_path / "a.toml").write_text(
        'name = "[/x]\\u001b[2J"\n[markers]\n"L\\u202eFHD" = "sternum"\n'
    )
    layout = load_layout(tmp_path / "a.toml")
    assert layout.name == r"[/x]\x1b[2J" and layout.markers[0].label == r"L\u202eFHD"


@pytest.mark.parametrize(
    "text",
    [
        "a" + ".a" * 20_000 + " = 1",  # takes the parser minutes
        "a = " + "[" * 100_000,
        "a = " + "{a=" * 100_000,
        "a = " + "9" * 10_000,
        'name = "x"\n[markers]\nA = { place = "sternum", distance = 1e999 }',
        'name = "x"\n[markers]\nA = { between = ["a", "b", ' + "9" * 400 + "] }",
        "#" * (1 << 21),
    ],
)
def test_texts_without_end_are_refused_at_once(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    (tmp_path / "a.json").write_text(text.removeprefix("a = "))
    started = time.perf_counter()
    for name in ("a.toml", "a.json"):
        with pytest.raises(HabitusError, match=rf"{re.escape(name)}"):
            load_layout(tmp_path / name)
    assert time.perf_counter() - started < 2


@given(st.text(max_size=200))
def test_any_text_is_a_layout_or_one_clear_error(text):
    try:
        parse(text)
    except HabitusError as error:
        assert "\n" not in str(error).split("not TOML")[0]


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=True) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(
    st.sampled_from(
        ["place", "between", "vertex", "aliases", "distance", "direction", "optional", "odd"]
    ),
    values,
)
def test_any_marker_value_is_taken_or_refused(key, value):
    from habitus.io.layouts.toml import _all_markers

    with contextlib.suppress(HabitusError):
        _all_markers(
            {"markers": {"[LR]X": {"place": "left_x", key: value}, "Y": value}}, None, "test"
        )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no name"),
        ('name = "x"', "has no markers"),
        ('name = "x"\n[markers]\nA = 3', "expected a landmark name"),
        ('name = "x"\n[markers]\nA = { distance = 0.01 }', "expected one place"),
        (
            'name = "x"\n[markers]\nA = { place = "c7", between = ["a", "b", 0.5] }',
            "expected one place",
        ),
        ('name = "x"\n[markers]\nA = { place = "c7", distance = 9.5 }', "expected metres"),
        ('name = "x"\n[markers]\nA = { place = "c7", distance_spread = 0 }', "expected metres"),
        (
            'name = "x"\n[markers]\nA = { place = "[left|right]_asis" }',
            r"write \[LR\] in the label",
        ),
        ('name = "x"\n[markers]\nA = { place = "c7", colour = "red" }', "unknown key colour"),
        ('name = "x"\n[markers]\nA = { between = ["a", "b", 1.5] }', "share from 0 to 1"),
        ('name = "x"\n[markers]\nA = ""', "empty text"),
        ('name = "x"\nextends = "nothing"', "no layout 'nothing'"),
        ('name = "x"\nextends = "cmu-41"\nwithout = ["NOPE"]', "does not have"),
        ('name = "x"\nmarkers = 3', r"expected a table \[markers\]"),
        ('name = "x"\nnum_vertices = "many"\n[markers]\nA = "c7"', "number of vertices"),
        ("name = ", "not TOML"),
    ],
)
def test_wrong_files_are_refused_with_what_is_wrong(text, says):
    with pytest.raises(HabitusError, match=says):
        parse(text)


def test_left_and_right_are_written_once():
    layout = parse(
        'name = "x"\n[markers]\n"[LR]A" = { place = "[left|right]_asis", aliases = ["[LR]B", '
        '"[Left|Right]C"], '
        'direction = [1, 0, 0] }\n"W[Lo|Hi]" = "[left|right]_psis"'
    )
    assert layout.labels == ("LA", "RA", "WLo", "WHi")
    assert layout["LA"].aliases == ("LB", "LeftC") and layout["RA"].landmark == "right_asis"
    assert layout["LA"].direction == (1.0, 0.0, 0.0) and layout["RA"].direction == (-1.0, 0.0, 0.0)
    assert sides("plain") == ("plain",)


def test_extending_adds_replaces_and_takes_away(tmp_path):
    (tmp_path / "base.toml").write_text(
        'name = "base"\n[markers]\n"[LR]A" = "[left|right]_asis"\nC = "c7"\n'
    )
    (tmp_path / "mine.toml").write_text(
        'name = "mine"\nextends = "base.toml"\nwithout = ["RA"]\n[markers]\nC = "t2"\nD = "t6"\n'
    )
    layout = load_layout(tmp_path / "mine.toml")
    assert {marker.label: marker.landmark for marker in layout.markers} == {
        "LA": "left_asis",
        "C": "t2",
        "D": "t6",
    }


def test_a_file_that_extends_itself_is_refused(tmp_path):
    (tmp_path / "a.toml").write_text('name = "a"\nextends = "b.toml"\n')
    (tmp_path / "b.toml").write_text('name = "b"\nextends = "a.toml"\n')
    with pytest.raises(HabitusError, match="extends itself"):
        load_layout(tmp_path / "a.toml")


def test_a_link_to_itself_is_refused(tmp_path):
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    with pytest.raises(HabitusError, match="cannot read layout file"):
        load_layout(tmp_path / "loop.toml")


def test_unknown_names_and_files(tmp_path):
    with pytest.raises(HabitusError, match="or one of: ais-mu"):
        (tmp_path / "odd.toml").write_text('name = "odd"\nextends = "nothing"\n')
        load_layout(tmp_path / "odd.toml")
    with pytest.raises(HabitusError, match="cmu-41"):
        load_layout("no-such-set")
    with pytest.raises(HabitusError, match="no layout file"):
        load_layout(tmp_path / "gone.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(HabitusError, match="cannot read"):
        load_layout(tmp_path / "binary.toml")
    assert load_layout("CMU_41") is load_layout("cmu-41") is load_layout("HDM05")


# -- MoSh++ layouts --------------------------------------------------------------------------------


def moshpp(**changes):
    """A file of MoSh++'s form with made-up vertex ids."""
    body = {
        "indices": {"LFWT": 11, "RFWT": 12, "C7": 13, "STRN": 14, "NOWHERE": 15},
        "distance_from_skin": 0.0095,
    }
    finger = {
        "indices": {"LELB": 21, "RELB": 22, "LKNE": 23, "RKNE": 24},
        "distance_from_skin": 0.0002,
    }
    sets = [{"type": "body", **body}, {"type": "other", **finger}]
    return {"surface_model_type": "smplx", "markersets": sets, **changes}


def test_moshpp_layouts_keep_ids_and_get_landmarks(tmp_path):
    path = tmp_path / "some_mocap_smplx.json"
    path.write_text(json.dumps(moshpp()))
    layout = load_layout(path)
    assert layout.name == "some_mocap_smplx" and layout.num_vertices == 10475
    assert layout["LFWT"].vertex == 11 and layout["LFWT"].landmark == "left_asis"
    assert layout["LELB"].distance == 0.0002 and layout["NOWHERE"].landmark is None


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"markersets": 3}', '{"markersets": '
                                                                        '[{"indices": {"A": '
                                                                        '"x"}}]}',
                                  '{"markersets": []}', '{"markersets": [{"indices": {"A": '
                                                        '-1}}]}'])  # fmt: skip
def test_other_json_is_refused(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(HabitusError, match=r"x\.json"):
        load_layout(tmp_path / "x.json")


# -- what cannot be matched ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "labels",
    [
        [],
        ["C7"],
        [f"Marker_{k}" for k in range(40)],
        ["LASI", "RASI", "C7", "CLAV"],
        [f"Channel{k}" for k in range(9)],
    ],
)
def test_too_few_known_labels_are_refused(labels):
    with pytest.raises(HabitusError, match="habitus layout new"):
        match_layout(labels)


def test_an_unsure_choice_is_refused_and_says_which_labels_arrived():
    labels = ["LASI", "RASI", "LKNE", "RKNE", "LANK", "RANK", *(f"THING{k}" for k in range(14))]
    with pytest.raises(HabitusError, match=r"unsure.*LASI.*confidence|unsure.*confidence.*LASI"):
        match_layout(labels)


@pytest.mark.parametrize("count, told", [(9, 9), (10, 10), (11, 10), (40, 10)])
def test_a_refusal_names_ten_labels_and_counts_the_others(count, told):
    with pytest.raises(HabitusError) as refused:
        match_layout([f"Thing<{k}>" for k in range(count)])
    assert str(refused.value).count("Thing<") == told + (count > 3)  # once more in what they share
    assert (f"({count} in all)" in str(refused.value)) == (count > 10)


def test_copies_and_second_fragments_are_not_used_twice():
    labels = [*load_layout("cmu-41").labels, "RBAC-1", "C7"]
    match = match_layout(labels)
    assert len(set(match.columns)) == len(match.columns) == 42
    assert match.unmatched_labels == ("RBAC-1", "C7")
    alone = [label if label != "RBAC" else "RBAC-1" for label in load_layout("cmu-41").labels]
    assert match_layout(alone).layout["RBAC-1"].landmark == "right_scapula_mid"


def test_known_extras_of_other_sets_are_used():
    labels = [*(m.label for m in load_layout("cmu-41").markers), "LMMA", "RMMA", "SEL"]
    match = match_layout(labels)
    assert match.layout.name == "cmu-41"
    assert (
        match.layout["LMMA"].landmark == "left_ankle_medial"
        and match.layout["SEL"].landmark == "sellion"
    )
    assert any("taken from other sets" in warning for warning in match.warnings)


# -- real captures ---------------------------------------------------------------------------------

WRIST = "LWRA and LWRB"
KNEE = "RLFE and RMFE"
ELBOWS = ["LLHE and LMHE are exchanged", "RLHE and RMHE are exchanged"]
REAL = {
    "85_02.c3d": ("cmu-41", 41, []),
    "85_12.c3d": ("cmu-41", 41, []),
    "HDM_mm_01-02_03_120.c3d": ("cmu-41", 41, ["RBAC sits", "LFIN is", "RFIN is"]),
    "HC030A01.c3d": ("plug-in-gait-oxford-foot", 65, []),
    "HC030A05.c3d": ("plug-in-gait-oxford-foot", 59, [f"{WRIST} are exchanged"]),
    "HC030A22.c3d": ("plug-in-gait-oxford-foot", 59, [f"{WRIST} are exchanged"]),
    "HC042A13.c3d": ("plug-in-gait-oxford-foot", 59, []),
    "HC042A40.c3d": ("plug-in-gait-oxford-foot", 59, []),
    "testsample.c3d": ("plug-in-gait", 41, [f"{WRIST} are exchanged"]),
    "testsample2.c3d": ("plug-in-gait", 41, [f"{WRIST} change places in 133"]),
    "kinematics_tennis_serve.c3d": ("plug-in-gait", 39, []),
    "anat_pose_ECH.c3d": ("ech-49", 73, ELBOWS),
    "right_hip.c3d": ("ech-49", 73, [f"{KNEE} change places in 958", *ELBOWS]),
    "right_knee.c3d": ("ech-49", 73, []),
    "static_rotated.c3d": ("ech-49", 49, []),
    "Running_0002.c3d": ("running-clusters", 64, []),
    "nick_freeform_001.c3d": (
        "vicon-53",
        52,
        ["LFSH and LBSH are exchanged", "RFSH and RBSH are exchanged"],
    ),
    "DJ2.trc": ("opensim-mobilecap", 47, []),
}


@pytest.mark.parametrize("name", REAL)
def test_real_captures_find_their_layout_and_its_faults(shared, name):
    layout, count, faults = REAL[name]
    capture = read_capture(shared / "mocap" / name)
    match = match_layout(capture.labels, capture.markers)
    assert match.layout.name == layout and len(match.matched) == count
    assert match.confidence > 0.95 and not match.unmatched_labels
    told = [correction.text for correction in match.corrections if not correction.quiet]
    assert len(told) == len(faults)
    assert all(text.startswith(fault) for text, fault in zip(told, faults, strict=True))
    assert match.select(capture.markers).shape == (len(capture.markers), count, 3)


def test_a_standing_trial_learns_from_a_walking_one(shared):
    captures = [read_capture(shared / "mocap" / name) for name in ("HC030A01.c3d", "HC030A05.c3d")]
    matches = match_layouts([(capture.labels, capture.markers) for capture in captures])
    assert all(match.layout["LWRA"].landmark == "left_wrist_ulnar" for match in matches)
    assert [len(match.matched) for match in matches] == [65, 59]


def test_odd_captures_match_or_are_refused(shared):
    found = {}
    for path in sorted((shared / "mocap-odd").glob("*.[cC]3[dD]")):
        try:
            capture = read_capture(path)
            found[path.stem] = match_layout(capture.labels, capture.markers).layout.name
        except HabitusError as error:
            assert "\n" not in str(error)
    assert found["Walking_Hybrid_2"] == "lower-body-clusters"
    assert found["MACsample"] == found["short-copy"] == "helen-hayes"
    assert found["Res16bits"] == "french-landmarks"
    assert not {
        "Dance",
        "golfswing",
        "mocap36",
        "phasespace_sample",
        "Optotrak",
        "dec_int",
        "duplicate_labels",
    } & set(found)


def test_the_example_of_the_documentation_is_a_layout():
    page = Path(__file__).resolve().parents[3] / "docs" / "adding-a-marker-layout.md"
    example = page.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0]
    layout = parse(example)
    assert (
        layout["LTIB"].distance == 0.055
        and "RBAK" not in layout.labels
        and "LHJC" in layout.left_out
    )
