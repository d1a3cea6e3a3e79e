"""A learned body in the file that it was started from: what was not learned is there to the bit,
both levels fit.
"""

from dataclasses import replace

import numpy as np
import pytest
from two_levels import two_level_arrays, write_two_levels

from habitus.io.models.bodies import load_body, save_body
from habitus.io.models.levels import has_levels, save_like


@pytest.fixture
def source(tmp_path):
    return write_two_levels(tmp_path / "source.npz")


def test_only_what_was_learned_is_other_than_it_was(source, tmp_path):
    start = load_body(source, detail="full")
    rng = np.random.default_rng(0)
    drivers = (16, 18, 20)
    learned = replace(
        start, posedirs=0.01 * rng.normal(size=(start.num_vertices, 3, 27)), pose_joints=drivers
    )
    save_like(learned, source, tmp_path / "learned.npz")
    before = two_level_arrays()
    with np.load(tmp_path / "learned.npz") as file:
        after = dict(file)
    assert set(before) - set(after) == {"license", "version"} and set(after) <= set(before)
    other = {key for key, array in after.items() if not np.array_equal(array, before[key])}
    assert other == {"posedirs", "posedirs_joints"}
    assert all(after[key].dtype == before[key].dtype for key in after)
    found = load_body(tmp_path / "learned.npz")
    assert found.full is not None and found.pose_joints == drivers
    np.testing.assert_allclose(found.full.posedirs, learned.posedirs, rtol=1e-3, atol=1e-6)


def test_a_body_that_is_other_in_everything_is_itself_again(source, tmp_path):
    start = load_body(source, detail="full")
    rng = np.random.default_rng(1)
    start = replace(start, posedirs=None, pose_joints=None)
    coarse = load_body(source).full_vertices
    regressor = np.zeros_like(start.joint_regressor)
    regressor[:, coarse] = rng.dirichlet(np.ones(len(coarse)), start.num_joints)
    other = replace(
        start,
        v_template=start.v_template * 1.1,
        shapedirs=2 * start.shapedirs,
        joint_regressor=regressor,
    )
    save_like(other, source, tmp_path / "other.npz")
    found = load_body(tmp_path / "other.npz", detail="full")
    assert found.posedirs is None
    for name in ("v_template", "shapedirs", "joint_regressor"):
        np.testing.assert_allclose(getattr(found, name), getattr(other, name), rtol=2e-3, atol=1e-6)
    assert load_body(tmp_path / "other.npz").full is not None


def test_which_files_have_two_levels(source, tmp_path):
    save_body(load_body(source), tmp_path / "one.npz")
    assert has_levels(source) and has_levels("female")
    assert not has_levels(tmp_path / "one.npz") and not has_levels(tmp_path / "none.npz")
