"""Terms for `habitus.minimize`: residuals of a body's betas, pose and trans, for arrays and
tensors.

```python
terms = {"markers": hb.terms.Markers(body, observed, vertices), "pose": hb.terms.PosePrior(body)}
found = hb.minimize(terms, body.state(), weights={"markers": 7500.0})
```

A term is any function whose parameters are named like the unknowns that it takes and that returns a
residual, or what `Term` says beside it. Their cost is 1/2 |residual|^2 times the weight given to
`minimize`. `Markers` and the priors are those of MoSh, whose weights of squared lengths (per cm^2)
are to be multiplied by 1e4, as lengths are metres; `Points`, `Depth`, `Silhouette`, `Keypoints` and
`Joints` know their own noise, so that their weight is 1. `points_term` makes a term of any points
of the body that should be at places.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import constant, flatten, namespace
from habitus.body.hand_space import HAND_SPACE
from habitus.body.hands import HAND_JOINTS, SIDES, HandAxes
from habitus.body.joint_layouts import SMPL
from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.observe.markers import MarkerAttachment, predict_markers
from habitus.residuals.keypoint_terms import Keypoints
from habitus.residuals.points import JointObservations, PointObservations, points_term
from habitus.residuals.surface_terms import Depth, Joints, Points, Silhouette
from habitus.solve.terms import GemanMcClure, Quadratic, Term
from habitus.types import Array

__all__ = [
    "Acceleration",
    "Depth",
    "GemanMcClure",
    "HandLimits",
    "JointObservations",
    "Joints",
    "Keypoints",
    "Markers",
    "PointObservations",
    "Points",
    "PosePrior",
    "Quadratic",
    "ShapePrior",
    "Silhouette",
    "Term",
    "points_term",
]


@dataclass(frozen=True)
class Markers:
    """E_D (M eq. 3): a body's markers against observed ones (*batch, M, 3) in metres; NaN is a
    missing marker.

    sites: where the markers sit, vertex numbers (M,) or a `MarkerAttachment`.
    """

    body: BodyModel
    observed: Float[np.ndarray, "*batch M 3"]
    sites: MarkerAttachment | Sequence[int] | Int[np.ndarray, " M"]

    def __call__(self, betas: Array, pose: Array, trans: Array) -> Array:
        """Predicted minus observed markers, 0 where missing."""
        if isinstance(self.sites, MarkerAttachment):
            corners = self.sites.triangles
            own = MarkerAttachment(np.arange(corners.size).reshape(-1, 3), self.sites.coefficients)
            predicted = predict_markers(
                self.body(betas, pose, trans, vertices=corners.ravel()).vertices, own
            )
        else:
            predicted = self.body(betas, pose, trans, vertices=self.sites).vertices
        observed = np.asarray(self.observed, dtype=float)
        seen = constant(np.isfinite(observed), predicted)
        return (predicted - constant(np.nan_to_num(observed), predicted)) * seen


@dataclass(frozen=True)
class PosePrior:
    """E_theta (M eq. 7): a Gaussian over the joints' rotation vectors, the root left free.

    body: whose own prior, or the shipped one matched by joint names, is taken; without it the
    shipped one for a pose of SMPL's 24 joints.
    """

    body: BodyModel | None = None
    _mean: np.ndarray = field(init=False, repr=False)
    _whitening: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        prior = prior_of(self.body)
        prior = prior.for_joints(SMPL.joint_names if self.body is None else self.body.joint_names)
        object.__setattr__(self, "_mean", prior.mean)
        object.__setattr__(self, "_whitening", prior.whitening)

    def __call__(self, pose: Array) -> Array:
        """The whitened deviation (*batch, 3 (J - 1)) from the prior's mean."""
        deviation = flatten(pose[..., 1:, :], -2) - constant(self._mean, pose)
        return deviation @ constant(self._whitening, pose).T


@dataclass(frozen=True)
class HandLimits:
    """Finger joints beyond the angles that hands reach (`HandSpace.low`, ``high``): 0 within them,
    beside `PosePrior`, whose Gaussian knows no bounds.

    body: with finger joints; HabitusError otherwise. sd: how far beyond a limit counts as one, rad.
    """

    body: BodyModel
    sd: float = float(np.radians(3.0))
    _hands: tuple[tuple[HandAxes, list[int]], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        names = self.body.joint_names
        axes = [HandAxes.of(self.body, side) for side in SIDES]
        joints = [[names.index(f"{side}_{joint}") for joint in HAND_JOINTS] for side in SIDES]
        object.__setattr__(self, "_hands", tuple(zip(axes, joints, strict=True)))

    def __call__(self, pose: Array) -> Array:
        """Angles beyond their limits (*batch, 40) in ``sd``: of the left hand, then of the
        right.
        """
        angles = namespace(pose).concatenate(
            [axes.angles(pose[..., joints, :]) for axes, joints in self._hands], -1
        )
        low, high = (
            constant(np.radians(np.tile(ends, len(SIDES))), pose)
            for ends in (HAND_SPACE.low, HAND_SPACE.high)
        )
        return ((angles - low).clip(max=0.0) + (angles - high).clip(min=0.0)) / self.sd


@dataclass(frozen=True)
class ShapePrior:
    """E_beta (M eq. 6): the shape coefficients, which are standard deviations of the population."""

    def __call__(self, betas: Array) -> Array:
        """The betas themselves."""
        return betas


@dataclass(frozen=True)
class Acceleration:
    """E_u (M eq. 8): the change of the joints' velocity between frames of a pose (T, J, 3), the
    root left out.
    """

    def __call__(self, pose: Array) -> Array:
        """Second differences (T - 2, J - 1, 3)."""
        return pose[2:, 1:] - 2.0 * pose[1:-1, 1:] + pose[:-2, 1:]
