"""Detections of every detector's form; orders of points are never guessed from their number."""

import json
from pathlib import Path

import numpy as np
import pytest

from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError
from habitus.io.keypoints.read import read_detections
from habitus.io.models.bodies import load_body
from habitus.observe.keypoints import KeypointRig

FRAMES = 4


def _person(convention: str, shift: float = 0.0) -> np.ndarray:
    """u, v, confidence of the body at rest, 200 px a metre."""
    body = load_body("neutral")
    rig = KeypointRig.of(body, CONVENTIONS[convention])
    none = np.zeros((len(rig.names), 3))
    pose = np.zeros((1, 24, 3))
    pose[0, 16:18, 2] = -0.9, 0.9
    at = rig.shaped(np.zeros(body.num_betas), none).points(pose, np.zeros((1, 3)))[0]
    return np.column_stack([500.0 + shift + 200.0 * at[:, 0], 400.0 - 200.0 * at[:, 1],
                            np.full(len(at), 0.8)])  # fmt: skip


def _openpose(folder: Path, convention: str) -> Path:
    for camera in ("cam01_json", "cam02_json"):
        (folder / camera).mkdir()
        for t in range(FRAMES):
            rows = [_person(convention, t), _person(convention, 100.0 + t)]
            people = [{"pose_keypoints_2d": row.ravel().tolist()} for row in rows]
            text = json.dumps({"version": 1.3, "people": people})
            (folder / camera / f"cam.{t:04d}.json").write_text(text)
    return folder


def _mmpose(folder: Path, convention: str) -> Path:
    info = [
        {
            "frame_id": t,
            "instances": [
                {
                    "keypoints": _person(convention, shift + t)[:, :2].tolist(),
                    "keypoint_scores": [0.8] * len(CONVENTIONS[convention]),
                }
                for shift in (0.0, 100.0)
            ],
        }
        for t in range(FRAMES)
    ]
    names = {str(k): name for k, name in enumerate(CONVENTIONS[convention])}
    for camera in ("cam01", "cam02"):
        table = {"meta_info": {"keypoint_id2name": names}, "instance_info": info}
        (folder / f"{camera}.json").write_text(json.dumps(table))
    return folder


def _alphapose(folder: Path, convention: str) -> Path:
    rows = [
        {"image_id": f"{t}.jpg", "score": 2.5,
         "keypoints": _person(convention, shift + t).ravel().tolist()}
        for t in range(FRAMES) for shift in (0.0, 100.0)
    ]  # fmt: skip
    for camera in ("cam01", "cam02"):
        (folder / f"{camera}.json").write_text(json.dumps(rows))
    return folder


def _deeplabcut(folder: Path, convention: str) -> Path:
    names = CONVENTIONS[convention]
    heads = [["scorer"], ["individuals"], ["bodyparts"], ["coords"]]
    for who in ("a", "b"):
        for name in names:
            for coord in ("x", "y", "likelihood"):
                for head, text in zip(heads, ("net", who, name, coord), strict=True):
                    head.append(text)
    lines = [",".join(head) for head in heads]
    for t in range(FRAMES):
        both = np.concatenate([_person(convention, t), _person(convention, 100.0 + t)]).ravel()
        lines.append(",".join([str(t), *map(repr, both.tolist())]))
    for camera in ("cam01", "cam02"):
        (folder / f"{camera}.csv").write_text("\n".join(lines))
    return folder


def _sleap(folder: Path, convention: str) -> Path:
    """Nodes in any order, a row for each person that was seen."""
    names = CONVENTIONS[convention]
    order = [*range(1, len(names)), 0]
    heads = ["track", "frame_idx", "instance.score"]
    heads += [f"{names[k]}.{part}" for k in order for part in ("x", "y", "score")]
    lines = [",".join(heads)]
    for t in range(FRAMES):
        for who, shift in (("a", 0.0), ("b", 100.0)):
            row = _person(convention, shift + t)[order].ravel()
            lines.append(",".join([who, str(t), "0.9", *map(repr, row.tolist())]))
    for camera in ("cam01", "cam02"):
        (folder / f"{camera}.csv").write_text("\n".join(lines))
    return folder


