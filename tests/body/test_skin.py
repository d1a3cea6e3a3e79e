"""The default body's skin: painted everywhere, the same each time, lips, nails and irises where the
body has them.
"""

from dataclasses import replace

import numpy as np
import pytest

from habitus import load_body
from habitus.body.skin import (
    MASKS,
    TONES,
    paint_skin,
    resized,
    skin_mesh,
    skin_of,
    skin_tone,
)
from habitus.errors import HabitusError

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
SIZE = 512


@pytest.fixture(scope="module")
def body():
    return load_body("female", detail="full", joints="smplx")


@pytest.fixture(scope="module")
def mesh(body):
    return skin_mesh(body.mesh)


@pytest.fixture(scope="module")
def masks():
    with np.load(MASKS) as stored:
        return {name: stored[name] for name in stored.files}


def texels(uv, size):
    """Columns and rows of the texel that holds each coordinate."""
    return (uv * [size, -size] + [0, size]).astype(int).clip(0, size - 1).T


def at_vertices(image, mesh, count):
    """An image's values (n, n, ...) at vertices: the mean over a vertex' places in the layout."""
    column, row = texels(mesh.uv[mesh.quad_uv.ravel()], len(image))
    values = image[row, column].reshape(len(row), -1).astype(float)
    sums = np.stack([np.bincount(mesh.quads.ravel(), each, count) for each in values.T], axis=1)
    return np.squeeze(sums / np.bincount(mesh.quads.ravel(), minlength=count)[:, None])


def test_the_same_tone_gives_the_same_picture():
    first = paint_skin(0.4, SIZE)
    assert first.shape == (SIZE, SIZE, 3) and first.dtype == np.uint8
    assert np.array_equal(first, paint_skin(0.4, SIZE))
    assert not np.array_equal(first, paint_skin(0.45, SIZE))


def test_darker_tones_are_darker_everywhere_on_skin(masks):
    painted = np.unpackbits(masks["painted"], axis=1).astype(bool)[::4, ::4]
    skin = painted & (resized(masks["mask_eyes"].astype(np.float32), 256) == 0)
    pictures = [paint_skin(tone, 256)[skin] @ LUMINANCE for tone in np.linspace(0, 1, 9)]
    steps = np.diff([picture.mean() for picture in pictures])
    assert (steps < -3).all()
    assert (pictures[-1] < pictures[0]).mean() > 0.999


def test_every_texel_under_a_triangle_is_painted(body, mesh, masks):
    painted = np.unpackbits(masks["painted"], axis=1).astype(bool)
    size = len(painted)
    corners = mesh.uv[mesh.triangle_uv(body.faces)]
    shares = np.random.default_rng(0).dirichlet(np.full(3, 0.6), (20, len(corners)))
    inner = np.einsum("rtk,tkc->rtc", shares, corners).reshape(-1, 2)
    for points in (inner, corners.reshape(-1, 2)):
        for step in ([0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]):  # and what bilinear readers read
            column, row = texels(points + np.array(step) / size, size)
            assert painted[row, column].all()


def test_islands_do_not_meet(mesh):
    """What is beside an island is its own border, as far as mipmaps read."""
    parts = {}
    for quad in mesh.quad_uv:
        for row in quad:
            parts.setdefault(row, row)

    def root(row):
        while parts[row] != row:
            parts[row] = parts[parts[row]]
            row = parts[row]
        return row

    for quad in mesh.quad_uv:
        for row in quad[1:]:
            parts[root(row)] = root(quad[0])
    size = 256
    owner = np.full((size, size), -1)
    for island in {root(row) for row in parts}:
        own = np.array([row for row in parts if root(row) == island])
        column, row = texels(mesh.uv[own], size)
        assert np.isin(owner[row, column], (-1, island)).all()
        owner[row, column] = island


def test_seams_do_not_show(mesh):
    """Both places of a vertex on a seam have nearly one colour; linings apart, which nobody
    sees.
    """
    picture = paint_skin(0.3)
    seen = ~mesh.hidden
    pairs = np.stack([mesh.quads[seen].ravel(), mesh.quad_uv[seen].ravel()], axis=1)
    pairs = np.unique(pairs, axis=0)
    column, row = texels(mesh.uv[pairs[:, 1]], len(picture))
    colours = picture[row, column].astype(float)
    double = np.flatnonzero(pairs[1:, 0] == pairs[:-1, 0])
    apart = np.abs(colours[double] - colours[double + 1]).max(axis=1)
    assert len(double) > 400
    assert np.median(apart) <= 3 and np.percentile(apart, 95) <= 10


def test_lips_are_between_nose_and_chin(body, mesh, masks):
    found = at_vertices(masks["mask_lips"] / 63, mesh, body.num_vertices) > 0.5
    found[np.unique(mesh.quads[mesh.hidden])] = False
    places = body.v_template[found]
    nose, chin = (body.v_template[body.landmarks[name]] for name in ("nose_tip", "chin"))
    assert found.sum() > 50
    assert (places[:, 1] < nose[1]).all() and (places[:, 1] > chin[1]).all()
    assert abs(places[:, 0]).max() < 0.035 and (places[:, 2] > chin[2] - 0.03).all()
    colours = skin_of(body.mesh, "light").colours.astype(float)
    redness = colours[found].mean(axis=0) / colours[body.landmarks["forehead"]]
    assert redness[0] > redness[1] + 0.05 and redness[0] > redness[2] + 0.05


