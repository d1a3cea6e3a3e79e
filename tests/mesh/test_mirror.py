import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.mesh.mirror import find_mirror, mirrored_joints, with_mirror
from habitus.mesh.shapes import icosphere
from habitus.mesh.template import Template

NAMES = ("pelvis", "left_hip", "right_hip", "spine", "left_knee", "right_knee")
PARENTS = (-1, 0, 0, 0, 1, 2)
PARTNERS = [0, 2, 1, 3, 5, 4]


@pytest.fixture(scope="module")
def body():
    return load_body("default")


def arrays(body):
    return body.v_template, body.faces, body.mirror


def test_the_default_body_is_mirrored_as_its_file_says(body):
    vertices, faces, mirror = arrays(body)
    assert np.array_equal(find_mirror(vertices, faces), mirror)


def test_a_mesh_that_is_symmetric_but_for_noise_is_paired_by_its_faces(body):
    vertices, faces, mirror = arrays(body)
    skin = trimesh.graph.connected_components(trimesh.geometry.faces_to_edges(faces), min_len=4)
    skin = np.isin(np.arange(len(vertices)), max(skin, key=len))
    size = np.where(
        skin, 0.002, 0.0005
    )  # m; an eyeball's edges are 2 mm, and no faces lead there from the skin
    noisy = vertices + size[:, None] * np.random.default_rng(0).normal(size=vertices.shape)
    assert (~skin).sum() == 2 * 72
    assert np.array_equal(find_mirror(noisy, faces), mirror)


def test_numbering_of_the_vertices_and_order_of_the_faces_do_not_matter(body):
    vertices, faces, mirror = arrays(body)
    rng = np.random.default_rng(1)
    order = rng.permutation(len(vertices))  # new vertex k is old vertex order[k]
    back = np.argsort(order)
    found = find_mirror(vertices[order], back[faces[rng.permutation(len(faces))]])
    assert np.array_equal(found, back[mirror[order]])


def test_quads_cut_along_other_diagonals_are_paired_by_place():
    x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(0, 1, 5))
    vertices = np.stack([x, y, 0.1 * x**2], -1).reshape(-1, 3)
    a = (np.arange(4)[:, None] * 9 + np.arange(8)).reshape(-1)
    faces = np.concatenate([np.stack([a, a + 1, a + 10], 1), np.stack([a, a + 10, a + 9], 1)])
    expected = np.arange(45).reshape(5, 9)[:, ::-1].reshape(-1)
    assert np.array_equal(find_mirror(vertices, faces), expected)


def test_two_layers_that_nearly_touch_are_not_confused():
    shape = icosphere(2)
    vertices = shape.vertices.numpy()
    faces = shape.faces.numpy()
    both = np.concatenate([vertices, 0.97 * vertices])
    noisy = both + np.random.default_rng(0).normal(0, 0.012, both.shape)
    nearest = KDTree(noisy).query(noisy * [-1, 1, 1])[1]
    inner = np.arange(len(both)) >= len(vertices)
    assert (inner[nearest] != inner).any()  # by place alone they would be
    pairs = find_mirror(noisy, np.concatenate([faces, faces + len(vertices)]))
    assert np.allclose(both[pairs], both * [-1, 1, 1])


def test_a_mesh_without_symmetry_is_refused_with_the_number_of_lonely_vertices(body):
    vertices, faces, _ = arrays(body)
    with pytest.raises(
        HabitusError, match=rf"\d+ of {len(vertices)} vertices .* have no partner across x = 0"
    ):
        find_mirror(vertices + np.array([0.3, 0.0, 0.0]), faces)
    with pytest.raises(HabitusError, match=r"no partner across x = 0"):
        find_mirror(
            vertices, faces[vertices[faces, 0].mean(1) < 0.4]
        )  # the left hand's faces are lost


STYLES = (
    "left_{}|right_{}",
    "l_{}|r_{}",
    "L_{}|R_{}",
    "{}_L|{}_R",
    "{}_l|{}_r",
    "{}.l|{}.r",
    "{}.L|{}.R",
    "left{}|right{}",
    "Left{}|Right{}",
    "{}Left|{}Right",
    "l{}|r{}",
    "L{}|R{}",
    "{}L|{}R",
    "Bip01 L {}|Bip01 R {}",
    "rig:Left{}|rig:Right{}",
    "{} (left)|{} (right)",
    "LEFT_{}|RIGHT_{}",
    "l-{}|r-{}",
)


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("words", ["hip knee", "Hip Knee", "leg lower_leg", "ear elbow"])
def test_names_tell_the_sides_in_any_spelling(style, words):
    left, right = style.split("|")
    hip, knee = words.split()
    names = (
        "root",
        left.format(hip),
        right.format(hip),
        "middle",
        left.format(knee),
        right.format(knee),
    )
    assert mirrored_joints(names, PARENTS).tolist() == PARTNERS


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 8))
def test_trees_without_telling_names_are_paired_by_place(seed, middle, side):
    rng = np.random.default_rng(seed)
    parents = [-1]
    places = [[0.0, *rng.normal(size=2)]]
    partner = [0]
    for _ in range(middle):
        parents.append(int(rng.choice([k for k in range(len(parents)) if partner[k] == k])))
        places.append([0.0, *rng.normal(size=2)])
        partner.append(len(partner))
    for _ in range(side):
        above = int(rng.integers(len(parents)))
        place = rng.normal(size=3)
        place[0] = abs(place[0]) + 0.5
        n = len(parents)
        parents += [above, partner[above]]
        places += [place, place * [-1, 1, 1]]
        partner += [n + 1, n]
    found = mirrored_joints([f"joint_{k}" for k in range(len(parents))], parents, np.array(places))
    assert found.tolist() == partner


def test_a_side_without_its_partner_is_named():
    with pytest.raises(HabitusError, match="'left_knee' has no partner"):
        mirrored_joints((*NAMES[:5], "knee"), PARENTS)


def test_partners_on_joints_that_are_no_partners_are_refused():
    with pytest.raises(HabitusError, match="hang on joints that are no partners"):
        mirrored_joints(NAMES, (-1, 0, 0, 0, 1, 3))


def test_names_that_tell_nothing_need_places_unless_the_tree_is_a_chain():
    assert mirrored_joints(("a", "b", "c"), (-1, 0, 1)).tolist() == [0, 1, 2]
    with pytest.raises(HabitusError, match="give the joints' places"):
        mirrored_joints(("a", "b", "c"), (-1, 0, 0))


def test_a_template_gets_both_maps_by_names_and_by_places(body):
    vertices, faces, mirror = arrays(body)
    part = body.skinning_weights.argmax(1)
    named = Template(vertices, faces, part, body.parents, body.joint_names)
    nameless = Template(vertices, faces, part, body.parents, tuple(map(str, range(24))))
    for template in (with_mirror(named), with_mirror(nameless)):
        assert np.array_equal(template.mirror, mirror)
        assert [named.joint_names[k] for k in template.joint_mirror] == [
            name.replace("left", "*").replace("right", "left").replace("*", "right")
            for name in named.joint_names
        ]
