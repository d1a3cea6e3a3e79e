"""The command from detections to files, and keypoints in space, which need no calibration."""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import habitus as hb
from habitus.body.keypoints import CONVENTIONS
from habitus.body.prior import prior_of
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.io.captures.read import Capture
from habitus.io.keypoints.points import read_points
from habitus.observe.keypoints import KeypointRig
from habitus_lab.population.camera_scenes import CameraScene, camera_scene

RATE = 50.0
FRAMES = 24


@pytest.fixture(scope="module")
def scene() -> CameraScene:
    """Somebody who turns and bends the arms, before three cameras."""
    body = hb.load_body("female")
    rng = np.random.default_rng(2)
    mean = prior_of(body).for_joints(body.joint_names).mean.reshape(-1, 3)
    pose = np.tile(np.concatenate([np.zeros((1, 3)), mean]), (FRAMES, 1, 1))
    phase = np.linspace(0.0, 2.0, FRAMES)
    pose[:, 0, 1] = 0.3 * phase
    pose[:, body.joint_names.index("left_elbow"), 1] -= 0.5 * phase
    trans = np.zeros((FRAMES, 3))
    trans[:, 0] = 0.1 * phase
    return camera_scene(body, pose, trans, RATE, 3, rng)


def _write(scene: CameraScene, folder: Path) -> tuple[Path, Path]:
    """Detections as OpenPose writes them, and Pose2Sim's calibration."""
    detections = scene.detections
    for c, name in enumerate(detections.cameras):
        (folder / "pose" / f"{name}_json").mkdir(parents=True)
        for t in range(detections.num_frames):
            at = np.nan_to_num(detections.pixels[t, c, 0] - 0.5)
            row = np.column_stack([at, detections.confidence[t, c, 0]])
            table = {"people": [{"pose_keypoints_2d": row.ravel().tolist()}]}
            (folder / "pose" / f"{name}_json" / f"{t:04d}.json").write_text(json.dumps(table))
    lines = []
    for camera in scene.rig.cameras:
        matrix = np.diag([*camera.focal, 1.0])
        matrix[:2, 2] = camera.centre - 0.5
        lines += [
            f"[{camera.name}]", f"size = [{camera.width}, {camera.height}]",
            f"matrix = {matrix.tolist()}", "distortions = [0.0, 0.0, 0.0, 0.0]",
            f"rotation = {camera.rotation.tolist()}",
            f"translation = {camera.translation.tolist()}",
        ]  # fmt: skip
    (folder / "Calib.toml").write_text("\n".join(lines))
    return folder / "pose", folder / "Calib.toml"


def test_the_command_writes_a_result_that_can_be_used(scene, tmp_path, capsys):
    pose, calibration = _write(scene, tmp_path)
    out = tmp_path / "out"
    words = [
        "cameras",
        str(pose),
        "--calibration",
        str(calibration),
        "--fps",
        "50",
        "--out",
        str(out),
    ]
    with suppress(SystemExit):  # code 0
        assert not main(words)
    said = capsys.readouterr().out
    assert "keypoints body25b" in said and "good" in said
    assert {path.name for path in out.iterdir()} == {
        "body.npz", "body.glb", "measurements.csv", "metrics.json", "report.html",
    }  # fmt: skip
    numbers = json.loads((out / "metrics.json").read_text())
    assert numbers["verdict"]["level"] == "good" and len(numbers["cameras"]) == 3
    assert "waist_circumference_m" in numbers["guessed_measurements"]
    motion = hb.load_motion(out / "body.npz")
    first = numbers["first_frame"]
    rows = slice(first, first + motion.num_frames)
    truth = np.asarray(scene.body(scene.betas, scene.pose[rows], scene.trans[rows]).joints)
    apart = np.linalg.norm(motion.joints()[:, :22] - truth[:, :22], axis=-1)
    assert apart.mean() < 0.03
    motion.export(tmp_path / "walk.bvh")
    page = (out / "report.html").read_text()
    assert page.count("<svg") >= 9 and "Sides put back" in page
    with np.load(out / "body.npz") as file:
        assert file["keypoints_observed"].shape == (motion.num_frames, 3, 25, 2)


def test_keypoints_in_space_need_no_calibration(scene, tmp_path):
    """A TRC in millimetres, with names as OpenSim's users give them, z up."""
    names = CONVENTIONS["body25b"]
    labels = [_short(name) for name in names]
    turned = scene.keypoints[..., [2, 0, 1]]
    rng = np.random.default_rng(0)
    noisy = turned + 0.004 * rng.normal(size=turned.shape)
    noisy[5:8, 3] = np.nan
    capture = Capture("points", tuple(labels), noisy, RATE, "+z")
    hb.write_trc(capture, tmp_path / "points.trc", y_up=False)
    (fit,) = hb.fit_cameras(tmp_path / "points.trc")
    assert fit.up_axis == "+z" and fit.verdict.level == "good"
    assert np.nanmedian(fit.errors_px) < 15.0  # a pixel is a millimetre
    truth = np.asarray(scene.body(scene.betas, scene.pose, scene.trans).joints)[..., [2, 0, 1]]
    assert np.linalg.norm(fit.joints()[:, :22] - truth[:, :22], axis=-1).mean() < 0.025
    assert not fit.corrections.any()


