"""Small pictures: people stand on the floor of the picture, as tall as they are, and a PNG is what
readers expect.
"""

import io

import numpy as np
import pytest
from PIL import Image
from planted import person
from synthetic_fit import synthetic_fit

from habitus.export.png import png, small_png
from habitus.report.archive import (
    HEIGHT,
    METRES,
    MOMENTS,
    motion_picture,
    palette,
    shape_picture,
)


def opened(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))


def test_png_files_hold_their_pixels():
    rng = np.random.default_rng(0)
    image = rng.integers(256, size=(5, 7, 4), dtype=np.uint8)
    np.testing.assert_array_equal(opened(png(image)), image)
    levels = rng.integers(16, size=(4, 7), dtype=np.uint8)
    found = opened(small_png(levels, palette()))
    np.testing.assert_array_equal(found[..., :3], palette()[levels])
    np.testing.assert_array_equal(found[..., 3] > 0, levels > 0)


def test_a_person_is_as_tall_as_the_body_and_stands_on_the_floor():
    body = person()
    betas = np.zeros(4)
    seen = opened(shape_picture(body, betas))[..., 3] > 0
    rows = np.flatnonzero(seen.any(axis=1))
    tall = np.ptp(np.asarray(body.rest_vertices(betas))[:, 1])
    assert rows[-1] >= HEIGHT - 2 and np.ptp(rows) == pytest.approx(HEIGHT * tall / METRES, abs=2)
    inside = seen[rows[0] : rows[-1]]  # no holes along the middle of the trunk
    assert inside[HEIGHT // 5 : HEIGHT // 2 - 4, HEIGHT // 2].all()  # above the crotch


def test_a_motion_shows_its_moments_side_by_side():
    picture = opened(motion_picture(synthetic_fit(frames=20)))
    thirds = np.array_split(picture[..., 3] > 0, MOMENTS, axis=1)
    assert picture.shape[0] == HEIGHT and all(part.sum() > 50 for part in thirds)
