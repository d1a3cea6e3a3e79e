"""What colours of scans came to is written: albedo on the surface, numbers, and pictures in the
report.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

import habitus
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_result import ScanColours, ScanFit
from habitus.fit.points.skin_grid import SkinGrid
from habitus.io.people import read_shape
from habitus.io.scans import read_scan
from habitus.jobs.register import ScanResult
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.painted_skin import PaintedSkin


@pytest.fixture(scope="module")
def fit() -> ScanFit:
    body = coarse_body(habitus.load_body("default"), 400)
    betas = np.zeros(body.num_betas)
    pose = np.zeros((body.num_joints, 3))
    surface = np.asarray(body(betas, pose).vertices)
    away = np.full(len(surface), 0.001)
    return ScanFit(
        "anna",
        "default",
        body,
        betas,
        pose,
        np.zeros(3),
        surface,
        surface,
        surface,
        np.ones(len(surface)),
        Cloud(surface, vertex_normals(surface, body.faces)),
        away,
        away,
        away,
        matched=1.0,
        lost=0.0,
        rival=None,
        pose_distance=0.5,
        to_body=np.eye(4),
        up_axis="+y",
    )


def test_a_scan_with_colours_is_saved_with_them(fit, tmp_path):
    grid = SkinGrid.of(fit.body.faces, 2)
    albedo = 0.5 * np.random.default_rng(0).uniform(size=(grid.size, 3))
    told = replace(
        fit, colours=ScanColours(grid, albedo, np.full(grid.size, 0.1), 0.2, 0.12, 0.0004)
    )
    ScanResult.of(told).save(tmp_path / "anna")
    numbers = json.loads((tmp_path / "anna" / "metrics.json").read_text())["colours"]
    assert numbers == {
        "difference_before": 0.2,
        "difference_after": 0.12,
        "surface_shift_mm": pytest.approx(0.4),
    }
    page = (tmp_path / "anna" / "report.html").read_text()
    assert "0.200" in page and "<h2>Colours</h2>" in page
    again = read_scan(tmp_path / "anna" / "surface.glb")
    assert len(again.points) == grid.size
    np.testing.assert_allclose(
        again.colours, (0.9 * albedo / np.percentile(albedo, 99.5)).clip(0, 1), atol=0.01
    )


def test_a_scan_without_colours_says_nothing_of_them(fit, tmp_path):
    ScanResult.of(fit).save(tmp_path / "anna")
    assert json.loads((tmp_path / "anna" / "metrics.json").read_text())["colours"] is None
    assert "<h2>Colours</h2>" not in (tmp_path / "anna" / "report.html").read_text()


def test_natural_and_painted_skin_have_as_much_colour_as_they_should():
    body = habitus.load_body("default")
    corners = body.faces[:4000]
    share = np.full((4000, 3), 1 / 3)
    plain, painted = (
        PaintedSkin.of(body, np.random.default_rng(0), one).albedo(corners, share)
        for one in (False, True)
    )
    assert ((plain > 0) & (plain < 1)).all() and painted.std() > plain.std()
    again = PaintedSkin.of(body, np.random.default_rng(0)).albedo(corners, share)
    np.testing.assert_array_equal(plain, again)


def test_the_person_of_a_saved_scan_has_its_surface_and_not_the_models(fit, tmp_path):
    normals = vertex_normals(fit.rest_vertices, fit.body.faces)
    outwards = replace(fit, rest_vertices=fit.rest_vertices + 0.01 * normals)
    ScanResult.of(outwards).save(tmp_path / "anna")
    shape = read_shape(tmp_path / "anna", fit.body)
    np.testing.assert_allclose(shape.rest_vertices(), outwards.rest_vertices, atol=1e-6)
