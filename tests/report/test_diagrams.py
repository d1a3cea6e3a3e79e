"""The picture of a measured person."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from synthetic import synthetic_body

from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.report.diagrams import tape_picture


def test_every_tape_is_drawn_and_every_measurement_told():
    body = load_body("default")
    found = body.measure()
    drawing = tape_picture(body, body.v_template, found)
    root = ET.fromstring(drawing)
    said = ["".join(each.itertext()) for each in root.iter("{http://www.w3.org/2000/svg}text")]
    assert len(said) == len(found)
    assert "Waist 93.3 cm" in said or f"Waist {100 * found['waist_circumference_m']:.1f} cm" in said
    width, height = (float(root.get(key)) for key in ("width", "height"))
    lines = [
        each
        for each in root.iter("{http://www.w3.org/2000/svg}path")
        if each.get("stroke-width") == "2"
    ]
    rings = sum(len(tape.rings) for tape in body.measuring_kit.tapes)
    assert len(lines) >= rings
    for line in lines:
        points = np.array(re.findall(r"[ML]([\d.-]+) ([\d.-]+)", line.get("d")), float)
        assert len(points) and (points > 0).all() and (points < [width, height]).all()


def test_a_hand_has_no_tapes():
    with pytest.raises(HabitusError, match="no tapes"):
        tape_picture(replace(synthetic_body("mano", 60), name="hand"), np.zeros((60, 3)), {})
