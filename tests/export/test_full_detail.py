"""What is fitted on a coarse mesh is shown on the full one: the same person, with quads and a
texture's coordinates.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from read_glb import Glb
from synthetic_fit import synthetic_fit
from two_levels import write_two_levels

from habitus.body.surface_files import write_surface
from habitus.export import write_glb, write_obj_sequence
from habitus.export.obj import fitted_vertices
from habitus.io.models.bodies import load_body
from habitus.report import write_report
from habitus.results.save import marker_metrics
from habitus.rotations import up_rotation


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    path = write_two_levels(tmp_path_factory.mktemp("bodies") / "made_up.npz")
    body = replace(
        load_body(path, joints="smpl"), mirror=None
    )  # it has no middle to be measured at
    return synthetic_fit(frames=6, body=body)


def test_files_show_the_full_body_and_the_fit_keeps_the_coarse_one(fit, tmp_path):
    full = fit.finest_body
    assert full.num_vertices > fit.body.num_vertices == fit.vertices(0).shape[0]
    write_glb(fit, tmp_path / "a.glb", correctives="all")
    glb = Glb(tmp_path / "a.glb")
    turn = up_rotation(fit.up_axis)
    attributes = glb.json["meshes"][0]["primitives"][0]["attributes"]
    uv = glb.array(attributes["TEXCOORD_0"])
    corners = glb.array(glb.json["meshes"][0]["primitives"][0]["indices"]).ravel().reshape(-1, 3)
    for frame, expected in zip((0, 5), fitted_vertices(fit, (0, 5), body=full), strict=True):
        assert (
            np.abs(
                glb.vertices(frame / fit.rate_hz)[corners] - (expected @ turn.T)[full.faces]
            ).max()
            < 1e-4
        )
        assert np.abs(expected[fit.body.full_vertices] - fit.vertices(frame)).max() < 1e-6
    half = len(full.mesh.quads)
    known = full.mesh.uv[full.mesh.quad_uv[:, [0, 1, 2]]] * [1, -1] + [0, 1]
    assert np.abs(uv[corners[:half]] - known).max() < 1e-6
    write_report(fit, tmp_path / "report.html", marker_metrics(fit), ())
    assert (tmp_path / "report.html").stat().st_size < 2_000_000


def test_meshes_have_the_bodys_quads(fit, tmp_path):
    full = fit.finest_body
    text = write_obj_sequence(fit, tmp_path, [2])[0].read_text("ascii").splitlines()
    quads = [
        [tuple(map(int, corner.split("/"))) for corner in line.split()[1:]]
        for line in text
        if line[:2] == "f "
    ]
    assert np.array_equal(np.array(quads)[..., 0] - 1, full.mesh.quads)
    assert np.array_equal(np.array(quads)[..., 1] - 1, full.mesh.quad_uv)
    places = np.array(
        [list(map(float, line.split()[1:])) for line in text if line.startswith("vt ")]
    )
    assert np.abs(places - full.mesh.uv).max() < 1e-6
    known = next(fitted_vertices(fit, [2], body=full))
    points = np.array(
        [list(map(float, line.split()[1:])) for line in text if line.startswith("v ")]
    )
    assert np.abs(points - known).max() < 1e-6


@pytest.mark.parametrize("ending", [".obj", ".glb", ".ply"])
def test_a_surface_takes_its_quads_along(fit, ending, tmp_path):
    full = fit.finest_body
    write_surface(full(), tmp_path / f"a{ending}")
    mesh = trimesh.load(tmp_path / f"a{ending}", process=False, force="mesh")
    corners = np.asarray(mesh.vertices)[mesh.faces]
    assert len(corners) == len(full.faces)
    centre = lambda points: np.sort(points.reshape(-1, 3).mean(0))  # noqa: E731
    assert np.abs(centre(corners) - centre(full.v_template[full.faces])).max() < 0.05
    if ending == ".obj":
        assert "/" in (tmp_path / "a.obj").read_text().splitlines()[-1]
    if ending == ".glb":
        assert (
            "TEXCOORD_0" in Glb(tmp_path / "a.glb").json["meshes"][0]["primitives"][0]["attributes"]
        )
