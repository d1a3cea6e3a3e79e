"""Laws of the public terms of surfaces: slopes of their costs, planted bodies found, refusals."""

import numpy as np
import pytest
import torch
from planted import person

from habitus.errors import HabitusError
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera, look_at
from habitus.residuals.surface_terms import (
    Depth,
    Joints,
    Points,
    Silhouette,
    draw_faces,
    rays,
)
from habitus.solve.minimize import minimize
from habitus.solve.terms import Term


def camera(size=120):
    eye, middle = (torch.tensor(v, dtype=torch.float64) for v in ((0.6, 0.3, 3.0), (0.0, 0.0, 0.0)))
    rotation, translation = look_at(eye, middle)
    return Camera.of(size, size, 1.3 * size, rotation=rotation, translation=translation)


def planted(seed=0):
    body = person()
    rng = np.random.default_rng(seed)
    state = {
        "betas": rng.normal(size=body.num_betas),
        "pose": 0.1 * rng.normal(size=(body.num_joints, 3)),
        "trans": 0.05 * rng.normal(size=3),
    }
    return state, np.asarray(body(**state).vertices)


def seen_depth(vertices):
    """Depth (H, W) along the camera's axis, 0 where there is nothing, by the drawn faces."""
    seen = draw_faces(camera(), vertices, person().faces)
    corners = vertices[person().faces[np.maximum(seen.face, 0)]]
    places = torch.from_numpy(np.einsum("nk,nkc->nc", seen.barycentric, corners))
    depth = np.where(seen.face >= 0, camera().to_camera(places).numpy()[:, 2], 0.0)
    return depth.reshape(120, 120)


def some_points(vertices, count=300):
    rows = np.random.default_rng(1).integers(0, len(vertices), count)
    return vertices[rows], vertex_normals(vertices, person().faces)[rows]


def terms(state):
    """Each term of what it would observe of a state."""
    body = person()
    vertices = np.asarray(body(**state).vertices)
    depth = seen_depth(vertices)
    joints = np.asarray(body(**state).joints)
    return {
        "points": Points(body, *some_points(vertices)),
        "depth": Depth(body, camera(), depth, stride=2, share=1.0),
        "pixel": Depth(body, camera(), depth, stride=2, share=1.0, matching="pixel"),
        "silhouette": Silhouette(body, camera(), depth > 0.0, stride=1, share=1.0),
        "joints": Joints(body, joints),
    }


NAMES = ("points", "depth", "silhouette", "joints")


@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_is_the_slope_of_the_cost_where_correspondences_stay(name):
    """To first order: the nearest point moves along the surface, which changes no distance. Pixels
    that come and go at a silhouette are steps of its cost.
    """
    truth, vertices = planted()
    term = terms(truth)[name]
    term = Points(person(), some_points(vertices)[0]) if name == "points" else term
    here = {**truth, "trans": truth["trans"] + [0.02, -0.01, 0.01]}
    slopes = Term(term)(here).quadratic.derivatives()[0]
    for along in np.eye(3):
        costs = [term(**{**here, "trans": here["trans"] + h * along}).cost for h in (2e-3, -2e-3)]
        change = (costs[0] - costs[1]) / 4e-3
        scale = np.linalg.norm(slopes["trans"])
        assert (
            abs(slopes["trans"] @ along - change) < (0.25 if name == "silhouette" else 0.15) * scale
        )


@pytest.mark.parametrize("name", [*NAMES, "pixel"])
def test_what_was_planted_costs_least(name):
    truth, _ = planted()
    term = terms(truth)[name]
    moved = {**truth, "trans": truth["trans"] + [0.05, 0.0, 0.02]}
    assert term(**truth).cost < 0.05 * term(**moved).cost


@pytest.mark.parametrize("names", [("points",), ("depth", "silhouette"), ("joints",)])
def test_a_displaced_body_is_found(names):
    truth, vertices = planted()
    given = {name: term for name, term in terms(truth).items() if name in names}
    begin = {**truth, "trans": truth["trans"] + [0.06, -0.04, 0.03]}
    begin["pose"] = truth["pose"] + 0.05 * (np.arange(len(truth["pose"])) == 0)[:, None]
    result = minimize(
        given,
        begin,
        "levenberg",
        fixed=["betas"],
        masks={"pose": (np.arange(len(truth["pose"])) == 0)[:, None]},
        max_iterations=25,
        stretch=False,
    )
    found = person()(**result.values).vertices
    assert np.linalg.norm(found - vertices, axis=1).max() < 0.01


