"""Folders of views as people have them: ours, Open3D's, TUM's; names that pair up, and images that
are none.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.io.rgbd.keypoints import read_keypoints
from habitus.io.rgbd.read import read_views

H = 6
W = 8
FLAT = {"fx": 10.0, "fy": 10.0, "cx": 3.5, "cy": 2.5}


def depth_image(path, value=2000, kind=np.uint16):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((H, W), value, kind)).save(path)


def colour_image(path, value=90):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((H, W, 3), value, np.uint8)).save(path)


def camera(folder, **more):
    (folder / "cameras.json").write_text(
        json.dumps({"depth": FLAT, "color": FLAT, "depth_to_color": np.eye(4).tolist()} | more)
    )


def test_our_layout(tmp_path):
    for k in (1, 2, 10):
        depth_image(tmp_path / "depth" / f"{k}.png", 1000 * (1 + k % 3))
        colour_image(tmp_path / "color" / f"frame{k:04d}.jpg", 10 * k)
        depth_image(tmp_path / "mask" / f"{k}.png", 255, np.uint8)
    depth_image(tmp_path / "background" / "depth.png", 4000)
    colour_image(tmp_path / "background" / "color.png")
    camera(tmp_path, depth_scale=0.001)
    found = read_views(tmp_path)
    assert [view.name for view in found.views] == ["1", "2", "10"] and found.notes == ()
    assert [float(view.depth[0, 0]) for view in found.views] == pytest.approx([2.0, 3.0, 2.0])
    assert [int(view.colour[0, 0, 0]) for view in found.views] == [10, 20, 100]
    assert all(view.background[0, 0] == 4.0 and view.mask.all() for view in found.views)
    assert len(read_views(tmp_path, views=[2]).views) == 1


def test_names_in_one_folder(tmp_path):
    for k in range(2):
        depth_image(tmp_path / f"kinect_depth_{k}.png")
        colour_image(tmp_path / f"kinect_rgb_{k}.png", 50 + k)
    depth_image(tmp_path / "background_depth.png", 3000)
    camera(tmp_path)
    found = read_views(tmp_path)
    assert len(found.views) == 2
    assert found.views[1].colour[0, 0, 0] == 51 and found.views[0].background[
        0, 0
    ] == pytest.approx(3)
    assert "millimetres" in found.notes[-1]


def test_open3ds_folder(tmp_path):
    for k in range(3):
        depth_image(tmp_path / "depth" / f"{k:06d}.png")
        colour_image(tmp_path / "color" / f"{k:06d}.jpg")
    matrix = np.array([[10.0, 0, 3.5], [0, 10.0, 2.5], [0, 0, 1.0]]).T.ravel().tolist()
    table = {"width": W, "height": H, "intrinsic_matrix": matrix, "depth_scale": 1000.0}
    (tmp_path / "intrinsic.json").write_text(json.dumps(table))
    found = read_views(tmp_path)
    assert found.views[0].depth[0, 0] == 2.0 and found.views[0].camera.principal_point.tolist() == [
        4.0,
        3.0,
    ]
    assert (
        found.views[0].colour_camera is found.views[0].camera or found.views[0].colour is not None
    )


def test_tums_folder(tmp_path):
    for stamp in ("1.00", "1.10"):
        depth_image(tmp_path / "depth" / f"{stamp}.png", 10000)
    colour_image(tmp_path / "rgb" / "1.01.png")
    (tmp_path / "depth.txt").write_text("# depth\n1.00 depth/1.00.png\n1.10 depth/1.10.png\n")
    (tmp_path / "rgb.txt").write_text("1.01 rgb/1.01.png\n")
    camera(tmp_path)
    found = read_views(tmp_path)
    assert found.views[0].depth[0, 0] == 2.0
    assert found.views[0].colour is not None and found.views[1].colour is None
    (tmp_path / "depth.txt").write_text("1.00 ../../secret.png\n")
    with pytest.raises(HabitusError, match="leads out"):
        read_views(tmp_path)


def test_intrinsics_of_another_resolution(tmp_path):
    depth_image(tmp_path / "depth" / "0.png")
    camera(tmp_path, depth=FLAT | {"width": 2 * W, "height": 2 * H})
    assert read_views(tmp_path).views[0].camera.focal_length[0] == 5.0
    camera(tmp_path, depth=FLAT | {"width": W, "height": W})
    with pytest.raises(HabitusError, match="this resolution"):
        read_views(tmp_path)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda p: (p / "depth" / "0.png").write_bytes(b"\x89PNG no"), "cannot be read"),
        (lambda p: depth_image(p / "depth" / "0.png", 200, np.uint8), "8 bits"),
        (lambda p: colour_image(p / "depth" / "0.png"), "3 channels"),
        (lambda p: depth_image(p / "depth" / "0.png", 0), "no depth"),
        (lambda p: depth_image(p / "depth" / "0.png", 60), "unit"),
        (lambda p: [colour_image(p / "color" / f"x{k}.png") for k in (3, 4)], "pair up"),
        (lambda p: (p / "cameras.json").write_text("{"), "JSON"),
    ],
)
def test_spoilt_folders_say_what_is_wrong(tmp_path, spoil, words):
    depth_image(tmp_path / "depth" / "0.png")
    camera(tmp_path)
    spoil(tmp_path)
    with pytest.raises(HabitusError, match=words) as raised:
        read_views(tmp_path)
    assert "\n" not in str(raised.value)


def detected(convention, *, hide=()):
    """u, v, confidence of a person's keypoints in a picture, in that convention's order."""
    body = load_body("default")
    pose = {"left_elbow": (0.0, -1.0, 0.0), "right_hip": (-0.6, 0.0, 0.0)}
    points = body.keypoints(convention, body(pose=pose, trans=[0.0, 0.0, 4.0]))
    uv = 640 + 900 * points[:, :2] / points[:, 2:] * [1, -1]
    rows = np.hstack([uv, np.full((len(uv), 1), 0.8)])
    rows[list(hide)] = 0.0
    return rows


def keypoint_file(path, *people):
    path.write_text(
        json.dumps({"people": [{"pose_keypoints_2d": p.ravel().tolist()} for p in people]})
    )
    return path


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_keypoints_are_read_in_the_order_that_makes_a_person(convention, tmp_path):
    rows = detected(convention, hide=[3, 7])
    small = detected(convention)
    small[:, 2] *= 0.3
    found = read_keypoints(keypoint_file(tmp_path / "a_keypoints.json", small, rows))
    names = CONVENTIONS[convention]
    assert list(found) == [name for k, name in enumerate(names) if k not in (3, 7)]
    for name, point in found.items():
        assert np.allclose(point, rows[names.index(name)] + [0.5, 0.5, 0.0])


def test_keypoints_in_an_order_that_gives_no_person_are_refused(tmp_path):
    rows = detected("openpose25")
    mixed = rows[np.random.default_rng(0).permutation(25)]
    for path, words in (
        (keypoint_file(tmp_path / "a.json", mixed), "order that gives no person; expected that of"),
        (keypoint_file(tmp_path / "b.json", rows[:, :] * (np.arange(25) < 3)[:, None]), "too few"),
        (keypoint_file(tmp_path / "c.json", rows[:24]), "24 keypoints a person; expected"),
    ):
        with pytest.raises(HabitusError, match=words) as raised:
            read_keypoints(path)
        assert "\n" not in str(raised.value) and path.name in str(raised.value)


def test_keypoints_of_real_detections_are_body_25b():
    folder = Path(__file__).resolve().parents[4] / "shared" / "keypoints" / "pose2sim"
    files = sorted(folder.glob("*/pose/cam0*_json/*.json"))[::37]
    if not files:
        pytest.skip("the real detections are not here")
    for path in files:
        found = read_keypoints(path)
        assert "head_top" in found and "mid_hip" not in found
        assert found["head_top"][1] < found["left_hip"][1] < found["left_ankle"][1] + 200


def test_keypoints_of_coco(tmp_path):
    coco = {"annotations": [{"keypoints": [0.0] * 48 + [1.0, 2.0, 2.0]}]}
    (tmp_path / "b.json").write_text(json.dumps(coco))
    assert read_keypoints(tmp_path / "b.json") == {"right_ankle": (1.5, 2.5, 1.0)}
    (tmp_path / "c.json").write_text("[]")
    with pytest.raises(HabitusError, match="OpenPose"):
        read_keypoints(tmp_path / "c.json")
