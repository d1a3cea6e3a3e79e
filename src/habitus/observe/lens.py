"""Lens distortion: OpenCV's radial, tangential and rational terms (T 4.3), their inverse, and how
far they are of use.

``plane`` is (x', y') = (x / z, y / z) of the camera's frame; ``distortion`` is OpenCV's k1 k2 p1 p2
k3 k4 k5 k6. With s = x'^2 + y'^2:

    radial = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)
    x'' = x' radial + 2 p1 x' y' + p2 (s + 2 x'^2),    y'' = y' radial + p1 (s + 2 y'^2) + 2 p2 x' y'
"""  # noqa: E501

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from habitus.arrays import broadcast_shapes

_NEWTON_STEPS = 30


def distorted(
    plane: Float[Tensor, "*batch N 2"], distortion: Float[Tensor, "*camera 8"]
) -> Float[Tensor, "*out N 2"]:
    """(x'', y'') of (x', y')."""
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion[..., None, :].unbind(-1)
    x, y = plane.unbind(-1)
    s = x * x + y * y
    xy = 2 * x * y
    radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    return torch.stack(
        [x * radial + p1 * xy + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + p2 * xy],
        -1,
    )


def distortion_slope(
    plane: Float[Tensor, "*batch N 2"], distortion: Float[Tensor, "*camera 8"]
) -> tuple[Float[Tensor, "*out N"], Float[Tensor, "*out N"], Float[Tensor, "*out N"]]:
    """The derivative of ``distorted`` at ``plane``, a symmetric 2 x 2 matrix: dx''/dx', dx''/dy' =
    dy''/dx' and dy''/dy'.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion[..., None, :].unbind(-1)
    x, y = plane.unbind(-1)
    s = x * x + y * y
    below = 1 + s * (k4 + s * (k5 + s * k6))
    radial = (1 + s * (k1 + s * (k2 + s * k3))) / below
    slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3) - radial * (k4 + s * (2 * k5 + s * 3 * k6))) / below
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return xx, xy, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x


def _newton_step(plane: Tensor, wrong: Tensor, distortion: Tensor) -> Tensor:
    """The inverse of the derivative of ``distorted`` at ``plane``, times ``wrong``."""
    xx, xy, yy = distortion_slope(plane, distortion)
    determinant = xx * yy - xy * xy
    determinant = determinant.where(determinant != 0, 1.0)
    a, b = wrong.unbind(-1)
    return torch.stack([yy * a - xy * b, xx * b - xy * a], -1) / determinant[..., None]


def undistorted(
    target: Float[Tensor, "*batch N 2"], distortion: Float[Tensor, "*camera 8"]
) -> Float[Tensor, "*out N 2"]:
    """(x', y') of (x'', y''), NaN where no place inside ``first_turn`` has that picture; first
    derivatives are exact.

    Newton's method from the middle on all points at once; a step that does not help, or leaves the
    valid circle, is halved. One more step at the root carries the derivatives (implicit function
    theorem).
    """
    wanted = target.detach()
    k = distortion.detach()
    limit = first_turn(distortion)
    plane = torch.zeros_like(wanted).expand(broadcast_shapes(wanted.shape, (*k.shape[:-1], 1, 2)))
    wrong = -wanted.expand(plane.shape)
    size = torch.ones_like(wrong[..., :1])
    for _ in range(_NEWTON_STEPS):
        trial = plane - size * _newton_step(plane, wrong, k)
        trial_wrong = distorted(trial, k) - wanted
        better = trial_wrong.norm(dim=-1, keepdim=True) < wrong.norm(dim=-1, keepdim=True)
        better = better & ((trial * trial).sum(-1, keepdim=True) <= limit[..., None, None])
        plane = trial.where(better, plane)
        wrong = trial_wrong.where(better, wrong)
        size = torch.where(better, 1.0, size / 2)
    tolerance = 100 * torch.finfo(wanted.dtype).eps * (1 + wanted.norm(dim=-1, keepdim=True))
    converged = wrong.norm(dim=-1, keepdim=True) < tolerance
    plane = plane.where(converged, 0.0)
    plane = plane - _newton_step(plane, distorted(plane, distortion) - target, k)
    return plane.where(converged, math.nan)


def first_turn(distortion: Float[Tensor, "*camera 8"]) -> Float[Tensor, "*camera"]:
    """The s up to which a growing radius grows in the picture too (without p1 and p2); infinite if
    it always does.

    It is the least positive s where the derivative of sqrt(s) radial(s), or the denominator of
    radial, is zero. Beyond it the polynomials fold the picture back, or divide by zero. A constant:
    it has no derivative.
    """
    k1, k2, _, _, k3, k4, k5, k6 = distortion.detach().double().cpu().unbind(-1)
    one = torch.ones_like(k1)
    above = (one, k1, k2, k3)
    below = (one, k4, k5, k6)
    turn = [
        sum(above[i] * below[m - i] * (1 + 2 * (2 * i - m)) for i in range(4) if 0 <= m - i < 4)
        for m in range(1, 7)
    ]
    return torch.minimum(_least_positive_root(turn), _least_positive_root([k4, k5, k6])).to(
        distortion
    )


def _least_positive_root(coefficients: list[Any]) -> Tensor:
    """The least s > 0 with 1 + c1 s + c2 s^2 + ... = 0, else infinity: 1 / s are eigenvalues of a
    companion matrix.
    """
    first = -torch.stack(coefficients, -1)[..., None, :]
    shift = torch.eye(len(coefficients), dtype=first.dtype)[:-1].expand(*first.shape[:-2], -1, -1)
    inverse = torch.linalg.eigvals(torch.cat([first, shift], -2))
    real = (inverse.imag.abs() <= 1e-7 * inverse.real) & (inverse.real > 1e-9)
    largest = inverse.real.where(real, 0.0).amax(-1)
    return torch.where(largest > 0, 1 / largest.where(largest > 0, 1.0), math.inf)
