"""A motion as USD: UsdSkel, USD's own code, makes the fit's surface of it, and USD's validators
find nothing.
"""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body
from two_levels import write_two_levels

from habitus.errors import HabitusError
from habitus.export.obj import fitted_vertices
from habitus.export.usd import write_usd
from habitus.io.models.bodies import load_body
from habitus.rotations import up_rotation

pytest.importorskip("pxr", reason="no usd-core here: pip install 'habitus[usd]'")
from pxr import Usd, UsdGeom, UsdValidation
from read_usd import skinned

FRAMES = (0, 7, 19)


@pytest.mark.parametrize(
    ("soft", "posedirs", "ending"), [(1, 1, "usdc"), (0, 1, "usda"), (1, 0, "usdz"), (0, 0, "usd")]
)
def test_usd_shows_the_fit(tmp_path, soft, posedirs, ending):
    fit = synthetic_fit(20, soft=bool(soft), body=tube_body(posedirs=bool(posedirs)), up_axis="-x")
    write_usd(fit, tmp_path / f"a.{ending}")
    assert [path.name for path in tmp_path.iterdir()] == [f"a.{ending}"]
    stage = Usd.Stage.Open(str(tmp_path / f"a.{ending}"))
    turn = up_rotation(fit.up_axis)
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == fit.rate_hz and stage.GetEndTimeCode() == 19
    extent = UsdGeom.Boundable.Get(stage, "/person").GetExtentAttr()
    for frame, expected in zip(FRAMES, fitted_vertices(fit, FRAMES), strict=True):
        points = skinned(stage, frame)
        assert np.linalg.norm(points - expected @ turn.T, axis=1).max() < 1.2e-4
        least, most = np.array(extent.Get(frame))
        assert (points > least).all() and (points < most).all()


def test_validators_find_nothing(tmp_path):
    body = replace(
        load_body(write_two_levels(tmp_path / "made_up.npz"), joints="smpl"), mirror=None
    )
    fit = synthetic_fit(4, body=body, capture_name="walk / 01")
    write_usd(fit, tmp_path / "a b.usdz")
    stage = Usd.Stage.Open(str(tmp_path / "a b.usdz"))
    found = UsdValidation.ValidationContext(
        UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    ).Validate(stage)
    assert not [f"{error.GetName()}: {error.GetMessage()}" for error in found]
    mesh = UsdGeom.Mesh.Get(stage, "/person/body")
    full = fit.finest_body
    assert np.array_equal(
        np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4), full.mesh.quads
    )
    uv = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
    assert np.allclose(np.array(uv).reshape(-1, 4, 2), full.mesh.uv[full.mesh.quad_uv], atol=1e-6)


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(HabitusError, match=r"habitus\[usd\]"):
        write_usd(synthetic_fit(2), tmp_path / "a.usdc")
