"""Motions on robots: derivatives, limits, feet, planted motions, files and pages."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from made_robot import PAIRS, mjcf
from scipy.spatial.transform import Rotation

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.robot import write_robot
from habitus.fit.retarget.robot_body import capsule, robot_motion
from habitus.fit.retarget.robot_pairs import Capsule
from habitus.fit.retarget.robot_quality import overlaps, robot_quality
from habitus.fit.retarget.robots import (
    ROBOT,
    ROOT,
    RobotProblem,
    retargeted_to_robot,
    robot_goal,
    segment_distance,
)
from habitus.io.robots.pairs import read_pairs
from habitus.io.robots.read import read_robot
from habitus.jobs.robots import retarget_to_robot

RATE = 60.0


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "made.xml"
    path.write_text(mjcf())
    return read_robot(path)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "made.toml"
    path.write_text(PAIRS)
    return read_pairs(path)


@pytest.fixture(scope="module")
def motion():
    """A person who squats, bends the arms and turns the head of the pelvis, feet where they are."""
    body = hb.load_body("default")
    phase = np.linspace(0.0, 2.0 * np.pi, 90)
    pose = np.zeros((90, body.num_joints, 3))
    bend = 0.35 * (1.0 - np.cos(phase))
    names = body.joint_names
    for side, sign in (("left", 1.0), ("right", -1.0)):
        pose[:, names.index(f"{side}_hip"), 0] = -bend
        pose[:, names.index(f"{side}_knee"), 0] = 2.0 * bend
        pose[:, names.index(f"{side}_ankle"), 0] = -bend
        pose[:, names.index(f"{side}_shoulder"), 2] = -sign * 1.1
        pose[:, names.index(f"{side}_elbow"), 1] = -sign * 0.5 * (1.0 - np.cos(phase))
    made = BodyMotion(body, np.zeros(body.num_betas), pose, np.zeros((90, 3)), RATE, "+y")
    ankle = made.joints()[:, names.index("left_ankle")]
    return replace(made, trans=ankle[0] - ankle)


@pytest.fixture(scope="module")
def result(motion, robot, pairs):
    return retargeted_to_robot(motion, robot, pairs)


def test_derivatives_are_those_of_differences(result, robot, pairs):
    goal = robot_goal(robot, pairs, result.person, result.prints, result.scale, ROBOT)
    problem = RobotProblem(robot, goal, RATE, pairs, ROBOT)
    rng = np.random.default_rng(0)
    frames = np.array([3, 40, 77])
    states = np.column_stack(
        [
            rng.normal(scale=0.3, size=(3, ROOT)),
            rng.uniform(robot.lower, robot.upper, size=(3, robot.num_joints)),
        ]
    )
    costs, gradients, matrices = problem.linearize(frames, states)
    np.testing.assert_allclose(costs, problem.cost(frames, states))
    step = 1e-6
    for n in range(states.shape[1]):
        ahead, behind = states.copy(), states.copy()
        ahead[:, n] += step
        behind[:, n] -= step
        slope = (problem.cost(frames, ahead) - problem.cost(frames, behind)) / (2.0 * step)
        np.testing.assert_allclose(gradients[:, n], slope, rtol=1e-5, atol=1e-4 * costs.max())
    np.testing.assert_allclose(matrices, np.swapaxes(matrices, 1, 2))
    assert (np.linalg.eigvalsh(matrices) > -1e-6 * np.abs(matrices).max()).all()


def test_feet_stand_limits_hold_and_limbs_follow(result, robot, pairs):
    quality = robot_quality(result)
    assert result.status == "converged"
    assert quality.slip < 0.005
    assert quality.penetration < 0.005
    assert quality.mean_free_direction < 8.0
    motion = result.motion
    assert (motion.angles >= robot.lower).all()
    assert (motion.angles <= robot.upper).all()
    speeds = np.abs(np.diff(motion.angles, axis=0)) * RATE
    assert speeds.max() <= pairs.velocity
    assert quality.verdict.level == "good"


def test_a_motion_that_the_robot_can_do_is_found(motion, robot, pairs, result):
    """The robot's own motion, as the person's directions and places: nothing is left over."""
    planted = result.motion
    links = planted.links()
    directions = {}
    for (name, kind), _ in result.person.directions.items():
        link = robot.link(pairs.segments[name].link)
        axis = robot.zero.rotations[link].T @ pairs.segments[name].directions[kind]
        directions[name, kind] = links.rotations[:, link] @ axis
    from habitus.fit.retarget import robots

    person = result.person._replace(directions=directions)
    solved = robots.solve_robot(robot, pairs, person, result.prints, result.scale, RATE, ROBOT)
    for (name, kind), truth in directions.items():
        link = robot.link(pairs.segments[name].link)
        axis = robot.zero.rotations[link].T @ pairs.segments[name].directions[kind]
        found = solved.motion.links().rotations[:, link] @ axis
        angle = np.rad2deg(np.linalg.norm(found - truth, axis=1))
        assert angle.mean() < 1.5, (name, kind)


def test_turning_the_person_turns_the_robot(motion, robot, pairs, result):
    """The same motion with +z up and turned about the vertical."""
    to_z = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    turn = Rotation.from_euler("z", 70, degrees=True).as_matrix() @ to_z
    pose = motion.pose.copy()
    root = Rotation.from_matrix(turn) * Rotation.from_rotvec(pose[:, 0])
    pose[:, 0] = root.as_rotvec()
    rest = motion.body.rest_joints(motion.betas)[0]
    trans = (motion.trans + rest) @ turn.T - rest
    other = retargeted_to_robot(replace(motion, pose=pose, trans=trans, up_axis="+z"), robot, pairs)
    np.testing.assert_allclose(other.motion.angles, result.motion.angles, atol=0.02)
    height = result.motion.root[:, 2]
    np.testing.assert_allclose(other.motion.root[:, 2], height, atol=0.003)


def test_links_that_would_enter_one_another_keep_clear(motion, robot, pairs):
    """Arms crossed before the chest, on a robot with thick parts."""
    thick = {name: replace(part, radius=1.5 * part.radius) for name, part in pairs.capsules.items()}
    pairs = replace(pairs, capsules=thick)
    pose = motion.pose.copy()
    names = motion.body.joint_names
    for side, sign in (("left", 1.0), ("right", -1.0)):
        pose[:, names.index(f"{side}_shoulder")] = (0.0, -sign * 1.3, -sign * 0.9)
        pose[:, names.index(f"{side}_elbow")] = (0.0, -sign * 1.6, 0.0)
    crossed = replace(motion, pose=pose)
    free = replace(pairs, capsules={})
    touching = retargeted_to_robot(crossed, robot, free)
    entered = overlaps(replace(touching, pairs=pairs), touching.motion.links())
    solved = retargeted_to_robot(crossed, robot, pairs)
    clear = overlaps(solved, solved.motion.links())
    assert np.median(entered) > 0.03
    assert np.median(clear) < 0.002
    assert clear.max() < entered.max()


def test_distance_of_segments_is_the_least_of_points():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 50, 2, 3))
    shares = np.linspace(0.0, 1.0, 60)
    points = [
        ends[:, None, 0] + shares[:, None] * (ends[:, None, 1] - ends[:, None, 0])
        for ends in (first, second)
    ]
    apart = np.linalg.norm(points[0][:, :, None] - points[1][:, None], axis=-1).min(axis=(1, 2))
    distance = segment_distance(first, second)
    assert (distance <= apart + 1e-12).all()
    np.testing.assert_allclose(distance, apart, atol=0.05)


def test_a_capsule_is_closed_and_as_thick_as_it_says():
    import trimesh

    ends = np.array([[0.1, 0.2, 0.3], [0.4, -0.1, 0.9]])
    mesh = trimesh.Trimesh(*capsule(ends, 0.1), process=False)
    assert mesh.is_watertight
    length = np.linalg.norm(ends[1] - ends[0])
    volume = np.pi * 0.1**2 * length + 4.0 / 3.0 * np.pi * 0.1**3
    assert 0.9 * volume < mesh.volume < volume


def test_the_robot_drawn_is_where_its_links_are(result, pairs):
    drawn = robot_motion(result.motion, pairs)
    to_y_up = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    robot, links = result.motion.robot, result.motion.links()
    places = links.origins.copy()
    jointed = robot.joint_links
    places[:, jointed] += (links.rotations[:, jointed] @ robot.anchors[..., None])[..., 0]
    np.testing.assert_allclose(drawn.joints(), places @ to_y_up.T, atol=1e-9)
    parts = pairs.capsules["left_forearm"]
    link = robot.link(parts.link)
    end = links.rotations[:, link] @ robot.zero.rotations[link].T @ parts.ends[1]
    tip = (links.origins[:, link] + end) @ to_y_up.T
    apart = np.linalg.norm(drawn.vertices() - tip[:, None], axis=-1).min(axis=1)
    np.testing.assert_allclose(apart, parts.radius, rtol=0.05)


def test_files_hold_the_motion(result, robot, tmp_path):
    motion = result.motion
    write_robot(motion, tmp_path / "a.npz")
    own = np.load(tmp_path / "a.npz", allow_pickle=False)
    np.testing.assert_array_equal(own["dof_pos"], motion.angles)
    turn = Rotation.from_quat(own["root_rot"]).as_matrix()
    np.testing.assert_allclose(turn, motion.turn, atol=1e-12)
    assert own["joint_names"].tolist() == list(robot.joint_names)
    rows = write_robot(motion, tmp_path / "a.csv") or np.loadtxt(tmp_path / "a.csv", delimiter=",")
    assert rows.shape == (90, 7 + robot.num_joints)
    np.testing.assert_allclose(rows[:, 7:], motion.angles, atol=1e-6)
    write_robot(motion, tmp_path / "a.pkl")
    held = pickle.loads((tmp_path / "a.pkl").read_bytes())
    assert held["fps"] == RATE
    np.testing.assert_array_equal(held["root_pos"], motion.root)


def test_loco_mujoco_velocities_integrate_to_the_poses(result, tmp_path):
    """MuJoCo's own integration of qvel, where it is installed, leads from qpos to qpos."""
    mujoco = pytest.importorskip("mujoco")
    write_robot(result.motion, tmp_path / "a.npz", "loco-mujoco")
    held = np.load(tmp_path / "a.npz", allow_pickle=False)
    (tmp_path / "made.xml").write_text(mjcf())
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "made.xml"))
    assert held["njnt"] == model.njnt
    assert held["jnt_type"].tolist() == model.jnt_type.tolist()
    for t in (20, 50):
        qpos = held["qpos"][t - 1].copy()
        mujoco.mj_integratePos(model, qpos, held["qvel"][t], 2.0 / RATE)
        np.testing.assert_allclose(qpos, held["qpos"][t + 1], atol=2e-3)


