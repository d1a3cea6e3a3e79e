"""The geometry checks correct what is wrong, all of it, and nothing that is right."""

from dataclasses import replace

import numpy as np
import pytest
from stick_figure import FRAMES, stick_figure

from habitus.markers.checks import checked, other_side
from habitus.markers.geometry import PAIRS
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.matching import best_match, match_together

PAIR_NAMES = [
    (f"{side}_{first}", f"{side}_{second}")
    for first, second, _ in PAIRS
    for side in ("left", "right")
]


def scene(seed=0, **changes):
    """A layout whose labels are the landmark names, and the figure's markers (T, M, 3) in its
    order.
    """
    figure = stick_figure(seed)
    markers = tuple(changes.get(name, Marker(name, landmark=name)) for name in figure)
    return MarkerLayout("stick", markers), np.stack(list(figure.values()), axis=1)


def loud(corrections):
    return [correction for correction in corrections if not correction.quiet]


@pytest.mark.parametrize("seed", range(5))
def test_right_labels_stay_as_they_are(seed):
    layout, markers = scene(seed)
    result, corrections = checked(layout, markers)
    assert loud(corrections) == []
    assert [m.landmark for m in result.markers] == [m.landmark for m in layout.markers]


@pytest.mark.parametrize("pair", PAIR_NAMES)
def test_an_exchanged_pair_gets_each_others_places(pair):
    layout, markers = scene(1)
    a, b = (layout.labels.index(name) for name in pair)
    markers[:, [a, b]] = markers[:, [b, a]]
    result, corrections = checked(layout, markers)
    assert [result[name].landmark for name in pair] == list(pair[::-1])
    assert [correction.check for correction in loud(corrections)] == ["exchanged pair"]
    others = set(layout.labels) - set(pair)
    assert all(result[name].landmark == name for name in others)


@pytest.mark.parametrize("pair", PAIR_NAMES)
@pytest.mark.parametrize("span", [(0, 70), (90, 150), (170, FRAMES)])
def test_a_pair_that_changes_places_for_a_while_is_put_back(pair, span):
    layout, markers = scene(2)
    a, b = (layout.labels.index(name) for name in pair)
    broken = markers.copy()
    broken[span[0] : span[1], [a, b]] = markers[span[0] : span[1], [b, a]]
    match = best_match(layout.labels, [layout], broken)
    assert [m.landmark for m in match.layout.markers] == list(layout.labels)
    assert np.array_equal(match.select(broken), markers)
    assert len(loud(match.corrections)) == 1


def test_corrections_do_not_depend_on_the_world():
    layout, markers = scene(3)
    pair = [layout.labels.index(name) for name in ("left_knee_lateral", "left_knee_medial")]
    markers[:, pair] = markers[:, pair[::-1]]
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    texts = [
        [c.text for c in checked(layout, moved)[1]]
        for moved in (markers, markers @ turn.T + [5.0, -2.0, 9.0])
    ]
    assert texts[0] == texts[1]


def test_missing_frames_change_no_verdict():
    layout, markers = scene(4)
    pair = [layout.labels.index(name) for name in ("left_wrist_radial", "left_wrist_ulnar")]
    markers[:, pair] = markers[:, pair[::-1]]
    markers[np.random.default_rng(1).random(markers.shape[:2]) < 0.3] = np.nan
    corrections = loud(checked(layout, markers)[1])
    assert [correction.check for correction in corrections] == ["exchanged pair"]
    assert loud(checked(layout, np.full_like(markers, np.nan))[1]) == []


@pytest.mark.parametrize("what", ["mirrored", "labels"])
def test_left_and_right_exchanged_throughout(what):
    layout, markers = scene(5)
    if what == "mirrored":
        markers = markers * [-1.0, 1.0, 1.0]
    else:
        swapped = {"left_": "right_", "right_": "left_"}
        names = [
            next((o + n.removeprefix(s) for s, o in swapped.items() if n.startswith(s)), n)
            for n in layout.labels
        ]
        layout = MarkerLayout("stick", tuple(Marker(name, landmark=name) for name in names))
    result, corrections = checked(layout, markers)
    assert [correction.check for correction in loud(corrections)] == ["mirrored capture"]
    assert [m.landmark for m in result.markers] == [other_side(m).landmark for m in layout.markers]


