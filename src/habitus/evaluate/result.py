"""Results of an evaluation (S 5): each model's measures, the registrations that they were taken on,
and the run time of its forward function (S 5.4, Fig. 14).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.evaluate.generalisation import Generalisation
from habitus.evaluate.neck_twist import NeckTwist
from habitus.evaluate.posable import ComparedModel, Posable
from habitus.mesh.registrations import Registrations, Vertices


@dataclass(frozen=True, eq=False)
class ForwardTimes:
    """Seconds for one surface from new shape and pose: medians of ``seconds`` for each number of
    coefficients.
    """

    model: str
    counts: tuple[int, ...]
    seconds: Float[np.ndarray, "K R"]

    @property
    def medians(self) -> Float[np.ndarray, " K"]:
        """Seconds."""
        return np.median(self.seconds, axis=1)


def time_forward(
    models: Sequence[Posable],
    counts: Sequence[int],
    *,
    joints: int,
    repeats: int = 20,
    seed: int = 0,
) -> tuple[ForwardTimes, ...]:
    """Time each model's forward function with the first k coefficients, for each k of ``counts``
    that it has.

    Every repeat has a shape and a pose of its own. With 0 coefficients the shape was made before:
    the time is that of animating a fixed shape. Models take turns, so that whatever else the
    machine does meets all of them. Raises HabitusError for fewer than one repeat.
    """
    if repeats < 1:
        raise HabitusError(f"{repeats} repeats asked for; expected at least 1")
    rng = np.random.default_rng(seed)
    used = [tuple(sorted({min(k, model.num_betas) for k in counts})) for model in models]
    seconds = [np.zeros((len(numbers), repeats)) for numbers in used]
    for row in range(max(map(len, used), default=0)):
        forward = [
            (m, model.forward(used[m][row])) for m, model in enumerate(models) if row < len(used[m])
        ]
        for repeat in range(-1, repeats):  # the first of each is not counted
            pose = 0.3 * rng.normal(size=(joints, 3))
            shape = rng.normal(size=max(map(max, used)))
            for m, function in forward:
                betas = shape[: used[m][row]].copy()
                begin = time.perf_counter()
                function(betas, pose)
                if repeat >= 0:
                    seconds[m][row, repeat] = time.perf_counter() - begin
    return tuple(
        ForwardTimes(*each) for each in zip((m.name for m in models), used, seconds, strict=True)
    )


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
