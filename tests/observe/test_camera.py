import math

import cv2
import numpy as np
import pytest
import torch

from habitus.errors import HabitusError
from habitus.observe.camera import Camera, look_at
from habitus.observe.lens import distorted

SPREAD = torch.tensor([0.3, 0.1, 0.01, 0.01, 0.05, 0.1, 0.05, 0.02], dtype=torch.float64)
seeds = pytest.mark.parametrize("seed", range(12))


def uniform(seed: int, *shape: int) -> torch.Tensor:
    return (
        2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        - 1
    )


def some_camera(seed: int, coefficients: int = 8) -> Camera:
    numbers = uniform(seed, 18)
    return Camera.of(
        640,
        480,
        focal_length=600 + 200 * numbers[:2],
        principal_point=numbers.new_tensor([320, 240]) + 30 * numbers[2:4],
        rotation=3 * numbers[4:7],
        translation=numbers[7:10],
        distortion=None if coefficients == 0 else (numbers[10:] * SPREAD)[:coefficients],
    )


def seen_points(camera: Camera, seed: int, count: int = 50) -> torch.Tensor:
    """Points of the world that lie up to 45 degrees off the camera's axis, 0.1 to 10 m deep."""
    depth = 10 ** uniform(seed + 100, count, 1)
    plane = 0.7 * uniform(seed + 200, count, 2)
    return camera.to_world(torch.cat([plane * depth, depth], -1)).detach()


def opencv_matrix(camera: Camera) -> np.ndarray:
    matrix = np.diag([*camera.focal_length.tolist(), 1.0])
    matrix[:2, 2] = camera.principal_point.numpy() - 0.5
    return matrix


