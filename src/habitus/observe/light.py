"""Light on a surface, in NumPy or torch: real spherical harmonics of orders 0, 1 and 2 of unit
normals; sRGB, which is what files hold, and linear light, which adds up (IEC 61966-2-1).

In the order (l, m) = (0, 0), (1, -1), (1, 0), (1, 1), (2, -2), (2, -1), (2, 0), (2, 1), (2, 2) the
harmonics vary over directions as 1, y, z, x, xy, yz, 3 z^2 - 1, xz, x^2 - y^2.
"""

import math

import numpy as np
from jaxtyping import Float, UInt8

from habitus.arrays import constant, namespace, unbind
from habitus.errors import HabitusError
from habitus.types import Array

_FACTORS = [
    math.sqrt(math.pi * scale)
    for scale in (1 / 4, *3 * [1 / 3], 15 / 64, 15 / 64, 5 / 256, 15 / 64, 15 / 256)
]
"""Of each term: the harmonic's normalisation times pi, 2 pi/3 or pi/4 for orders 0, 1 and 2, which
is what a Lambertian surface keeps of the order.
"""


def harmonic_terms(normals: Float[Array, "*batch V 3"]) -> Float[Array, "*batch V 9"]:
    """The nine harmonics of unit normals without their factors."""
    _check(normals)
    xp = namespace(normals)
    x, y, z = unbind(normals)
    one = xp.ones_like(x)
    return xp.stack([one, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], -1)


def harmonics(normals: Float[Array, "*batch V 3"]) -> Float[Array, "*batch V 9"]:
    """What each of the nine lights of `habitus.observe.lighting.spherical_harmonics` gives to unit
    normals: brightness is this times their coefficients.

    Each harmonic is multiplied by what a Lambertian surface keeps of its order: pi, 2 pi/3, pi/4
    (Ramamoorthi and Hanrahan 2001).
    """
    return harmonic_terms(normals) * constant(_FACTORS, normals)


def harmonics_slope(normals: Float[Array, "*batch V 3"]) -> Float[Array, "*batch V 9 3"]:
    """The derivative of `harmonics` to normals, as if these were free in all three directions."""
    _check(normals)
    xp = namespace(normals)
    x, y, z = unbind(normals)
    zero = xp.zeros_like(x)
    one = xp.ones_like(x)
    rows = [
        (zero, zero, zero),
        (zero, one, zero),
        (zero, zero, one),
        (one, zero, zero),
        (y, x, zero),
        (zero, z, y),
        (zero, zero, 6 * z),
        (z, zero, x),
        (2 * x, -2 * y, zero),
    ]
    terms = xp.stack([xp.stack(row, -1) for row in rows], -2)
    return terms * constant(_FACTORS, normals)[:, None]


def _check(normals: Array) -> None:
    if normals.ndim < 2 or normals.shape[-1] != 3:
        raise HabitusError(f"normals are {tuple(normals.shape)}; expected (*batch, V, 3)")


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
