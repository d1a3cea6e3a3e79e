"""Run time of a model's forward function against the number of shape coefficients (S 5.4, Fig.
14).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.evaluate.posable import Posable


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
