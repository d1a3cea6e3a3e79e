"""From made detections to bodies: the planted person is found, cameras are corrected where they
disagree, and nothing that is wrong is called good.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from habitus.body.keypoints import CONVENTIONS
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.cameras.one_camera import SOLE, _turns, placed_by_one, standing_points
from habitus.fit.cameras.people import tracks
from habitus.fit.cameras.result import CameraFit
from habitus.fit.cameras.settings import CAMERAS
from habitus.fit.cameras.shape import corrected_rig, mirrored
from habitus.fit.cameras.triangulate import triangulated
from habitus.io.models.bodies import load_body
from habitus.jobs.cameras import fit_cameras
from habitus.observe.camera_rig import CameraRig
from habitus.observe.keypoints import KeypointRig, convention_names
from habitus.report.cameras import camera_page
from habitus.results.cameras import camera_metrics
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus_lab.population.camera_scenes import CameraScene, camera_scene, disturbed, ring

RATE = 50.0
FRAMES = 40


def motion(seed: int, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Somebody who walks on the spot and swings the arms."""
    body = load_body("female")
    names = body.joint_names
    rng = np.random.default_rng(seed)
    mean = prior_of(body).for_joints(names).mean.reshape(-1, 3)
    phase = np.linspace(0.0, 3.0 * np.pi, FRAMES) + seed
    pose = np.tile(np.concatenate([np.zeros((1, 3)), mean]), (FRAMES, 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * np.sin(phase)
        pose[:, names.index(f"{side}_hip"), 0] -= 0.5 * np.maximum(swing, -0.3)
        pose[:, names.index(f"{side}_knee"), 0] += 0.6 * np.maximum(swing, 0.0)
        pose[:, names.index(f"{side}_elbow"), 1] -= sign * 0.5
        pose[:, names.index(f"{side}_shoulder"), 1] += 0.4 * swing
    pose[:, 0, 1] = 0.5 + 0.1 * np.sin(phase)
    trans = np.zeros((FRAMES, 3))
    trans[:, 0] = shift + 0.3 * np.sin(phase / 3.0)
    trans += 0.02 * rng.normal(size=3)
    return pose, trans


@cache
def scene(seed: int = 0, cameras: int = 4) -> CameraScene:
    rng = np.random.default_rng([seed, cameras])
    return camera_scene(load_body("female"), *motion(seed), RATE, cameras, rng)


def errors(made: CameraScene, fit: CameraFit) -> np.ndarray:
    """Distances (m) of joints but fingers."""
    rows = slice(fit.first_frame, fit.first_frame + len(fit.pose))
    truth = np.asarray(made.body(made.betas, made.pose[rows], made.trans[rows]).joints)
    return np.linalg.norm(fit.joints()[:, :22] - truth[:, :22], axis=-1)


@cache
def fitted(cameras: int = 4) -> CameraFit:
    (fit,) = fit_cameras(scene(cameras=cameras).detections, scene(cameras=cameras).rig)
    return fit


@pytest.mark.parametrize(("cameras", "most"), [(2, 0.036), (4, 0.022)])
def test_a_planted_person_is_found(cameras, most):
    fit = fitted(cameras)
    assert errors(scene(cameras=cameras), fit).mean() < most
    assert fit.verdict.level == "good" and fit.up_axis == "+y"
    rest = scene(cameras=cameras).body.rest_vertices(scene(cameras=cameras).betas)
    assert abs(fit.height - np.ptp(rest[:, 1])) < 0.05
    assert not fit.corrections.any() and not fit.late.any()


def test_a_height_that_is_given_is_kept():
    made = scene()
    height = fitted().height + 0.04
    (fit,) = fit_cameras(made.detections, made.rig, height=height)
    assert abs(fit.height - height) < 0.02


def test_cameras_that_disagree_are_corrected():
    made = scene()
    rng = np.random.default_rng(1)
    off = disturbed(made.rig, 0.7, 0.03, rng)
    (kept,) = fit_cameras(made.detections, off, keep_cameras=True)
    (fit,) = fit_cameras(made.detections, off)
    assert not kept.corrections.any() and fit.corrections.any()
    assert np.nanmedian(fit.errors_px) < 0.7 * np.nanmedian(kept.errors_px)

    def placed(one: CameraFit) -> float:
        rows = slice(one.first_frame, one.first_frame + len(one.pose))
        truth = np.asarray(made.body(made.betas, made.pose[rows], made.trans[rows]).joints)
        apart = one.joints()[:, :22] - truth[:, :22]
        return float(np.linalg.norm(apart - apart.mean((0, 1)), axis=-1).mean())

    assert placed(fit) < placed(fitted()) + 0.004
    distances = [
        np.linalg.norm(rig.places[:, None] - rig.places[None], axis=-1).sum()
        for rig in (off, fit.cameras)
    ]
    np.testing.assert_allclose(*distances, rtol=2e-3)


def test_a_late_camera_is_found_and_said():
    made = scene()
    seen = made.detections
    pixels, sure = seen.pixels.copy(), seen.confidence.copy()
    pixels[3:, 1], sure[3:, 1] = seen.pixels[:-3, 1], seen.confidence[:-3, 1]
    (fit,) = fit_cameras(replace(seen, pixels=pixels, confidence=sure), made.rig)
    late = fit.late * RATE
    assert abs(late[1] - 3.0) < 1.0 and np.abs(np.delete(late, 1)).max() < 0.8
    assert fit.verdict.level != "good" and "late" in " ".join(fit.verdict.reasons)


def test_sides_that_a_camera_exchanges_are_put_back():
    made = scene()
    seen = made.detections
    order = [seen.names.index(_other(name)) for name in seen.names]
    pixels, sure = seen.pixels.copy(), seen.confidence.copy()
    rows = slice(10, 20)
    pixels[rows, 2], sure[rows, 2] = pixels[rows, 2][..., order, :], sure[rows, 2][..., order]
    (fit,) = fit_cameras(replace(seen, pixels=pixels, confidence=sure), made.rig)
    found = fit.exchanged[:, 2][10 - fit.first_frame : 20 - fit.first_frame]
    assert found.mean() > 0.7
    assert errors(made, fit).mean() < errors(made, fitted()).mean() + 0.003


def _other(name: str) -> str:
    left, right = name.replace("left_", "right_"), name.replace("right_", "left_")
    return left if name.startswith("left_") else right


def _moved(rig: CameraRig, change) -> CameraRig:
    return CameraRig(tuple(change(k, camera) for k, camera in enumerate(rig.cameras)))


def _mirror(_, camera):
    flip = np.diag([-1.0, 1.0, 1.0])
    turn = flip @ camera.rotation @ flip
    return replace(camera, rotation=turn, translation=-turn @ flip @ camera.place)


FAULTS = {
    "convention": lambda d, r: (replace(d, names=CONVENTIONS["openpose25"]), r),
    "unit": lambda d, r: (
        d, _moved(r, lambda _, c: replace(c, translation=10.0 * c.translation))
    ),
    "exchanged": lambda d, r: (
        d,
        CameraRig((
            replace(r.cameras[1], name="cam1"), replace(r.cameras[0], name="cam2"), *r.cameras[2:]
        )),
    ),
    "mirrored": lambda d, r: (d, _moved(r, _mirror)),
    "turned": lambda d, r: (
        d,
        _moved(r, lambda k, c: c.moved(matrix_from_rotvec(np.array([0, 0.087, 0])), np.zeros(3))
               if k == 0 else c),
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", list(FAULTS))
def test_what_is_wrong_is_not_called_good(fault):
    made = scene()
    detections, rig = FAULTS[fault](made.detections, made.rig)
    try:
        (fit,) = fit_cameras(detections, rig)
    except HabitusError as error:
        assert "\n" not in str(error)
        return
    assert fit.verdict.level != "good" and fit.verdict.reasons


def test_two_people_and_a_bystander_are_told_apart():
    """The bystander is seen by one camera alone."""
    one, other = scene(0), scene(1)
    rig = one.rig
    shifted = other.keypoints + np.array([1.2, 0.0, 0.3])
    pixels = np.moveaxis(rig.project(shifted), 0, 1)[:, :, None]
    third = np.full_like(pixels, np.nan)
    third[:, 0] = pixels[:, 0] + 300.0
    all_pixels = np.concatenate([one.detections.pixels, pixels, third], axis=2)
    sure = np.isfinite(all_pixels).all(-1).astype(float)
    rng = np.random.default_rng(0)
    for t in range(len(all_pixels)):
        for c in range(4):
            order = rng.permutation(3)
            all_pixels[t, c], sure[t, c] = all_pixels[t, c, order], sure[t, c, order]
    both = replace(one.detections, pixels=all_pixels, confidence=sure)
    found = tracks(both, rig, CAMERAS)
    assert len(found) == 2
    truths = [np.moveaxis(rig.project(each), 0, 1) for each in (one.keypoints, shifted)]
    who = []
    for track in found:
        off = [np.nanmedian(np.linalg.norm(track.pixels - t, axis=-1), axis=(1, 2)) for t in truths]
        best = int(np.argmin([np.nanmedian(each) for each in off]))
        assert (off[best] < 40.0).all()
        who.append(best)
    assert sorted(who) == [0, 1]


def test_points_meet_where_they_are():
    made = scene()
    pixels = made.rig.project(made.keypoints)
    points, error = triangulated(made.rig, pixels, np.ones(pixels.shape[:-1]))
    np.testing.assert_allclose(points, made.keypoints, atol=1e-6)
    assert np.nanmax(error) < 1e-3
    one = np.zeros(pixels.shape[:-1])
    one[0] = 1.0
    assert np.isnan(triangulated(made.rig, pixels, one)[0]).all()


def test_offsets_of_both_sides_are_mirror_images():
    names = CONVENTIONS["body25b"]
    own = mirrored(names)
    offsets = (own @ np.random.default_rng(0).normal(size=own.shape[1])).reshape(-1, 3)
    for name in names:
        if name.startswith("left_"):
            left, right = (offsets[names.index(each)] for each in (name, "right_" + name[5:]))
            np.testing.assert_allclose(right, left * [-1.0, 1.0, 1.0])
    assert offsets[names.index("nose"), 0] == 0.0


def test_a_rig_that_is_not_corrected_is_the_same():
    rig = scene().rig
    same = corrected_rig(rig, np.zeros((4, 6)))
    np.testing.assert_allclose(same.rotation, rig.rotation)
    np.testing.assert_allclose(same.translation, rig.translation)


@cache
def by_one_camera(number: int = 0, given: bool = True) -> CameraFit:
    made = scene()
    seen = made.detections
    one = replace(
        seen,
        cameras=("video",),
        pixels=seen.pixels[:, number : number + 1],
        confidence=seen.confidence[:, number : number + 1],
    )
    rest = made.body.rest_vertices(made.betas)[:, 1]
    height = float(np.ptp(rest)) if given else None
    (fit,) = fit_cameras(one, CameraRig(made.rig.cameras[number : number + 1]), height=height)
    return fit


@pytest.mark.parametrize("number", range(4))
def test_one_camera_finds_the_person_and_says_that_depth_is_open(number):
    """From the front, the sides and the back."""
    made, fit = scene(), by_one_camera(number)
    rows = slice(fit.first_frame, fit.first_frame + len(fit.pose))
    truth = np.asarray(made.body(made.betas, made.pose[rows], made.trans[rows]).joints)[:, :22]
    off = fit.joints()[:, :22] - truth
    assert np.linalg.norm(off - off[:, :1], axis=-1).mean() < 0.08
    across = off @ made.rig.rotation[number, :2].T
    assert np.median(np.linalg.norm(across, axis=-1)) < 0.03
    assert fit.verdict.level == "doubtful"
    assert "One camera leaves depth open: distance" in " ".join(fit.verdict.reasons)
    assert not fit.corrections.any() and not fit.late.any()


def test_one_camera_without_a_height_says_so():
    reasons = " ".join(by_one_camera(given=False).verdict.reasons)
    assert "size and distance" in reasons


def test_the_page_of_one_camera_names_what_is_guessed():
    fit = by_one_camera()
    page = camera_page(fit, camera_metrics(fit))
    assert "1 camera<" in page or "1 camera ·" in page
    assert "One camera sees no depth" in page


def test_a_planted_mean_pose_is_placed_by_one_camera():
    """Headings that are tried, without noise: place and turn come out exactly."""
    body = load_body("female")
    names = convention_names("body25b")
    mean = prior_of(body).for_joints(body.joint_names).mean
    rig = KeypointRig.of(body, names)
    person = rig.shaped(np.zeros(body.num_betas), np.zeros((len(names), 3)))
    camera = ring(1, np.array([0.2, 0.1, 0.0]), 4.0).cameras[0]
    turns = _turns()
    picks = np.repeat([30, 31, 32], 5)
    pose = np.tile(np.concatenate([np.zeros(3), mean]).reshape(1, -1, 3), (len(picks), 1, 1))
    pose[:, 0] = rotvec_from_matrix(camera.rotation.T @ turns[picks])
    trans = np.array([0.1, 0.2, -0.1]) + np.linspace(0.0, 0.3, len(picks))[:, None]
    pixels = camera.project(person.points(pose, trans))
    sure = np.ones(pixels.shape[:2])
    sure[7] = 0.0
    found, place = placed_by_one(camera, pixels, sure, names, person, mean)
    seen = sure[:, 0] > 0.0
    np.testing.assert_allclose(place[seen], trans[seen], atol=1e-6)
    np.testing.assert_allclose(
        matrix_from_rotvec(found[seen, 0]), matrix_from_rotvec(pose[seen, 0]), atol=1e-9
    )
    np.testing.assert_allclose(place[7], trans[[6, 8]].mean(0), atol=0.03)


def test_nobody_and_strangers_are_refused():
    made = scene()
    seen = made.detections
    nobody = replace(
        seen,
        cameras=("video",),
        pixels=np.full_like(seen.pixels[:, :1], np.nan),
        confidence=np.zeros_like(seen.confidence[:, :1]),
    )
    with pytest.raises(HabitusError, match="nobody is seen"):
        fit_cameras(nobody, CameraRig(made.rig.cameras[:1]))
    with pytest.raises(HabitusError, match="expected the same names"):
        fit_cameras(replace(made.detections, cameras=("a", "b", "c", "d")), made.rig)
    with pytest.raises(HabitusError, match="people is"):
        fit_cameras(made.detections, made.rig, people="3")


def one_camera_fit(made: CameraScene, floor: float | None) -> CameraFit:
    height = float(np.ptp(made.body.rest_vertices(made.betas)[:, 1]))
    (fit,) = fit_cameras(made.detections, made.rig, height=height, floor=floor, up="+y")
    return fit


def test_a_floor_tells_one_camera_the_distance():
    """Where feet stand; one that is elsewhere is told, and the verdict stays doubtful."""
    without, given = [], []
    for seed in range(4):
        made = scene(seed, 1)
        vertices = np.asarray(made.body(made.betas, made.pose[::5], made.trans[::5]).vertices)
        floor = float(np.percentile(vertices[..., 1].min(1), 20))
        without.append(errors(made, one_camera_fit(made, None)).mean())
        fit = one_camera_fit(made, floor)
        given.append(errors(made, fit).mean())
        assert fit.verdict.level != "good"
        assert not any("floor" in text for text in fit.warnings)
    assert np.mean(given) < 0.97 * np.mean(without)  # feet that slide: a walk on the spot
    wrong = one_camera_fit(made, floor + 0.6)
    assert any("check the floor" in text for text in wrong.warnings)
    with pytest.raises(HabitusError, match="one camera alone"):
        fit_cameras(scene().detections, scene().rig, floor=0.0)
    with pytest.raises(HabitusError, match="floor is inf"):
        fit_cameras(made.detections, made.rig, floor=float("inf"))


def test_feet_that_stand_are_where_the_floor_is():
    """A foot that rests on a plane, seen by a camera that leans: its points are found; a foot that
    moves has none.
    """
    made = scene(0, 1)
    rig = KeypointRig.of(made.body, made.detections.names)
    person = rig.shaped(made.betas, np.zeros((len(rig.names), 3)))
    pose = np.zeros((30, len(made.body.joint_names), 3))
    points = person.points(pose, np.zeros((30, 3)))
    floor = float(points[0, :, 1].min()) - SOLE
    camera = made.rig.cameras[0]
    size = np.full(30, 900.0)
    arguments = camera, camera.project(points), size, rig.names, person, np.eye(3), floor, RATE
    stood = standing_points(*arguments)
    feet = [k for k, name in enumerate(rig.names) if "heel" in name or "toe" in name]
    np.testing.assert_allclose(stood[5:-5, feet], points[5:-5, feet], atol=1e-9)
    others = [k for k in range(len(rig.names)) if k not in feet]
    assert np.isnan(stood[:, others]).all()
    moving = points + np.linspace(0.0, 1.0, 30)[:, None, None] * [1.0, 0.0, 0.0]
    walked = standing_points(camera, camera.project(moving), *arguments[2:])
    assert np.isnan(walked).all()
