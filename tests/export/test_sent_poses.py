"""OSC and VMC: a receiver on loopback, by python-osc, rebuilds the pose and has the joints where
the body has them.
"""

import socket
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import synthetic_body

from habitus.errors import HabitusError
from habitus.export.osc import Bundles, Message, Sender
from habitus.export.posing import UNITY_BONES, OscPoses, VmcPoses
from habitus.rotations import UP_AXES, up_rotation

osc = pytest.importorskip("pythonosc.osc_packet")

UNITY = np.diag([-1.0, 1.0, 1.0])
PARENT = {
    "Spine": "Hips",
    "Chest": "Spine",
    "UpperChest": "Chest",
    "Neck": "UpperChest",
    "Head": "Neck",
    "Jaw": "Head",
    "LeftShoulder": "UpperChest",
    "LeftUpperArm": "LeftShoulder",
    "LeftLowerArm": "LeftUpperArm",
    "LeftHand": "LeftLowerArm",
    "LeftUpperLeg": "Hips",
    "LeftLowerLeg": "LeftUpperLeg",
    "LeftFoot": "LeftLowerLeg",
    "LeftToes": "LeftFoot",
    "LeftEye": "Head",
    **{f"Left{f}Proximal": "LeftHand" for f in ("Thumb", "Index", "Middle", "Ring", "Little")},
    **{
        f"Left{f}Intermediate": f"Left{f}Proximal"
        for f in ("Thumb", "Index", "Middle", "Ring", "Little")
    },
    **{
        f"Left{f}Distal": f"Left{f}Intermediate"
        for f in ("Thumb", "Index", "Middle", "Ring", "Little")
    },
}
"""Unity's humanoid: each bone's parent, as its documentation has them; the right side mirrors."""


def parent(bone):
    if not bone.startswith("Right"):
        return PARENT.get(bone)
    return PARENT["Left" + bone[5:]].replace("Left", "Right")


