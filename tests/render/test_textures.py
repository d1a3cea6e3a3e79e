import math

import numpy as np
import pytest
import torch

from habitus.errors import HabitusError
from habitus.render.reference import textures as reference_textures
from habitus.render.textures import Texture, footprint, halve

WRAPS = [("repeat", "clamp"), ("clamp", "repeat")]
SIZES = [(8, 8), (7, 12), (1, 5), (9, 1), (1, 1), (13, 11)]


def random(seed: int, *shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(
        *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    ).to(dtype)


def random_uv(count: int, seed: int = 0, beyond: float = 1.5) -> torch.Tensor:
    """Random texture coordinates from -beyond to 1 + beyond."""
    return (1 + 2 * beyond) * random(seed, count, 2) - beyond


def footprints(count: int, seed: int = 0) -> torch.Tensor:
    """Random footprints from a half to 32 texels."""
    return 2 ** (6 * random(seed, count) - 1)


def sample_reference(texture: Texture, uv: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    """What `Texture.sample` does where there are no kernels."""
    repeat = texture.wrap[0] == "repeat", texture.wrap[1] == "repeat"
    level = size.log2().clamp(0, len(texture.sizes) - 1)
    return reference_textures.sample(texture.texels, uv, level, texture.sizes, repeat)


@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_kernels_and_twin_agree(size, channels, wrap):
    image = random(1, *size, channels).requires_grad_()
    uv = random_uv(200).requires_grad_()
    sizes = footprints(200)
    cotangent = random(2, 200, channels)
    texture = Texture.of(image, wrap=wrap)
    fast = texture.sample(uv, sizes)
    slow = sample_reference(texture, uv, sizes)
    torch.testing.assert_close(fast, slow, rtol=0, atol=1e-12)
    gradients = [
        torch.autograd.grad(found, (image, uv), cotangent, retain_graph=True)
        for found in (fast, slow)
    ]
    for mine, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-12, atol=1e-12)


def test_in_single_precision_too():
    image = random(1, 9, 16, 3)
    uv = random_uv(500, beyond=0.5)
    sizes = footprints(500)
    cotangent = random(2, 500, 3)
    found = []
    for dtype in (torch.float32, torch.float64):
        leaf = image.to(dtype).requires_grad_()
        at = uv.float().to(dtype).requires_grad_()
        values = Texture.of(leaf).sample(at, sizes)
        assert values.dtype == dtype
        found.append((values, *torch.autograd.grad(values, (leaf, at), cotangent.to(dtype))))
    for single, double in zip(*found, strict=True):
        torch.testing.assert_close(single.double(), double, rtol=1e-5, atol=1e-5)


def test_the_more_exact_type_is_kept():
    image = random(1, 4, 4, 3)
    uv = random_uv(5)
    exact = Texture.of(image).sample(uv)
    for found in (Texture.of(image.float()).sample(uv), Texture.of(image).sample(uv.float())):
        assert found.dtype == torch.float64
        torch.testing.assert_close(found, exact, rtol=0, atol=1e-5)


@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize("size", SIZES)
def test_a_constant_texture_is_constant(size, wrap):
    colour = torch.tensor([0.2, 0.5, 0.7], dtype=torch.float64)
    texture = Texture.of(colour.expand(*size, 3), wrap=wrap)
    found = texture.sample(random_uv(100), footprints(100))
    torch.testing.assert_close(found, colour.expand(100, 3), rtol=0, atol=1e-14)


def test_every_level_has_the_mean_of_the_image():
    for height in range(1, 12):
        for width in range(1, 12):
            image = random(height, height, width, 2)
            levels = Texture.of(image).levels
            assert levels[-1].shape == (1, 1, 2)
            for level in levels:
                torch.testing.assert_close(
                    level.mean((0, 1)), image.mean((0, 1)), rtol=1e-13, atol=0
                )


@pytest.mark.parametrize("length", [6, 7, 9])
def test_a_smaller_level_holds_means_over_equal_parts(length):
    row = random(1, length)
    fine = 1000
    parts = length // 2
    cut = row.repeat_interleave(parts * fine).unflatten(0, (parts, length * fine)).mean(1)
    torch.testing.assert_close(halve(row[:, None, None], 0).flatten(), cut, rtol=1e-12, atol=0)


def test_row_0_is_on_top_and_texels_lie_at_half_integers():
    height = 3
    width = 4
    image = torch.arange(12, dtype=torch.float64).reshape(height, width, 1)
    for row in range(height):
        for column in range(width):
            at = torch.tensor(
                [[(column + 0.5) / width, 1 - (row + 0.5) / height]], dtype=torch.float64
            )
            torch.testing.assert_close(
                Texture.of(image).sample(at)[0], image[row, column], rtol=1e-13, atol=1e-13
            )
    corner = Texture.of(image, wrap=("clamp", "clamp")).sample(
        torch.zeros(1, 2, dtype=torch.float64)
    )
    assert corner.item() == image[-1, 0].item()


def test_a_linear_ramp_is_reproduced_between_centres():
    height = 9
    width = 14
    u = (torch.arange(width) + 0.5) / width
    v = 1 - (torch.arange(height) + 0.5) / height
    image = (0.3 + 0.7 * u[None, :] - 1.1 * v[:, None])[..., None].double()
    inside = torch.tensor([[0.5 / width, 0.5 / height]]) + random(0, 200, 2) * torch.tensor(
        [[1 - 1 / width, 1 - 1 / height]]
    )
    inside.requires_grad_()
    found = Texture.of(image).sample(inside)[:, 0]
    torch.testing.assert_close(
        found, 0.3 + 0.7 * inside[:, 0] - 1.1 * inside[:, 1], rtol=0, atol=1e-6
    )
    (cotangent,) = torch.autograd.grad(found.sum(), inside)
    torch.testing.assert_close(
        cotangent, torch.tensor([0.7, -1.1]).double().expand(200, 2), rtol=0, atol=1e-5
    )


def test_repeat_is_periodic_and_continuous_and_clamp_keeps_the_border():
    texture = Texture.of(random(1, 7, 6, 3), wrap=("repeat", "clamp"))
    uv = random_uv(100, beyond=0.0)
    sizes = footprints(100)
    for step in (-2.0, 1.0, 5.0):
        moved = uv + torch.tensor([step, 0.0])
        torch.testing.assert_close(
            texture.sample(moved, sizes), texture.sample(uv, sizes), rtol=0, atol=1e-13
        )
    for whole in (-1.0, 0.0, 1.0):
        seam = torch.tensor([[whole - 1e-12, 0.3], [whole, 0.3], [whole + 1e-12, 0.3]]).double()
        values = texture.sample(seam)
        torch.testing.assert_close(values, values[1:2].expand(3, 3), rtol=0, atol=1e-10)
    for inside, outside in ((1 - 0.5 / 7, 1.7), (0.5 / 7, -3.0), (1.0, 1e30)):
        ends = [torch.tensor([[0.4, v]], dtype=torch.float64) for v in (inside, outside)]
        torch.testing.assert_close(
            texture.sample(ends[0]), texture.sample(ends[1]), rtol=0, atol=1e-13
        )


def test_footprints_choose_levels_and_mix_them_continuously():
    image = random(1, 16, 16, 3)
    uv = random_uv(50)
    texture = Texture.of(image)
    for number, level in enumerate(texture.levels):
        alone = Texture.of(level, mipmaps=False).sample(uv)
        for near in (1 - 1e-12, 1.0, 1 + 1e-12):
            found = texture.sample(uv, torch.full((50,), near * 2.0**number, dtype=torch.float64))
            torch.testing.assert_close(found, alone, rtol=0, atol=1e-10)
    halfway = texture.sample(uv, torch.full((50,), math.sqrt(2), dtype=torch.float64))
    mean = (texture.sample(uv) + texture.sample(uv, torch.full((50,), 2.0))) / 2
    torch.testing.assert_close(halfway, mean, rtol=0, atol=1e-7)
    for tiny in (0.0, 0.3, math.nan):
        assert torch.equal(texture.sample(uv, torch.full((50,), tiny)), texture.sample(uv))
    for huge in (16.0, 1e20, math.inf):
        mean = image.mean((0, 1)).expand(50, 3)
        torch.testing.assert_close(
            texture.sample(uv, torch.full((50,), huge)), mean, rtol=0, atol=1e-13
        )


def test_a_footprint_counts_texels():
    texture = Texture.of(random(1, 8, 32, 1))
    right = torch.tensor([[1 / 32, 0.0], [0.0, 1 / 8], [0.0, 0.0]])
    down = torch.tensor([[0.0, -2 / 8], [0.0, 0.0], [0.0, 0.0]])
    assert footprint(right, down, texture).tolist() == pytest.approx([2.0, 1.0, 0.0])


@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize("size", [(4, 5), (1, 3)])
def test_derivatives_are_those_of_finite_differences(size, wrap):
    image = random(1, *size, 2).requires_grad_()
    uv = random_uv(12, seed=3).requires_grad_()
    sizes = footprints(12)

    def values(image, uv):
        return Texture.of(image, wrap=wrap).sample(uv, sizes)

    assert torch.autograd.gradcheck(values, (image, uv), check_forward_ad=True)


def test_weights_add_up_to_one():
    texture = Texture.of(random(1, 9, 9, 2))
    levels = [level.clone().requires_grad_() for level in texture.levels]
    total = Texture.from_levels(levels).sample(random_uv(300), footprints(300)).sum()
    gradients = torch.autograd.grad(total, levels)
    assert all(cotangent.min() >= 0 for cotangent in gradients)
    assert all(cotangent.max() > 0 for cotangent in gradients)
    assert sum(cotangent.sum().item() for cotangent in gradients) == pytest.approx(600)


@pytest.mark.parametrize("moving", ["texture", "uv", "both"])
def test_forward_mode_agrees_with_the_twin(moving):
    image = random(1, 6, 5, 2)
    uv = random_uv(20)
    sizes = footprints(20)

    def values(state, sampled=Texture.sample):
        brighter = image * state[0] + image**2 * state[1] if moving != "uv" else image
        farther = (uv + state[2:4]) * state[4] if moving != "texture" else uv
        return sampled(Texture.of(brighter), farther, sizes)

    state = torch.tensor([0.7, -0.4, 0.01, -0.02, 1.1], dtype=torch.float64)
    expected = torch.autograd.functional.jacobian(
        lambda state: values(state, sample_reference), state
    )
    torch.testing.assert_close(torch.func.jacfwd(values)(state), expected, rtol=1e-12, atol=1e-12)
    if moving != "texture":
        assert expected[..., 2:].abs().amax((0, 1)).min() > 0.1


def test_gradients_of_torch_func_are_those_of_autograd():
    image = random(1, 6, 5, 2).requires_grad_()
    uv = random_uv(20).requires_grad_()
    sizes = footprints(20)

    def value(image, uv):
        return (Texture.of(image).sample(uv, sizes) ** 2).sum()

    found = torch.func.grad(value, (0, 1))(image.detach(), uv.detach())
    for mine, expected in zip(
        found, torch.autograd.grad(value(image, uv), (image, uv)), strict=True
    ):
        assert torch.equal(mine, expected)


def test_the_level_is_held_fixed():
    texture = Texture.of(random(1, 8, 8, 2))
    uv = random_uv(20)
    sizes = footprints(20)
    step = torch.func.jacfwd(lambda scale: texture.sample(uv, sizes * scale))(
        torch.ones(()).double()
    )
    assert step.count_nonzero() == 0


def test_sums_do_not_depend_on_threads(monkeypatch):
    image = random(1, 33, 20, 3).float()
    uv = random_uv(20_000).float()
    sizes = footprints(20_000).float()
    cotangent = random(2, 20_000, 3).float()
    found = []
    for threads in (1, 2, 3):
        monkeypatch.setenv("NUMBA_NUM_THREADS", str(threads))
        leaf = image.clone().requires_grad_()
        at = uv.clone().requires_grad_()
        values = Texture.of(leaf).sample(at, sizes)
        found.append((values, *torch.autograd.grad(values, (leaf, at), cotangent)))
    for other in found[1:]:
        assert all(torch.equal(mine, first) for mine, first in zip(other, found[0], strict=True))


@pytest.mark.parametrize("wrap", WRAPS)
def test_places_that_are_not_finite_give_nan_and_leave_the_others_alone(wrap):
    texture = Texture.of(random(1, 5, 4, 3), wrap=wrap)
    uv = random_uv(6)
    broken = uv.clone()
    broken[1, 0], broken[2, 1], broken[3, 0], broken[4, 1] = math.nan, math.nan, math.inf, -math.inf
    found = texture.sample(broken, footprints(6))
    good = [0, 5]
    assert found[1:5].isnan().all()
    assert torch.equal(found[good], texture.sample(uv, footprints(6))[good])


def test_no_places_give_no_values():
    texture = Texture.of(random(1, 5, 4, 3).requires_grad_())
    none = torch.zeros(0, 2).double()
    found = texture.sample(none, none[:, 0])
    assert found.shape == (0, 3)
    found.sum().backward()


def test_layouts_in_memory_do_not_matter():
    image = random(1, 3, 6, 5)
    uv = random(2, 2, 40)
    plain = Texture.of(image.permute(1, 2, 0).contiguous()).sample(uv.T.contiguous())
    assert torch.equal(Texture.of(image.permute(1, 2, 0), mipmaps=False).sample(uv.T), plain)
    assert torch.equal(Texture.of(np.moveaxis(image.numpy(), 0, 2)).sample(uv.T), plain)


@pytest.mark.wrong_shapes
def test_bad_textures_are_refused():
    image = random(1, 4, 4, 3)
    for wrong in (image[0], image[None], image[:0], image[:, :0], image[..., :0]):
        with pytest.raises(
            HabitusError, match=r"expected \(height, width, channels\), each at least 1"
        ):
            Texture.of(wrong)
    with pytest.raises(HabitusError, match=r"uint8.*divide bytes by 255"):
        Texture.of((255 * image).to(torch.uint8))
    for value in (math.nan, math.inf):
        broken = image.clone()
        broken[1, 2, 0] = value
        with pytest.raises(HabitusError, match="not finite"):
            Texture.of(broken)
    for wrap in (("repeat",), ("repeat", "mirror")):
        with pytest.raises(HabitusError, match="wrap"):
            Texture.of(image, wrap=wrap)
    with pytest.raises(HabitusError, match="no levels"):
        Texture.from_levels([])
    with pytest.raises(HabitusError, match=r"after one of \(4, 4\); expected \(2, 2\)"):
        Texture.from_levels([image, image[:1, :1]])
    with pytest.raises(HabitusError, match="differs from the first"):
        Texture.from_levels([image, image[:2, :2].float()])


@pytest.mark.wrong_shapes
def test_bad_uv_is_refused():
    texture = Texture.of(random(1, 4, 4, 3))
    uv = random_uv(6)
    for wrong in (uv[0], uv[:, :1], uv[None], uv.long()):
        with pytest.raises(HabitusError, match=r"expected \(N, 2\)"):
            texture.sample(wrong)
    for size in (torch.ones(5), torch.ones(6, 1), torch.ones(())):
        with pytest.raises(HabitusError, match=r"expected one number per uv, \(6,\)"):
            texture.sample(uv, size)
    with pytest.raises(HabitusError, match="vmap"):
        torch.func.vmap(texture.sample)(uv[None])
