"""``joints`` "auto": finger joints where markers sit on fingers, whatever the layout calls them."""

import gc
import weakref
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import habitus as hb
from habitus.body.hands import FINGERS, HAND_JOINTS, HAND_POSES, SIDES, HandPose, hand_pose
from habitus.body.prior import prior_of
from habitus.export.trc import write_trc
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout, shipped_layouts
from habitus.io.layouts.toml import layout_text
from habitus.jobs.bodies import loaded, with_fingers
from habitus.jobs.subjects import Person
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

FRAMES = 60
RATE = 60.0
TIPS = tuple(f"{finger}_tip" for finger in ("thumb", *FINGERS))
FOURTEEN = (*TIPS, "thumb_ip", *(f"{f}_{part}" for f in FINGERS for part in ("pip", "dip")))


@cache
def body(joints="smplh"):
    return hb.load_body("default", joints=joints)


def own_layout(*places):
    """The body markers of cmu-41, and finger markers of both hands, under labels of their own."""
    whole = [
        replace(marker, label=f"P{k:02d}", aliases=(), distance_spread=0.002)
        for k, marker in enumerate(load_layout("cmu-41").markers)
    ]
    fingers = [
        Marker(f"{side[0]}g{k}", landmark=f"{side}_{place}", distance=0.004, place_spread=0.003)
        for side in SIDES
        for k, place in enumerate(places)
    ]
    return MarkerLayout("own", (*whole, *fingers))


def chosen(layout, given="default", joints="auto"):
    person = Person((), layout, layout, ())
    loaded = body("smpl") if isinstance(given, str) else given
    return with_fingers([person], loaded, given, joints)[1].num_joints


@pytest.mark.parametrize(
    ("places", "joints"),
    [
        (FOURTEEN, 52),
        (TIPS, 52),
        (TIPS[:3], 52),
        (TIPS[:2], 24),
        ((), 24),
        (tuple(f"{finger}_mcp" for finger in FINGERS), 24),  # knuckles: no finger bends them
    ],
)
def test_the_skin_under_markers_decides_on_finger_joints(places, joints):
    assert chosen(own_layout(*places)) == joints


def test_markers_placed_between_landmarks_count_too():
    between = [
        Marker(f"f{k}", between=(f"left_{finger}_pip", f"left_{finger}_dip", 0.5))
        for k, finger in enumerate(FINGERS)
    ]
    layout = own_layout()
    assert chosen(replace(layout, markers=(*layout.markers, *between))) == 52


def test_a_body_or_joints_that_are_given_stay():
    layout = own_layout(*FOURTEEN)
    assert chosen(layout, body("smpl")) == 24
    assert chosen(layout, joints="smpl") == 24


def test_shipped_layouts_have_no_fingers_outside_their_finger_markers():
    for layout in shipped_layouts():
        assert chosen(replace(layout, fingers=())) == 24, layout.name


def moving(side, seconds):
    """A hand that closes from flat to a grip, pinches, and spreads what no preset spreads."""
    share = 0.5 - 0.5 * np.cos(2 * np.pi * seconds)
    rows = np.array([HAND_POSES[name].angles for name in ("flat", "grip", "pinch")])
    angles = (1 - share) * rows[0] + share * (rows[1] if side == "left" else rows[2])
    angles[:12] += 10.0 * np.sin(2 * np.pi * 0.7 * seconds + np.arange(12))
    angles[16:] += np.array([6.0, 1.0, -3.0, -7.0]) * (1 - share)
    return HandPose.of(angles)


def test_an_own_layout_of_fourteen_markers_a_hand_is_followed_by_the_fingers(tmp_path):
    rng = np.random.default_rng(4)
    layout = own_layout(*FOURTEEN)
    prior = prior_of(body()).for_joints(body().joint_names)
    pose, trans = smooth_motion(
        prior.mean, 0.5 * np.sqrt(np.diag(prior.covariance)), FRAMES, RATE, rng
    )
    for side in SIDES:
        for t in range(FRAMES):
            for name, turn in hand_pose(body(), moving(side, t / RATE), (side,)).items():
                pose[t, body().joint_names.index(name)] = turn
    betas = np.clip(rng.normal(size=body().num_betas), -2, 2)
    faults = Faults(placement=0.001, noise=5e-4, missing=0.0)
    truth = simulate_capture(
        body(), betas, pose, trans, layout.vertices(body()), layout.distances(), faults, rng
    )
    write_trc(Capture("hands", layout.labels, truth.observed, RATE, "+y"), tmp_path / "hands.trc")
    (tmp_path / "own.toml").write_text(layout_text(layout), encoding="utf-8")
    fit = hb.Mosh(layout=tmp_path / "own.toml", soft_tissue=False).fit(tmp_path / "hands.trc")
    assert fit.body.num_joints == 52
    tips = [body().landmarks[f"{side}_{tip}"] for side in SIDES for tip in TIPS]
    exact = body()(betas, pose, trans)
    found = fit.body(fit.betas, fit.pose, fit.trans, vertices=tips).vertices
    off = 1e3 * np.linalg.norm(found - exact.vertices[:, tips], axis=2)
    assert off.mean() < 2.5 and np.percentile(off, 95) < 4.0
    fingers = [body().joint_names.index(f"{s}_{joint}") for s in SIDES for joint in HAND_JOINTS]
    turned = (
        Rotation.from_rotvec(fit.pose[:, fingers].reshape(-1, 3)).inv()
        * Rotation.from_rotvec(pose[:, fingers].reshape(-1, 3))
    ).magnitude()
    assert np.degrees(turned).mean() < 6.0
    arms = [body().joint_names.index(f"{s}_{part}") for s in SIDES for part in ("elbow", "wrist")]
    away = 1e3 * np.linalg.norm(fit.joints()[:, arms] - exact.joints[:, arms], axis=2)
    assert away.mean() < 6.0


def test_bodies_in_use_are_shared_and_then_freed():
    """Two jobs hold one body: each result that kept its own would take 240 MB."""
    first = loaded("female", "smplh", 7.25)
    assert loaded("female", "smplh", 7.25) is first
    assert loaded("female", age=7.25) is not first and loaded("female", "smplh", 8.0) is not first
    gone = weakref.ref(first)
    del first
    gc.collect()
    assert gone() is None
