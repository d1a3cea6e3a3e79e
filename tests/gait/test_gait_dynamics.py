"""Newton's and Euler's equations on motions whose forces are known, and masses of a body's parts."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import habitus as hb
from habitus.body.segments import DENSITY, TRUNK_DENSITY, owners, segment_masses
from habitus.errors import HabitusError
from habitus.gait.contacts import ForcePlate
from habitus.gait.dynamics import (
    GRAVITY,
    GroundForces,
    Loads,
    angular_velocity,
    ground_forces,
    joint_moment,
    loads,
    residual,
)

UP = np.array([0.0, 0.0, 1.0])
RATE, FRAMES = 100.0, 60
TIME = np.arange(FRAMES)[:, None] / RATE
UNFILTERED = 1e6  # Hz: above what can be filtered


def rods(count: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Masses and inertias of rods along z, 1 m and less."""
    mass = np.linspace(2.0, 5.0, count)
    length = np.linspace(1.0, 0.4, count)
    across = mass * length**2 / 12.0
    return mass, np.stack([np.diag([i, i, 0.0]) for i in across])


def turns(count: int = 3) -> np.ndarray:
    return np.broadcast_to(np.eye(3), (FRAMES, count, 3, 3)).copy()


def test_a_falling_body_needs_no_force():
    mass, inertia = rods()
    start = np.random.default_rng(0).normal(size=(3, 3))
    centre = start + TIME[:, None] * [1.0, 2.0, 0.5] - 0.5 * GRAVITY * TIME[:, None] ** 2 * UP
    own = loads(mass, inertia, centre, turns(), RATE, UP, UNFILTERED)
    np.testing.assert_allclose(own.force[1:-1], 0.0, atol=1e-9)
    standing = loads(mass, inertia, np.broadcast_to(start, centre.shape), turns(), RATE, UP)
    np.testing.assert_allclose(
        standing.needed, np.tile(mass.sum() * GRAVITY * UP, (FRAMES, 1)), atol=1e-9
    )
    np.testing.assert_allclose(standing.spin, 0.0, atol=1e-12)


def test_a_rod_that_turns_steadily_has_the_moment_of_its_rotation():
    """A tilted rod about the vertical: dH/dt = w x H, to what central differences make of a circle."""
    mass, inertia = rods(1)
    speed = 3.0
    lean = Rotation.from_euler("x", 0.6).as_matrix()
    turn = Rotation.from_rotvec(speed * TIME * UP).as_matrix() @ lean
    own = loads(mass, inertia, np.zeros((FRAMES, 1, 3)), turn[:, None], RATE, UP, UNFILTERED)
    spin = angular_velocity(turn[:, None], RATE)
    np.testing.assert_allclose(spin[:, 0], np.tile(speed * UP, (FRAMES, 1)), atol=1e-9)
    world = turn @ inertia[0] @ turn.transpose(0, 2, 1)
    momentum = world @ (speed * UP)
    step = np.sin(speed / RATE) * RATE / speed
    expected = step * np.cross(speed * UP, momentum)
    np.testing.assert_allclose(own.spin[1:-1, 0], expected[1:-1], atol=1e-9)


def test_a_hanging_chain_at_rest_has_the_moments_of_its_weights():
    mass, inertia = rods()
    centre = np.array([[0.3, 0.0, -0.5], [0.6, 0.1, -1.0], [0.7, 0.2, -1.4]])
    own = loads(mass, inertia, np.broadcast_to(centre, (FRAMES, 3, 3)), turns(), RATE, UP)
    joint = np.broadcast_to([0.1, 0.0, -0.2], (FRAMES, 3))
    below = np.array([False, True, True])
    moment = joint_moment(own, below, joint, [])
    expected = sum(np.cross(centre[k] - joint[0], mass[k] * GRAVITY * UP) for k in (1, 2))
    np.testing.assert_allclose(moment, np.tile(expected, (FRAMES, 1)), atol=1e-9)


def test_a_force_through_the_joint_turns_nothing():
    """And a force beside it by its arm; its free moment counts as it is."""
    own = Loads(np.zeros((FRAMES, 1, 3)), np.zeros((FRAMES, 1, 3)), np.zeros((FRAMES, 1, 3)))
    joint = np.tile([0.2, 0.1, 0.5], (FRAMES, 1))
    force = np.tile(700.0 * UP, (FRAMES, 1))
    under = GroundForces(force, joint - 0.5 * UP, np.zeros((FRAMES, 3)))
    np.testing.assert_allclose(joint_moment(own, np.array([True]), joint, [under]), 0.0, atol=1e-9)
    beside = GroundForces(force, joint - [0.1, 0.0, 0.5], np.tile(4.0 * UP, (FRAMES, 1)))
    moment = joint_moment(own, np.array([True]), joint, [beside])
    np.testing.assert_allclose(moment, np.tile([0.0, -70.0, -4.0], (FRAMES, 1)), atol=1e-9)