def received(packets):
    """What another program gets: (address, arguments) of all messages."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(2.0)
        sender = Sender("127.0.0.1", ear.getsockname()[1])
        sender.send(packets)
        found = [osc.OscPacket(ear.recv(65536)) for _ in packets]
        sender.close()
    return [(one.message.address, list(one.message)) for packet in found for one in packet.messages]


def state(body, seed=0):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=body.num_betas),
        0.6 * rng.normal(size=(body.num_joints, 3)),
        rng.normal(size=3),
    )


def at_rest(body, betas):
    return body(betas, np.zeros((body.num_joints, 3)), np.zeros(3)).joints


@pytest.mark.parametrize("up", sorted(UP_AXES))
@pytest.mark.parametrize("family", ["smpl", "smplh", "smplx"])
def test_a_vmc_receiver_has_the_joints_where_the_body_has_them(family, up):
    body = synthetic_body(family)
    betas, pose, trans = state(body)
    poses = VmcPoses(body.joint_names, body.parents, at_rest(body, betas), up)
    messages = received(poses.packets(7, 1.5, pose, trans, 1))
    bones = {one[1][0]: np.array(one[1][1:]) for one in messages if one[0] == "/VMC/Ext/Bone/Pos"}
    world = {None: (np.zeros(3), Rotation.identity())}
    for bone, values in bones.items():  # parents come first
        place, turn = world[parent(bone)]
        world[bone] = (place + turn.apply(values[:3]), turn * Rotation.from_quat(values[3:]))
    joints = body(betas, pose, trans).joints @ up_rotation(up).T @ UNITY
    named = {name: joints[k] for k, name in enumerate(body.joint_names)}
    sent = [name for name in body.joint_names if name in UNITY_BONES]
    assert {UNITY_BONES[name] for name in sent} == set(bones) and len(sent) == {
        "smpl": 22,
        "smplh": 52,
        "smplx": 55,
    }[family]
    for name in sent:
        np.testing.assert_allclose(
            world[UNITY_BONES[name]][0], named[name], atol=1e-5, err_msg=name
        )
    assert dict(messages[:3]) == {
        "/VMC/Ext/OK": [1, 3, 0, 1],
        "/VMC/Ext/T": [1.5],
        "/VMC/Ext/Root/Pos": ["root", 0, 0, 0, 0, 0, 0, 1],
    }


def test_in_unitys_space_the_left_hand_is_at_minus_x_and_a_raised_arm_is_up():
    """Left-handed: who faces +z has the left at -x; and there a turn about +z that lifts the left
    arm is negative.
    """
    body = synthetic_body("smpl")
    names = list(body.joint_names)
    pose = np.zeros((24, 3))
    rest = np.zeros((24, 3))
    for name, place in {
        "left_shoulder": (0.2, 0.5, 0),
        "left_elbow": (0.5, 0.5, 0),
        "left_wrist": (0.8, 0.5, 0),
    }.items():
        rest[names.index(name)] = place
    pose[names.index("left_shoulder")] = (
        0.0,
        0.0,
        np.pi / 2,
    )  # from +x to +y in the body's right-handed axes
    messages = received(
        VmcPoses(names, body.parents, rest, "+y").packets(0, 0.0, pose, np.zeros(3), 1)
    )
    arm = next(np.array(args[1:]) for _, args in messages if args[0] == "LeftUpperArm")
    elbow = next(np.array(args[1:]) for _, args in messages if args[0] == "LeftLowerArm")
    assert elbow[0] < -0.25 and arm[5] < 0
    np.testing.assert_allclose(Rotation.from_quat(arm[3:]).apply(elbow[:3]), [0, 0.3, 0], atol=1e-6)


def test_nobody_has_no_bones():
    body = synthetic_body("smpl")
    betas, pose, trans = state(body)
    poses = VmcPoses(body.joint_names, body.parents, at_rest(body, betas), "+z")
    assert dict(received(poses.packets(1, 0.5, pose * np.nan, trans * np.nan, -1))) == {
        "/VMC/Ext/OK": [1, 3, 0, 0],
        "/VMC/Ext/T": [0.5],
    }
    assert received(OscPoses(body.joint_names).packets(3, 0.5, pose * np.nan, trans, -1)) == [
        ("/habitus/frame", [3, -1, 0.5])
    ]


def test_osc_tells_every_joint_in_the_bodys_axes():
    body = synthetic_body("smplh")
    _, pose, trans = state(body)
    messages = received(OscPoses(body.joint_names).packets(12, 2.0, pose, trans, 1))
    assert messages[0] == ("/habitus/frame", [12, 1, 2.0])
    np.testing.assert_allclose(messages[1][1], trans, rtol=1e-6)
    assert [args[0] for _, args in messages[2:]] == list(body.joint_names)
    turns = Rotation.from_quat([args[1:] for _, args in messages[2:]])
    np.testing.assert_allclose((turns * Rotation.from_rotvec(pose).inv()).magnitude(), 0, atol=1e-6)


def test_no_datagram_is_cut_in_pieces_and_filling_takes_no_time():
    body = synthetic_body("smplx")
    betas, pose, trans = state(body)
    poses = VmcPoses(body.joint_names, body.parents, at_rest(body, betas), "+z")
    taken = []
    for _ in range(30):
        began = time.perf_counter()
        packets = poses.packets(1, 0.5, pose, trans, 1)
        taken.append(time.perf_counter() - began)
    assert max(map(len, packets)) <= 1400 and min(taken) < 1e-3


def test_texts_and_numbers_are_where_osc_wants_them():
    (data,) = Bundles([Message("/ab", "sif", ("abc",))]).filled([0.5], [-2])
    assert data == (
        b"#bundle\0" + b"\0" * 7 + b"\x01" + b"\0\0\0\x18" + b"/ab\0" + b",sif\0\0\0\0" + b"abc\0"
        + b"\xff\xff\xff\xfe" + b"\x3f\0\0\0"
    )  # fmt: skip


def test_a_host_that_nobody_knows_is_told():
    with pytest.raises(HabitusError, match="no host"):
        Sender("no such host.invalid", 9000)