@pytest.mark.parametrize(("shear", "mirrored"), [(1.5, True), (4.5, False)])
def test_left_and_right_are_exchanged_where_all_fronts_say_so_clearly(shear, mirrored):
    """Mirrored, and all that is in front moved to one side: fronts say so with cosines of about
    -0.55, or -0.2.
    """
    layout, markers = scene(5)
    at = {label: markers[:, k] for k, label in enumerate(layout.labels)}
    left = at["left_asis"] - at["right_asis"]
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    pairs = [("c7", "jugular_notch"), ("t10", "xiphoid")]
    pairs += [
        (f"{s}_{back}", f"{s}_{front}")
        for s in ("left", "right")
        for back, front in (
            ("psis", "asis"),
            ("back_head", "temple"),
            ("heel", "mt5_head"),
            ("heel", "mt2_head"),
            ("heel", "toe_tip"),
            ("heel", "little_toe"),
        )
    ]
    for back, front in [pair for pair in pairs if set(pair) <= set(at)]:
        depth = np.linalg.norm(at[front] - at[back], axis=1, keepdims=True)
        markers[:, layout.labels.index(front)] += shear * depth * left
    checks = [correction.check for correction in checked(layout, markers * [-1.0, 1.0, 1.0])[1]]
    assert ("mirrored capture" in checks) == mirrored


def test_a_lone_shoulder_blade_marker_goes_to_its_side():
    layout, markers = scene(6)
    column = layout.labels.index("right_scapula_mid")
    layout = replace(
        layout,
        markers=tuple(other_side(m) if i == column else m for i, m in enumerate(layout.markers)),
    )
    result, corrections = checked(layout, markers)
    assert result.markers[column].landmark == "right_scapula_mid"
    assert [correction.check for correction in loud(corrections)] == ["side of a single marker"]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("across", "moved"), [(0.02, False), (-0.02, False), (-0.04, True), (-0.08, True)]
)
def test_a_lone_marker_must_be_clearly_on_the_other_side(across, moved, side):
    layout, markers = scene(6)
    column = layout.labels.index("right_scapula_mid")
    other = "left" if side == "right" else "right"
    lone = Marker(f"{side}_scapula_mid", landmark=f"{side}_scapula_mid")
    layout = replace(
        layout, markers=tuple(lone if k == column else m for k, m in enumerate(layout.markers))
    )
    at = {label: markers[:, k] for k, label in enumerate(layout.labels)}
    outward = at[f"{side}_asis"] - at[f"{other}_asis"]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    markers[:, column] = (at["c7"] + at["t10"]) / 2 + across * outward
    found = checked(layout, markers)[0].markers[column]
    assert found.landmark == f"{other if moved else side}_scapula_mid"


@pytest.mark.parametrize(("out", "wand"), [(0.0, False), (0.05, True)])
def test_wand_or_skin_is_told_by_the_distance(out, wand):
    unsure = Marker(
        "left_shank_lateral", landmark="left_shank_lateral", distance=0.03, distance_spread=0.025
    )
    layout, markers = scene(7, left_shank_lateral=unsure)
    column = {
        name: layout.labels.index(f"left_{name}")
        for name in ("shank_lateral", "knee_lateral", "knee_medial")
    }
    away = markers[:, column["knee_lateral"]] - markers[:, column["knee_medial"]]
    markers[:, column["shank_lateral"]] += out * away / np.linalg.norm(away, axis=1, keepdims=True)
    found = checked(layout, markers)[0]["left_shank_lateral"]
    assert (found.distance > 0.03) == wand
    assert found.distance_spread < unsure.distance_spread


