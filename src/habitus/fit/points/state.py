"""The state that point fits solve for: one shape, and pose and translation of each scan or view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MAX_STEPS = (0.5, 0.4, 1.5)
"""The longest step at once: m of place, rad of a joint, sd of shape."""
SMALLEST_STEP = 1e-9


@dataclass(frozen=True, eq=False)
class State:
    """Betas (B,), pose (K, J, 3) and trans (K, 3) of K views."""

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "K J 3"]
    trans: Float[np.ndarray, "K 3"]

    @property
    def vector(self) -> Float[np.ndarray, " n"]:
        """All numbers, in the energy's order."""
        views = np.concatenate([self.trans, self.pose.reshape(len(self.pose), -1)], 1)
        return np.concatenate([self.betas, views.ravel()])

    def moved(self, step: Float[np.ndarray, " n"]) -> "State":
        """The state a step further, cut short where it would leap."""
        head = step[: len(self.betas)]
        views = step[len(self.betas) :].reshape(len(self.pose), -1)
        place = views[:, :3]
        turn = views[:, 3:].reshape(self.pose.shape)
        longest = (place, turn, head)
        share = min(
            [
                1.0,
                *(
                    most / max(np.abs(part).max(initial=0.0), SMALLEST_STEP)
                    for part, most in zip(longest, MAX_STEPS, strict=True)
                ),
            ]
        )
        return State(
            self.betas + share * head, self.pose + share * turn, self.trans + share * place
        )