def test_markers_that_a_network_added_are_left_out(scene, tmp_path):
    """OpenCap's and Pose2Sim's augmented files hold them beside the keypoints."""
    labels = [_short(name) for name in scene.detections.names]
    added = [f"r_{name}_study" for name in ("knee", "mknee", "toe", "calc", "ankle", "sh1")]
    points = np.concatenate([scene.keypoints, scene.keypoints[:, : len(added)] + 0.02], 1)
    capture = Capture("points", (*labels, *added), points, RATE, "+y")
    hb.write_trc(capture, tmp_path / "points.trc")
    detections, _ = read_points(tmp_path / "points.trc")
    assert len(detections.names) == len(labels)
    for name, label in zip(detections.names, labels, strict=True):
        assert _short(name) == label


def test_points_without_keypoints_are_listed_by_their_own_names(tmp_path):
    points = np.random.default_rng(0).normal(size=(9, 9, 3)).cumsum(0) * 0.01
    labels = tuple(f"M{k}X" for k in range(9))
    hb.write_trc(Capture("points", labels, points, RATE, "+y"), tmp_path / "points.trc")
    with pytest.raises(HabitusError, match=r"0 of its 9 points.*M0X"):
        read_points(tmp_path / "points.trc")


def _short(name: str) -> str:
    side, _, plain = name.partition("_")
    words = "".join(part.capitalize() for part in (plain or side).split("_"))
    return {"left": "L", "right": "R"}.get(side, "") + (
        words if side in ("left", "right") else name.replace("_", " ").title().replace(" ", "")
    )


def test_points_are_seen_as_they_are(scene, tmp_path):
    np.save(tmp_path / "points.npy", 1e3 * _blaze())
    detections, rig = read_points(tmp_path / "points.npy", 30.0)
    assert detections.names == CONVENTIONS["blazepose33"] and detections.rate_hz == 30.0
    assert any("millimetres" in note for note in detections.notes)
    from habitus.fit.cameras.triangulate import triangulated

    pixels = np.moveaxis(detections.pixels[:, :, 0], 1, 0)
    points, _ = triangulated(rig, pixels, np.ones(pixels.shape[:-1]))
    np.testing.assert_allclose(points, _blaze(), atol=1e-4)
    step = rig.project(np.array([[0.0, 1.0, 0.0], [0.001, 1.001, 0.001]]))
    np.testing.assert_allclose(np.abs(np.diff(step, axis=1)), 1.0, rtol=0.01)


def _blaze() -> np.ndarray:
    body = hb.load_body("neutral")
    rig = KeypointRig.of(body, CONVENTIONS["blazepose33"])
    at = rig.shaped(np.zeros(body.num_betas), np.zeros((33, 3)))
    return np.tile(at.points(np.zeros((1, 24, 3)), np.ones((1, 3))), (4, 1, 1))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--fps", "50"], "no calibration"),
        (["--calibration", "none.toml", "--fps", "50"], "none.toml"),
        (["--calibration", "CAL"], "fps is missing"),
        (["--calibration", "CAL", "--fps", "50", "--people", "many"], "people is 'many'"),
        (["--calibration", "CAL", "--fps", "50", "--height", "172"], "height is 172"),
        (["--calibration", "CAL", "--fps", "50", "--convention", "coco18"], "coco18"),
    ],
)
def test_what_is_missing_is_said_in_one_line(words, says, scene, tmp_path, capsys):
    pose, calibration = _write(scene, tmp_path)
    given = [str(calibration) if word == "CAL" else word for word in words]
    with pytest.raises(SystemExit) as stopped:
        main(["cameras", str(pose), "--out", str(tmp_path / "out"), *given])
    assert stopped.value.code == 2
    wrong = capsys.readouterr().err
    assert says in wrong and wrong.count("\n") == 1
    assert not (tmp_path / "out" / "body.npz").exists()


def test_points_without_names_are_refused(tmp_path):
    capture = Capture("a", ("M1", "M2"), np.zeros((3, 2, 3)) + 0.1, 50.0, "+y")
    hb.write_trc(capture, tmp_path / "a.trc")
    with pytest.raises(HabitusError, match="named as keypoints are"):
        hb.fit_cameras(tmp_path / "a.trc")
