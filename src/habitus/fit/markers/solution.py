"""The solution of a marker fit: state, status, residuals, timings and the settings that made it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.body.prior import prior_of
from habitus.body.soft_tissue import simulate_soft_tissue
from habitus.body.state import BodyState
from habitus.fit.markers.energy import sequence_terms
from habitus.fit.markers.settings import sequence_settings, settings_from
from habitus.fit.markers.suspects import Suspect
from habitus.observe.marker_prediction import BodyMarkers, marked_body, predict
from habitus.observe.markers import MarkerAttachment
from habitus.parallel.blocks import distances, mapped
from habitus.solve.terms import Term

ALL = slice(None)


def _locked(array: np.ndarray) -> np.ndarray:
    """The array, read-only."""
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class UncertaintySettings:
    """How far betas and segments are determined by the markers."""

    spans: int = 24
    """Spans of time in which segments are looked at, at most: each costs a solve of all joints."""
    place: float = 0.015
    """Standard deviation (m) of a marker's place on a real body about its place on the fitted one:
    hands that placed it, flesh, and a shape space that knows no body exactly."""
    trusted: float = 0.5
    """Robust weight, of 1, from which on a marker counts as seen."""
    root_sd: float = 10.0
    """Radians and metres by which the whole body may be turned and moved: as good as free."""
    pose_sd: float = 1.0
    """Radians and metres by which pose and trans may make up for a change of betas: wide, but no
    joint turns further."""
    probes: int = 3
    """Points of the skin, far apart, that stand for a joint's segment: enough for any turn."""
    min_weight: float = 0.4
    """Skinning weight of a joint at such a point, at least."""
    guessed: float = 0.06
    """Metres: a segment whose skin is known no better (standard deviation) is guessed."""


UNCERTAINTY = UncertaintySettings()


class Guessed(NamedTuple):
    """How well each joint's segment is known: ``spread`` (F, J) in metres, in the spans of frames
    from ``edges`` (F,).

    It is the standard deviation of where the segment's skin is; zero for a joint that carries none.
    """

    edges: Int[np.ndarray, " F"]
    spread: Float[np.ndarray, "F J"]

    def joints(self, limit: float = UNCERTAINTY.guessed) -> Bool[np.ndarray, " J"]:
        """Which joints' segments are guessed (spread beyond ``limit``, m) in half of the spans, or
        more.
        """
        return np.median(self.spread, axis=0) > limit


@dataclass(frozen=True)
class HeldOut:
    """Errors (T, H) in metres of H markers left out of everything, where one expects them; NaN
    where unseen.
    """

    labels: tuple[str, ...]
    pose: Float[np.ndarray, "T H"]
    soft_tissue: Float[np.ndarray, "T H"] | None


