"""Options of training: weights of eq. 14, kind of model, stopping criteria (S 4, S 5.2, T 5.6)."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal

from habitus.body.pose_features import POSE_FEATURES
from habitus.body.skinning import SKINNING
from habitus.errors import HabitusError
from habitus.learn.check_settings import CHECKS, CheckSettings

CANDIDATES = 8
"""Joints that a vertex' influences are chosen from."""
POSE_SHAPES = ("full", "sparse", "local", "low_rank", "l1", "none")
STARTS = ("parts", "body")
REGRESSORS = ("convex", "signed", "auto")
FIXED = ("skinning_weights", "joint_regressor", "posedirs", "shapedirs", "people", "poses")
"""What can be held fixed: of a body by the names of its arrays, "shapedirs" with the mean,
``v_template``; of the registrations what is known of them: rest surfaces of the "people", "poses"
and places.
"""
HELD = {"people": ("templates", "joints"), "poses": ("pose", "trans")}
"""The unknowns of eq. 14 that those of `FIXED` hold, where these are not of the same name."""
STOPPING = ("rounds", "tolerance", "least_effect", "hinges")
"""Options that say how long, or what is done at the end: a training goes on with others."""


@dataclass(frozen=True)
class EnergyWeights:
    """Weights of eq. 14, over metres squared.

    That of skinning is 1 in the paper and alone depends on the unit of length: like MoSh's weights
    it is taken against square centimetres. Against square metres the weights could hardly leave
    their start.
    """

    symmetry: float = 100.0
    """Symmetry of left and right (lambda_Y)."""
    joint_symmetry: float = 100.0
    """Symmetry of joints relative to that of vertices (lambda_U)."""
    joints: float = 100.0
    """Distance of joints from the centres of their rings (lambda_J)."""
    pose_shapes: float = 25.0
    """Size of pose blend shapes (lambda_P); small datasets need less."""
    skinning: float = 1e-4
    """Distance of the skinning weights from the template's (lambda_W)."""

    def __post_init__(self):
        _check_sizes(asdict(self))


@dataclass(frozen=True)
class TrainSettings:
    """Tuning of the trainer's parts, for all kinds of models alike. The values are those that the
    planted bodies of `benchmarks/learn_planted.py` and the default body were trained with.
    """

    border_spread: float = 0.35
    """Standard deviation by which a part's border is smeared in the initial weights, in radii of
    the part: knees and elbows then blend over as many centimetres as with hand-made weights.
    """
    border_steps: int = 8
    """Implicit steps of the heat equation that smears borders; more change nothing visible."""
    min_initial_weight: float = 1e-3
    """Initial weights below are dropped, so that a joint's influence ends somewhere."""
    max_cotangent: float = 100.0
    """Bound on half the cotangents of needle triangles; a regular triangle's is 0.29."""
    pose_iterations: int = 1
    """Gauss-Newton steps of a registration's pose in a round: the round is alternated anyway."""
    skeleton_steps: int = 1
    """Levenberg-Marquardt steps of poses, joints and rest vertices together, likewise."""
    skeleton_damping: float = 1e-4
    """Damping of the first of them, in units of the matrix' diagonal."""
    relaxation_factors: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0)
    """Multiples of a round's change that are tried beyond it, as long as the energy falls."""
    gradient_steps: int = 5
    """Conjugate-gradient steps of pose blend shapes in a round; each lowers the energy."""
    majorised_steps: int = 5
    """Steps of low-rank and of l1 pose blend shapes in a round, each to the minimum of a bound."""
    coordinate_sweeps: int = 4
    """Sweeps over the coordinates within such a step of l1 pose blend shapes."""
    joint_reach: int = 2
    """Bones from a vertex' strongest joint within which joints may drive its local pose shapes."""
    min_observed_weight: float = 1e-2
    """Registrations' weights at a vertex, summed, below which it is held near its neighbourhood."""
    regressor_ridges: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0, 3.0)
    """Strengths, tried by cross-validation, that keep a signed regressor row near its convex
    one."""
    regressor_min_people: int = 3
    """With fewer people rows stay convex: nobody is left to try a signed one on."""
    regressor_gain: float = 0.9
    """With ``regressor`` "auto" a row is signed where that lowers the error on held-out people to
    this share or less.
    """
    regressor_folds: int = 5
    """Parts into which people are divided for that cross-validation."""
    imputation_steps: int = 12
    """Steps of expectation maximisation that fill holes of rest surfaces; converged by then."""
    hinge_joints: tuple[str, ...] = ("left_knee", "right_knee", "left_elbow", "right_elbow")
    """Joints that fold about one axis, of those that the body has: ``hinges`` are theirs."""
    hinge_shapes: int = 2
    """Shape coefficients that hinge channels are multiplied with: two tell as much of where a
    person's fold begins as girths do, a third no more."""
    hinge_ridge: float = 3e-3
    """Of a channel's mean square: what keeps its directions small."""
    checks: CheckSettings = CHECKS
    """What counts as wrong with registrations."""


