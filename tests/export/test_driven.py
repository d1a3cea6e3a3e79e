"""The file beside a file: with it bones drive blend shapes in poses that the file's motion has
not.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body

from habitus.export.animation import Animation, animate, one_sided
from habitus.export.driven import write_drivers
from habitus.export.motion import export_motion
from habitus.rotations import matrix_from_rotvec


def in_a_file(fit, correctives: str) -> Animation:
    return one_sided(animate(fit, correctives=correctives))


@pytest.mark.parametrize("correctives", ["all", "live:207"])
def test_other_poses_get_their_own_correctives(tmp_path, correctives):
    fit = synthetic_fit(4, soft=False, body=tube_body(posedirs=True))
    rng = np.random.default_rng(5)
    animation = in_a_file(fit, correctives)
    told = json.loads(write_drivers(animation, tmp_path / "a.fbx").read_text())
    assert [joint["name"] for joint in told["joints"]] == list(fit.body.joint_names)
    assert np.allclose([joint["rest"] for joint in told["joints"]], animation.rest_joints)
    turns = matrix_from_rotvec(rng.normal(0, 1.0, (fit.body.num_joints, 3)))
    found = np.zeros(animation.morphs.shape[1:])
    reached = []
    for channel in told["channels"]:
        turn = turns[fit.body.joint_names.index(channel["joint"])] - np.eye(3)
        weight = min(1.0, max(0.0, float(np.dot(channel["row"], turn.ravel()))))
        reached.append(weight)
        found += weight * animation.morphs[animation.morph_names.index(channel["name"])]
    known = fit.body.posedirs @ np.concatenate(
        [(turns[j] - np.eye(3)).ravel() for j in fit.body.drivers]
    )
    assert np.abs(found - known).max() < 1e-5
    assert 0.5 < max(reached) <= 1


def test_the_same_channels_for_every_motion_of_a_body(tmp_path):
    body = tube_body(posedirs=True)
    files = []
    for frames in (3, 6):
        animation = in_a_file(synthetic_fit(frames, soft=False, body=body), "live:24")
        files.append(write_drivers(animation, tmp_path / "a.fbx").read_text())
    assert files[0] == files[1] and 24 <= len(json.loads(files[0])["channels"]) <= 48


def test_a_person_who_stands_still_can_be_posed_as_well():
    fit = synthetic_fit(4, soft=False, body=tube_body(posedirs=True))
    still = replace(fit, pose=np.zeros_like(fit.pose))
    counts = [len(in_a_file(moving, "all").morph_names) for moving in (fit, still)]
    assert counts == [23 * 15, 23 * 15]  # nine entries, six of which a rotation moves both ways


def test_files_without_driven_channels_have_nothing_beside_them(tmp_path):
    fit = synthetic_fit(4, body=tube_body(posedirs=True))
    assert write_drivers(in_a_file(fit, "auto"), tmp_path / "a.fbx") is None and not [
        *tmp_path.iterdir()
    ]
    told = export_motion(fit, tmp_path / "a.glb", correctives="live:9")
    assert told.drivers == tmp_path / "a.correctives.json" and told.drivers.exists()
