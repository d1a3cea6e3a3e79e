"""Triangles: their normals, and places on them in barycentric coordinates.

A place on a triangle with corners a, b, c is u a + v b + w c with u + v + w = 1; (u, v, w) are its
barycentric coordinates.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import cross
from habitus.types import Array


def triangle_normals(corners: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """(b - a) x (c - a) of triangles with these corners (m; corner, coordinate): normals of twice
    the area (m^2) as length, on the side from which the corners run counter-clockwise.
    """
    first = corners[..., 0, :]
    return cross(corners[..., 1, :] - first, corners[..., 2, :] - first)


def at_barycentrics(
    values: Float[np.ndarray, "V C"],
    corners: Int[np.ndarray, "N 3"],
    barycentric: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N C"]:
    """Values of vertices interpolated at N places: ``corners`` are the three vertices of each
    place's triangle.
    """
    return np.einsum("nk,nkc->nc", barycentric, values[corners])


def barycentric_coordinates(
    points: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "N 3 3"]
) -> Float[np.ndarray, "N 3"]:
    """Barycentric coordinates of N points, each in the plane of its triangle (corner,
    coordinate).
    """
    e = corners[:, 1] - corners[:, 0]
    f = corners[:, 2] - corners[:, 0]
    p = points - corners[:, 0]
    ee = (e * e).sum(1)
    ef = (e * f).sum(1)
    ff = (f * f).sum(1)
    pe = (p * e).sum(1)
    pf = (p * f).sum(1)
    determinant = ee * ff - ef * ef + 1e-300  # a triangle without area: no division by zero
    b = (ff * pe - ef * pf) / determinant
    c = (ee * pf - ef * pe) / determinant
    return np.stack([1 - b - c, b, c], axis=1)
