"""Dynamic blend shapes, and the regressor that predicts their coefficients from motion (DMPL: S 6,
eqs. 16 and 17).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.motion_controls import CONTROLS
from habitus.errors import HabitusError

REST_SECONDS = 2.0
"""Soft tissue of a body that has stopped moving is at rest after so long,"""
REST_SHARE = 0.01
"""which is when this share of it is left."""


@dataclass(frozen=True, eq=False)
class DynamicsRegressor:
    """f of S eq. 17: D coefficients from those of the last two frames and from what joints do,
    linear in both.

        delta_t = A_1 delta_{t-1} + A_2 delta_{t-2} + B u_t;   A_1, A_2, B = X_0 + sum_s betas_s X_s

    ``history`` holds A_1 and A_2, ``drive`` B, as blocks X_0, X_1, ..., X_S. The C controls u_t are
    of the kind ``controls`` (`habitus.body.motion_controls`) and of these ``joints``, at
    ``rate_hz``: the rate that was learned. Controls are cut off at ``limits`` (C,), betas at
    ``reach`` (2, S): the regressor knows nothing of what lies beyond. There is no constant: a body
    at rest has no soft tissue in motion. Raises HabitusError where these do not fit together.
    """

    history: Float[np.ndarray, "S1 2 D D"]
    drive: Float[np.ndarray, "S1 D C"]
    joints: tuple[str, ...]
    rate_hz: float
    limits: Float[np.ndarray, " C"]
    reach: Float[np.ndarray, "2 S"]
    controls: str = "joints"

    def __post_init__(self) -> None:
        if self.controls not in CONTROLS:
            raise HabitusError(
                f"controls are {self.controls!r}; expected one of {', '.join(CONTROLS)}"
            )
        if not 1.0 <= self.rate_hz <= 1e5:
            raise HabitusError(
                f"dynamics were learned at {self.rate_hz:g} Hz; expected 1 to 100,000"
            )
        blocks = self.drive.shape[0]
        count = CONTROLS[self.controls].count(len(self.joints))
        expected = {
            "history": (blocks, 2, *2 * self.drive.shape[1:2]),
            "drive": (blocks, self.drive.shape[1], count),
            "limits": (count,),
            "reach": (2, blocks - 1),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise HabitusError(
                    f"dynamics' {name} has shape {getattr(self, name).shape}; expected {shape}"
                )

    @property
    def count(self) -> int:
        """D."""
        return self.drive.shape[1]

    def of_person(self, betas: Float[np.ndarray, " B"]) -> tuple[np.ndarray, np.ndarray]:
        """The history (2, D, D) and the drive (D, C) of a person of this shape; the history is
        `at_rest_in_time`.
        """
        known = self.drive.shape[0] - 1
        shape = np.zeros(known)
        shape[: len(betas)] = np.asarray(betas, np.float64)[:known]
        factors = np.concatenate([[1.0], np.clip(shape, *self.reach)])
        return at_rest_in_time(np.tensordot(factors, self.history, 1), self.rate_hz), np.tensordot(
            factors, self.drive, 1
        )


@dataclass(frozen=True, eq=False)
class Dynamics:
    """What a body knows of soft tissue in motion: blend shapes, and what predicts their
    coefficients.

    ``directions`` are in metres for a coefficient of 1, which is its root mean square over the
    motions that were learned. They are added to the rest surface and move no joint (S eq. 16).
    """

    directions: Float[np.ndarray, "V 3 D"]
    regressor: DynamicsRegressor

    def __post_init__(self) -> None:
        object.__setattr__(self, "directions", np.asarray(self.directions, np.float64, order="C"))
        if self.directions.ndim != 3 or self.directions.shape[2] != self.regressor.count:
            raise HabitusError(
                f"dynamic blend shapes have shape {self.directions.shape}; expected (V, 3, "
                f"{self.regressor.count})"
            )

    def scaled(self, factor: float) -> "Dynamics":
        """Of a body that is larger by a factor."""
        return replace(self, directions=factor * self.directions)


def at_rest_in_time(
    history: Float[np.ndarray, "2 D D"], rate_hz: float
) -> Float[np.ndarray, "2 D D"]:
    """The history, damped where its slowest mode would take longer than `REST_SECONDS` to die down
    to `REST_SHARE`.

    A_1 and A_2 times s and s^2 have all modes times s, so that nothing else of the motion changes.
    Every person's history passes through here: whatever was learned, and for whatever shape, soft
    tissue stays bounded.
    """
    most = REST_SHARE ** (1.0 / (REST_SECONDS * rate_hz))
    radius = float(np.abs(np.linalg.eigvals(companion(history))).max(initial=0.0))
    shrink = min(1.0, most / radius) if radius > 0.0 else 1.0
    return history * np.array([shrink, shrink**2])[:, None, None]


def companion(history: Float[np.ndarray, "2 D D"]) -> Float[np.ndarray, "E E"]:
    """The matrix that takes two frames' coefficients (delta_{t-1}, delta_{t-2}) to the next two; E
    = 2 D.
    """
    count = history.shape[-1]
    return np.block([[history[0], history[1]], [np.eye(count), np.zeros((count, count))]])


def free_run(
    history: Float[np.ndarray, "2 D D"],
    pushes: Float[np.ndarray, "T D"],
    start: Float[np.ndarray, "2 D"] | None = None,
) -> Float[np.ndarray, "T D"]:
    """Coefficients of T frames from what pushes them, B u_t; ``start``: of the two frames before,
    the later first.
    """
    count = history.shape[-1]
    step = np.concatenate(list(history), axis=1)
    state = np.zeros(2 * count)
    if start is not None:
        state[:] = np.ravel(start)
    found = np.empty_like(pushes)
    for t, push in enumerate(pushes):
        now = step @ state + push
        found[t] = now
        state[count:] = state[:count]
        state[:count] = now
    return found
