"""The renderer with tensors on a GPU: the same images and gradients, on their device."""

import pytest
import torch
from scenes import SCENES, scene

from habitus.render.draw import draw

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")


@pytest.mark.parametrize("boundary", ["antialias", "exact", "filter", "none"])
@pytest.mark.parametrize("name", SCENES)
def test_images_and_gradients_are_those_of_the_processor(name, boundary):
    def look(device: str) -> tuple[torch.Tensor, ...]:
        camera, vertices, triangles = scene(name)
        vertices = vertices.to(device).requires_grad_()
        values = vertices.detach().abs().requires_grad_()
        frame = draw(camera.to(device), vertices, triangles.to(device), boundary=boundary)
        image = frame.image(values)
        depth = frame.depth()
        make = torch.Generator().manual_seed(4)
        weights = torch.rand(image.shape, generator=make, dtype=image.dtype).to(device)
        seen = depth.isfinite()
        (image * weights).sum().backward(retain_graph=True)
        (torch.where(seen, depth, 0.0).sum() / seen.sum()).backward()
        assert image.device.type == depth.device.type == vertices.grad.device.type == device
        return tuple(part.detach().cpu() for part in (image, depth, vertices.grad, values.grad))

    for here, there, what in zip(
        look("cpu"), look("cuda"), ("image", "depth", "vertices", "values"), strict=True
    ):
        assert here.isfinite().equal(there.isfinite()), what
        scale = float(here[here.isfinite()].abs().max())
        assert (here - there)[here.isfinite()].abs().max() < 1e-9 * max(scale, 1.0), what
