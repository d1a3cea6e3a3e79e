"""Results of an evaluation: each model's measures, and the registrations that they were taken on (S
5).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.evaluate.generalisation import Generalisation
from habitus.evaluate.neck_twist import NeckTwist
from habitus.evaluate.posable import ComparedModel
from habitus.evaluate.timing import ForwardTimes
from habitus.mesh.registrations import Registrations, Vertices


@dataclass(frozen=True, eq=False)
class ModelEvaluation:
    """One model's measures; ``file`` is None for a body that was not read from a file.

    ``without_pose_shapes_of`` names the model whose copy without pose blend shapes this is.

    ``variances`` (m^2, or of triangle deformations) are those of the shapes that it was trained on
    where the file keeps them (``all_variances``), else those that its own directions explain.
    """

    model: ComparedModel
    file: str | None
    without_pose_shapes_of: str | None
    shape: Generalisation
    pose: Generalisation | None
    times: ForwardTimes
    variances: Float[np.ndarray, " S"]
    all_variances: bool
    twist: NeckTwist | None

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        return self.model.name


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Models measured on the same registrations; ``clean`` are these without noise, where they are
    known.
    """

    dataset: str
    registrations: Registrations
    clean: Vertices | None
    models: tuple[ModelEvaluation, ...]

    @property
    def shown(self) -> int | None:
        """The largest number of shape coefficients that all models were measured with; None where
        there is none.
        """
        common = set.intersection(*({*entry.shape.counts} for entry in self.models))
        return max(common, default=None)