def test_a_term_of_one_frame_leaves_the_others():
    truth, vertices = planted()
    term = Points(person(), *some_points(vertices), frame=1)
    pose = np.stack([0.0 * truth["pose"], truth["pose"], truth["pose"]])
    trans = np.stack([truth["trans"]] * 3) + 0.01
    slopes, blocks = term(truth["betas"], pose, trans).derivatives()
    assert slopes["pose"][1].any() and not slopes["pose"][[0, 2]].any()
    assert blocks["pose", "pose"].shape[0] == 3 and not blocks["pose", "betas"][0].any()


def test_outliers_and_other_sides_hardly_pull():
    truth, vertices = planted()
    points, normals = some_points(vertices)
    normals = normals.copy()
    points = points.copy()
    points[:30] += 0.5
    normals[30:60] *= -1.0
    term = Points(person(), points, normals)
    slopes, _ = term(**truth).derivatives()
    clean, _ = Points(person(), points[60:], normals[60:])(
        **{
            **truth,
            "trans": truth["trans"] + 0.002,
        }
    ).derivatives()
    assert np.linalg.norm(slopes["trans"]) < 0.1 * np.linalg.norm(clean["trans"])


def test_missing_joints_are_left_out_and_unknown_ones_refused():
    truth, _ = planted()
    names = ("left_wrist", "right_wrist")
    rows = [person().joint_names.index(name) for name in names]
    observed = np.asarray(person()(**truth).joints)[rows]
    observed[1] = np.nan
    assert Joints(person(), observed, names)(**truth).cost == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(HabitusError, match="tail"):
        Joints(person(), observed, ("tail", "left_wrist"))(**truth)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda d: Depth(person(), camera(), d[:50]), "shape"),
        (lambda d: Depth(person(), camera(), 0.0 * d), "no pixel"),
        (lambda d: Depth(person(), camera(), d, matching="best"), "best"),
        (lambda d: Silhouette(person(), camera(), d > 100.0), "no pixel"),
    ],
)
def test_images_that_do_not_fit_are_refused(make, word):
    with pytest.raises(HabitusError, match=word):
        make(np.ones((120, 120)))


def test_rays_go_through_pixel_centres():
    along = rays(camera(), np.array([0, 121]))
    pixels, _ = camera().project_camera_points(torch.from_numpy(2.0 * along))[:2]
    np.testing.assert_allclose(np.asarray(pixels)[0], [0.5, 0.5], atol=1e-9)


def information(term, vertices):
    """Of each observation the largest eigenvalue of its information (1/m^2), and its point."""
    points = term.matched(vertices).points
    corners = vertices[person().faces[points.face]]
    place = np.einsum("nk,nkc->nc", points.barycentric, corners)
    return np.linalg.norm(points.directions, ord=2, axis=(1, 2)) ** 2, place, points


def test_an_outline_counts_a_quarter_at_its_reach():
    """Geman-McClure's weight of the distance in pixels, and 1 / noise^2 of a pixel at the surface's
    distance from the camera.
    """
    _, vertices = planted()
    mask = np.roll(seen_depth(vertices) > 0.0, 6, axis=1)
    given = {"stride": 1, "share": 1.0, "noise": 2.0}
    near, place, points = information(
        Silhouette(person(), camera(), mask, reach=8.0, **given), vertices
    )
    plain, *_ = information(Silhouette(person(), camera(), mask, reach=1e6, **given), vertices)
    eye = np.array([0.6, 0.3, 3.0])
    pixel = np.linalg.norm(place - eye, axis=1) / (1.3 * 120)  # metres there
    distance = np.linalg.norm(place - points.target, axis=1) / pixel
    assert distance.max() > 4.0
    np.testing.assert_allclose(plain, 1.0 / (2.0 * pixel) ** 2, rtol=1e-6)
    np.testing.assert_allclose(near / plain, (1.0 + (distance / 8.0) ** 2) ** -2, rtol=1e-6)


def test_depth_of_oblique_skin_counts_more_where_noise_is_along_the_ray():
    """The noise of depth moves a point off the surface by the cosine of ray and normal."""
    _, vertices = planted()
    depth = seen_depth(vertices)
    given = {"stride": 1, "matching": "pixel", "model_sd": 1e-9}
    straight, place, points = information(Depth(person(), camera(), depth, **given), vertices)
    oblique, *_ = information(Depth(person(), camera(), depth, min_cosine=0.3, **given), vertices)
    corners = vertices[person().faces[points.face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ray = place - np.array([0.6, 0.3, 3.0])
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(ray, axis=1)
    cosine = np.maximum(np.abs((normal * ray).sum(1)) / lengths, 0.3)
    assert cosine.min() == 0.3 and cosine.max() > 0.9
    np.testing.assert_allclose(oblique / straight, cosine**-2.0, rtol=1e-5)
