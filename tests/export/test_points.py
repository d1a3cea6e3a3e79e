import numpy as np
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
from habitus.export.trc import write_points
from habitus.io.captures.read import read_capture
from habitus.rotations import up_rotation


def test_joints_and_markers_come_back(tmp_path):
    fit = synthetic_fit(9, labels=("neck", *(f"skin{k}" for k in range(11))))
    write_points(fit, tmp_path / "a.trc")
    found = read_capture(tmp_path / "a.trc")
    turn = up_rotation(fit.up_axis)
    assert found.up_axis == "+y" and found.rate_hz == fit.rate_hz
    places = dict(zip(found.labels, found.markers.transpose(1, 0, 2), strict=True))
    joints = fit.joints()
    for k, name in enumerate(fit.body.joint_names):
        known = joints[:, k] @ turn.T
        assert np.abs(places["neck_joint" if name == "neck" else name] - known).max() < 2e-8
    assert np.abs(places["skin3"] - fit.predicted_soft_tissue[:, 4] @ turn.T).max() < 2e-8
    write_points(BodyMotion.of(fit), tmp_path / "b.trc")
    assert read_capture(tmp_path / "b.trc").labels == fit.body.joint_names
