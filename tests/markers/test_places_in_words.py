"""Places in words: a landmark is itself, any other vertex is near to what is said, on its own side."""

import numpy as np
import pytest

from habitus.io.models.bodies import load_body
from habitus.markers.layouts import MarkerLayout, place_in_words


@pytest.fixture(scope="module")
def body():
    return load_body("default")


@pytest.mark.parametrize("name", ["left_asis", "c7", "right_elbow_lateral", "left_heel"])
def test_a_landmark_is_called_by_a_landmark_there(body, name):
    said = place_in_words(body, body.landmarks[name])
    template = np.asarray(body.v_template)
    assert said.between is None
    assert (
        np.linalg.norm(template[body.landmarks[said.landmark]] - template[body.landmarks[name]])
        < 0.012
    )


def test_any_vertex_is_said_to_within_centimetres_and_on_its_side(body):
    template = np.asarray(body.v_template)
    for vertex in np.random.default_rng(0).integers(len(template), size=25):
        said = place_in_words(body, int(vertex))
        place = template[MarkerLayout("one", (said,)).vertices(body)[0]]
        assert np.linalg.norm(place - template[vertex]) < 0.04, said.place
        assert (
            abs(place[0]) < 0.03
            or place[0] * template[vertex][0] > 0
            or abs(template[vertex][0]) < 0.03
        )


def test_a_body_without_landmarks_has_vertices():
    class Bare:
        name, landmarks, v_template = "bare", {}, np.zeros((5, 3))

    assert place_in_words(Bare(), 3).vertex == 3
