import io
import json
import zipfile

import numpy as np
import pytest
from synthetic_fit import reference_vertices, synthetic_fit

from habitus.export import write_npz
from habitus.export.npz import npz_arrays, save_arrays
from habitus.parallel import blocks


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    fit = synthetic_fit(labels=tuple(f"Märker </script> {k}" for k in range(12)))
    path = tmp_path_factory.mktemp("npz") / "walk.npz"
    write_npz(fit, path)
    with np.load(path, allow_pickle=False) as file:
        return fit, {key: file[key] for key in file.files}


def test_shapes_of_amass(written):
    fit, data = written
    frames, joints = fit.pose.shape[:2]
    assert data["poses"].shape == (frames, 3 * joints) and data["trans"].shape == (frames, 3)
    assert data["pose_body"].shape == (frames, 63) and data["root_orient"].shape == (frames, 3)
    assert data["betas"].shape == (int(data["num_betas"]),)
    assert data["mocap_framerate"] == data["mocap_frame_rate"] == fit.rate_hz
    assert str(data["gender"]) == "neutral" and str(data["up_axis"]) == "+z"
    assert np.array_equal(
        np.c_[data["root_orient"], data["pose_body"], data["pose_hand"]], data["poses"]
    )


def test_file_alone_gives_the_surface_back(written):
    fit, data = written
    pose = data["poses"].reshape(len(data["poses"]), -1, 3)
    found = reference_vertices(
        fit.body, data["betas"] + data["soft_tissue_betas"], pose, data["trans"]
    )
    expected = fit.body(fit.betas, fit.pose, fit.trans, soft_tissue=fit.soft_tissue)
    assert np.abs(found - expected.vertices).max() < 1e-9


def test_markers_keep_labels_gaps_and_places(written):
    fit, data = written
    assert list(data["latent_labels"]) == list(data["labels_obs"]) == list(fit.labels)
    assert np.array_equal(np.isnan(data["markers_obs"]), np.isnan(fit.observed_markers))
    assert np.allclose(data["markers_sim"], fit.predicted_soft_tissue, atol=1e-5)
    rest = fit.body.rest_vertices(fit.betas)
    away = np.linalg.norm(rest[:, None] - data["markers_latent"], axis=2)
    assert np.allclose(away[data["markers_latent_vids"], np.arange(len(fit.labels))], away.min(0))
    assert json.loads(str(data["settings"])) == fit.settings


def test_without_soft_tissue(tmp_path):
    fit = synthetic_fit(frames=4, soft=False, suspects=())
    write_npz(fit, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as data:
        assert "soft_tissue_betas" not in data and data["suspect_labels"].shape == (0,)
        assert np.allclose(data["markers_sim"], fit.predicted_pose_stage, atol=1e-5)


@pytest.mark.parametrize("soft", [False, True])
def test_the_archive_is_numpys_to_the_byte_where_memory_is_short_too(soft, monkeypatch):
    fit = synthetic_fit(soft=soft)
    expected = io.BytesIO()
    found = io.BytesIO()
    np.savez(expected, allow_pickle=False, **npz_arrays(fit))
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    monkeypatch.setattr(blocks, "BLOCK", 16)
    arrays = npz_arrays(fit)
    assert blocks.is_file_backed(arrays["markers_obs"]) and blocks.is_file_backed(
        arrays["pose_body"]
    )
    save_arrays(found, arrays)
    assert found.getvalue() == expected.getvalue()


def test_long_arrays_are_written_as_short_ones_are(monkeypatch):
    """File-backed arrays, whole or in part, go to the file a block at a time."""
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    long = blocks.empty_array((20_000, 4, 3))
    long[:] = np.arange(long.size).reshape(long.shape)
    arrays = {"poses": long.reshape(len(long), 12), "root": long[:, 0], "ends": long[[0, -1]]}
    written, expected = io.BytesIO(), io.BytesIO()
    save_arrays(written, arrays)
    np.savez(expected, **{name: np.array(each) for name, each in arrays.items()})
    for name in arrays:
        contents = (zipfile.ZipFile(file).read(f"{name}.npy") for file in (written, expected))
        assert next(contents) == next(contents), name