def test_nails_are_on_the_ends_of_fingers_and_toes(body, mesh, masks):
    found = at_vertices(masks["mask_nails"] / 63, mesh, body.num_vertices) > 0.4
    places = body.v_template[found]
    tips = [body.v_template[row] for name, row in body.landmarks.items() if name.endswith("_tip")]
    toes = [row for name, row in body.landmarks.items() if "toe" in name or "hallux" in name]
    hand = abs(places[:, 0]) > 0.5
    away = np.linalg.norm(places[hand, None] - np.array(tips), axis=-1).min(axis=1)
    fingers = [
        body.landmarks[f"{side}_{finger}_tip"]
        for side in ("left", "right")
        for finger in ("thumb", "index", "middle", "ring", "pinky")
    ]
    assert away.max() < 0.022
    for tip in body.v_template[fingers]:
        assert np.linalg.norm(places - tip, axis=1).min() < 0.016
    assert (~hand).any() and (places[~hand, 1] < -0.7).all()
    assert places[~hand, 2].min() > body.v_template[toes, 2].min() - 0.03


@pytest.mark.parametrize("side", ["left", "right"])
def test_pupil_iris_and_white_of_the_eye_lie_about_the_gaze(body, mesh, side):
    picture = paint_skin(0.5, 2048)
    joint = body.joint_names.index(f"{side}_eye_smplhf")
    centre = body.rest_joints(np.zeros(body.num_betas))[joint]
    faces = body.faces[(body.skinning_weights[body.faces, joint] > 0.99).all(axis=1)]
    uv_faces = mesh.triangle_uv(faces_of(mesh, body.faces))[
        (body.skinning_weights[body.faces, joint] > 0.99).all(axis=1)
    ]
    shares = np.random.default_rng(1).dirichlet(np.ones(3), (200, len(faces)))
    points = np.einsum("rtk,tkc->rtc", shares, body.v_template[faces]).reshape(-1, 3) - centre
    uv = np.einsum("rtk,tkc->rtc", shares, mesh.uv[uv_faces]).reshape(-1, 2)
    angle = np.degrees(np.arccos(points[:, 2] / np.linalg.norm(points, axis=1)))
    column, row = texels(uv, len(picture))
    light = picture[row, column] @ LUMINANCE
    pupil, iris, white = (light[(angle > a) & (angle < b)] for a, b in ((0, 5), (11, 18), (27, 60)))
    assert min(len(pupil), len(iris), len(white)) > 50
    assert pupil.max() < 40 < iris.mean() < 110 < 160 < white.min()


def faces_of(mesh, faces):
    """The triangles, which must be the mesh's quads cut in two."""
    assert mesh.triangle_uv(faces) is not None
    return faces


def test_palms_of_dark_skin_are_lighter_than_backs_of_hands(body):
    colours = skin_of(body.mesh, "dark").colours @ LUMINANCE
    back = body.landmarks["left_hand_back"]
    near = np.linalg.norm(body.v_template - body.v_template[back], axis=1) < 0.05
    palm = near & (body.v_template[:, 1] < body.v_template[back, 1] - 0.02)
    assert palm.sum() > 10
    assert colours[palm].mean() > 1.3 * colours[back]


def test_colours_of_vertices_are_those_of_the_texture(body, mesh):
    skin = skin_of(body.mesh, 0.3)
    apart = np.abs(skin.colours - at_vertices(skin.image, mesh, body.num_vertices)).max(axis=1)
    assert skin.colours.shape == (body.num_vertices, 3)
    assert np.median(apart) <= 2 and np.percentile(apart, 95) <= 16


def test_size_changes_detail_and_not_colour():
    small, large = paint_skin(0.6, 256).astype(float), paint_skin(0.6, 1024).astype(float)
    means = large.reshape(256, 4, 256, 4, 3).mean(axis=(1, 3))
    assert abs(small - means).mean() < 1.0


def test_bodies_of_another_layout_have_no_skin(body):
    other = replace(body.mesh, uv=body.mesh.uv[::-1])
    assert skin_mesh(other) is None and skin_of(other, "dark") is None
    assert skin_of(None, 0.3) is None and skin_of(body.mesh, "none") is None
    for name in ("male", "neutral"):
        assert skin_mesh(load_body(name, detail="full").mesh) is not None


@pytest.mark.parametrize("skin", ["pale", 1.2, -0.1, "nan", float("nan"), [0.5]])
def test_other_tones_are_refused(skin):
    with pytest.raises(HabitusError, match="expected light, medium, dark, none, or a number"):
        skin_tone(skin)


def test_tones_by_name_number_and_text():
    assert skin_tone("none") is None and skin_tone(None) is None
    assert skin_tone("0.25") == 0.25 and skin_tone(1) == 1.0 and skin_tone("dark") == TONES["dark"]
    with pytest.raises(HabitusError, match="size is 8 pixels"):
        paint_skin(0.5, 8)
