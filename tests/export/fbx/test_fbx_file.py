"""A motion as FBX: what a reader makes of it is the fit's surface, and another program's parser
agrees.
"""

from dataclasses import replace

import numpy as np
import pytest
from read_fbx import TICKS, Fbx
from synthetic_fit import synthetic_fit, tube_body
from two_levels import write_two_levels

from habitus.errors import HabitusError
from habitus.export.fbx.write import write_fbx
from habitus.export.obj import fitted_vertices
from habitus.io.models.bodies import load_body
from habitus.rotations import up_rotation

FRAMES = (0, 7, 19)


@pytest.mark.parametrize("correctives", ["auto", "all"])
@pytest.mark.parametrize(
    ("soft", "posedirs"), [(True, True), (False, True), (True, False), (False, False)]
)
def test_the_file_shows_the_fit(tmp_path, soft, posedirs, correctives):
    fit = synthetic_fit(20, soft=soft, body=tube_body(posedirs=posedirs))
    written = write_fbx(fit, tmp_path / "a.fbx", correctives=correctives)
    found = Fbx(tmp_path / "a.fbx")
    turn = up_rotation(fit.up_axis)
    assert bool(written.morph_names) == (soft or posedirs)
    for frame, expected in zip(FRAMES, fitted_vertices(fit, FRAMES), strict=True):
        away = np.linalg.norm(found.vertices(frame) - expected @ turn.T, axis=1)
        assert away.max() < (1.2e-4 if correctives == "auto" else 2e-5)


def test_live_channels_are_the_bodys_own_and_none_leaves_all_out(tmp_path):
    fit = synthetic_fit(5, soft=False, body=tube_body(posedirs=True))
    written = write_fbx(fit, tmp_path / "a.fbx", correctives="all")
    name = "left_knee_xy"
    knee = fit.body.drivers.index(fit.body.joint_names.index("left_knee"))
    shape = written.morphs[written.morph_names.index(name)]
    assert np.allclose(shape, 2 * fit.body.posedirs[..., 9 * knee + 1], atol=1e-6)
    back = written.morphs[written.morph_names.index(f"{name}_back")]
    assert np.array_equal(back, -shape)
    bare = write_fbx(fit, tmp_path / "b.fbx", correctives="none")
    assert bare.morph_names == () and bare.morph_worst > 1e-3
    away = np.linalg.norm(
        Fbx(tmp_path / "b.fbx").vertices(3) - fit.vertices(3) @ up_rotation("+z").T, axis=1
    ).max()
    assert away == pytest.approx(bare.morph_worst, rel=0.3)


def test_settings_skeleton_and_take(tmp_path):
    fit = synthetic_fit(6, rate_hz=119.88)
    write_fbx(fit, tmp_path / "a.fbx")
    found = Fbx(tmp_path / "a.fbx")
    assert found.up == 1 and found.metres == pytest.approx(0.01)
    settings = found.top["GlobalSettings"]
    assert settings.prop("TimeMode") == [14] and settings.prop("CustomFrameRate") == [119.88]
    assert settings.prop("TimeSpanStop")[0] == pytest.approx(5 / 119.88 * TICKS, abs=1)
    assert [limb.values[1].split("\0")[0] for limb in found.limbs()] == list(fit.body.joint_names)
    (stack,) = (o for o in found.objects.values() if o.name == "AnimationStack")
    assert stack.values[1].startswith("walk\0") and stack.prop("LocalStop") == settings.prop(
        "TimeSpanStop"
    )
    counted = {
        d.values[0]: d["Count"].values[0] for d in found.top["Definitions"].all("ObjectType")
    }
    kinds = [o.name for o in found.objects.values()]
    assert counted == {"GlobalSettings": 1} | {kind: kinds.count(kind) for kind in set(kinds)}
    first = (tmp_path / "a.fbx").read_bytes()
    write_fbx(fit, tmp_path / "a.fbx")
    assert (tmp_path / "a.fbx").read_bytes() == first


def test_quads_and_texture_coordinates_of_the_full_level(tmp_path):
    body = replace(
        load_body(write_two_levels(tmp_path / "made_up.npz"), joints="smpl"), mirror=None
    )
    fit = synthetic_fit(3, body=body)
    write_fbx(fit, tmp_path / "a.fbx")
    found = Fbx(tmp_path / "a.fbx")
    full = fit.finest_body
    corners = found.geometry["PolygonVertexIndex"].values[0].reshape(-1, 4)
    assert (corners[:, :3] >= 0).all() and np.array_equal(
        np.c_[corners[:, :3], ~corners[:, 3]], full.mesh.quads
    )
    layer = found.geometry["LayerElementUV"]
    uv = layer["UV"].values[0].reshape(-1, 2)[layer["UVIndex"].values[0]].reshape(-1, 4, 2)
    assert np.allclose(uv, full.mesh.uv[full.mesh.quad_uv])
    (expected,) = fitted_vertices(fit, [2], body=full)
    assert np.abs(found.vertices(2) - expected @ up_rotation(fit.up_axis).T).max() < 1.2e-4
    write_fbx(fit, tmp_path / "b.fbx", detail="coarse")
    assert len(Fbx(tmp_path / "b.fbx").vertices(0)) == fit.body.num_vertices
    with pytest.raises(HabitusError, match="expected full, parts or coarse"):
        write_fbx(fit, tmp_path / "c.fbx", detail="fine")


def test_ufbx_reads_it(tmp_path):
    ufbx = pytest.importorskip("ufbx", reason="no pyufbx here: pip install pyufbx")
    fit = synthetic_fit(12, body=tube_body(posedirs=True), rate_hz=120.0)
    written = write_fbx(fit, tmp_path / "a.fbx")
    with ufbx.load_file(str(tmp_path / "a.fbx")) as scene:
        told = scene.settings
        assert (
            told.unit_meters == pytest.approx(0.01)
            and told.frames_per_second == 120
            and told.axes.up == 2
        )
        (mesh,), (stack,) = scene.meshes, scene.anim_stacks
        assert (mesh.num_vertices, mesh.num_faces) == (fit.body.num_vertices, len(fit.body.faces))
        channels = mesh.blend_deformers[0].channels
        assert [channel.name for channel in channels] == list(written.morph_names)
        clusters = mesh.skin_deformers[0].clusters
        assert sum(c.num_weights for c in clusters) == (fit.body.skinning_weights > 0).sum()
        assert (stack.name, stack.time_begin) == ("walk", 0.0) and stack.time_end == pytest.approx(
            11 / 120
        )
        limbs = [scene.find_node(name) for name in fit.body.joint_names]
        assert all((limb.parent.name or None) for limb in limbs[1:])
        for limb, parent in zip(limbs[1:], fit.body.parents[1:], strict=True):
            assert limb.parent.name == fit.body.joint_names[parent]
