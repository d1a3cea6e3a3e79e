"""What a live fit has followed, as a fit like any other."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from habitus.fit.markers.gaps import MarkerTargets
from habitus.fit.markers.live import LiveFrame
from habitus.fit.markers.recipe import PoseStage, assemble
from habitus.fit.markers.recordings import Recording
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.sequence import SequenceResult
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.suspects import exchange
from habitus.fit.subject import Subject
from habitus.residuals.robust import geman_mcclure_weight


class Record:
    """Keeps the frames of a stream; about 1 kB each."""

    def __init__(self) -> None:
        self._poses: list[np.ndarray] = []
        self._trans: list[np.ndarray] = []
        self._costs: list[float] = []
        self._observed: list[np.ndarray] = []

    def __len__(self) -> int:
        """How many frames there are."""
        return len(self._poses)

    def add(self, frame: LiveFrame, observed: np.ndarray) -> None:
        """The next frame, with the markers (N, 3) that it was told; nobody's markers are not
        kept.
        """
        self._poses.append(frame.pose)
        self._trans.append(frame.trans)
        self._costs.append(frame.cost)
        self._observed.append(
            (observed if frame.state != "nobody" else np.full_like(observed, np.nan)).astype("f4")
        )

    def fit(
        self,
        known: Subject,
        recording: Recording,
        settings: MoshSettings,
        notes: Sequence[str],
    ) -> MarkerFit:
        """The fit of all frames; where nobody was seen the body stands as it was last, and the
        frames are flagged.
        """
        standing = _held(np.isfinite(np.array(self._trans)[:, 0]))
        pose = np.array(self._poses)[standing]
        trans = np.array(self._trans)[standing]
        observed = exchange(np.array(self._observed, dtype=np.float64), known.exchanged)
        scale = np.full(observed.shape[1], settings.robust_scale[1])
        costs = np.array(self._costs)
        result = SequenceResult(
            pose,
            trans,
            None,
            {"frames": float(costs.sum())},
            costs,
            np.ones(observed.shape[:2]),
            "causal",
            len(costs),
            (float(costs.sum()),),
        )
        found = PoseStage(result, observed, MarkerTargets(observed, None), scale)
        recording = replace(recording, warnings=(*recording.warnings, *notes))
        seconds = {"shape": known.seconds, "pose": None, "soft_tissue": None}
        fit = assemble(recording, known, found, None, seconds, settings)
        distances = np.linalg.norm(fit.observed_markers - fit.predicted_pose_stage, axis=2)
        return replace(fit, marker_weights=np.nan_to_num(geman_mcclure_weight(distances, scale)))


def _held(valid: np.ndarray) -> np.ndarray:
    """For each frame the last valid one up to it; of those before the first, the first."""
    rows = np.where(valid, np.arange(len(valid)), -1)
    rows = np.maximum.accumulate(rows)
    return np.where(rows < 0, int(np.argmax(valid)), rows)
