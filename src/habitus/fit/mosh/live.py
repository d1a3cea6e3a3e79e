"""A marker fit for live use: shape from some frames first, then pose frame after frame as markers arrive (M 6)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.mosh.causal import CausalFrame, CausalSolver
from habitus.fit.mosh.recipe import fit_subject
from habitus.fit.mosh.recordings import FEWEST_MARKERS, Recording
from habitus.fit.mosh.settings import MoshSettings, sequence_settings
from habitus.fit.mosh.start import start_sequence
from habitus.fit.mosh.suspects import exchange
from habitus.markers.layouts import MarkerLayout


class LiveFit:
    """Follows one person's markers: ``step`` fits the next frame from itself and the two before it.

    Shape and latent markers are found from ``recording`` (its markers in ``layout``'s order) when it is made.
    ``labels`` name the M markers that ``step`` takes, in their order; ``layout`` names those that are used. ``betas``
    (B,) and ``latent_markers`` (N, 3) are the subject's. For one stream and one thread.
    """

    def __init__(
        self,
        body: BodyModel,
        prior: PosePrior,
        layout: MarkerLayout,
        recording: Recording,
        labels: Sequence[str],
        settings: MoshSettings,
    ):
        seen = np.any(np.isfinite(recording.observed[..., 0]), axis=0)
        self.layout = replace(layout, markers=tuple(m for m, s in zip(layout.markers, seen, strict=True) if s))
        self.body, self.labels, self._settings = body, tuple(labels), settings
        self._columns = [self.labels.index(label) for label in self.layout.labels]
        self._prior = prior.for_joints(body.joint_names)
        recording = replace(recording, observed=np.ascontiguousarray(recording.observed[:, seen]))
        self._subject = fit_subject(body, self._prior, self.layout, [recording], settings)
        self.betas, self.latent_markers = self._subject.shape.betas, self._subject.shape.latent_markers
        self._solver: CausalSolver | None = None

    def step(self, markers: Float[np.ndarray, "M 3"]) -> CausalFrame:
        """Pose (J, 3) in rad, trans (3,) in m and cost of the next frame, in the markers' own world frame.

        markers: those of ``labels``, in metres, NaN where missing. Pose and trans are NaN until a first frame shows at
        least four markers. Raises HabitusError where the shape is another.
        """
        given = np.asarray(markers, dtype=np.float64)
        if given.shape != (len(self.labels), 3):
            raise HabitusError(f"markers have shape {given.shape}; expected ({len(self.labels)}, 3), one row a label")
        observed = exchange(given[None, self._columns], self._subject.exchanged)
        if self._solver is None and np.isfinite(observed[0, :, 0]).sum() < FEWEST_MARKERS:
            return CausalFrame(np.full((self.body.num_joints, 3), np.nan), np.full(3, np.nan), 0.0)
        self._solver = self._solver or self._started(observed)
        return self._solver.step(observed[0])

    def _started(self, observed: np.ndarray) -> CausalSolver:
        rig, names = self._subject.rig, ("root", *self._prior.joint_names)
        pose, trans = start_sequence(rig, self._subject.shape.pose, names, observed)
        scales = np.full(observed.shape[1], self._settings.robust_scale[1])
        return CausalSolver(rig, self._prior, pose[0], trans[0], sequence_settings(self._settings), scales)
