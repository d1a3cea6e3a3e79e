"""One reader of persons: the kind of a file follows from its content, whoever wrote it."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body

import habitus
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.motion import export_motion
from habitus.fit.markers.result import MarkerFit
from habitus.io.models.bodies import SHIPPED_BETAS, load_body, save_body
from habitus.io.people import BodyShape, Mesh, open_person, read_motion, read_shape
from habitus.jobs.estimates import body_from_measurements, save_estimate


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A file of each kind."""
    at = tmp_path_factory.mktemp("people")
    fit = synthetic_fit(4)
    export_motion(fit, at / "fit.npz")
    export_motion(BodyMotion.of(fit), at / "motion.npz")
    fit.save(at / "walk")
    fit.save(at / "amass", npz_style="amass")
    save_estimate(body_from_measurements(height=1.7), at / "person.npz")
    save_body(tube_body(), at / "body.npz")
    habitus.write_surface(load_body("female")(), at / "mesh.ply")
    return at


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("fit.npz", MarkerFit),
        ("motion.npz", BodyMotion),
        ("walk", MarkerFit),
        ("walk/body.npz", MarkerFit),
        ("amass/body.npz", BodyMotion),
        ("person.npz", BodyShape),
        ("body.npz", BodyModel),
        ("mesh.ply", Mesh),
    ],
)
def test_the_kind_of_a_file_is_that_of_its_content(folder, name, kind):
    body = None if name in ("person.npz", "body.npz") else tube_body()
    assert type(open_person(folder / name, body)) is kind


def test_a_shipped_body_is_opened_by_its_name():
    assert isinstance(open_person("female"), BodyModel)


def test_a_fit_read_as_a_motion_keeps_the_motion_and_no_markers(folder):
    fit = open_person(folder / "fit.npz", tube_body())
    motion = read_motion(folder / "fit.npz", tube_body())
    assert type(motion) is BodyMotion
    np.testing.assert_array_equal(motion.pose, fit.pose)


def test_the_shape_of_any_file_with_betas_is_that_of_its_person(folder):
    body = tube_body()
    fit = synthetic_fit(4)
    for name in ("fit.npz", "motion.npz", "walk", "amass/body.npz"):
        shape = read_shape(folder / name, body)
        np.testing.assert_array_equal(shape.betas, fit.betas)
        np.testing.assert_array_equal(shape.rest_vertices(), body.rest_vertices(fit.betas))
    assert not read_shape(folder / "body.npz").betas.any()


def test_a_skin_offset_moves_the_surface_along_its_normals(tmp_path):
    body = load_body("default")
    offset = np.full(body.num_vertices, 0.01)
    np.savez(tmp_path / "thick.npz", betas=[1.0], surface_model_type="default", skin_offset=offset)
    shape = read_shape(tmp_path / "thick.npz")
    moved = np.linalg.norm(shape.rest_vertices() - body.rest_vertices(shape.betas), axis=1)
    np.testing.assert_allclose(moved, 0.01, atol=1e-9)


def test_missing_betas_are_zero_and_further_ones_must_be(tmp_path):
    np.savez(tmp_path / "few.npz", betas=[0.5, -0.5], surface_model_type="default")
    assert read_shape(tmp_path / "few.npz").betas[:3].tolist() == [0.5, -0.5, 0.0]
    np.savez(tmp_path / "zeros.npz", betas=np.zeros(400), surface_model_type="default")
    assert len(read_shape(tmp_path / "zeros.npz").betas) == load_body("default").num_betas
    np.savez(tmp_path / "many.npz", betas=np.ones(400), surface_model_type="default")
    with pytest.raises(HabitusError, match="400 betas; default has 100"):
        read_shape(tmp_path / "many.npz")


def test_further_betas_are_of_the_same_body_with_all_of_them(tmp_path):
    betas = np.append(np.zeros(30), 0.5)
    np.savez(tmp_path / "further.npz", betas=betas, surface_model_type="female")
    shape = read_shape(tmp_path / "further.npz")
    assert shape.body.num_betas == len(shape.betas) == SHIPPED_BETAS
    body = load_body("female", num_betas=31)
    np.testing.assert_allclose(shape.rest_vertices(), body.rest_vertices(betas), atol=1e-12)


def test_betas_that_describe_no_body_are_refused(tmp_path):
    np.savez(tmp_path / "huge.npz", betas=[1e4], surface_model_type="default")
    with pytest.raises(HabitusError, match="betas reach 1e\\+04; expected a person's, within 100"):
        read_shape(tmp_path / "huge.npz")


def test_a_motion_without_betas_moves_the_mean_person_and_says_so(tmp_path):
    motion = {"trans": np.zeros((3, 3)), "mocap_framerate": 60.0}
    body = load_body("default")
    motion["poses"] = np.zeros((3, 3 * body.num_joints))
    np.savez(tmp_path / "bare.npz", body="default", **motion)
    read = read_motion(tmp_path / "bare.npz")
    assert not read.betas.any()
    assert read.made[-1] == "its file has no betas: the mean person moves"
    with pytest.raises(HabitusError, match="holds no betas; expected the betas of a person"):
        read_shape(tmp_path / "bare.npz")


def test_betas_are_put_on_no_other_body(folder):
    with pytest.raises(HabitusError, match="another person"):
        read_motion(folder / "motion.npz", "default")
    fit = open_person(folder / "fit.npz", tube_body())
    fatter = replace(tube_body(), v_template=1.1 * fit.body.v_template)
    with pytest.raises(HabitusError, match="another person"):
        open_person(folder / "fit.npz", fatter)


@pytest.mark.parametrize("read", [open_person, read_motion, read_shape, habitus.load_fit])
def test_every_reader_names_a_file_that_it_cannot_read(read, tmp_path):
    with pytest.raises(HabitusError, match=r"none\.npz: no such file"):
        read(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(HabitusError, match=r"text\.npz"):
        read(tmp_path / "text.npz")
    with pytest.raises(HabitusError, match=r"a folder without body\.npz"):
        read(tmp_path)


@pytest.mark.parametrize("rate", [np.nan, np.inf, -30.0, 0.0, 1e-9, 1e5])
@pytest.mark.parametrize("name", ["fit.npz", "motion.npz"])
def test_rates_that_no_capture_has_are_refused(folder, tmp_path, name, rate):
    arrays = dict(np.load(folder / name))
    np.savez(tmp_path / "bad.npz", **{**arrays, "mocap_framerate": np.array(rate)})
    with pytest.raises(HabitusError, match=r"mocap_framerate is .* Hz; expected 0.1 to 20000"):
        open_person(tmp_path / "bad.npz", tube_body())


def test_a_file_with_two_rates_or_none_is_refused(folder, tmp_path):
    arrays = dict(np.load(folder / "fit.npz"))
    np.savez(tmp_path / "two.npz", **{**arrays, "mocap_framerate": np.array(25.0)})
    with pytest.raises(HabitusError, match=r"two frame rates \(mocap_framerate 25 Hz and mocap_"):
        open_person(tmp_path / "two.npz", tube_body())
    for key in ("mocap_framerate", "mocap_frame_rate"):
        del arrays[key]
    np.savez(tmp_path / "none.npz", **arrays)
    with pytest.raises(HabitusError, match="no frame rate; expected mocap_framerate"):
        open_person(tmp_path / "none.npz", tube_body())