@pytest.mark.parametrize("extra", [0.0, 0.02, 0.045])
def test_the_bar_across_a_wrist_sets_its_distance(extra):
    layout, markers = scene(8)
    a, b = (layout.labels.index(f"right_wrist_{name}") for name in ("radial", "ulnar"))
    outward = (markers[:, a] - markers[:, b]) / np.linalg.norm(
        markers[:, a] - markers[:, b], axis=1, keepdims=True
    )
    markers[:, a] += extra * outward
    markers[:, b] -= extra * outward
    found = checked(layout, markers)[0]["right_wrist_radial"].distance
    assert found == pytest.approx(max(0.0095, extra), abs=0.003)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_free_markers_get_the_share_of_the_limb_that_they_show(share):
    free = Marker("left_upper_arm", landmark="left_upper_arm", place_spread=0.06)
    layout, markers = scene(9, left_upper_arm=free)
    arm, top, end = (
        layout.labels.index(f"left_{name}") for name in ("upper_arm", "acromion", "elbow_lateral")
    )
    markers[:, arm] = markers[:, top] + share * (markers[:, end] - markers[:, top])
    found, corrections = checked(layout, markers)
    assert [c.check for c in corrections if c.text.startswith("measured")] == ["places along limbs"]
    found = found["left_upper_arm"]
    assert found.between is not None and found.between[2] == pytest.approx(share, abs=0.05)
    assert found.landmarks == ("left_acromion", "left_elbow_lateral")


@pytest.mark.parametrize(("wobble", "measured"), [(0.1, True), (0.3, False)])
def test_a_marker_that_wanders_along_its_limb_shows_no_share(wobble, measured):
    """Uniformly over so much of the limb: half of that lies between the quartiles."""
    free = Marker("left_upper_arm", landmark="left_upper_arm", place_spread=0.06)
    layout, markers = scene(9, left_upper_arm=free)
    arm, top, end = (
        layout.labels.index(f"left_{name}") for name in ("upper_arm", "acromion", "elbow_lateral")
    )
    share = 0.5 + wobble * (np.random.default_rng(0).permutation(FRAMES) / FRAMES - 0.5)[:, None]
    markers[:, arm] = markers[:, top] + share * (markers[:, end] - markers[:, top])
    assert (checked(layout, markers)[0]["left_upper_arm"].between is not None) == measured


def test_the_waist_s_middle_is_told_from_its_sides():
    layout, markers = scene(10)
    names = ("left_asis", "right_asis", "left_psis", "right_psis")
    corners = [markers[:, layout.labels.index(name)] for name in names]
    front = (corners[0] + corners[1]) / 2
    back = (corners[2] + corners[3]) / 2
    extra = (
        Marker("LMWT", landmark="left_iliac_crest"),
        Marker("RMWT", landmark="right_iliac_crest"),
    )
    wide = replace(layout, markers=layout.markers + extra)
    found = checked(wide, np.concatenate([markers, front[:, None], back[:, None]], axis=1))[0]
    assert (found["LMWT"].landmark, found["RMWT"].landmark) == ("waist_front", "waist_back")
    out = corners[0] - corners[1]
    sides = np.stack([front + 0.8 * out, front - 0.8 * out], axis=1)
    found = checked(wide, np.concatenate([markers, sides], axis=1))[0]
    assert (found["LMWT"].landmark, found["RMWT"].landmark) == (
        "left_iliac_crest",
        "right_iliac_crest",
    )


def test_captures_of_one_person_are_judged_together():
    layout, moving = scene(11)
    pair = [layout.labels.index(f"left_elbow_{name}") for name in ("lateral", "medial")]
    exchanged = moving.copy()
    exchanged[:, pair] = exchanged[:, pair[::-1]]
    still = np.tile(exchanged[:1], (50, 1, 1))
    order = np.random.default_rng(0).permutation(len(layout))
    labels = tuple(layout.labels[k] for k in order)
    one, two = match_together([(layout.labels, still), (labels, exchanged[:, order])], [layout])
    assert {m.label: m for m in one.layout.markers} == {m.label: m for m in two.layout.markers}
    assert one.layout["left_elbow_lateral"].landmark == "left_elbow_medial"
    good, bad = match_together([(layout.labels, moving), (layout.labels, exchanged)], [layout])
    assert np.array_equal(good.select(moving), moving)
    assert np.array_equal(bad.select(exchanged), moving)
    assert bad.warnings == (
        "left_elbow_lateral and left_elbow_medial change places in all frames: put back",
    )