def test_the_job_writes_motion_page_and_numbers(motion, robot, pairs, tmp_path):
    made = retarget_to_robot(
        motion, robot, pairs=pairs, fps=30.0, out=tmp_path / "walk.csv", style="habitus"
    )
    assert made.motion.rate_hz == 30.0
    page = (tmp_path / "walk.html").read_text()
    assert "Penetration" in page
    numbers = json.loads((tmp_path / "walk.json").read_text())
    assert numbers["slip_mm_s"] == pytest.approx(1e3 * made.quality.slip)
    assert numbers["verdict"]["level"] == made.quality.verdict.level


def test_a_table_that_does_not_fit_is_refused(motion, robot, pairs, tmp_path):
    wrong = replace(pairs, segments={**pairs.segments, "head": pairs.segments["torso"]})
    wrong.segments["head"] = replace(wrong.segments["torso"], link="skull")
    with pytest.raises(HabitusError, match="names skull, which the robot made lacks"):
        retargeted_to_robot(motion, robot, wrong)
    few = {name: part for name, part in pairs.segments.items() if "shank" not in name}
    with pytest.raises(HabitusError, match="no link for left_shank, right_shank"):
        retargeted_to_robot(motion, robot, replace(pairs, segments=few))
    with pytest.raises(HabitusError, match="choose one"):
        retarget_to_robot(motion, robot, pairs=pairs, out=tmp_path / "walk.fbx")
    with pytest.raises(HabitusError, match="no shipped table fits"):
        retarget_to_robot(motion, robot)


