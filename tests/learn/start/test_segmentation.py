"""Start weights and start joints: what diffusion and rings must do on any mesh, and on the default
body.
"""

import numpy as np
import pytest
from scipy.special import erf

from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.io.registrations.templates import body_template
from habitus.learn.options import SETTINGS
from habitus.learn.start.segmentation import diffuse_weights, ring_regressor
from habitus.mesh.template import Template


def tube(length=1.0, radius=0.1, rings=101, around=24, cuts=(0.5,)):
    """A tube along y with one part between every two cuts (in metres), each the child of the
    last.
    """
    height, angle = np.meshgrid(
        np.linspace(0, length, rings), np.arange(around) * 2 * np.pi / around, indexing="ij"
    )
    vertices = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], -1).reshape(-1, 3)
    a, b = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    corner = lambda i, k: (i * around + k % around).ravel()  # noqa: E731
    faces = np.concatenate(
        [
            np.stack([corner(a, b), corner(a + 1, b), corner(a, b + 1)], 1),
            np.stack([corner(a + 1, b), corner(a + 1, b + 1), corner(a, b + 1)], 1),
        ]
    )
    part = np.searchsorted(cuts, vertices[:, 1])
    count = len(cuts) + 1
    return Template(
        vertices,
        faces,
        part,
        tuple(range(-1, count - 1)),
        tuple(f"joint_{k}" for k in range(count)),
    )


def changed(template, **fields):
    return Template(**(vars(template) | fields))


@pytest.fixture(scope="module")
def human():
    body = load_body("default")
    return body_template(body), body


@pytest.mark.parametrize("size", [1.0, 0.01, 100.0])
def test_on_a_tube_heat_is_the_error_function_whatever_its_size(size):
    template = tube(length=size, radius=0.1 * size, cuts=(0.5 * size,))
    half_area = 2 * np.pi * 0.1 * 0.5 * size**2
    sigma = SETTINGS.border_spread * np.sqrt(half_area / (4 * np.pi))
    height = template.vertices[:, 1] - 0.505 * size  # the border lies between two rings of vertices
    expected = (1 + erf(height / np.sqrt(2) / sigma)) / 2
    assert np.abs(diffuse_weights(template)[:, 1] - expected).max() < 0.03


def test_small_parts_blend_over_shorter_bands():
    weights = diffuse_weights(tube(rings=401, cuts=(0.5, 0.9, 0.95)))
    blended = lambda a, b: (np.minimum(weights[:, a], weights[:, b]) > 0.05).sum()  # noqa: E731
    assert blended(2, 3) < 0.6 * blended(0, 1)


def test_at_the_border_of_parts_of_two_sizes_each_has_half():
    template = tube(rings=400, cuts=(0.8,))  # rings lie half a step either side of the border
    weights = diffuse_weights(template)
    nearest = np.abs(template.vertices[:, 1] - 0.8).argmin()
    assert abs(weights[[nearest, nearest + 24]].mean(0)[0] - 0.5) < 0.02


def test_weights_are_shares_of_at_most_four_joints():
    template = tube(cuts=tuple(np.linspace(0, 1, 40)[1:-1]))
    weights = diffuse_weights(template)
    assert (weights >= 0).all() and np.abs(weights.sum(1) - 1).max() < 1e-12
    assert (weights > 0).sum(1).max() == 4
    hard = np.eye(template.num_joints)[template.part]
    assert (weights * hard).sum(1).min() > 0.2


def test_numbering_of_vertices_and_joints_does_not_matter(human):
    template, _ = human
    rng = np.random.default_rng(3)
    order = rng.permutation(template.num_vertices)
    rank = np.argsort(order)
    shuffled = changed(
        template,
        vertices=template.vertices[order] + [3.0, -2.0, 1.0],
        faces=rank[template.faces][rng.permutation(len(template.faces))][:, [1, 2, 0]],
        part=template.part[order],
        mirror=rank[template.mirror[order]],
    )
    assert np.allclose(diffuse_weights(shuffled), diffuse_weights(template)[order], atol=1e-9)
    assert np.allclose(ring_regressor(shuffled), ring_regressor(template)[:, order], atol=1e-15)


def test_both_are_symmetric_even_where_the_segmentation_is_not(human):
    template, _ = human
    part = template.part.copy()
    part[np.flatnonzero(part == template.joint_names.index("left_knee"))[:40]] = 1
    template = changed(template, part=part)
    for weights in (diffuse_weights(template), ring_regressor(template).T):
        assert np.abs(weights - weights[template.mirror][:, template.joint_mirror]).max() < 1e-12


def test_weights_are_near_those_of_an_animators_body(human):
    template, body = human
    own = body.skinning_weights
    weights = diffuse_weights(template)
    hard = np.eye(template.num_joints)[template.part]
    rows = template.part != template.joint_names.index(
        "head"
    )  # a fifth of the vertices, and hardly any of it blended
    moved = lambda w: np.abs(w - own)[rows].sum(1).mean() / 2  # noqa: E731  # weight that sits with another joint
    assert moved(weights) < 0.08 < 0.15 < moved(hard)


def test_joints_are_the_means_of_rings():
    template = tube(cuts=(0.205, 0.605))
    joints = ring_regressor(template) @ template.vertices
    assert np.allclose(joints, [[0, 0.205, 0], [0, 0.205, 0], [0, 0.605, 0]], atol=1e-12)


def test_ring_regressors_rows_are_means(human):
    template, body = human
    regressor = ring_regressor(template)
    assert (regressor >= 0).all() and np.abs(regressor.sum(1) - 1).max() < 1e-12
    own = body.joint_template
    limbs = [
        k
        for k, name in enumerate(template.joint_names)
        if name.split("_")[-1] in ("knee", "elbow", "wrist")
    ]
    assert np.linalg.norm((regressor @ template.vertices - own)[limbs], axis=1).max() < 0.028


def test_a_part_that_does_not_touch_its_parents_is_named():
    template = changed(tube(cuts=(0.3, 0.6)), parents=(-1, 0, 0))
    with pytest.raises(
        HabitusError, match=r"'joint_2' \(960 vertices\) to its parent's, 'joint_0'"
    ):
        ring_regressor(template)


def test_loose_pieces_keep_their_part_and_slivers_do_no_harm():
    one = tube()
    other = tube(rings=5)
    n = one.num_vertices
    vertices = np.concatenate([one.vertices, other.vertices + 1.0, [[5.0, 5.0, 5.0]]])
    flat = [[0, 1, 1], [7, 8, 7]]
    faces = np.concatenate([one.faces, other.faces + n, flat])
    part = np.concatenate([one.part, np.zeros(other.num_vertices + 1, int)])
    weights = diffuse_weights(changed(one, vertices=vertices, faces=faces, part=part))
    assert np.allclose(weights[n:, 0], 1) and np.isfinite(weights).all()
    assert 0.5 < weights[50 * 24, 0] < 0.6


def test_a_single_joint_is_the_middle():
    template = tube(cuts=())
    assert np.allclose(ring_regressor(template) @ template.vertices, [[0, 0.5, 0]], atol=1e-12)
    assert np.allclose(diffuse_weights(template), 1)
