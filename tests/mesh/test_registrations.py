from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template

FACES = np.array([[0, 1, 2], [0, 2, 3]])
SEX = {"ann": "female", "bob": "male", "cat": ""}


def registrations(subject=("ann", "bob", "ann", "cat"), **changed):
    n = len(subject)
    words = {
        "vertices": np.arange(n * 12, dtype=np.float32).reshape(n, 4, 3),
        "faces": FACES,
        "subject": tuple(subject),
        "sex": tuple(SEX[word] for word in subject),
        "set": tuple(("pose", "shape", "test")[k % 3] for k in range(n)),
        "name": tuple(f"scan {k}" for k in range(n)),
    }
    return Registrations(**(words | changed))


names = st.sampled_from(sorted(SEX))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(names, max_size=12),
    st.lists(names, max_size=3),
    st.sampled_from(["pose", "shape", "test"]),
)
def test_a_choice_keeps_order_and_words_and_choices_of_choices_commute(subject, chosen, which):
    whole = registrations(subject)
    kept = [k for k in range(len(subject)) if subject[k] in chosen and whole.set[k] == which]
    for found in (
        whole.where(subject=chosen, set=which),
        whole.where(subject=chosen).where(set=which),
        whole.where(set=which).where(subject=chosen),
        whole.take(np.array(kept, dtype=int)),
    ):
        assert found.name == tuple(whole.name[k] for k in kept) and len(found) == len(kept)
        assert found.vertices.shape == (len(kept), 4, 3)
        for place, k in enumerate(kept):
            assert np.array_equal(found.read(place), whole.vertices[k])
            assert (found.subject[place], found.sex[place]) == (whole.subject[k], whole.sex[k])


@settings(max_examples=60, deadline=None)
@given(st.lists(names, min_size=1, max_size=12))
def test_subjects_are_numbered_as_they_appear(subject):
    whole = registrations(subject)
    assert [whole.subjects[k] for k in whole.subject_index] == subject
    assert [int(k) for k in dict.fromkeys(whole.subject_index.tolist())] == list(
        range(len(whole.subjects))
    )
    assert whole.subject_sex == tuple(SEX[word] for word in whole.subjects)


def test_choices_read_only_what_is_asked_for():
    class Counting:
        shape, read = (4, 4, 3), []

        def __getitem__(self, rows):
            self.read.append(rows)
            return np.zeros((4, 4, 3))[rows]

    chosen = (
        registrations(vertices=Counting())
        .where(subject="ann")
        .where(sex="female")
        .take(np.array([1, 0]))
    )
    assert Counting.read == []
    assert chosen.read(0).shape == (4, 3) and Counting.read == [2]
    assert chosen.vertices[:].shape == (2, 4, 3) and Counting.read[1].tolist() == [2, 0]


def test_reading_gives_a_copy_in_double_precision():
    whole = registrations()
    vertices = whole.read(1)
    assert vertices.dtype == np.float64
    vertices += 1
    assert np.array_equal(whole.read(1), whole.vertices[1])


@pytest.mark.wrong_shapes
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"vertices": np.zeros((4, 12))}, r"shape \(4, 12\)"),
        ({"vertices": np.zeros((3, 4, 3))}, "4 words of 'subject' for 3"),
        ({"sex": ("f",) * 4}, "scan 0: its sex is 'f'"),
        ({"set": ("pose", "pose", "train", "pose")}, "scan 2: its set is 'train'"),
        ({"faces": np.array([[0, 1, 4]])}, "faces name vertices 0 to 4; expected 0 to 3"),
        ({"faces": np.array([[0, 1, -1]])}, "faces name vertices -1 to 1"),
        ({"faces": FACES.astype(float)}, "float64"),
        ({"faces": np.zeros((0, 3), int)}, r"shape \(0, 3\)"),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused(changed, message):
    with pytest.raises(HabitusError, match=message):
        registrations(**changed)


def test_rows_out_of_range_are_refused():
    with pytest.raises(HabitusError, match="4 to 4 asked for; expected 0 to 3"):
        registrations().take(np.array([4]))


def template(**changed):
    words = {
        "vertices": np.random.default_rng(0).normal(size=(4, 3)),
        "faces": FACES,
        "part": np.array([0, 0, 2, 2]),
        "parents": (-1, 0, 1),
        "joint_names": ("root", "middle", "end"),
    }
    return Template(**(words | changed))


def test_joints_without_vertices_are_told():
    assert template().empty_joints == ("middle",)
    assert (
        template().part_vertices(2).tolist() == [2, 3]
        and template().part_vertices(1).tolist() == []
    )


@pytest.mark.wrong_shapes
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"vertices": np.full((4, 3), np.inf)}, "4 of the template's vertices .* are not finite"),
        ({"vertices": np.zeros((4, 2))}, r"\(4, 2\); expected numbers \(V, 3\)"),
        ({"vertices": np.zeros((4, 3), int)}, "int64"),
        ({"faces": FACES + 2}, "faces name vertices 2 to 5"),
        ({"part": np.array([0, 0, 2, 3])}, "part runs from 0 to 3; expected 0 to 2"),
        ({"part": np.array([0.0, 0, 2, 2])}, "part is float64"),
        ({"part": np.zeros(3, int)}, "expected 4 whole numbers"),
        ({"parents": (-1, 2, 1)}, "parent of joint 1 is 2"),
        ({"parents": (0, 0, 1)}, "joint 0 is the root"),
        ({"joint_names": ("root", "end", "end")}, "3 distinct ones"),
        ({"mirror": np.array([1, 2, 0, 3])}, "pairs 0 with 1 but 1 with another"),
        ({"joint_mirror": np.array([0, 1])}, "joint_mirror is int64"),
    ],
)  # fmt: skip
def test_a_template_whose_arrays_do_not_fit_together_is_refused(changed, message):
    with pytest.raises(HabitusError, match=message) as refused:
        template(**changed)
    assert "\n" not in str(refused.value)


def test_holes_and_weights_go_with_their_registrations():
    whole = registrations()
    vertices = whole.vertices.astype(float).copy()
    vertices[2, 1] = np.nan
    each = np.random.default_rng(0).random(vertices.shape[:2])
    each[1, 3] = 0.0
    for weights in (None, each[0], each):
        chosen = replace(whole, vertices=vertices, weights=weights).take(np.array([2, 1]))
        for place, k in enumerate((2, 1)):
            expected = (
                np.ones(4) if weights is None else np.where(weights.ndim == 2, each[k], each[0])
            )
            expected = np.where(np.isnan(vertices[k]).any(1), 0.0, expected)
            found, weight = chosen.read_seen(place)
            assert np.array_equal(np.ones(4) if weight is None else weight, expected)
            assert np.array_equal(found, np.where(expected[:, None] > 0, vertices[k], 0.0))
        assert chosen.weighted and replace(whole, weights=weights).weighted == (weights is not None)
    assert whole.read_seen(0)[1] is None


@pytest.mark.parametrize("weights", [np.full(4, 1.5), np.full(4, np.nan), np.full(4, -0.1)])
def test_weights_beyond_their_range_are_refused(weights):
    with pytest.raises(HabitusError, match=r"its weights run from .*; expected 0 to 1"):
        replace(registrations(), weights=weights).read_seen(1)


def test_weights_of_another_shape_are_refused():
    with pytest.raises(HabitusError, match=r"weights have shape \(5,\); expected \(4,\) or"):
        replace(registrations(), weights=np.ones(5))