@pytest.mark.parametrize("convention", ["openpose25", "body25b", "halpe26", "coco17"])
@pytest.mark.parametrize("write", [_openpose, _mmpose, _alphapose, _deeplabcut, _sleap])
def test_every_form_gives_the_same_detections(write, convention, tmp_path):
    found = read_detections(write(tmp_path, convention), 60)
    names = CONVENTIONS[convention]
    assert set(found.names) == set(names) and found.pixels.shape[:3] == (FRAMES, 2, 2)
    order = [names.index(name) for name in found.names]
    for t in range(FRAMES):
        for p, shift in enumerate((0.0, 100.0)):
            true = _person(convention, shift + t)[order, :2] + 0.5
            np.testing.assert_allclose(found.pixels[t, 1, p], true)
    assert found.rate_hz == 60 and (found.confidence > 0.5).all()
    assert found.of_cameras(("cam_1", "cam_2")).cameras == ("cam_1", "cam_2")


def test_names_in_the_file_go_before_proportions(tmp_path):
    """Body parts by names of one's own, in an order of one's own, and some that no table has."""
    order = ["RShoulder", "LShoulder", "tail", "LHip", "RHip", "LKnee", "RKnee", "LAnkle", "RAnkle",
             "Nose"]  # fmt: skip
    heads = [["scorer"], ["bodyparts"], ["coords"]]
    for name in order:
        for coord in ("x", "y", "likelihood"):
            for head, text in zip(heads, ("net", name, coord), strict=True):
                head.append(text)
    rows = [",".join(head) for head in heads]
    rows.append(",".join(["0", *[str(k) for k in range(30)]]))
    (tmp_path / "cam1.csv").write_text("\n".join(rows))
    found = read_detections(tmp_path, 30)
    assert found.names == (
        "right_shoulder", "left_shoulder", "left_hip", "right_hip", "left_knee", "right_knee",
        "left_ankle", "right_ankle", "nose",
    )  # fmt: skip
    assert found.pixels[0, 0, 0, 2].tolist() == [9.5, 10.5]


def test_a_convention_that_is_asked_for_is_taken(tmp_path):
    found = read_detections(_openpose(tmp_path, "body25b"), 60, "openpose25")
    assert found.names == CONVENTIONS["openpose25"]


def test_missing_samples_and_frames_are_missing(tmp_path):
    folder = _openpose(tmp_path, "body25b")
    (folder / "cam01_json" / "cam.0002.json").unlink()
    path = folder / "cam02_json" / "cam.0001.json"
    table = json.loads(path.read_text())
    table["people"][0]["pose_keypoints_2d"][:3] = [0.0, 0.0, 0.0]
    path.write_text(json.dumps(table))
    found = read_detections(folder, 60)
    assert not found.confidence[2, 0].any() and np.isnan(found.pixels[2, 0]).all()
    assert np.isnan(found.pixels[1, 1, 0, 0]).all() and found.confidence[1, 1, 0, 0] == 0.0
    assert any("without a file: cam01_json 1" in note for note in found.notes)


def test_scores_above_one_are_scaled_and_said(tmp_path):
    rows = [{"image_id": "0.jpg", "keypoints": (_person("coco17") * [1, 1, 5]).ravel().tolist()}]
    (tmp_path / "cam1.json").write_text(json.dumps(rows))
    found = read_detections(tmp_path, 60)
    assert 0.0 < found.confidence.max() <= 1.0 and any("scores" in note for note in found.notes)


def test_two_dimensional_points_of_freemocap(tmp_path):
    table = np.full((2, 5, 553, 3), np.nan)
    table[:, :, :33, :2] = _person("blazepose33")[:, :2]
    np.save(tmp_path / "points.npy", table)
    found = read_detections(tmp_path / "points.npy", 30)
    assert found.names == CONVENTIONS["blazepose33"] and found.pixels.shape == (5, 2, 1, 33, 2)
    np.testing.assert_allclose(found.pixels[0, 0, 0], _person("blazepose33")[:, :2] + 0.5)


