"""Depth and colour images from files: 16-bit PNG, 8-bit PNG and JPEG."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from habitus.errors import HabitusError, require_extra
from habitus.io.archives import reason
from habitus.io.limits import MAX_IMAGE_BYTES, MAX_IMAGE_PIXELS, Allowance, read_file

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm")
_KEPT_MODES = ("L", "RGB", "RGBA", "I", "I;16", "I;16B", "I;16L", "F")


def read_image(path: Path) -> np.ndarray:
    """The numbers of an image (H, W) or (H, W, C) as they are stored. Raises HabitusError."""
    with _opened(path) as image:
        if image.mode not in _KEPT_MODES:
            image = image.convert("L" if image.mode in ("1", "LA", "La") else "RGB")
        return np.array(image)


def check_images(paths: Iterable[Path]) -> None:
    """Raise HabitusError, before any image is decoded, where one is none, or where all together
    would fill more memory than files of their size may.
    """
    paths = tuple(dict.fromkeys(paths))
    sizes = [path.stat().st_size if path.is_file() else 0 for path in paths]
    allowance = Allowance(sum(sizes), MAX_IMAGE_BYTES)
    for path in paths:
        with _opened(path) as image:
            width = max(4 if image.mode[:1] in "IF" else 1, len(image.getbands()))
            allowance.take_bytes(image.width * image.height * width, "with this image, all views")


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An image of which only the header is read; whatever a damaged one raises is a
    HabitusError.
    """
    require_extra("PIL", "image files", "rgbd")
    from PIL import Image

    try:
        # From memory, since a read of a damaged chunk's length then ends where the file does.
        with Image.open(BytesIO(read_file(path))) as image:
            if image.width * image.height > MAX_IMAGE_PIXELS:
                raise HabitusError(
                    f"{image.width} x {image.height} pixels; expected a camera's image"
                )
            yield image
    except FileNotFoundError:
        raise HabitusError(f"{path}: no such file; expected an image") from None
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}") from error
    except Exception as error:  # a damaged file may raise anything
        raise HabitusError(
            f"{path}: cannot be read as an image ({reason(error)}); get it again"
        ) from error


def read_depth(path: Path, metres: float) -> Float[np.ndarray, "H W"]:
    """Depth in metres, 0 where there is none: whole numbers of 16 bits times ``metres``, or
    floating numbers.

    Raises HabitusError for colour images and for 8 bits, which hold no depth.
    """
    image = read_image(path)
    if image.ndim != 2 or image.dtype.itemsize < 2:
        kind = (
            f"{image.shape[2]} channels" if image.ndim == 3 else f"{8 * image.dtype.itemsize} bits"
        )
        raise HabitusError(
            f"{path}: has {kind}; expected depth in one channel of 16 bits, as a PNG"
        )
    with np.errstate(invalid="ignore"):
        depth = image.astype(np.float32) * np.float32(metres)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))


def read_colour(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Colours of 8 bits; grey images become three equal channels. Raises HabitusError."""
    image = read_image(path)
    if image.dtype.kind == "f":
        raise HabitusError(f"{path}: has floating-point numbers; expected colours of 8 or 16 bits")
    if image.dtype.itemsize > 1:
        scaled = image.astype(np.float64) / np.iinfo(image.dtype).max * 255
        image = scaled.clip(0.0, 255.0).astype(np.uint8)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3].astype(np.uint8))


def read_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Where an image is not black. Raises HabitusError."""
    image = read_image(path)
    flat = image if image.ndim == 2 else image[..., :3].max(-1)
    return flat > flat.max(initial=0) / 2
