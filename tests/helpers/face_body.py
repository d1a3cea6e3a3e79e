"""A body with a face that was drawn at random."""

from dataclasses import replace

import numpy as np

from habitus.body.face import Face

JAW = "jaw"
EYE = "left_eye_smplhf"


def with_face(body):
    """A body whose face was drawn at random: two units, of which one turns the jaw, one an eye."""
    rng = np.random.default_rng(3)
    head = np.flatnonzero(body.skinning_weights[:, body.joint_names.index("head")] > 0.5)[::3]
    turned = [body.joint_names.index(name) for name in (JAW, EYE)]
    carried = np.flatnonzero(body.skinning_weights[:, turned].any(axis=1))
    vertices = np.union1d(head, carried)
    turns = np.zeros((3, 2, 3))
    turns[1, 0] = [0.35, 0, 0]
    turns[2, 1] = [0.1, 0.2, 0]
    face = Face(
        vertices,
        ("smile", "jawOpen", "eyeLookOutLeft"),
        0.004 * rng.normal(size=(len(vertices), 3, 3)),
        tuple(turned),
        turns,
        0.002 * rng.normal(size=(len(vertices), 3, 4)),
    )
    return replace(body, face=face, finer=None, full_vertices=None)
