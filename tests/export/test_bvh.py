import numpy as np
import pytest
from read_bvh import Bvh
from synthetic_fit import synthetic_fit

from habitus.export.bvh import write_bvh
from habitus.rotations import up_rotation


@pytest.mark.parametrize(("soft", "up"), [(True, "+z"), (False, "-x")])
def test_joints_stand_where_the_fits_do(tmp_path, soft, up):
    fit = synthetic_fit(15, soft=soft, up_axis=up, rate_hz=100.0)
    write_bvh(fit, tmp_path / "a.bvh")
    found = Bvh(tmp_path / "a.bvh")
    turn = up_rotation(up)
    assert found.frame_time == pytest.approx(0.01) and len(found.values) == 15
    assert set(found.names) == set(fit.body.joint_names) and found.offsets[0] == [0, 0, 0]
    for frame in (0, 6, 14):
        joints = found.joints(frame)
        known = fit.joints(frame) @ turn.T
        for name, place in zip(fit.body.joint_names, known, strict=True):
            assert np.linalg.norm(joints[name] / 100 - place) < 1e-6
    below = [channels for channels in found.channels[1:] if len(channels) == 6]
    assert bool(below) == soft  # soft tissue moves joints; without it only the root has a place
    rest = fit.body.rest_joints(fit.betas)
    for name, parent, offset in zip(
        found.names[1:], found.parents[1:], found.offsets[1:], strict=True
    ):
        here, above = (fit.body.joint_names.index(each) for each in (name, found.names[parent]))
        assert np.allclose(offset, 100 * (rest[here] - rest[above]), atol=1e-5)
    leaves = set(range(len(found.names))) - set(found.parents)
    assert len(found.ends) == len(leaves) and all(np.linalg.norm(end) > 0.5 for end in found.ends)
