"""MJCF, URDF and tables of pairs: against MuJoCo and SciPy, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from made_robot import PAIRS, URDF, mjcf
from scipy.spatial.transform import Rotation

from habitus.errors import HabitusError
from habitus.io.robots.pairs import pairs_for, read_pairs, shipped_pairs
from habitus.io.robots.read import read_robot

ROBOTS = Path(__file__).parents[4] / "shared" / "robots"


def written(folder: Path, text: str, name: str = "robot.xml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def as_mujoco(model, robot, angles, root, turn):
    import mujoco

    data = mujoco.MjData(model)
    quaternion = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    data.qpos[:] = np.concatenate([root, quaternion, angles])
    mujoco.mj_kinematics(model, data)
    places = [data.body(name).xpos.copy() for name in robot.link_names if " " not in name]
    turns = [
        data.body(name).xmat.reshape(3, 3).copy() for name in robot.link_names if " " not in name
    ]
    return np.array(places), np.array(turns)


def test_links_are_where_mujoco_places_them(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    path = written(tmp_path, mjcf())
    robot = read_robot(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    assert list(robot.joint_names) == [model.joint(k).name for k in range(1, model.njnt)]
    np.testing.assert_allclose(robot.lower, model.jnt_range[1:, 0])
    np.testing.assert_allclose(robot.upper, model.jnt_range[1:, 1])
    rng = np.random.default_rng(0)
    named = [k for k, name in enumerate(robot.link_names) if " " not in name]
    for _ in range(5):
        angles = rng.uniform(robot.lower, robot.upper)
        root, turn = rng.normal(size=3), Rotation.random(random_state=rng).as_matrix()
        links = robot.pose(angles, root, turn)
        places, turns = as_mujoco(model, robot, angles, root, turn)
        np.testing.assert_allclose(links.origins[named], places, atol=1e-12)
        np.testing.assert_allclose(links.rotations[named], turns, atol=1e-12)


@pytest.mark.parametrize(
    "turn",
    [
        'quat="1 0.2 -0.3 0.4"',
        'euler="10 20 30"',
        'axisangle="1 2 3 40"',
        'xyaxes="1 1 0 0 1 1"',
        'zaxis="0.3 0.2 -0.5"',
        'zaxis="0 0 -1"',
    ],
)
@pytest.mark.parametrize("sequence", ["xyz", "ZXY"])
def test_frames_are_turned_as_mujoco_turns_them(tmp_path, turn, sequence):
    mujoco = pytest.importorskip("mujoco")
    text = f"""<mujoco><compiler eulerseq="{sequence}"/><worldbody><body name="a"><freejoint/>
    <geom size="0.1"/><body name="b" {turn}><joint name="j" range="-10 20"/><geom size="0.1"/>
    </body></body></worldbody></mujoco>"""
    path = written(tmp_path, text)
    robot = read_robot(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    _, turns = as_mujoco(model, robot, np.array([0.3]), np.zeros(3), np.eye(3))
    links = robot.pose(np.array([0.3]))
    np.testing.assert_allclose(links.rotations, turns, atol=1e-12)
    np.testing.assert_allclose([robot.lower[0], robot.upper[0]], np.deg2rad([-10.0, 20.0]))


def test_urdf_is_read_as_its_document_says(tmp_path):
    robot = read_robot(written(tmp_path, URDF, "robot.urdf"))
    assert robot.link_names == ("pelvis", "thigh", "shank", "fixed")
    assert robot.joint_names == ("hip", "knee")
    assert robot.velocity.tolist() == [12.0, np.inf]
    assert (robot.lower[0], robot.upper[0], robot.upper[1]) == (-1.0, 1.5, np.inf)
    links = robot.pose(np.array([0.5, -0.7]))
    hip = Rotation.from_euler("xyz", [0.1, -0.2, 0.3]) * Rotation.from_rotvec([0, 0.5, 0])
    knee = hip * Rotation.from_rotvec(np.array([1, 1, 0]) / np.sqrt(2) * -0.7)
    np.testing.assert_allclose(links.rotations[2], knee.as_matrix(), atol=1e-12)
    shank = np.array([0, 0.1, -0.05]) + hip.apply([0, 0, -0.3])
    np.testing.assert_allclose(links.origins[3], shank + knee.apply([0.1, 0, 0]), atol=1e-12)


def test_g1_in_both_formats_is_one_robot():
    path = ROBOTS / "g1_mocap_29dof.xml"
    if not path.exists():
        pytest.skip("the shared robots are not here")
    robot = read_robot(path)
    assert robot.num_joints == 29
    assert pairs_for(robot).name == "unitree_g1"
    assert not np.isfinite(robot.velocity).any()


def test_right_side_of_a_table_is_the_left_one_mirrored(tmp_path):
    pairs = read_pairs(written(tmp_path, PAIRS, "pairs.toml"))
    left, right = pairs.segments["left_upper_arm"], pairs.segments["right_upper_arm"]
    assert (left.link, right.link) == ("left_upper_arm", "right_upper_arm")
    np.testing.assert_allclose(left.directions["along"] * [1, -1, 1], right.directions["along"])
    np.testing.assert_allclose(pairs.soles[0].heel * [1, -1, 1], pairs.soles[1].heel)
    robot = read_robot(written(tmp_path, mjcf()))
    assert pairs.missing(robot) == []


@pytest.mark.parametrize("name", shipped_pairs())
def test_shipped_tables_name_all_that_is_needed(name):
    pairs = read_pairs(name)
    assert {"pelvis", "torso", "left_thigh", "right_forearm"} <= set(pairs.segments)
    assert len(pairs.capsules) >= 8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<html/>", "root element is html"),
        ("<mujoco/>", "no body in worldbody"),
        ("<robot><link name='a'/></robot>", "no hinge joints"),
        ("<robot><link name='a'/><link name='b'/></robot>", "2 links without a parent"),
        ("<mujoco><include file='x.xml'/></mujoco>", "includes other files"),
        (mjcf().replace('axis="0 1 0"', 'axis="0 0 0"', 1), "its axis is 0 0 0"),
        (mjcf().replace('axis="0 1 0"', 'axis="0 1"', 1), "expected 3 numbers"),
        (mjcf().replace('axis="0 1 0"', 'type="slide"', 1), "expected hinges"),
        (mjcf().replace('range="-2 2"', 'range="2 -2"', 1), "expected lower <= upper"),
        (mjcf().replace('pos="0 0 -0.3"', 'pos="0 0 -300"', 1), "expected metres"),
        (URDF.replace('"revolute"', '"prismatic"'), "is prismatic"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><mujoco/>', "entity"),
    ],
)
def test_other_robots_are_refused_in_a_line(tmp_path, text, message):
    with pytest.raises(HabitusError, match=message) as error:
        read_robot(written(tmp_path, text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PAIRS.replace("[capsules]", "[capsule]"), "capsule: unknown"),
        (PAIRS.replace("torso = { link", "tail = { link", 1), "segments.tail: unknown"),
        (PAIRS.replace("along = [0, 0, -1]", "along = [0, 0, 0]"), "no direction"),
        (PAIRS.replace("up = [0, 0, 1]", "along = [0, 0, 1]", 1), "has no end"),
        (PAIRS.replace("radius = 0.09", "radius = 90"), "expected metres"),
        (PAIRS.replace("velocity = 25", "velocity = -1"), "expected rad/s"),
        (PAIRS.replace("heel = [[-0.05, 0.03, -0.04]", "heel = [[-50, 30, -40]"), "metres"),
    ],
)
def test_wrong_tables_are_refused_in_a_line(tmp_path, text, message):
    with pytest.raises(HabitusError, match=message):
        read_pairs(written(tmp_path, text, "pairs.toml"))