def by_opencv(camera: Camera, points: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and their derivatives to rotation, translation, focal length, centre, distortion, as
    OpenCV has them.
    """
    lens = None if camera.distortion is None else camera.distortion.numpy()
    turn = camera.rotation.numpy()
    move = camera.translation.numpy()
    pixels, slopes = cv2.projectPoints(points.numpy(), turn, move, opencv_matrix(camera), lens)
    return pixels[:, 0] + 0.5, slopes


@seeds
@pytest.mark.parametrize("coefficients", [0, 4, 5, 8])
def test_pixels_are_opencvs(seed, coefficients):
    camera = some_camera(seed, coefficients)
    points = seen_points(camera, seed)
    pixels, depth = camera.project(points)
    assert np.abs(pixels.numpy() - by_opencv(camera, points)[0]).max() < 1e-6
    assert torch.equal(camera.screen(points), torch.cat([pixels, depth[:, None]], -1))


@seeds
def test_derivatives_are_opencvs(seed):
    camera = some_camera(seed)
    points = seen_points(camera, seed, 10)
    names = ("rotation", "translation", "focal_length", "principal_point", "distortion")

    def pixels(*values):
        return camera.replace(**dict(zip(names, values, strict=True))).project(points)[0]

    ours = torch.func.jacrev(pixels, argnums=tuple(range(5)))(
        *(getattr(camera, name) for name in names)
    )
    ours = torch.cat(ours, -1).flatten(0, 1).numpy()
    theirs = by_opencv(camera, points)[1]
    assert np.abs(ours - theirs).max() < 1e-8 * np.abs(theirs).max()


@pytest.mark.parametrize("coefficients", [0, 8])
def test_forward_and_backward_derivatives_are_those_of_finite_steps(coefficients):
    camera = some_camera(3, coefficients)
    names = [
        name
        for name in ("focal_length", "rotation", "translation", "distortion")
        if coefficients or name[0] != "d"
    ]
    points = seen_points(camera, 3, 3)

    def screen(points, *values):
        return camera.replace(**dict(zip(names, values, strict=True))).screen(points)

    inputs = [points, *(getattr(camera, name) for name in names)]
    every = tuple(range(len(inputs)))
    assert torch.autograd.gradcheck(screen, [value.clone().requires_grad_() for value in inputs])
    forward = torch.func.jacfwd(screen, argnums=every)(*inputs)
    backward = torch.func.jacrev(screen, argnums=every)(*inputs)
    for a, b in zip(forward, backward, strict=True):
        torch.testing.assert_close(a, b)


def test_zero_distortion_is_no_distortion_but_has_derivatives():
    plain = some_camera(0, 0)
    points = seen_points(plain, 0)
    zeros = torch.zeros(8, dtype=torch.float64, requires_grad=True)
    bent = plain.replace(distortion=zeros).screen(points)
    torch.testing.assert_close(bent, plain.screen(points), rtol=0, atol=1e-11)
    (slope,) = torch.autograd.grad(bent.square().sum(), zeros)
    assert (slope != 0).all()


def test_the_axis_meets_the_middle_of_the_image_and_opencv_counts_half_a_pixel_less():
    axis = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64)
    assert Camera.of(5, 4).project(axis)[0].tolist() == [[2.5, 2.0]]
    matrix = np.array([[7.0, 0, 2.0], [0, 7.0, 1.5], [0, 0, 1]])
    assert Camera.from_opencv(matrix, None, np.zeros(3), np.zeros(3), 5, 4).project(axis)[
        0
    ].tolist() == [[2.5, 2.0]]


@seeds
def test_from_opencv_takes_what_a_calibration_returns(seed):
    camera = some_camera(seed)
    points = seen_points(camera, seed)
    lens = np.concatenate([camera.distortion.numpy(), np.zeros(6)])[None]
    turn = camera.rotation.numpy()[:, None]
    move = camera.translation.numpy()[:, None]
    for rotation in (turn, cv2.Rodrigues(turn)[0]):
        again = Camera.from_opencv(opencv_matrix(camera), lens, rotation, move, 640, 480)
        torch.testing.assert_close(again.screen(points), camera.screen(points), rtol=0, atol=1e-8)


def test_points_behind_the_camera_poison_nothing():
    camera = some_camera(1).replace(
        rotation=torch.zeros(3).double(), translation=torch.zeros(3).double()
    )
    bad = torch.tensor(
        [[0.1, 0.2, 0.0], [0.0, 0.0, 0.0], [1.0, -1.0, -3.0], [5.0, 5.0, 1e-300]],
        dtype=torch.float64,
    )
    points = torch.cat([seen_points(camera, 1, 3), bad]).requires_grad_()
    values = [
        getattr(camera, name).clone().requires_grad_()
        for name in ("rotation", "translation", "distortion")
    ]
    camera = camera.replace(rotation=values[0], translation=values[1], distortion=values[2])
    screen = camera.screen(points)
    assert screen.isfinite().all()
    everything = torch.autograd.grad(screen.square().sum(), [*values, points], retain_graph=True)
    assert all(slope.isfinite().all() for slope in everything)
    only_front = torch.autograd.grad(screen[:3].square().sum(), [*values, points])
    alone = torch.autograd.grad(camera.screen(points[:3].detach()).square().sum(), values)
    for a, b in zip(only_front, alone, strict=False):
        torch.testing.assert_close(a, b)
    assert (only_front[-1][3:] == 0).all()


def fold_by_scanning(k: torch.Tensor) -> float:
    """The first radius on a fine grid up to 3 where the picture's radius does not grow, squared."""
    radius = torch.linspace(0, 3, 300_001, dtype=torch.float64)
    pure = k.clone()
    pure[2:4] = 0.0
    drawn = distorted(torch.stack([radius, 0 * radius], -1), pure)[:, 0]
    fall = (drawn.diff() <= 0).nonzero()
    return math.inf if len(fall) == 0 else radius[fall[0, 0]].item() ** 2


def test_the_valid_radius_ends_where_the_picture_folds():
    folds = 0
    for seed in range(60):
        camera = some_camera(seed)
        limit = camera.valid_radius_squared().item()
        scanned = fold_by_scanning(camera.distortion)
        folds += scanned < math.inf
        assert limit == pytest.approx(scanned, rel=1e-4) if scanned < math.inf else limit > 9.0
    assert 10 < folds < 60
    assert Camera.of(
        4, 4, distortion=[-0.3, 0, 0, 0]
    ).valid_radius_squared().item() == pytest.approx(1 / 0.9)
    for none in (None, torch.zeros(8), [0.2, 0.1, 0.0, 0.0, 0.05]):
        assert Camera.of(4, 4, distortion=none).valid_radius_squared().item() == math.inf


@seeds
def test_rays_undo_projection_wherever_the_lens_is_valid(seed):
    camera = some_camera(seed)
    camera = camera.replace(
        distortion=camera.distortion * torch.tensor([1, 1, 0.1, 0.1, 1, 1, 1, 1])
    )
    reach = min(0.95 * camera.valid_radius_squared().item() ** 0.5, 1.2)
    angle = math.pi * uniform(seed, 200)
    radius = reach * uniform(seed + 1, 200)
    rays = torch.stack(
        [radius * angle.cos(), radius * angle.sin(), torch.ones(200, dtype=torch.float64)], -1
    )
    assert (camera.rays(camera.project_camera_points(rays)) - rays).abs().max() < 1e-9


def test_rays_have_first_derivatives():
    camera = some_camera(5)
    pixels = torch.tensor([[300.0, 200.0], [20.0, 30.0], [600.0, 470.0]], dtype=torch.float64)

    def rays(pixels, lens, focal):
        return camera.replace(distortion=lens, focal_length=focal).rays(pixels)

    inputs = (pixels, camera.distortion, camera.focal_length)
    assert torch.autograd.gradcheck(rays, [value.clone().requires_grad_() for value in inputs])
    forward = torch.func.jacfwd(rays, argnums=(0, 1, 2))(*inputs)
    for a, b in zip(forward, torch.func.jacrev(rays, argnums=(0, 1, 2))(*inputs), strict=True):
        torch.testing.assert_close(a, b)


def test_a_pixel_that_no_ray_reaches_is_nan_and_poisons_nothing():
    lens = torch.tensor([-0.3, 0, 0, 0, 0, 0, 0, 0], dtype=torch.float64, requires_grad=True)
    rays = Camera.of(200, 200, 100.0, distortion=lens).rays(
        torch.tensor([[300.0, 100.0], [130.0, 90.0]]).double()
    )
    assert rays[0, :2].isnan().all() and rays[1].isfinite().all()
    assert torch.autograd.grad(rays[1].sum(), lens)[0].isfinite().all()


def test_batches_are_loops():
    cameras = [some_camera(seed) for seed in range(4)]
    names = ("focal_length", "principal_point", "rotation", "translation", "distortion")
    together = cameras[0].replace(
        **{name: torch.stack([getattr(c, name) for c in cameras]) for name in names}
    )
    points = torch.stack([seen_points(c, seed) for seed, c in enumerate(cameras)])
    assert together.batch_shape == (4,)
    for k, camera in enumerate(cameras):
        torch.testing.assert_close(together.screen(points)[k], camera.screen(points[k]))
        torch.testing.assert_close(together.screen(points[0])[k], camera.screen(points[0]))
        torch.testing.assert_close(
            together.rays(points[k, :, :2])[k], camera.rays(points[k, :, :2]), equal_nan=True
        )
        torch.testing.assert_close(
            together.valid_radius_squared()[k], camera.valid_radius_squared()
        )
    shared = cameras[0].replace(translation=together.translation)
    torch.testing.assert_close(
        shared.screen(points[0])[2],
        shared.replace(translation=cameras[2].translation).screen(points[0]),
    )
    mapped = torch.func.vmap(lambda turn: cameras[0].replace(rotation=turn).screen(points[0]))(
        together.rotation
    )
    torch.testing.assert_close(
        mapped, cameras[0].replace(rotation=together.rotation).screen(points[0])
    )


def test_a_scaled_camera_sees_the_same_picture_in_other_pixels():
    camera = some_camera(2)
    points = seen_points(camera, 2)
    half = camera.scaled(0.5)
    assert (half.width, half.height) == (320, 240)
    torch.testing.assert_close(half.project(points)[0], camera.project(points)[0] / 2)


def test_float32_is_float64_to_its_own_precision():
    camera = some_camera(4)
    points = seen_points(camera, 4)
    single = camera.to(torch.float32).screen(points.float())
    assert single.dtype == torch.float32 and (single - camera.screen(points)).abs().max() < 2e-2


@seeds
def test_look_at_puts_the_target_in_the_middle_and_up_upwards(seed):
    eye, target, up = uniform(seed, 3, 3)
    rotation, translation = look_at(eye, target, up)
    camera = Camera.of(640, 480, 500.0, rotation=rotation, translation=translation)
    (pixel,), (depth,) = camera.project(target[None])
    torch.testing.assert_close(pixel, pixel.new_tensor([320.0, 240.0]))
    torch.testing.assert_close(depth, (target - eye).norm())
    torch.testing.assert_close(camera.to_world(torch.zeros(1, 3, dtype=torch.float64))[0], eye)
    above = camera.project((target + 1e-3 * up)[None])[0][0]
    assert above[1] < pixel[1] and (above[0] - pixel[0]).abs() < 1e-6


GOOD = {"width": 64, "height": 48, "focal_length": 50.0}


@pytest.mark.wrong_shapes
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"width": 0}, "width is 0"),
        ({"height": 4.5}, "height is 4.5"),
        ({"near": 0.0}, "near is 0.0"),
        ({"focal_length": 0.0}, "focal_length is not greater than 0"),
        ({"focal_length": [1.0, 2.0, 3.0]}, r"focal_length is \(3,\)"),
        ({"focal_length": "long"}, "focal_length is 'long'"),
        ({"rotation": [0.0, math.nan, 0.0]}, "rotation has NaN"),
        ({"translation": torch.zeros(4)}, r"translation is \(4,\)"),
        ({"distortion": [0.1, 0.2]}, "expected 4, 5 or 8"),
        (
            {"rotation": torch.zeros(2, 3), "translation": torch.zeros(3, 3)},
            "leading axes do not fit",
        ),
    ],
)
def test_bad_cameras_are_one_clear_line(changes, words):
    with pytest.raises(HabitusError, match=words) as caught:
        Camera.of(**(GOOD | changes))
    assert "\n" not in str(caught.value)


