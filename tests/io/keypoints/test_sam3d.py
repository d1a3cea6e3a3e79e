"""SAM 3D Body's frames: points of our skin on MHR's mesh, one size, one person in motion."""

import numpy as np
import pytest

import habitus as hb
from habitus.errors import HabitusError
from habitus.io.keypoints.sam3d import NOTE, mhr_points, read_sam3d, same_size
from habitus.jobs.cameras import sam3d


def _frames(folder, sizes, vertices=None):
    """Files whose mesh carries our body's skin, turning, in the camera's frame."""
    body = hb.load_body("neutral")
    points = mhr_points()
    for t, size in enumerate(sizes):
        pose = np.zeros((24, 3))
        pose[0, 1] = 0.03 * t
        pose[16, 2], pose[17, 2] = -0.8, 0.8
        skin = np.asarray(body(None, pose).vertices)[points.vertices] * [1.0, -1.0, -1.0]
        mesh = np.zeros((points.mesh_vertices if vertices is None else vertices, 3), np.float32)
        if vertices is None:
            mesh[points.corners.ravel()] = np.repeat(size * skin, 3, axis=0)
        place = size * np.array([0.1, 0.0, 4.0 + 0.1 * (-1) ** t])
        np.savez(folder / f"f{t}.npz", pred_vertices=mesh, pred_cam_t=place.astype(np.float32))
    return body


def test_points_are_those_of_our_skin_in_one_size(tmp_path):
    body = _frames(tmp_path, [1.0, 1.1, 1.0, 0.9, 1.0])
    capture, layout = read_sam3d(tmp_path, 30.0, body)
    assert capture.labels == layout.labels and capture.up_axis == "+y" and len(capture) == 5
    assert NOTE in capture.doubts and "20 %" in capture.warnings[0]
    rest = np.asarray(body(None, None).vertices)[mhr_points().vertices]
    span = np.linalg.norm(np.ptp(capture.markers, axis=1), axis=-1)
    assert np.ptp(span) < 0.06 * span.mean()
    vertices = layout.vertices(body)
    np.testing.assert_array_equal(vertices, mhr_points().vertices)
    assert len(rest) == len(layout)
    assert np.ptp(capture.markers[:, :, 2].mean(1)) < 0.15  # depth jumped by .2 m a frame


def test_the_person_is_found_and_scaled_to_the_height(tmp_path):
    body = _frames(tmp_path, [1.0, 1.05, 0.95, 1.0])
    true = body.measure(np.zeros(body.num_betas))["height_m"]
    fit = sam3d(tmp_path, tmp_path / "out", fps=30.0)
    assert abs(fit.body.measure(fit.betas)["height_m"] - true) < 0.02
    assert fit.errors_mm.mean() < 4.0 and fit.verdict.level == "doubtful"
    assert (tmp_path / "out" / "body.npz").is_file()
    taller = sam3d(tmp_path, fps=30.0, height=true + 0.1)
    assert abs(taller.body.measure(taller.betas)["height_m"] - true - 0.1) < 0.02


def test_sizes_are_those_of_the_median_frame():
    rng = np.random.default_rng(0)
    points, bone = rng.normal(size=(1, 12, 3)), np.repeat([0, 1, 2], 4)
    scale = np.array([1.0, 1.2, 0.7, 1.0, 1.0])
    same, factor = same_size(scale[:, None, None] * points, bone)
    np.testing.assert_allclose(same, np.repeat(points, 5, axis=0))
    np.testing.assert_allclose(factor, 1.0 / scale)


def test_other_files_are_refused_in_one_line(tmp_path):
    body = hb.load_body("neutral")
    with pytest.raises(HabitusError, match=r"holds no \.npz"):
        read_sam3d(tmp_path, 30.0, body)
    _frames(tmp_path, [1.0], vertices=100)
    with pytest.raises(HabitusError, match=r"expected \(18439, 3\)"):
        read_sam3d(tmp_path, 30.0, body)
    (tmp_path / "f0.npz").write_bytes(b"PK")
    with pytest.raises(HabitusError) as error:
        read_sam3d(tmp_path, 30.0, body)
    assert "f0.npz" in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(HabitusError, match="frame rate"):
        read_sam3d(tmp_path, 0.0, body)