@dataclass(frozen=True)
class MarkerSolution(Moving):
    """A body in motion, found from the markers of one capture.

    Metres, radians and the capture's own world frame. T frames, M markers, J joints, B betas.
    ``latent_markers`` (M, 3) lie in the body's rest space (zero pose). Where there is soft tissue,
    the body at frame t is ``body(betas + soft_tissue[t], pose[t], trans[t])``, and ``pose_stage``
    holds pose and trans before it was let go; where it is dynamics, or these too,
    ``dynamics=dynamics[t]`` comes to it, and ``soft_tissue`` may be zero. ``recorded`` is what the
    capture says of the person, ``layout_confidence`` how sure the choice of the layout is (0..1),
    ``displaced`` how far each latent marker sits from the layout's place, in the layout's spreads;
    ``tried`` says in sentences what was done when a first attempt failed, ``left_out`` which labels
    were left out for it, ``doubts`` what was not decided where markers' places were found by
    fitting; ``discovered_layout`` is the layout so found, as a TOML file's text.
    ``held_out_known_placement``: errors of held-out markers at the places that other captures have
    them at. ``status`` and ``shape_status`` say how the last stage and the shape stage ended.
    ``gender`` is the body's model; where it was chosen by itself, ``female_probability`` is what a
    neutral fit said.
    """

    capture_name: str
    body_name: str
    layout_name: str
    body: BodyModel
    up_axis: str
    rate_hz: float
    labels: tuple[str, ...]
    betas: Float[np.ndarray, " B"]
    latent_markers: Float[np.ndarray, "M 3"]
    attachment: MarkerAttachment
    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    soft_tissue: Float[np.ndarray, "T B"] | None
    pose_stage: tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]
    observed_markers: Float[np.ndarray, "T M 3"]
    predicted_pose_stage: Float[np.ndarray, "T M 3"]
    predicted_soft_tissue: Float[np.ndarray, "T M 3"] | None
    marker_weights: Float[np.ndarray, "T M"]
    marker_noise: Float[np.ndarray, " M"]
    flagged_frames: Bool[np.ndarray, " T"]
    suspects: tuple[Suspect, ...] = ()
    held_out: HeldOut | None = None
    costs: Mapping[str, float] = field(default_factory=dict)
    stage_seconds: Mapping[str, float | None] = field(default_factory=dict)
    startup_seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    status: str = ""
    shape_status: str = ""
    seed: int = 0
    gender: str = "neutral"
    female_probability: float | None = None
    recorded: Mapping[str, float | str] = field(default_factory=dict)
    layout_confidence: float | None = None
    displaced: Float[np.ndarray, " M"] | None = None
    left_out: tuple[str, ...] = ()
    tried: tuple[str, ...] = ()
    dynamics: Float[np.ndarray, "T D"] | None = None
    doubts: tuple[str, ...] = ()
    discovered_layout: str = ""
    held_out_known_placement: HeldOut | None = None

    @property
    def visible(self) -> Bool[np.ndarray, "T M"]:
        """Which samples the capture holds."""
        return mapped(lambda part: np.isfinite(part[..., 0]), self.observed_markers)

    @property
    def errors_mm(self) -> Float[np.ndarray, "T M"]:
        """Distances of observed from predicted markers of the last stage in mm, NaN where a marker
        is missing.
        """
        last = self.errors("pose" if self.predicted_soft_tissue is None else "soft_tissue")
        assert last is not None
        return mapped(lambda part: 1e3 * part, last)

    def state(self, frames: slice = ALL) -> BodyState:
        """The state of some frames: betas (B,), pose (T, J, 3), trans (T, 3) and soft_tissue (T,
        B), zero without.

        Where there are dynamics, their coefficients follow behind: soft_tissue is then (T, B + D),
        as in ``terms``.
        """
        return BodyState(self.betas, self.pose[frames], self.trans[frames], self._soft(frames))

    def with_dynamics(self, strength: float = 1.0) -> Self:
        """The same motion with soft tissue that the body predicts from it, in the place of what was
        fitted (SMPL sec. 6).

        ``strength`` exaggerates. Pose and trans stay as they are. Raises HabitusError for a body
        without dynamics.
        """
        moving = np.asarray(
            simulate_soft_tissue(
                self.body, self.betas, self.pose, self.trans, self.rate_hz, strength
            )
        )
        marked = marked_body(self.body, self.betas, self.attachment, "dynamics")
        return replace(
            self,
            soft_tissue=np.zeros((self.num_frames, len(self.betas))),
            dynamics=moving,
            predicted_soft_tissue=predict(marked, self.pose, self.trans, moving),
        )

    @property
    def soft_space(self) -> str:
        """Which space holds ``soft_coefficients`` (`habitus.body.soft_tissue`): "shape", or
        "both".
        """
        return "shape" if self.dynamics is None else "both"

    @property
    def soft_coefficients(self) -> Float[np.ndarray, "T S"]:
        """Soft tissue and, where there are such, dynamics, side by side; zero without."""
        return self._soft(ALL)

    def _soft(self, frames: slice) -> Float[np.ndarray, "T S"]:
        count = len(self.pose[frames])
        soft = (
            np.zeros((count, len(self.betas)))
            if self.soft_tissue is None
            else self.soft_tissue[frames]
        )
        return (
            soft if self.dynamics is None else np.concatenate([soft, self.dynamics[frames]], axis=1)
        )

    def terms(self, frames: slice = ALL) -> dict[str, Term]:
        """The fit's energy in some frames, as terms of pose, trans and soft_tissue (MoSh eqs. 3, 7,
        8 and 10).

        It differs from what the fit minimised in three points: the robust scales come from the
        final noise instead of the noise before the last solve; misplaced markers count in full
        instead of not at all; the samples that filled gaps, short ones included, are left out.
        With terms of one's own beside them, `habitus.minimize` goes on from ``state(frames)``.
        """
        settings = settings_from(self.settings)
        scales = np.clip(settings.noise_factor * self.marker_noise, *settings.robust_scale)
        marked = BodyMarkers(self.body, self.betas, self.attachment, self.soft_space)
        prior = prior_of(self.body).for_joints(self.body.joint_names)
        return sequence_terms(
            marked, self.observed_markers[frames], None, scales, prior, sequence_settings(settings)
        )

    def errors(self, stage: str = "soft_tissue") -> Float[np.ndarray, "T M"] | None:
        """Distances of observed from predicted markers in metres, NaN where missing; ``stage`` pose
        or soft_tissue. Computed once, and read-only.
        """
        return self._pose_errors if stage == "pose" else self._soft_tissue_errors

    @cached_property
    def _pose_errors(self) -> Float[np.ndarray, "T M"]:
        return _locked(distances(self.observed_markers, self.predicted_pose_stage))

    @cached_property
    def _soft_tissue_errors(self) -> Float[np.ndarray, "T M"] | None:
        if self.predicted_soft_tissue is None:
            return None
        return _locked(distances(self.observed_markers, self.predicted_soft_tissue))
