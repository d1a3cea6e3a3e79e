"""Settings and result of a fit to several sensors (`habitus.fit.problem`)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.state import BodyState, BodySurface
from habitus.errors import HabitusError
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.points.depth_settings import STANDARD, RgbdSettings
from habitus.fit.points.settings import SCANS, ScanSettings
from habitus.fit.verdict import Verdict
from habitus.solve.least_squares import Tolerances


@dataclass(frozen=True)
class JointStage:
    """Some steps of all sensors together."""

    reach: float
    """Metres at which a pixel or a point counts a quarter (Geman-McClure's scale)."""
    prior: float
    """Factor of the priors of pose, shape and marker places."""
    matching: str = "nearest"
    """Of depth pixels: "nearest" or "pixel" (`habitus.residuals.surface_terms.Depth`)."""
    stride: int = 4
    """Of depth pixels, in both directions."""
    rounds: int = 1
    """Times that markers are attached and weighed anew."""
    iterations: int = 8
    """In each round, at most."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit to several sensors, and of each sensor's own recipe: weights, noise and
    starts are the recipes'.

    The stages were chosen on simulated people (examples/two_sensors.py).
    """

    stages: tuple[JointStage, ...] = (
        JointStage(0.10, 10.0, iterations=6),
        JointStage(0.06, 2.0, iterations=6),
        JointStage(0.03, 1.0, "pixel", 2, rounds=2, iterations=10),
    )
    frames: int = 12
    """Of each capture, that are solved with the other sensors: as many as MoSh's shape stage."""
    marker_reach: float = 3.0
    """Geman-McClure's scale of a marker, as a factor of `JointStage.reach`: 9 cm at last, near
    MoSh's 10 cm, since the noise of single markers is not known here."""
    outline_share: float = 0.1
    """Of each full-size pixel's certainty in silhouettes, as neighbouring pixels err alike."""
    enough_markers: int = 8
    """Labelled markers in a frame from which on captures give the shape of the start, rather than
    depth views: fewer leave it to the prior."""
    skin_steps: int = 6
    """Steps with skin offsets at the end, at most, where there are views or scans."""
    max_step: Mapping[str, float] = field(
        default_factory=lambda: {"pose": 0.4, "trans": 0.3, "betas": 1.5}
    )
    """Largest change of a number of each unknown in one step: rad, metres, standard deviations."""
    tolerances: Tolerances = field(default_factory=lambda: Tolerances(cost=1e-4, step=1e-6))
    """Of each round."""
    motion: bool = True
    """Whether the whole captures are solved at the end, by ``mosh``; a fit to markers alone always
    solves them."""
    mosh: MoshSettings = field(default_factory=MoshSettings)
    """Of markers, and of the priors of shape and pose: `MoshSettings.shape` holds the weights."""
    depth: RgbdSettings = STANDARD
    """Of depth views."""
    scans: ScanSettings = SCANS
    """Of scans: the last of ``stages`` says how many points are used and their noise."""
    seed: int = 0
    """Of the choice of frames and of scan points."""


@dataclass(frozen=True, eq=False)
class BodyFit:
    """One person from several sensors: betas (B,), pose (F, J, 3) and trans (F, 3) of F poses.

    poses: what each of the F poses is of. Those of a capture's frames, and of views and scans that
    name a frame, are in the capture's world; those of a view of its own in the camera's frame;
    those of a scan of its own in metres with y up. latent_markers (M, 3): where markers sit at
    rest. skin_offset (V,): how far (m) the person's skin lies off the model along its normals;
    None without views and scans. status, costs: of the last stage; costs by term sum to the energy.
    residuals: distances (m) by sensor: of markers, of pixels and points from the skin.
    motions: the whole captures. verdicts: by sensor, where its own recipe judges it.
    """

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "F J 3"]
    trans: Float[np.ndarray, "F 3"]
    poses: tuple[str, ...]
    status: str
    costs: Mapping[str, float]
    residuals: Mapping[str, Float[np.ndarray, " _"]]
    latent_markers: Float[np.ndarray, "M 3"] | None = None
    skin_offset: Float[np.ndarray, " V"] | None = None
    motions: tuple[MarkerFit, ...] = ()
    verdicts: Mapping[str, Verdict] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def motion(self) -> MarkerFit | None:
        """The whole capture, the first of several; None without markers."""
        return self.motions[0] if self.motions else None

    @property
    def state(self) -> BodyState:
        """Betas, pose and trans of all poses."""
        return BodyState(self.betas, self.pose, self.trans)

    def surface(self, pose: int | str = 0) -> BodySurface:
        """The posed body of one pose, by number or by name (`poses`)."""
        if isinstance(pose, str) and pose not in self.poses:
            raise HabitusError(f"no pose is named {pose!r}; there are {', '.join(self.poses)}")
        k = self.poses.index(pose) if isinstance(pose, str) else pose
        return self.body(self.betas, self.pose[k], self.trans[k])

    def vertices(self, pose: int | str = 0) -> Float[np.ndarray, "V 3"]:
        """The surface (m) of one pose."""
        return np.asarray(self.surface(pose).vertices)

    def joints(self, pose: int | str = 0) -> Float[np.ndarray, "J 3"]:
        """The joints (m) of one pose."""
        return np.asarray(self.surface(pose).joints)

    @cached_property
    def measurements(self) -> Mapping[str, float]:
        """Height, girths and the like of the body at rest (m)."""
        return self.body.measure_rest(self.body.rest_vertices(self.betas))

    @property
    def residuals_mm(self) -> dict[str, dict[str, float]]:
        """Median and 95th percentile of each sensor's residuals in mm."""
        return {
            name: {
                "median": 1e3 * float(np.median(off)),
                "p95": 1e3 * float(np.percentile(off, 95)),
            }
            for name, off in self.residuals.items()
            if len(off)
        }