SETTINGS = TrainSettings()


@dataclass(frozen=True)
class TrainOptions:
    """Kind of model and stopping criteria. Raises HabitusError for values that do not make
    sense.
    """

    skinning: Literal["lbs", "dqbs"] = "lbs"
    """Linear or dual quaternion blend skinning."""
    pose_shapes: Literal["full", "sparse", "local", "low_rank", "l1", "none"] = "full"
    """Pose blend shapes: "full" (S 3), "sparse" (driven by the joints that move a vertex, S 5.2),
    "local" (by nearby joints that reduce the error on held-out people by ``least_effect``),
    "low_rank" (of ``rank``), "l1" (with weight ``l1`` in place of lambda_P), or "none".
    """
    pose_features: Literal["rotations", "angles", "sin_cos", "quaternions", "polynomials"] = (
        "rotations"
    )
    """Inputs of the pose blend shapes; only the rotations' entries are SMPL's."""
    shape_features: int = 0
    """Number of shape coefficients on which they depend (T 5.6)."""
    rank: int = 32
    """Directions of low_rank pose blend shapes."""
    l1: float = 0.05
    """Weight of the l1 penalty."""
    least_effect: float = 1e-4
    """Least effect, root mean square in metres over the registrations, for which local pose blend
    shapes keep a joint.
    """
    rotation_prior: float = 0.0
    """Weight mu of E_R, which keeps local pose blend shapes small at rotations by 0 to 90 degrees
    that no registration shows (`habitus.learn.posing.rotation_prior`); 0 leaves it out, 0.01
    is that of the default bodies.
    """
    hinges: tuple[float, ...] = ()
    """Bends (degrees) where channels of knees and elbows begin, learned at the end for deep folds
    that vec(R - I) cannot tell (`habitus.body.pose_features`); the default body has 60, 90, 115
    and 135.
    """
    influences: int = 4
    """Most joints that move a vertex."""
    num_betas: int = 10
    """Shape directions kept."""
    rounds: int = 20
    """Most rounds of people, skinning weights, pose blend shapes and poses."""
    tolerance: float = 1e-3
    """Stop when a round lowers the energy by less than this share of it."""
    start: Literal["parts", "body"] = "parts"
    """Start from the template's parts (S 4.1), or from the skinning weights, joint regressor and
    blend shapes of the body that it is of.
    """
    fixed: tuple[str, ...] = ()
    """Held fixed: arrays of that body (skinning_weights, joint_regressor, posedirs, shapedirs), and
    of registrations that have them, people (rest surfaces) and poses.
    """
    regressor: Literal["convex", "signed", "auto"] = "convex"
    """Joints from vertices: convex combinations, of non-negative weights (S 4.1); weights of either
    sign; or "auto", signed where these have a lower error on held-out people.
    """
    weights: EnergyWeights = field(default_factory=EnergyWeights)
    """Weights of eq. 14."""
    settings: TrainSettings = SETTINGS
    """Tuning of the trainer's parts."""

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
        object.__setattr__(self, "hinges", tuple(map(float, self.hinges)))
        plain = self.pose_features == "rotations" and self.pose_shapes != "none"
        if self.hinges and (self.shape_features or not plain):
            raise HabitusError(
                f"hinges with pose_features {self.pose_features!r}, pose_shapes "
                f"{self.pose_shapes!r} and {self.shape_features} shape_features; expected pose "
                "blend shapes of 'rotations' alone"
            )
        if any(not 0 <= degrees < 150 for degrees in self.hinges):
            raise HabitusError(f"hinges begin at {self.hinges} degrees; expected 0 to 150")
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
