"""People with hair that is part of the scanned surface."""

from dataclasses import replace

import numpy as np
import pytest
from page_samples import registered

from habitus.fit.points.clothes import hair_notes
from habitus.fit.points.settings import SCANS
from habitus.fit.points.skin_offsets import scalp
from habitus.mesh.normals import vertex_normals
from habitus.results.save import scan_metrics


def test_height_and_head_are_measured_under_the_hair():
    bald = registered("bald")
    model = bald.model_vertices
    bald = replace(bald, vertices=model, rest_vertices=model)
    hair = 0.04 * scalp(bald.body, SCANS.hair.hairline)
    grown = model + hair[:, None] * vertex_normals(model, bald.body.faces)
    surface = replace(bald, vertices=grown, rest_vertices=grown)
    known = replace(surface, hair=hair)
    for name in ("height_m", "waist_circumference_m"):
        assert known.measurements[name] == pytest.approx(bald.measurements[name], abs=1e-4)
    for name, least in (("height_m", 0.03), ("head_circumference_m", 0.1)):
        assert known.measurements[name] == pytest.approx(bald.measurements[name], abs=0.005)
        assert surface.measurements[name] > bald.measurements[name] + least
    assert np.abs(known.skin_offset).max() < 0.01
    assert scan_metrics(known)["hair_mm"] == pytest.approx(40.0)
    assert scan_metrics(surface)["hair_mm"] == 0.0


def test_a_note_says_how_thick_the_hair_is():
    (note,) = hair_notes(np.array([0.0, 0.021]))
    assert "2 cm" in note and "without it" in note
