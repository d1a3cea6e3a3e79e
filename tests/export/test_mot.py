"""OpenSim's coordinates: what a limb does has the sign and the name that Rajagopal's model gives
it.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_fit import synthetic_fit

from habitus.errors import HabitusError
from habitus.export.mot import coordinates, write_mot


def posed(**turns):
    """One frame, facing +x with +y up, some joints turned (degrees about the body's left, up and
    forward axes).
    """
    fit = synthetic_fit(1, soft=False, up_axis="+y")
    pose = np.zeros_like(fit.pose)
    for name, turn in turns.items():
        pose[0, fit.body.joint_names.index(name)] = np.radians(turn)
    pose[0, 0] = (
        Rotation.from_euler("y", 90, degrees=True) * Rotation.from_rotvec(pose[0, 0])
    ).as_rotvec()
    return replace(fit, pose=pose, pose_stage=(pose, fit.trans))


@pytest.mark.parametrize(
    ("turns", "name", "degrees"),
    [
        ({"right_hip": (-30, 0, 0)}, "hip_flexion_r", 30),  # the leg comes forward
        ({"left_hip": (-30, 0, 0)}, "hip_flexion_l", 30),
        ({"right_hip": (0, 0, 10)}, "hip_adduction_r", 10),  # the leg comes to the middle
        ({"left_hip": (0, 0, -10)}, "hip_adduction_l", 10),
        ({"right_hip": (0, 15, 0)}, "hip_rotation_r", 15),  # the toes come to the middle
        ({"left_hip": (0, -15, 0)}, "hip_rotation_l", 15),
        ({"left_knee": (60, 0, 0)}, "knee_angle_l", 60),
        ({"right_ankle": (-12, 0, 0)}, "ankle_angle_r", 12),  # the toes come up
        ({"spine2": (-20, 0, 0)}, "lumbar_extension", 20),  # leaning back
        ({"spine2": (0, 0, 8)}, "lumbar_bending", 8),  # to the right
        ({"right_elbow": (0, 70, 0)}, "elbow_flex_r", 70),
        ({"right_shoulder": (0, 0, 90)}, "arm_add_r", 0),  # hanging
        ({"right_shoulder": (0, 0, 60)}, "arm_add_r", -30),  # 30 degrees away from the trunk
        ({"left_shoulder": (0, 0, -60)}, "arm_add_l", -30),
        ({"pelvis": (-20, 0, 0)}, "pelvis_tilt", 20),  # leaning back
        ({"pelvis": (0, 0, 7)}, "pelvis_list", 7),  # to the right
        ({"pelvis": (0, 25, 0)}, "pelvis_rotation", 25),  # to the left
    ],
)
def test_signs(turns, name, degrees):
    found = coordinates(posed(**turns))
    rest = coordinates(posed())  # a T-pose; the elbows of this body are not quite straight
    assert found[name] == pytest.approx(
        [degrees], abs=1e-6 if name not in rest or abs(rest[name][0]) < 1e-6 else 6
    )
    moved = {k for k, v in found.items() if abs(v[0] - rest[k][0]) > 1e-5}
    assert moved - {name} <= {"pelvis_tx", "pelvis_ty", "pelvis_tz"}


def test_the_file(tmp_path):
    fit = synthetic_fit(30, rate_hz=60.0)
    names = write_mot(fit, tmp_path / "a.mot")
    head, table = (tmp_path / "a.mot").read_text().split("endheader\n")
    told = dict(line.split("=") for line in head.splitlines() if "=" in line)
    assert told == {
        "version": "1",
        "nRows": "30",
        "nColumns": str(1 + len(names)),
        "inDegrees": "yes",
    }
    lines = [line.split("\t") for line in table.splitlines()]
    values = np.array(lines[1:], float)
    assert (
        lines[0] == ["time", *names]
        and values.shape == (30, 1 + len(names))
        and values[-1, 0] == pytest.approx(29 / 60)
    )
    height = values[:, lines[0].index("pelvis_ty")]
    assert np.allclose(height, fit.joints()[:, 0, 2], atol=1e-5)  # z is up there
    names = tuple("bone" if name == "spine3" else name for name in fit.body.joint_names)
    with pytest.raises(HabitusError, match="has no joint spine3"):
        write_mot(replace(fit, body=replace(fit.body, joint_names=names)), tmp_path / "b.mot")
