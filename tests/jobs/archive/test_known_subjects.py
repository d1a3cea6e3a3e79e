"""A subject's file holds, to the last bit, what its shape stage found."""

from dataclasses import replace

import numpy as np
import pytest
from planted import person

from habitus.errors import HabitusError
from habitus.fit.markers.shape import ShapeFit
from habitus.fit.markers.suspects import Suspect
from habitus.io.layouts.files import list_layouts, load_layout
from habitus.jobs.archive.items import BodyChoice, KnownSubject, read_known, write_known
from habitus.jobs.subjects import Agreed
from habitus.markers.layouts import Marker
from habitus.observe.markers import attach


def known(layout) -> KnownSubject:
    body = person()
    rng = np.random.default_rng(0)
    count = len(layout)
    latent = rng.normal(size=(count, 3))
    attachment = attach(latent, body.rest_vertices(np.zeros(body.num_betas)), body.faces)
    pose = rng.normal(size=(3, body.num_joints, 3))
    trans = rng.normal(size=(3, 3))
    shape = ShapeFit(
        rng.normal(size=4), latent, attachment, pose, trans, {"data": 1 / 3}, "converged", 7
    )
    agreed = Agreed(layout, 0.9, ("a note",), (Suspect("A", "b", 3, True),), ("a doubt",))
    return KnownSubject(
        BodyChoice("smplh", 8.0, "female", 0.1, ("told",)),
        agreed,
        shape,
        ((1, 2),),
        (0,),
        1.5,
        "name",
    )


def test_what_is_written_is_read(tmp_path):
    for name in list_layouts():
        layout = load_layout(name).with_fingers()
        free = Marker(
            "free", between=("left_asis", "right_asis", 1 / 3), direction=(0.1, 0.2, 0.3), vertex=3
        )
        given = known(replace(layout, markers=(*layout.markers, free)))
        digest = write_known(given, tmp_path / "known.npz")
        found = read_known(tmp_path / "known.npz")
        assert found.agreed == given.agreed and found.choice == given.choice
        for field in ("betas", "latent_markers", "pose", "trans"):
            np.testing.assert_array_equal(getattr(found.shape, field), getattr(given.shape, field))
        np.testing.assert_array_equal(
            found.shape.attachment.coefficients, given.shape.attachment.coefficients
        )
        assert (found.exchanged, found.misplaced, found.discovered_layout) == (
            ((1, 2),),
            (0,),
            "name",
        )
        assert (
            found.shape.costs == given.shape.costs
            and write_known(found, tmp_path / "again.npz") == digest
        )


def test_the_digest_is_that_of_what_a_fit_depends_on(tmp_path):
    given = known(load_layout("cmu-41"))
    betas = np.nextafter(given.shape.betas, 9.0)
    others = [
        replace(given, shape=replace(given.shape, betas=betas)),
        replace(given, choice=replace(given.choice, sex="male")),
        replace(given, agreed=replace(given.agreed, layout=load_layout("mosh-67"))),
        replace(given, misplaced=()),
    ]
    digests = {write_known(one, tmp_path / "one.npz") for one in (given, *others)}
    assert len(digests) == 5
    assert write_known(replace(given, seconds=99.0), tmp_path / "one.npz") in digests


def test_another_file_is_one_clear_line(tmp_path):
    np.savez(tmp_path / "other.npz", betas=np.zeros(3))
    (tmp_path / "text.npz").write_text("x")
    write_known(replace(known(load_layout("cmu-41")), seconds=-1e270), tmp_path / "time.npz")
    for name in ("other.npz", "text.npz", "time.npz", "none.npz"):
        with pytest.raises(HabitusError, match="is no subject that habitus archive wrote"):
            read_known(tmp_path / name)
