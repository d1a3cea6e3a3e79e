"""What training of dynamic blend shapes may be told."""

from dataclasses import dataclass

from habitus.body.dynamics import CONTROLS
from habitus.errors import HabitusError


@dataclass(frozen=True)
class DynamicsOptions:
    """Options of the training of dynamic blend shapes (S 6).

    ``components``: how many blend shapes. ``controls``: what drives them, "joints" (each joint's
    own linear acceleration, spin and angular acceleration), or "smpl" (S 6: joint angles' rates,
    the root's velocity and acceleration). ``shape_features``: how many shape coefficients the
    regressor may depend on, ``ridge``: shares of the variance that are added to that of each
    control; of both the training takes what runs free best on motions held out. ``rank``:
    directions kept while surfaces are gone through. ``personal``: a person's mean residual is part
    of the person's own template (S 6), not of the dynamics. Raises HabitusError for options that
    make no sense.
    """

    components: int = 8
    controls: str = "joints"
    shape_features: tuple[int, ...] = (0, 1, 2, 4)
    ridge: tuple[float, ...] = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
    rank: int = 64
    personal: bool = True

    def __post_init__(self) -> None:
        if self.controls not in CONTROLS:
            raise HabitusError(
                f"controls are {self.controls!r}; expected one of {', '.join(CONTROLS)}"
            )
        if not 1 <= self.components <= self.rank:
            raise HabitusError(
                f"{self.components} components asked of {self.rank} directions; expected 1 to "
                f"{self.rank}"
            )
        if not self.ridge or min(self.ridge) <= 0:
            raise HabitusError(f"ridge is {self.ridge}; expected one share or more, all above 0")
        if not self.shape_features or min(self.shape_features) < 0:
            raise HabitusError(
                f"shape_features are {self.shape_features}; expected one number or more, none "
                "below 0"
            )
