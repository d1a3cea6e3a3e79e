"""Brightness of vertices under light (T 4.3): spherical harmonics, Lambertian point lights, ambient
light.

Each function gives brightness (*batch, V, C) from unit normals
(`habitus.mesh.normals.vertex_normals`). Lights add, and what is drawn is their sum times the
albedo:

    values = albedo * (spherical_harmonics(normals, coefficients) + point_light(points, normals,
    position, colour))

Anything else that gives (*batch, V, C) may stand in their place. Nothing casts a shadow, and no
light comes back from other surfaces.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from habitus.arrays import broadcast_shapes
from habitus.errors import HabitusError
from habitus.observe.light import harmonics


def spherical_harmonics(
    normals: Float[Tensor, "*#batch V 3"],
    coefficients: Float[Tensor, "*#batch 9 C"] | Float[Tensor, "9"],
) -> Float[Tensor, "*batch V C"]:
    """Brightness from light that depends only on its direction (Ramamoorthi and Hanrahan 2001, T
    4.3).

    ``coefficients`` are the nine of the incoming light, in the order (l, m) = (0, 0), (1, -1), (1,
    0), (1, 1), (2, -2), (2, -1), (2, 0), (2, 1), (2, 2), which vary over directions as 1, y, z, x,
    xy, yz, 3 z^2 - 1, xz, x^2 - y^2; a plain (9,) is one grey light, C = 1. (1, 0, ..., 0) gives
    sqrt(pi)/2 = 0.886 everywhere. Brightness is linear in them and not cut off at zero: dark sides
    may come out a little negative. (OpenDR has x, z, y instead of y, z, x, no factors of a
    Lambertian surface, and cuts off.)
    """
    if coefficients.ndim < 1 or coefficients.shape[0 if coefficients.ndim == 1 else -2] != 9:
        raise HabitusError(
            f"coefficients are {tuple(coefficients.shape)}; expected (9,) or (*batch, 9, channels)"
        )
    if coefficients.dtype != normals.dtype:
        raise HabitusError(
            f"coefficients are {coefficients.dtype}, normals {normals.dtype}; convert one"
        )
    return harmonics(normals) @ (coefficients[:, None] if coefficients.ndim == 1 else coefficients)


def point_light(
    points: Float[Tensor, "*#batch V 3"],
    normals: Float[Tensor, "*#batch V 3"],
    position: Float[Tensor, "*#batch 3"],
    colour: Float[Tensor, "*#batch C"],
) -> Float[Tensor, "*batch V C"]:
    """Brightness of a Lambertian surface under a lamp at ``position``: colour times the cosine,
    zero from behind.

    The lamp does not fade with distance. A point exactly at the lamp gets none.
    """
    _check("points", points)
    _check("normals", normals)
    if position.ndim < 1 or position.shape[-1] != 3:
        raise HabitusError(f"a light's position is {tuple(position.shape)}; expected (*batch, 3)")
    _check_colour(colour)
    way = position[..., None, :] - points
    squared = (way * way).sum(-1)
    away = squared > torch.finfo(way.dtype).tiny
    cosine = (way * normals).sum(-1) * squared.where(away, 1.0).rsqrt()
    return cosine.clamp(min=0.0)[..., None] * colour[..., None, :]


def ambient(
    points: Float[Tensor, "*#batch V 3"], colour: Float[Tensor, "*#batch C"]
) -> Float[Tensor, "*batch V C"]:
    """The same brightness ``colour`` for each of ``points`` (of which only the number counts)."""
    _check("points", points)
    _check_colour(colour)
    shape = broadcast_shapes(points.shape[:-1], (*colour.shape[:-1], 1))
    return colour[..., None, :].expand(*shape, colour.shape[-1])


def _check(name: str, values: Tensor) -> None:
    if values.ndim < 2 or values.shape[-1] != 3:
        raise HabitusError(f"{name} are {tuple(values.shape)}; expected (*batch, V, 3)")


def _check_colour(colour: Tensor) -> None:
    if colour.ndim < 1:
        raise HabitusError(
            "a light's colour is one number; expected (*batch, channels), such as (1,) or (3,)"
        )