def test_hands_at_rest_on_the_ground_stay_there(motion, robot, pairs):
    """On hands and feet, and drifting slowly: the robot's hands are in one place on the ground."""
    names, frames = motion.body.joint_names, 60
    rest = motion.body.rest_joints(motion.betas)
    drift = np.linspace(0.0, 0.08, frames)[:, None] * [1.0, 0.0, 0.3]

    def bent(pitch: float) -> BodyMotion:
        """Bent forward, legs and arms upright."""
        pose = np.zeros((frames, len(names), 3))
        pose[:, 0, 0] = pitch
        down = [[0.0, -np.cos(pitch), np.sin(pitch)]]
        for side in ("left", "right"):
            pose[:, names.index(f"{side}_hip"), 0] = -pitch
            ends = [names.index(f"{side}_{part}") for part in ("shoulder", "wrist")]
            turn = Rotation.align_vectors(down, [rest[ends[1]] - rest[ends[0]]])[0]
            pose[:, ends[0]] = turn.as_rotvec()
        return replace(motion, pose=pose, trans=drift)

    ends = [names.index(f"left_{part}") for part in ("hand", "foot")]
    heights = {a: bent(a).joints()[0, ends, 1] for a in np.linspace(1.5, 2.6, 23)}
    plank = bent(min(heights, key=lambda a: abs(np.ptp(heights[a]))))
    fists = {
        f"{side}_hand": Capsule(f"{side}_forearm", np.array([[0.0, 0.03, -0.2]] * 2), 0.03)
        for side in ("left", "right")
    }
    with_hands = replace(pairs, capsules=pairs.capsules | fists)
    for noise in (0.0, 1e-15, 1e-6):  # m: no rounding may decide what is found
        placed = plank.trans + noise * np.random.default_rng(0).normal(size=plank.trans.shape)
        held = robot_quality(retargeted_to_robot(replace(plank, trans=placed), robot, with_hands))
        assert held.resting > 0.9
        assert held.palm_slip < 0.005
        assert held.penetration < 0.01
    without = robot_quality(retargeted_to_robot(plank, robot, pairs))
    assert (without.resting, without.palm_slip) == (0.0, 0.0)
