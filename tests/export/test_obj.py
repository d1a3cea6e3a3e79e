import numpy as np
import trimesh
from synthetic_fit import reference_vertices, synthetic_fit

from habitus.export import write_obj_sequence


def test_sequence_is_the_surface(tmp_path):
    fit = synthetic_fit(frames=40)
    paths = write_obj_sequence(fit, tmp_path / "objs", frames=[0, 7, 39])
    assert [p.name for p in paths] == ["walk_000000.obj", "walk_000007.obj", "walk_000039.obj"]
    expected = reference_vertices(fit.body, fit.betas + fit.soft_tissue, fit.pose, fit.trans)
    for path, frame in zip(paths, [0, 7, 39], strict=True):
        mesh = trimesh.load(path, process=False)
        assert np.allclose(mesh.vertices, expected[frame], atol=2e-6)
        assert np.array_equal(mesh.faces, fit.body.faces)


def test_all_frames_and_y_up(tmp_path):
    fit = synthetic_fit(frames=3, soft=False)
    paths = write_obj_sequence(fit, tmp_path, y_up=True)
    mesh = trimesh.load(paths[2], process=False)
    expected = reference_vertices(fit.body, np.tile(fit.betas, (3, 1)), fit.pose, fit.trans)[2]
    assert len(paths) == 3
    assert np.allclose(mesh.vertices, expected[:, [0, 2, 1]] * [1, 1, -1], atol=2e-6)