@pytest.mark.wrong_shapes
def test_bad_use_is_one_clear_line():
    camera = Camera.of(**GOOD)
    points = torch.zeros(5, 3, dtype=torch.float64)
    eye = torch.zeros(3, dtype=torch.float64)
    uses = [
        (lambda: camera.screen(points[0]), r"points are \(3,\)"),
        (lambda: camera.screen(points[:, :2]), r"points are \(5, 2\)"),
        (lambda: camera.screen(points.float()), "float32"),
        (lambda: camera.rays(points), r"points are \(5, 3\)"),
        (lambda: camera.scaled(0.0), "factor is 0.0"),
        (lambda: camera.replace(focal=3), "no field focal"),
        (lambda: camera.replace(rotation=torch.zeros(3)), "float32"),
        (lambda: camera.replace(rotation=[0, 0, 0]), "rotation is list"),
        (lambda: look_at(eye, eye), "eye is target"),
        (lambda: look_at(eye, eye + torch.tensor([0.0, 1.0, 0.0])), "up points along"),
        (lambda: Camera.from_opencv(np.eye(3)[:2], None, eye, eye, 4, 4), "camera matrix"),
        (
            lambda: Camera.from_opencv(np.eye(3), None, -np.eye(3), eye, 4, 4),
            "expected a rotation matrix",
        ),
        (
            lambda: Camera.from_opencv(np.eye(3), [0.0] * 8 + [1.0] * 4, eye, eye, 4, 4),
            "thin prism",
        ),
    ]
    for use, words in uses:
        with pytest.raises(HabitusError, match=words):
            use()
