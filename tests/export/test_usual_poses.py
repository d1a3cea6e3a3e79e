import numpy as np
from synthetic_fit import tube_body

from habitus.export.correctives import SAMPLES, sampled_rotations


def test_poses_are_rotations_always_the_same_and_knees_bend_backwards():
    body = tube_body(posedirs=True)
    found = sampled_rotations(body)
    assert found.shape == (SAMPLES, body.num_joints, 3, 3)
    assert (
        np.allclose(found @ np.swapaxes(found, -1, -2), np.eye(3), atol=1e-12)
        and np.linalg.det(found).min() > 0
    )
    assert np.array_equal(found, sampled_rotations(body))
    knee = found[:, body.joint_names.index("left_knee")]
    assert (knee[:, 2, 1] > 0).mean() > 0.6 and np.array_equal(
        found[:, 0], np.tile(np.eye(3), (SAMPLES, 1, 1))
    )
