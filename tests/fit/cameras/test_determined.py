"""What no keypoint determines is said and hatched, by the keypoints that were seen."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from browser import visit
from PIL import Image

from habitus.body.prior import prior_of
from habitus.fit.cameras.determined import bone_axes, determined, open_skin
from habitus.fit.cameras.result import CameraFit
from habitus.io.models.bodies import load_body
from habitus.observe.keypoints import convention_names
from habitus.report.cameras import camera_page
from habitus.results.cameras import camera_metrics
from habitus_lab.population.camera_scenes import camera_scene

FACE = ("eye", "ear", "nose", "neck", "top", "mouth")


@cache
def fit(convention: str) -> CameraFit:
    """The truth of a made scene of bent elbows, as if it were a fit."""
    body = load_body("female")
    names = body.joint_names
    mean = prior_of(body).for_joints(names).mean.reshape(-1, 3)
    pose = np.tile(np.concatenate([np.zeros((1, 3)), mean]), (6, 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        pose[:, names.index(f"{side}_elbow"), 1] -= sign * np.linspace(0.6, 1.2, 6)
    made = camera_scene(
        body, pose, np.zeros((6, 3)), 50.0, 4, np.random.default_rng(1), convention=convention
    )
    seen = made.detections
    return CameraFit(
        body=body,
        betas=made.betas,
        pose=pose,
        trans=made.trans,
        rate_hz=50.0,
        up_axis="+y",
        keypoint_names=convention_names(convention),
        convention=convention,
        cameras=made.rig,
        given_cameras=made.rig,
        corrections=np.zeros((4, 6)),
        late=np.zeros(4),
        observed=seen.pixels[:, :, 0],
        confidence=seen.confidence[:, :, 0],
        size_px=np.full((6, 4), 500.0),
        exchanged=np.zeros((6, 4), bool),
        keypoint_places=np.zeros((len(seen.names), 3)),
    )


def without(given: CameraFit, *parts: str) -> CameraFit:
    """As if the detector had none of these keypoints."""
    gone = [any(part in name for part in parts) for name in given.keypoint_names]
    return replace(given, confidence=np.where(gone, 0.0, given.confidence))


def open_bones(given: CameraFit) -> tuple[set[str], set[str]]:
    place, turn = determined(given).open
    names = np.array(given.body.joint_names)
    return set(names[place]), set(names[turn])


def test_hands_and_the_turn_of_forearms_are_open_without_keypoints_of_hands():
    place, turn = open_bones(fit("body25b"))
    assert {"left_wrist", "right_wrist", "left_hand", "right_hand"} <= place
    assert {"left_elbow", "right_elbow"} <= turn
    limbs = {"pelvis", "left_hip", "left_knee", "left_shoulder", "left_ankle", "head", "spine3"}
    assert not limbs & (place | turn)


def test_keypoints_of_hands_close_them():
    place, turn = open_bones(fit("blazepose33"))
    assert not {"left_wrist", "right_wrist", "left_elbow", "right_elbow"} & (place | turn)
    again, _ = open_bones(without(fit("blazepose33"), "pinky", "index", "thumb"))
    assert {"left_wrist", "right_wrist"} <= again


def test_head_and_feet_are_open_where_the_detector_has_none():
    place, _ = open_bones(without(fit("body25b"), *FACE, "toe", "heel"))
    assert {"head", "left_ankle", "right_ankle", "left_foot"} <= place


def test_shares_lie_between_nothing_and_all_and_fewer_keypoints_tell_no_more():
    whole = determined(fit("body25b"))
    less = determined(without(fit("body25b"), "wrist", "ear"))
    for more, fewer in zip(whole, less, strict=True):
        assert (more <= fewer + 1e-6).all() and np.isfinite(fewer).all()
    for share in (whole.place_share, whole.turn_share):
        assert (share >= 0.0).all() and (share <= 1.0 + 1e-6).all()
    blind = determined(replace(fit("body25b"), confidence=np.zeros_like(fit("body25b").confidence)))
    np.testing.assert_allclose(blind.place_share[1:], 1.0, atol=1e-6)
    np.testing.assert_allclose(blind.turn_share[1:], 1.0, atol=1e-6)


def test_axes_run_along_limbs_and_skin_belongs_to_its_bones():
    given = fit("body25b")
    names = given.body.joint_names
    joints = given.body.rest_joints(given.betas)
    elbow, wrist = names.index("left_elbow"), names.index("left_wrist")
    along = joints[wrist] - joints[elbow]
    assert bone_axes(given)[elbow] @ along / np.linalg.norm(along) > 0.95
    hand = open_skin(given, np.array([name in ("left_wrist", "left_hand") for name in names]))
    rest = given.body.rest_vertices(given.betas)
    assert hand[np.argmax(rest[:, 0])] and not hand[np.argmin(rest[:, 0])]


def test_the_page_hatches_and_says_it(tmp_path):
    given = fit("body25b")
    numbers = camera_metrics(given)
    assert "left_wrist" in numbers["undetermined_joints"]["place"]
    text = camera_page(given, numbers)
    assert "Crosshatched: no keypoint determines how this part is held (" in text
    assert "Hatched: no keypoint determines the turn of this part" in text and "left hand" in text
    (tmp_path / "report.html").write_text(text)
    picture = tmp_path / "page.png"
    visit(tmp_path / "report.html", tmp_path, fragment="still=yes&yaw=0", picture=picture)
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    red, green, blue = np.moveaxis(pixels, -1, 0)
    violet = (blue - green > 50) & (blue - red > 20)
    columns = np.nonzero(violet)[1]
    middle = pixels.shape[1] / 2
    assert violet.sum() > 300
    assert (columns < middle - 60).any() and (columns > middle + 60).any()  # both arms


@pytest.mark.parametrize("convention", ["coco17", "halpe26"])
def test_every_convention_has_an_answer(convention):
    place, turn = open_bones(fit(convention))
    assert "left_hand" in place and not place & turn
