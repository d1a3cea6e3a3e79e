"""Face units as blend shapes of files: named, whole at full weight, and moved where a motion says."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from face_body import with_face

from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.animation import animate, one_sided
from habitus.export.faces import with_face as with_shapes
from habitus.export.motion import export_motion, write_motion
from habitus.io.models.bodies import load_body, save_body
from habitus.io.people import read_motion

FRAMES = 4


@pytest.fixture(scope="module")
def motion():
    body = with_face(load_body("female", joints="smplx"))
    rng = np.random.default_rng(0)
    pose = np.zeros((FRAMES, body.num_joints, 3))
    pose[:, 4, 0] = np.linspace(0, 0.5, FRAMES)
    face = rng.uniform(0, 1, (FRAMES, 3))
    given = body, np.zeros(body.num_betas), pose, np.zeros((FRAMES, 3)), 30.0, "+y"
    return BodyMotion(*given, face=face, body_name="female")


def test_a_blend_shape_at_full_weight_is_the_unit(motion):
    animation = with_shapes(one_sided(animate(motion, correctives="none")), motion.face)
    body = motion.body
    assert animation.morph_names[-3:] == body.face_unit_names
    for k, name in enumerate(body.face_unit_names):
        moved = animation.rest_vertices + animation.morphs[len(animation.morphs) - 3 + k]
        expected = body(motion.betas, face={name: 1.0}).vertices
        np.testing.assert_allclose(moved, expected, atol=1e-7)
    np.testing.assert_allclose(animation.tracks[0].morph_weights[:, -3:], motion.face)


def test_glb_names_them(motion, tmp_path):
    export_motion(motion, tmp_path / "a.glb", face=True, correctives="none")
    export_motion(motion, tmp_path / "b.glb", correctives="none")
    content = (tmp_path / "a.glb").read_bytes()
    document = json.loads(content[20 : 20 + struct.unpack_from("<I", content, 12)[0]])
    mesh = document["meshes"][0]
    assert mesh["extras"]["targetNames"] == list(motion.body.face_unit_names)
    assert len(mesh["primitives"][0]["targets"]) == 3
    assert any(c["target"]["path"] == "weights" for c in document["animations"][0]["channels"])
    assert (tmp_path / "b.glb").stat().st_size < (tmp_path / "a.glb").stat().st_size


def test_fbx_and_usd_take_them(motion, tmp_path):
    export_motion(motion, tmp_path / "a.fbx", face=True, correctives="none")
    assert b"eyeLookOutLeft" in (tmp_path / "a.fbx").read_bytes()
    pytest.importorskip("pxr")
    export_motion(motion, tmp_path / "a.usda", face=True, correctives="none")
    assert "jawOpen" in (tmp_path / "a.usda").read_text()


def test_weights_travel_in_the_npz_and_at_another_rate(motion, tmp_path):
    save_body(motion.body, tmp_path / "body.npz")
    write_motion(motion, tmp_path / "motion.npz")
    again = read_motion(tmp_path / "motion.npz", load_body(tmp_path / "body.npz"))
    np.testing.assert_array_equal(again.face, motion.face)
    np.testing.assert_allclose(again.vertices(2), motion.vertices(2), atol=1e-6)
    plain = replace(motion, face=None)
    assert np.abs(plain.vertices(2) - motion.vertices(2)).max() > 1e-3


def test_a_body_without_units_is_named(motion, tmp_path):
    plain = replace(motion, body=replace(motion.body, face=None), face=None)
    with pytest.raises(HabitusError, match="has no face units to write"):
        export_motion(plain, tmp_path / "a.glb", face=True)