@pytest.mark.parametrize("shape", [(2, 0, 33, 2), (0, 5, 33, 2)])
def test_arrays_without_frames_or_cameras_are_refused(shape, tmp_path):
    np.save(tmp_path / "points.npy", np.zeros(shape))
    with pytest.raises(HabitusError, match="without a point"):
        read_detections(tmp_path / "points.npy", 30)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "no JSON"),
        ("[1, 2]", "no keypoints"),
        ('{"people": []}', "no person"),
        ('{"people": [{"pose_keypoints_2d": ["a", 1, 1]}]}', "no numbers"),
        ('{"instance_info": [{"instances": [{"keypoints": [1], "keypoint_scores": [1]}]}]}', "fit"),
        ('[{"keypoints": [1, 2, 3]}]', "image_id"),
        ('{"people": [{"pose_keypoints_2d": [1, 2, 0.5]}]}', "keypoints a person"),
        ('{"a": 1}', "no form"),
    ],
)
def test_what_is_none_is_refused_in_one_line(content, says, tmp_path):
    (tmp_path / "cam1.json").write_text(content)
    with pytest.raises(HabitusError, match=says) as error:
        read_detections(tmp_path, 60)
    assert "\n" not in str(error.value)


def test_rates_conventions_and_folders_are_checked(tmp_path):
    with pytest.raises(HabitusError, match="frames a second"):
        read_detections(tmp_path, 0.0)
    with pytest.raises(HabitusError, match="expected one of coco17"):
        read_detections(tmp_path, 60, "coco18")
    with pytest.raises(HabitusError, match="no detections"):
        read_detections(tmp_path, 60)
    with pytest.raises(HabitusError, match="no such folder"):
        read_detections(tmp_path / "none", 60)


def test_a_node_that_sleap_did_not_see_is_missing(tmp_path):
    _sleap(tmp_path, "coco17")
    for path in tmp_path.glob("*.csv"):
        lines = path.read_text().splitlines()
        cells = lines[1].split(",")
        cells[3:6] = ["", "", ""]
        path.write_text("\n".join([lines[0], ",".join(cells), "broken,row", *lines[2:]]))
    found = read_detections(tmp_path, 60)
    assert np.isnan(found.pixels[0, 0, 0, 0]).all() and found.confidence[0, 0, 0, 0] == 0.0
    assert np.isfinite(found.pixels[1:]).all()
    heads = (tmp_path / "cam01.csv").read_text().splitlines()[0]
    (tmp_path / "cam01.csv").write_text(heads.replace(".y", ".z"))
    with pytest.raises(HabitusError, match="SLEAP's analysis"):
        read_detections(tmp_path, 60)


def test_names_of_ones_own_are_mapped(tmp_path):
    """DeepLabCut's names are the user's: a file says what they are."""
    _deeplabcut(tmp_path, "coco17")
    for path in tmp_path.glob("*.csv"):
        text = path.read_text()
        for name in CONVENTIONS["coco17"]:
            text = text.replace(name, f"part {name[::-1]}")
        path.write_text(text)
    with pytest.raises(HabitusError, match="--names"):
        read_detections(tmp_path, 60)
    lines = [f'"part {name[::-1]}" = "{name}"' for name in CONVENTIONS["coco17"]]
    (tmp_path / "names.toml").write_text("\n".join(lines))
    found = read_detections(tmp_path, 60, names=tmp_path / "names.toml")
    assert found.names == CONVENTIONS["coco17"]
    np.testing.assert_allclose(found.pixels[2, 0, 0], _person("coco17", 2.0)[:, :2] + 0.5)
    with pytest.raises(HabitusError, match="expected a keypoint"):
        read_detections(tmp_path, 60, names={"part 1": "tail"})
    with pytest.raises(HabitusError, match="which the names map"):
        read_detections(tmp_path, 60, names={"part 99": "nose"})


def test_sam_3d_bodys_keypoints_are_a_detectors(tmp_path):
    """One .npz a frame and camera; finger joints and second elbows are left out."""
    for camera in ("cam1", "cam2"):
        (tmp_path / camera).mkdir()
        for t in range(3):
            at = np.arange(140.0).reshape(70, 2) + t
            np.savez(tmp_path / camera / f"{t:03d}.npz", pred_keypoints_2d=at.astype(np.float32))
    found = read_detections(tmp_path, 25)
    assert found.convention == "mhr70" and found.names == CONVENTIONS["mhr70"]
    wrist = found.names.index("left_wrist")
    assert found.pixels[1, 0, 0, wrist].tolist() == [125.5, 126.5]  # row 62
    np.savez(tmp_path / "cam1" / "000.npz", pred_keypoints_2d=np.zeros((69, 2)))
    with pytest.raises(HabitusError, match=r"expected \(70, 2\)"):
        read_detections(tmp_path, 25)
