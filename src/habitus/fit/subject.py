"""A subject: a person whose shape and marker placements are known, so that motion can be fitted."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import MarkedBody, marked_body
from habitus.observe.markers import MarkerAttachment


@dataclass(frozen=True)
class ShapeFit:
    """Result of the shape stage: betas, latent markers (m, in the body's rest space) and where they
    are attached, poses (rad) and places (m) of its F frames, costs by term, and how it ended.
    """

    betas: Float[np.ndarray, " B"]
    latent_markers: Float[np.ndarray, "M 3"]
    attachment: MarkerAttachment
    pose: Float[np.ndarray, "F J 3"]
    trans: Float[np.ndarray, "F 3"]
    costs: dict[str, float]
    status: str
    iterations: int


@dataclass(frozen=True, eq=False)
class Subject:
    """The result of the shape stage, found once for a person and valid for all captures.

    prior: of the body's joints. layout: the M markers in use, with the shape stage's ``shape``.
    exchanged: pairs of markers (columns) whose labels are swapped throughout. misplaced: markers
    (columns) too far from the layout's places to be the ones meant; they get no weight. seconds:
    that the shape stage took. sources: the recordings, by number, whose frames it used.
    """

    body: BodyModel
    prior: PosePrior
    layout: MarkerLayout
    shape: ShapeFit
    exchanged: tuple[tuple[int, int], ...] = ()
    misplaced: tuple[int, ...] = ()
    seconds: float = 0.0
    sources: tuple[int, ...] = (0,)

    @property
    def betas(self) -> Float[np.ndarray, " B"]:
        """Shape coefficients (B,)."""
        return self.shape.betas

    @cached_property
    def rig(self) -> MarkedBody:
        """The body of this shape with its markers attached."""
        return marked_body(self.body, self.shape.betas, self.shape.attachment)
