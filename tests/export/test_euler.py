import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from habitus.export.euler import continuous_angles


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["xyz", "ZXY"]))
def test_angles_are_the_rotation_and_turn_on(seed, order):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(2, 3))
    turned = (
        np.linspace(0, 4 * np.pi, 200)[:, None, None] * axis / np.linalg.norm(axis, axis=1)[:, None]
    )
    known = Rotation.from_rotvec(turned.reshape(-1, 3))
    angles = continuous_angles(known.as_quat().reshape(200, 2, 4), order)
    found = Rotation.from_euler(order, angles.reshape(-1, 3), degrees=True)
    assert (found.inv() * known).magnitude().max() < 1e-6
    way = np.abs(np.diff(angles, axis=0)).sum(-1)
    wrapped = np.abs(np.diff(known.as_euler(order, degrees=True).reshape(200, 2, 3), axis=0)).sum(
        -1
    )
    assert (way <= wrapped + 1e-6).all()


@pytest.mark.parametrize(("order", "axis"), [("xyz", 0), ("xyz", 2), ("ZXY", 0), ("ZXY", 2)])
def test_a_whole_turn_goes_on(order, axis):
    turn = np.radians(np.linspace(0, 720, 100))
    quaternions = Rotation.from_rotvec(
        turn[:, None] * np.eye(3)["XYZ".index(order[axis].upper())]
    ).as_quat()[:, None]
    angles = continuous_angles(quaternions, order)[:, 0]
    assert np.allclose(angles[:, axis], np.degrees(turn)) and np.allclose(
        np.delete(angles, axis, 1), 0
    )
