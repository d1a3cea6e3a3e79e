"""sRGB and linear light (IEC 61966-2-1): what files hold, and what light adds up in."""

import numpy as np
from jaxtyping import Float, UInt8


def linear_from_srgb(value: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Linear light, 0 to 1, of values of sRGB, 0 to 1."""
    return np.where(
        value <= 0.04045, value / 12.92, ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4
    )


def srgb_bytes(linear: Float[np.ndarray, "*any"]) -> UInt8[np.ndarray, "*any"]:
    """Bytes of sRGB of linear light; what is darker than 0 or brighter than 1 is cut off."""
    value = np.clip(linear, 0.0, 1.0)
    curve = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.round(255 * curve).astype(np.uint8)
