"""Pictures of the cameras' videos: the right frame of the right camera, without distortion."""

from dataclasses import replace

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.io.cameras.videos import read_videos, stills
from habitus.observe.camera_rig import CameraRig, RigCamera
from habitus.report.cameras import undistorted

cv2 = pytest.importorskip("cv2", reason="needs the extra video")

SIZE = (64, 48)
FRAMES = 12


def rig(names: tuple[str, ...] = ("cam_01", "cam_02")) -> CameraRig:
    distortion = np.array([0.1, -0.05, 0.01, -0.005, 0.0, 0.0, 0.0, 0.0])
    cameras = (
        RigCamera(name, *SIZE, np.full(2, 60.0), np.array(SIZE) / 2.0, np.eye(3), np.zeros(3),
                  distortion)
        for name in names
    )  # fmt: skip
    return CameraRig(tuple(cameras))


def write_video(path, size=SIZE, first=0) -> None:
    """Grey frames, each 15 levels brighter than the one before."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 50.0, size)
    assert writer.isOpened()
    for k in range(FRAMES):
        writer.write(np.full((size[1], size[0], 3), 30 + 15 * ((k + first) % FRAMES), np.uint8))
    writer.release()


def test_frames_of_each_camera_are_its_own(tmp_path):
    write_video(tmp_path / "cam01.avi")
    write_video(tmp_path / "cam02.avi", first=5)
    (tmp_path / "notes.txt").write_text("no video")
    videos = read_videos(tmp_path, rig())
    assert {v.rate_hz for v in videos.values()} == {50.0}
    assert [v.frames for v in videos.values()] == [FRAMES, FRAMES]
    taken = stills(videos, {"cam_01": [3, 7, 99], "cam_02": [3]})
    assert set(taken) == {("cam_01", 3), ("cam_01", 7), ("cam_02", 3)}
    for (name, frame), first in zip(taken, (0, 0, 5), strict=True):
        level = 30 + 15 * ((frame + first) % FRAMES)
        assert abs(float(taken[name, frame].mean()) - level) < 4.0


def test_a_folder_without_the_cameras_videos_is_refused(tmp_path):
    with pytest.raises(HabitusError, match="no such folder"):
        read_videos(tmp_path / "none", rig())
    write_video(tmp_path / "other7.avi")
    with pytest.raises(HabitusError, match=r"other7.avi; expected names such as cam_01.mp4"):
        read_videos(tmp_path, rig())


def test_a_video_of_another_size_is_refused(tmp_path):
    write_video(tmp_path / "cam01.avi", (32, 24))
    with pytest.raises(HabitusError, match="32 x 24 pixels, calibration of cam_01 64 x 48"):
        read_videos(tmp_path, rig())


def test_what_is_no_video_is_refused(tmp_path):
    (tmp_path / "cam01.mp4").write_bytes(b"nothing of the kind" * 50)
    with pytest.raises(HabitusError, match="OpenCV reads"):
        read_videos(tmp_path, rig())


def test_pictures_lose_their_distortion():
    """A picture whose levels are a smooth function of the pixel without distortion."""
    camera = replace(rig().cameras[0], width=640, height=480, focal=np.full(2, 600.0),
                     centre=np.array([320.0, 240.0]))  # fmt: skip
    at = np.stack(np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5), -1)
    ideal = camera.ideal(at)
    levels = np.stack([ideal[..., 0] / 4, ideal[..., 1] / 4, 100 + 0 * ideal[..., 0]], -1)
    picture = np.rint(np.clip(levels, 0, 255)).astype(np.uint8)
    low, scale = np.array([100.0, 80.0]), 0.5
    out = undistorted(picture, camera, low, scale, (200, 150)).astype(float)
    x = low[0] + (np.arange(200) + 0.5) / scale
    y = low[1] + (np.arange(150) + 0.5) / scale
    assert np.abs(out[..., 0] - x / 4).max() < 1.0
    assert np.abs(out[..., 1] - y[:, None] / 4).max() < 1.0
    np.testing.assert_allclose(camera.distorted(ideal), at, atol=1e-3)
    assert (undistorted(picture, camera, np.array([-900.0, 0.0]), 1.0, (10, 10)) == 128).all()
