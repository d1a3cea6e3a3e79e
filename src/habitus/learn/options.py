"""Options of training: weights of eq. 14, kind of model, stopping criteria (S 4, S 5.2, T 5.6)."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from habitus.body.pose_features import POSE_FEATURES
from habitus.body.skinning import SKINNING
from habitus.errors import HabitusError

CANDIDATES = 8
"""Joints that a vertex' influences are chosen from."""
POSE_SHAPES = ("full", "sparse", "local", "low_rank", "l1", "none")
STARTS = ("parts", "body")
REGRESSORS = ("auto", "convex", "signed")
FIXED = ("skinning_weights", "joint_regressor", "posedirs", "shapedirs", "people", "poses")
"""What can be held fixed: of a body by the names of its arrays, "shapedirs" with the mean,
``v_template``; of the registrations what is known of them: rest surfaces of the "people", "poses"
and places.
"""
HELD = {"people": ("templates", "joints"), "poses": ("pose", "trans")}
"""The unknowns of eq. 14 that those of `FIXED` hold, where these are not of the same name."""
STOPPING = ("rounds", "tolerance", "least_effect")
"""Options that say how long, or what is done at the end: a training goes on with others."""


@dataclass(frozen=True)
class EnergyWeights:
    """Weights of eq. 14 over metres squared: symmetry lambda_Y, joint_symmetry lambda_U, joints
    lambda_J, pose_shapes lambda_P, and skinning. The last is 1 in the paper and alone depends on
    the unit of length: like MoSh's weights it is taken against square centimetres. Against square
    metres the weights could hardly leave their start.
    """

    symmetry: float = 100.0
    joint_symmetry: float = 100.0
    joints: float = 100.0
    pose_shapes: float = 25.0
    skinning: float = 1e-4

    def __post_init__(self):
        _check_sizes(asdict(self))


@dataclass(frozen=True)
class TrainOptions:
    """Kind of model and stopping criteria. Raises HabitusError for values that do not make sense.

    skinning: "lbs" or "dqbs". pose_shapes: "full" (S 3), "sparse" (driven only by the joints that
    move a vertex, S 5.2), "local" (by the joints near it that matter: a joint lets go of a vertex
    where that costs people left out less than ``least_effect``, m, root mean square over the
    registrations), "low_rank" (of ``rank``), "l1" (with weight ``l1`` in place of lambda_P), "none"
    (plain skinning). rotation_prior: weight mu of E_R, which keeps local pose blend shapes small at
    rotations that no registration shows (`habitus.learn.posing.rotation_prior`); 0 leaves it out,
    .003 is what the default body's were damped with.
    pose_features: what drives them (``body.features``). shape_features: how many shape coefficients
    they depend on (T 5.6). influences: joints a vertex. num_betas: shape directions kept. rounds:
    alternations at most; they end earlier when a round lowers the energy by less than ``tolerance``
    of it. start: from the template's "parts" (S 4.1), or from the "body" that the template is of:
    its skinning weights, joint regressor and pose blend shapes, and what is known of the
    registrations. fixed: what of these stays as it is (some of `FIXED`). regressor: "convex"
    (S 4.1), "signed" (weights below zero allowed), "auto" (for the joints where these pay on people
    left out).
    """

    skinning: str = "lbs"
    pose_shapes: str = "full"
    pose_features: str = "rotations"
    shape_features: int = 0
    rank: int = 32
    l1: float = 0.05
    least_effect: float = 1e-4
    rotation_prior: float = 0.0
    influences: int = 4
    num_betas: int = 10
    rounds: int = 20
    tolerance: float = 1e-3
    start: str = "parts"
    fixed: tuple[str, ...] = ()
    regressor: str = "auto"
    weights: EnergyWeights = field(default_factory=EnergyWeights)

    def __post_init__(self):
        for key, allowed in (
            ("skinning", tuple(SKINNING)),
            ("pose_shapes", POSE_SHAPES),
            ("pose_features", tuple(POSE_FEATURES)),
            ("start", STARTS),
            ("regressor", REGRESSORS),
        ):
            if getattr(self, key) not in allowed:
                raise HabitusError(
                    f"{key} is {getattr(self, key)!r}; expected one of {', '.join(allowed)}"
                )
        object.__setattr__(
            self, "fixed", (self.fixed,) if isinstance(self.fixed, str) else tuple(self.fixed)
        )
        self._check_fixed()
        _check_sizes(
            {
                key: getattr(self, key)
                for key in ("l1", "least_effect", "rotation_prior", "tolerance")
            }
        )
        if self.influences > CANDIDATES:
            raise HabitusError(
                f"influences is {self.influences}; expected {CANDIDATES} or fewer joints a vertex"
            )
        for key, least in (
            ("rank", 1),
            ("influences", 1),
            ("num_betas", 1),
            ("rounds", 1),
            ("shape_features", 0),
        ):
            if getattr(self, key) < least:
                raise HabitusError(f"{key} is {getattr(self, key)}; expected {least} or more")
        if self.shape_features > self.num_betas or (
            self.shape_features and self.pose_shapes == "none"
        ):
            raise HabitusError(
                f"shape_features is {self.shape_features} with {self.num_betas} num_betas and "
                "pose_shapes "
                f"{self.pose_shapes!r}; expected pose blend shapes that depend on some of the "
                "shape coefficients"
            )

    def _check_fixed(self) -> None:
        unknown = [name for name in self.fixed if name not in FIXED]
        if unknown:
            raise HabitusError(f"fixed names {unknown[0]!r}; expected some of {', '.join(FIXED)}")
        if self.fixed and self.start != "body":
            raise HabitusError(
                f"{', '.join(self.fixed)} fixed, with a start from {self.start!r}; expected start "
                "'body', a training "
                "that begins with a body's own arrays"
            )
        for name, key, without in (
            ("posedirs", "pose_shapes", "none"),
            ("shapedirs", "shape_features", 0),
        ):
            if name in self.fixed and (getattr(self, key) == without) == (name == "posedirs"):
                raise HabitusError(
                    f"{name} fixed with {key} {getattr(self, key)!r}; these exclude each other"
                )


def _check_sizes(numbers: Mapping[str, float]) -> None:
    for key, number in numbers.items():
        if not (math.isfinite(number) and number >= 0):
            raise HabitusError(f"{key} is {number}; expected a number of 0 or more")
