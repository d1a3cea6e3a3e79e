import pytest

from habitus.body.joint_layouts import LAYOUTS, find_layout
from habitus.mesh.template import check_parents

JOINTS = {"smpl": 24, "smplh": 52, "smplx": 55, "mano": 16, "smal": 33}


@pytest.mark.parametrize("name", JOINTS)
def test_every_layout_is_a_tree_with_names_of_its_own(name):
    layout = LAYOUTS[name]
    check_parents(layout.parents)
    assert len(layout.parents) == len(set(layout.joint_names)) == JOINTS[name]
    assert find_layout(layout.parents) is layout


@pytest.mark.parametrize("name", ["smpl", "smplh", "smplx", "smal"])
def test_left_and_right_hang_alike(name):
    layout = LAYOUTS[name]
    for joint, parent in zip(layout.joint_names, layout.parents, strict=True):
        if joint.startswith("left_"):
            other = layout.joint_names.index(joint.replace("left_", "right_"))
            above = layout.joint_names[layout.parents[other]]
            assert above == layout.joint_names[parent].replace("left_", "right_")


def test_bodies_with_hands_begin_with_the_same_joints():
    assert (
        LAYOUTS["smplh"].parents[:22]
        == LAYOUTS["smplx"].parents[:22]
        == LAYOUTS["smpl"].parents[:22]
    )
    assert find_layout((-1, 0, 0)) is None