def test_the_residual_is_what_the_plates_lack():
    mass, inertia = rods()
    centre = np.zeros((FRAMES, 3, 3))
    own = loads(mass, inertia, centre, turns(), RATE, UP)
    whole = GroundForces(own.needed, np.zeros((FRAMES, 3)), np.zeros((FRAMES, 3)))
    np.testing.assert_allclose(residual(own, [whole]), 0.0, atol=1e-9)
    half = GroundForces(0.5 * own.needed, np.zeros((FRAMES, 3)), np.zeros((FRAMES, 3)))
    np.testing.assert_allclose(residual(own, [half, half]), 0.0, atol=1e-9)
    np.testing.assert_allclose(residual(own, [half]) @ UP, -0.5 * GRAVITY * mass.sum(), atol=1e-9)


def test_a_plate_that_moves_with_everything_changes_no_moment():
    rng = np.random.default_rng(4)
    samples = 10 * FRAMES
    force = np.tile([20.0, -30.0, 650.0], (samples, 1))
    place = np.tile([0.2, 0.1, 0.0], (samples, 1)) + 0.02 * np.sin(np.linspace(0, 3, samples))[
        :, None
    ] * [1, 0, 0]
    corners = np.array([[0.5, 0.4, 0], [0.0, 0.4, 0], [0, 0, 0], [0.5, 0, 0]])
    joint = np.tile([0.2, 0.1, 0.9], (FRAMES, 1))
    own = Loads(*(np.zeros((FRAMES, 1, 3)) for _ in range(3)))
    moments = []
    for shift in (np.zeros(3), rng.normal(size=3)):
        plate = ForcePlate(
            1, corners + shift, force, place + shift, np.zeros((samples, 3)), 10 * RATE
        )
        ground = ground_forces(plate, 0.0, 10.0, FRAMES, RATE)
        moments.append(joint_moment(own, np.array([True]), joint + shift, [ground]))
    np.testing.assert_allclose(moments[0], moments[1], atol=1e-9)


@pytest.mark.parametrize("name", ["female", "male"])
def test_parts_make_up_the_whole_body(name):
    """Volumes, their centre and their inertia, of any person."""
    body = hb.load_body(name)
    betas = np.random.default_rng(1).normal(size=body.num_betas) * 0.7
    own = segment_masses(body, betas)
    density = np.array([DENSITY.get(n.rpartition("_")[2], TRUNK_DENSITY) for n in body.joint_names])
    volume = own.mass / density
    whole = trimesh.Trimesh(body.rest_vertices(betas), body.faces, process=False)
    assert abs(volume.sum() / whole.volume - 1.0) < 1e-9
    middle = (volume[:, None] * own.centre).sum(0) / volume.sum()
    np.testing.assert_allclose(middle, whole.center_mass, atol=1e-9)
    arm = own.centre - middle
    steiner = np.einsum("j,ja,jb->ab", volume, arm, arm)
    inertia = (
        (own.inertia / density[:, None, None]).sum(0) + np.trace(steiner) * np.eye(3) - steiner
    )
    np.testing.assert_allclose(inertia, whole.moment_inertia, atol=1e-9)
    shares = {n: m / own.total for n, m in zip(body.joint_names, own.mass, strict=True)}
    for part, low, high in (
        ("hip", 0.10, 0.16),
        ("knee", 0.033, 0.052),
        ("shoulder", 0.02, 0.045),
        ("head", 0.035, 0.07),
    ):
        for full in (part,) if part == "head" else (f"left_{part}", f"right_{part}"):
            assert low < shares[full] < high, full


def test_a_known_mass_is_kept():
    body = hb.load_body("male")
    own = segment_masses(body, np.zeros(body.num_betas), 74.0, "recorded")
    assert abs(own.total - 74.0) < 1e-9 and own.source == "recorded"
    assert segment_masses(body, np.zeros(body.num_betas)).source == "from the volume"
    with pytest.raises(HabitusError, match="mass is 900 kg"):
        segment_masses(body, np.zeros(body.num_betas), 900.0)


@pytest.mark.parametrize("sex", ["female", "male"])
def test_each_part_is_a_solid_by_itself(sex):
    """Centres lie within their parts and inertias are those of solids, in the trunk, too."""
    body = hb.load_body(sex)
    betas = np.zeros(body.num_betas)
    own = segment_masses(body, betas)
    surface = body.rest_vertices(betas)
    owner = owners(body, surface, body.rest_joints(betas))
    for k in np.flatnonzero(own.mass):
        places = surface[owner == k]
        margin = 0.05
        assert (own.centre[k] > places.min(axis=0) - margin).all(), body.joint_names[k]
        assert (own.centre[k] < places.max(axis=0) + margin).all(), body.joint_names[k]
        moments = np.linalg.eigvalsh(own.inertia[k])
        assert moments[0] > 0.0, body.joint_names[k]
        assert moments[2] <= moments[0] + moments[1], body.joint_names[k]
    faces = surface[body.faces]
    volume = np.einsum("fi,fi->f", faces[:, 0], np.cross(faces[:, 1], faces[:, 2])).sum() / 6.0
    assert own.volume.sum() == pytest.approx(volume, rel=1e-6)
