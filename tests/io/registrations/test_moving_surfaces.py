"""Sequences of people in motion from every format that registrations have."""

import numpy as np
import pytest
from soft_people import soft_people
from soft_tubes import soft_tubes

from habitus.errors import HabitusError
from habitus.io.registrations.motions import open_moving_surfaces


@pytest.fixture(scope="module")
def people():
    return soft_tubes(), soft_people(soft_tubes(), people=2, sequences=1, frames=6)


def _arrays(one, **more):
    meshes = one.registrations
    return {
        "vertices": np.asarray(meshes.vertices),
        "faces": meshes.faces,
        "subject": np.array(meshes.subject),
        "name": np.array(meshes.name),
        "betas": one.betas,
        "pose": one.pose,
        "trans": one.trans,
        "rate_hz": np.array(one.rate_hz),
        **more,
    }


def _same(found, one):
    assert (found.name, found.subject, found.rate_hz, len(found)) == (
        one.name,
        one.subject,
        one.rate_hz,
        len(one),
    )
    for key in ("betas", "pose", "trans"):
        np.testing.assert_allclose(getattr(found, key), getattr(one, key), atol=1e-12)
    for frame in (0, len(one) - 1):
        np.testing.assert_allclose(
            found.registrations.read(frame), one.registrations.read(frame), atol=1e-12
        )


def test_an_npz_of_one_person_and_one_of_several_sequences(people, tmp_path):
    _, (one, other) = people
    np.savez(tmp_path / "one.npz", **_arrays(one))
    both = {
        key: np.concatenate([_arrays(x)[key] for x in (one, other)])
        for key in ("vertices", "subject", "name", "pose", "trans")
    }
    both |= {
        "betas": np.repeat([one.betas, other.betas], 6, axis=0),
        "poses": both.pop("pose").reshape(12, -1),
    }
    both |= {"faces": one.registrations.faces, "mocap_framerate": np.array(60)}
    both["still_vertices"] = both["vertices"] + 1.0
    np.savez(tmp_path / "both.npz", **both)
    first, second, third = open_moving_surfaces([tmp_path / "one.npz", tmp_path / "both.npz"])
    _same(first, one)
    _same(second, one)
    _same(third, other)
    assert first.still is None
    np.testing.assert_allclose(third.still[2], other.registrations.read(2) + 1.0)


def test_units_are_those_of_places_too(people, tmp_path):
    _, (one, _) = people
    mm = {key: 1e3 * np.asarray(_arrays(one)[key]) for key in ("vertices", "trans")}
    np.savez(tmp_path / "mm.npz", **_arrays(one, **mm, still_vertices=mm["vertices"]))
    (found,) = open_moving_surfaces(tmp_path / "mm.npz", unit="mm")
    _same(found, one)
    np.testing.assert_allclose(found.still[3], one.registrations.read(3))


def test_dynas_file_with_a_motion_and_without(people, tmp_path):
    h5py = pytest.importorskip("h5py")
    _, (one, other) = people
    with h5py.File(tmp_path / "dyna.h5", "w") as file:
        file["faces"] = one.registrations.faces
        for sequence in (one, other):
            file[sequence.name] = np.asarray(sequence.registrations.vertices).transpose(1, 2, 0)
        file["motion/rate_hz"] = 60.0
        for key in ("betas", "pose", "trans"):
            file[f"motion/{one.name}/{key}"] = getattr(one, key)
    first, second = open_moving_surfaces(tmp_path / "dyna.h5")
    _same(first, one)
    assert (
        second.pose is None
        and second.betas is None
        and second.rate_hz == 60.0
        and second.name == other.name
    )
    (faster, _) = open_moving_surfaces(tmp_path / "dyna.h5", fps=100)
    assert faster.rate_hz == 100


def test_a_folder_and_a_zarr_group(people, tmp_path):
    zarr = pytest.importorskip("zarr")
    _, (one, _) = people
    arrays = _arrays(one)
    folder = tmp_path / "folder"
    folder.mkdir()
    for key in ("vertices", "faces", "betas", "pose", "trans", "rate_hz"):
        np.save(folder / f"{key}.npy", arrays[key])
    rows = "".join(f"{s},{n}\n" for s, n in zip(arrays["subject"], arrays["name"], strict=True))
    (folder / "registrations.csv").write_text(f"subject,name\n{rows}")
    group = zarr.open_group(str(tmp_path / "people.zarr"), mode="w")
    for key, array in arrays.items():
        group.create_array(key, data=array)
    for path in (folder, tmp_path / "people.zarr"):
        (found,) = open_moving_surfaces(path)
        _same(found, one)


def test_frames_that_do_not_follow_each_other_are_other_sequences(people, tmp_path):
    _, (one, _) = people
    names = np.array(["jump_0003", "jump_0004", "jump_0007", "walk2:0", "walk2:1", "walk2:2"])
    np.savez(tmp_path / "parts.npz", **_arrays(one, name=names))
    found = open_moving_surfaces(tmp_path / "parts.npz")
    assert [(each.name, len(each)) for each in found] == [("jump", 2), ("jump", 1), ("walk2", 3)]
    np.testing.assert_array_equal(found[2].pose, one.pose[3:])


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"name": np.array(["anna"] * 6)},
            "no frame number in the name anna; expected names such as jump:17",
        ),
        ({"rate_hz": np.array(0)}, "rate.* is 0 Hz"),
        ({"pose": np.zeros((5, 10, 3))}, r"pose is float64 of shape \(5, 10, 3\)"),
        ({"trans": np.full((6, 3), np.nan)}, "trans holds numbers that are not finite"),
        ({"betas": np.arange(24.0).reshape(6, 4)}, "betas change within a sequence"),
        ({"still_vertices": np.zeros((6, 9, 3))}, "still_vertices have shape"),
    ],
)
def test_motions_that_cannot_be(people, change, told, tmp_path):
    np.savez(tmp_path / "bad.npz", **_arrays(people[1][0], **change))
    with pytest.raises(HabitusError, match=rf"bad\.npz.*{told}"):
        open_moving_surfaces(tmp_path / "bad.npz")
