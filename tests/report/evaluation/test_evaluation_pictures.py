"""Pictures of turned heads: the neck is in them, whether it stands upright or lies, as an
animal's.
"""

from dataclasses import replace

import numpy as np

from habitus.evaluate.neck_twist import neck_vertices, turned_head, twist_axis
from habitus.io.models.bodies import load_body
from habitus.report import drawing
from habitus.report.evaluation.pictures import head_view
from habitus_lab.population.coarse_bodies import coarse_body


def test_a_neck_is_seen_from_across_whatever_way_it_points():
    person = coarse_body(load_body("default"), 450)
    lying = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the head towards +z, as an animal's
    animal = replace(
        person,
        v_template=person.v_template @ lying.T,
        shapedirs=np.einsum("ij,vjb->vib", lying, person.shapedirs),
    )
    for body in (person, animal):
        rows = neck_vertices([body])
        surface, _ = turned_head(body, 70, rows)
        towards, frame = head_view(body, rows)
        assert abs(twist_axis(body) @ towards) < 0.5 * np.linalg.norm(towards)
        colours = np.zeros((len(surface), 3))
        colours[rows, 0] = 1.0
        axes = drawing.axes_from(towards)
        image = drawing.picture(surface, body.faces, colours, axes, frame=frame).astype(float)
        covered = image[..., 3] > 128
        assert 0.15 < covered.mean() < 0.9  # neither nothing nor a slab
        assert (
            covered & (image[..., 0] > 60)
        ).sum() > 0.04 * covered.sum()  # of which the neck is a part
