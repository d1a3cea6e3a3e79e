import math
from functools import partial
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch

from habitus.errors import HabitusError
from habitus.observe import images as im

SIZES = [(1, 1), (1, 2), (2, 1), (1, 5), (2, 3), (3, 3), (4, 4), (5, 8), (16, 16), (17, 30)]
sizes = pytest.mark.parametrize("size", SIZES, ids=str)
PYRAMIDS = [im.gaussian_pyramid, im.laplacian_pyramid]
pyramids = pytest.mark.parametrize("pyramid", PYRAMIDS)


def some_image(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@sizes
def test_levels_are_opencvs_pyrdown(size):
    levels = im.gaussian_pyramid(some_image(*size, 3), 4)
    assert len(levels) == 5
    for fine, coarse in pairwise(levels):
        assert coarse.shape == ((fine.shape[0] + 1) // 2, (fine.shape[1] + 1) // 2, 3)
        if min(fine.shape[:2]) > 1:  # OpenCV's mirror needs two pixels
            assert (
                np.abs(coarse.numpy() - cv2.pyrDown(fine.numpy()).reshape(coarse.shape)).max()
                < 1e-12
            )


@pytest.mark.parametrize("size", [(4, 4), (16, 16), (8, 30)], ids=str)
def test_bands_are_those_of_opencvs_pyrup(size):
    image = some_image(*size, 3)
    coarse = im.gaussian_pyramid(image, 1)[1]
    band = image.numpy() - cv2.pyrUp(coarse.numpy(), dstsize=size[::-1])
    assert np.abs(im.laplacian_pyramid(image, 1)[0].numpy() - band).max() < 1e-12


@sizes
def test_a_constant_image_is_constant_at_all_levels_and_has_no_bands(size):
    image = torch.full((*size, 2), 3.5, dtype=torch.float64)
    for level in im.gaussian_pyramid(image, 5):
        torch.testing.assert_close(level, torch.full_like(level, 3.5))
    *bands, rest = im.laplacian_pyramid(image, 5)
    assert all(band.abs().max() < 1e-14 for band in bands)
    torch.testing.assert_close(rest, torch.full_like(rest, 3.5))


@sizes
def test_a_laplacian_pyramid_gives_its_image_back(size):
    image = some_image(2, *size, 3)
    torch.testing.assert_close(
        im.from_laplacian_pyramid(im.laplacian_pyramid(image, 4)), image, rtol=0, atol=1e-14
    )


@pyramids
def test_pyramids_are_linear_and_batches_are_loops(pyramid):
    one = some_image(4, 9, 14, 2)
    two = some_image(4, 9, 14, 2, seed=1)
    parts = [im.as_vector(pyramid(image, 3)) for image in (one, two)]
    torch.testing.assert_close(im.as_vector(pyramid(2 * one - two, 3)), 2 * parts[0] - parts[1])
    assert parts[0].shape == (4, 2 * (9 * 14 + 5 * 7 + 3 * 4 + 2 * 2))
    torch.testing.assert_close(parts[0][2], im.as_vector(pyramid(one[2], 3)))


@pyramids
def test_a_mirrored_image_has_mirrored_levels(pyramid):
    image = some_image(17, 9, 2)  # 2^k + 1: both borders are kept at all levels
    for level, mirrored in zip(pyramid(image, 3), pyramid(image.flip(0, 1), 3), strict=True):
        torch.testing.assert_close(mirrored.flip(0, 1), level)


def test_each_level_is_blurrier_than_the_last():
    step = torch.zeros(64, 64, 1, dtype=torch.float64)
    step[:, 32:] = 1.0
    steepest = [
        level[..., 1:, :].sub(level[..., :-1, :]).max() / 2**k
        for k, level in enumerate(im.gaussian_pyramid(step, 4))
    ]
    assert all(b < 0.75 * a for a, b in pairwise(steepest))


@pyramids
def test_normalisations_weigh_levels_as_opendr_does(pyramid):
    image = some_image(2, 12, 10, 3)
    start = some_image(2, 12, 10, 3, seed=1)
    plain = pyramid(image, 2)
    first = pyramid(start, 2)
    for level, bare in zip(pyramid(image, 2, "size"), plain, strict=True):
        torch.testing.assert_close(level, bare / bare[0].numel())
    for level, bare, ref in zip(pyramid(image, 2, "SSE", start), plain, first, strict=True):
        torch.testing.assert_close(level, bare / ref.flatten(1).norm(dim=1)[:, None, None, None])
    for level in pyramid(start, 2, "SSE", start):
        torch.testing.assert_close(
            level.square().sum((1, 2, 3)), torch.ones(2, dtype=torch.float64)
        )


def test_the_reference_is_constant_and_a_black_one_divides_nothing():
    image = some_image(6, 6, 1).requires_grad_()
    square = im.as_vector(im.gaussian_pyramid(image, 2, "SSE", image)).square().sum()
    assert (
        torch.autograd.grad(square, image)[0].abs().max() > 0.01
    )  # of a self-normalised one it would be 0
    black = torch.zeros(6, 6, 1, dtype=torch.float64)
    for a, b in zip(
        im.gaussian_pyramid(image, 2, "SSE", black), im.gaussian_pyramid(image, 2), strict=True
    ):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("size", [(1, 1), (2, 5), (6, 7)], ids=str)
@pytest.mark.parametrize(
    "function",
    [
        lambda x: im.as_vector(im.gaussian_pyramid(x, 2, "size")),
        lambda x: im.as_vector(im.laplacian_pyramid(x, 2, "SSE", torch.ones_like(x).detach())),
        lambda x: im.as_vector(im.edges(x)),
        im.moments,
        im.central_moments,
        im.normalized_moments,
    ],
)
def test_derivatives_are_right_both_ways(function, size):
    image = some_image(*size, 2) + 0.1
    assert torch.autograd.gradcheck(function, image.clone().requires_grad_())
    torch.testing.assert_close(
        torch.func.jacfwd(function)(image), torch.func.jacrev(function)(image)
    )


def test_edges_are_differences_of_neighbours():
    ramp = (3.0 * torch.arange(5)[None, :] - 2.0 * torch.arange(4)[:, None])[..., None]
    across, down = im.edges(ramp)
    assert across.shape == (4, 4, 1) and (across == 3).all()
    assert down.shape == (3, 5, 1) and (down == -2).all()
    assert [part.shape for part in im.edges(some_image(1, 1, 3))] == [(1, 0, 3), (0, 1, 3)]
    assert im.as_vector(im.edges(some_image(2, 1, 1, 3))).shape == (2, 0)


@pytest.mark.parametrize("size", [(1, 1), (3, 8), (40, 30)], ids=str)
def test_moments_are_opencvs(size):
    image = some_image(*size)
    theirs = cv2.moments(image.numpy())
    raw = im.moments(image[..., None])[:, 0]
    central = im.central_moments(image[..., None])[:, 0]
    middle = [theirs["m10"] / theirs["m00"] + 0.5, theirs["m01"] / theirs["m00"] + 0.5]
    expected = [theirs["m00"], *middle, theirs["mu20"], theirs["mu11"], theirs["mu02"]]
    torch.testing.assert_close(
        central, torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-9
    )
    torch.testing.assert_close(raw[1:3] / raw[0], torch.tensor(middle, dtype=torch.float64))
    eta = torch.tensor([theirs["nu20"], theirs["nu11"], theirs["nu02"]], dtype=torch.float64)
    torch.testing.assert_close(
        im.normalized_moments(image[..., None])[:, 0], eta, rtol=1e-9, atol=1e-9
    )


def test_moments_of_a_moved_image_move():
    image = torch.zeros(2, 60, 50, 2, dtype=torch.float64)
    image[:, 5:25, 8:20] = some_image(2, 20, 12, 2)
    moved = image.roll((13, 21), (1, 2))
    m00, m10, m01, m20, m11, m02 = im.moments(image).unbind(-2)
    shifted = [m00, m10 + 21 * m00, m01 + 13 * m00]
    shifted += [
        m20 + 42 * m10 + 441 * m00,
        m11 + 21 * m01 + 13 * m10 + 273 * m00,
        m02 + 26 * m01 + 169 * m00,
    ]
    torch.testing.assert_close(im.moments(moved), torch.stack(shifted, -2))
    move = torch.tensor([0, 21, 13, 0, 0, 0], dtype=torch.float64)[:, None]
    torch.testing.assert_close(im.central_moments(moved), im.central_moments(image) + move)
    torch.testing.assert_close(im.normalized_moments(moved), im.normalized_moments(image))
    single = im.central_moments(moved.float()) - im.central_moments(moved)
    assert (single / im.central_moments(moved)).abs().max() < 1e-4


def test_an_empty_silhouette_has_no_centroid_and_finite_derivatives():
    image = torch.zeros(4, 5, 1, dtype=torch.float64, requires_grad=True)
    for function in (im.central_moments, im.normalized_moments):
        assert (function(image) == 0).all()
        assert torch.autograd.grad(function(image).sum(), image)[0].isfinite().all()


def test_a_mask_hides_whatever_lies_outside():
    image = some_image(2, 4, 5, 3)
    observed = some_image(2, 4, 5, 3, seed=1)
    mask = some_image(4, 5, seed=2) > 0.5
    broken = image.clone()
    holes = observed.clone()
    broken[:, ~mask], holes[:, ~mask] = math.inf, math.nan
    broken.requires_grad_()
    difference = im.masked_difference(broken, holes, mask)
    torch.testing.assert_close(difference, (image - observed) * mask[..., None])
    (slope,) = torch.autograd.grad(difference.square().sum(), broken)
    torch.testing.assert_close(slope, 2 * (image - observed) * mask[..., None])


POWERS = (0.5, 1.0, 1.5, 2.0)
ROBUST = {"geman_mcclure": im.geman_mcclure, "huber": im.huber} | {
    f"power {power}": partial(im.power_law, power=power) for power in POWERS
}


@pytest.mark.parametrize("function", ROBUST.values(), ids=ROBUST)
def test_robust_differences_are_plain_near_zero_odd_and_smooth(function):
    small = torch.linspace(-1e-5, 1e-5, 11, dtype=torch.float64)
    torch.testing.assert_close(function(small, 0.1), small, rtol=1e-6, atol=1e-15)
    wide = torch.linspace(-3, 3, 61, dtype=torch.float64)
    torch.testing.assert_close(function(-wide, 0.4), -function(wide, 0.4))
    assert (function(wide, 0.4).diff() > 0).all()
    points = torch.tensor([-2.0, -0.3, 0.0, 1e-7, 0.2, 5.0], dtype=torch.float64)
    assert torch.autograd.gradcheck(partial(function, scale=0.4), points.clone().requires_grad_())
    forward = torch.func.jacfwd(partial(function, scale=0.4))(points)
    torch.testing.assert_close(forward, torch.func.jacrev(partial(function, scale=0.4))(points))
    assert function(points.float(), 0.4).dtype == torch.float32


def test_squares_of_robust_differences_are_the_named_losses():
    d = torch.linspace(-4, 4, 82, dtype=torch.float64)
    s = 0.7
    torch.testing.assert_close(im.geman_mcclure(d, s) ** 2, s**2 * d**2 / (s**2 + d**2))
    torch.testing.assert_close(
        im.huber(d, s) ** 2, torch.where(d.abs() <= s, d**2, 2 * s * d.abs() - s**2)
    )
    torch.testing.assert_close(
        im.huber(d, s) ** 2, 2 * torch.nn.functional.huber_loss(d, 0 * d, reduction="none", delta=s)
    )
    for power in (0.5, 1.0, 1.7):
        loss = 2 * s**2 / power * ((1 + (d / s) ** 2) ** (power / 2) - 1)
        torch.testing.assert_close(im.power_law(d, s, power) ** 2, loss)
        far = torch.tensor([1e6, 2e6], dtype=torch.float64)
        growth = (im.power_law(far, s, power) ** 2).log2().diff().item()
        assert growth == pytest.approx(power, abs=1e-2)
    torch.testing.assert_close(im.power_law(d, s, 2.0), d)


@pytest.mark.wrong_shapes
def test_bad_images_are_one_clear_line():
    image = some_image(4, 5, 3)
    mask = torch.ones(4, 5, dtype=torch.bool)
    uses = [
        (lambda: im.gaussian_pyramid(image[..., 0]), r"image is \(4, 5\)"),
        (lambda: im.moments(image[:0]), r"image is \(0, 5, 3\)"),
        (lambda: im.edges((255 * image).byte()), "uint8"),
        (lambda: im.laplacian_pyramid(image, -1), "num_levels is -1"),
        (lambda: im.gaussian_pyramid(image, 2, "sse"), "normalization is 'sse'"),
        (lambda: im.gaussian_pyramid(image, 2, "SSE"), "reference is None"),
        (lambda: im.gaussian_pyramid(image, 2, "SSE", image[1:]), r"reference is \(3, 5, 3\)"),
        (lambda: im.masked_difference(image, image, mask.float()), "bool mask"),
        (lambda: im.masked_difference(image, image, mask[1:]), r"\(3, 5\)"),
        (lambda: im.masked_difference(image, image[1:], mask), "of one size"),
        (lambda: im.huber(image, 0.0), "scale is 0.0"),
        (lambda: im.power_law(image, 1.0, 3.0), "power is 3.0"),
    ]
    for use, words in uses:
        with pytest.raises(HabitusError, match=words) as caught:
            use()
        assert "\n" not in str(caught.value)
