"""What files tell of made registrations: read as written, joined, in metres, refused where it does
not fit.
"""

from dataclasses import replace

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.io.registrations.open import open_registrations, write_registrations
from habitus.mesh.known import Known
from habitus.mesh.registrations import Registrations
from habitus.mesh.shapes import icosphere

BALL = icosphere(1)
V = len(BALL.vertices)


def made(seed=0, subjects=("a", "a", "b"), rest=True) -> Registrations:
    rng = np.random.default_rng(seed)
    vertices = BALL.vertices.numpy() + rng.normal(size=(len(subjects), V, 3)).astype(np.float32)
    people = {name: rng.normal(size=(V, 3)) for name in dict.fromkeys(subjects)} if rest else {}
    count = len(subjects)
    known = Known(
        rng.normal(size=(count, 5, 3)),
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        people,
    )
    names = tuple(f"{seed}-{k}" for k in range(count))
    none = ("",) * count
    pose = ("pose",) * count
    return Registrations(vertices, BALL.faces.numpy(), subjects, none, pose, names, known=known)


@pytest.mark.parametrize("name", ["one.npz", "folder"])
def test_what_is_known_is_read_as_it_was_written(tmp_path, name):
    write_registrations(made(), tmp_path / name)
    found = open_registrations(tmp_path / name).known
    assert set(made().known.arrays()) == {"pose", "trans", "betas"}
    for key, value in made().known.arrays().items():
        np.testing.assert_array_equal(getattr(found, key), value)
    assert set(found.rest) == {"a", "b"}
    np.testing.assert_array_equal(found.rest["b"], made().known.rest["b"])


def test_poses_may_be_flat_as_amass_has_them(tmp_path):
    write_registrations(made(), tmp_path / "one.npz")
    with np.load(tmp_path / "one.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "flat.npz", **arrays | {"poses": arrays.pop("pose").reshape(3, -1)})
    np.testing.assert_array_equal(
        open_registrations(tmp_path / "flat.npz").known.pose, made().known.pose
    )


def test_a_folder_of_archives_is_one_dataset_and_what_one_does_not_tell_is_not_known(tmp_path):
    write_registrations(made(1, ("a", "a"), rest=False), tmp_path / "1.npz")
    write_registrations(replace(made(2, ("c",)), known=None), tmp_path / "2.npz")
    write_registrations(made(3, ("d", "d")), tmp_path / "3.npz")
    found = open_registrations(tmp_path)
    assert found.subject == ("a", "a", "c", "d", "d") and set(found.known.rest) == {"d"}
    assert found.known.known_rows("pose", 5).tolist() == [True, True, False, True, True]
    assert found.made.tolist() == [True, True, False, True, True]


def test_lengths_are_brought_to_metres(tmp_path):
    write_registrations(made(), tmp_path / "one.npz")
    found = open_registrations(tmp_path / "one.npz", unit="mm").known
    np.testing.assert_allclose(found.trans, made().known.trans / 1000)
    np.testing.assert_allclose(found.rest["a"], made().known.rest["a"] / 1000)
    np.testing.assert_array_equal(found.pose, made().known.pose)


@pytest.mark.parametrize(
    ("key", "array"),
    [
        ("pose", np.zeros((3, 5, 4))),
        ("trans", np.zeros((2, 3))),
        ("betas", np.zeros(3)),
        ("rest", np.zeros((3, V, 3))),
    ],
)
def test_another_shape_is_refused_by_the_files_name(tmp_path, key, array):
    write_registrations(made(), tmp_path / "one.npz")
    with np.load(tmp_path / "one.npz") as file:
        np.savez(tmp_path / "off.npz", **(dict(file) | {key: array}))
    with pytest.raises(
        HabitusError, match=rf"off\.npz: its {key} is float64 of shape .*expected numbers"
    ):
        open_registrations(tmp_path / "off.npz")
    write_registrations(
        replace(made(4), known=Known(pose=np.zeros((3, 6, 3)))), tmp_path / "six.npz"
    )
    with pytest.raises(HabitusError, match="pose have shapes"):
        open_registrations([tmp_path / "one.npz", tmp_path / "six.npz"])
