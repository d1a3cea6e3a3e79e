"""A marker fit for live use: shape from some frames first, then pose frame after frame as markers
arrive (M 6).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.markers.assembly import Subject
from habitus.fit.markers.frames import spread_frames
from habitus.fit.markers.recipe import fit_subject
from habitus.fit.markers.recordings import Recording, ever_seen, of_markers
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.shape import ShapeFit
from habitus.fit.markers.tracking import LiveFrame, Tracker
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import marked_body


@dataclass(frozen=True)
class KnownSubject:
    """A person whose shape and marker places are known: body, its prior, the layout of the N
    markers in use.
    """

    body: BodyModel
    prior: PosePrior
    layout: MarkerLayout
    subject: Subject

    @classmethod
    def learnt(
        cls,
        body: BodyModel,
        prior: PosePrior,
        layout: MarkerLayout,
        recording: Recording,
        settings: MoshSettings,
    ) -> "KnownSubject":
        """From some frames, by the shape stage; recording: its markers in the layout's order.

        Raises HabitusError where no frame holds enough markers.
        """
        seen = ever_seen(recording.observed)
        prior = prior.for_joints(body.joint_names)
        layout = replace(
            layout, markers=tuple(m for m, s in zip(layout.markers, seen, strict=True) if s)
        )
        recording = replace(recording, observed=of_markers(recording.observed, seen))
        return cls(body, prior, layout, fit_subject(body, prior, layout, [recording], settings))

    @classmethod
    def saved(
        cls, fit: MarkerFit, prior: PosePrior, layout: MarkerLayout, settings: MoshSettings
    ) -> "KnownSubject":
        """From an earlier fit; layout: of the labels that are in use, which the fit has too."""
        columns = [fit.labels.index(label) for label in layout.labels]
        attachment = replace(
            fit.attachment,
            triangles=fit.attachment.triangles[columns],
            coefficients=fit.attachment.coefficients[columns],
        )
        some = spread_frames(fit.observed_markers, settings.frames, settings.seed)
        shape = ShapeFit(
            betas=fit.betas,
            latent_markers=fit.latent_markers[columns],
            attachment=attachment,
            pose=fit.pose[some],
            trans=fit.trans[some],
            costs={},
            status="saved",
            iterations=0,
        )
        rig = marked_body(fit.body, fit.betas, attachment)
        return cls(
            fit.body,
            prior.for_joints(fit.body.joint_names),
            layout,
            Subject(shape, rig, (), (), 0.0),
        )

    def tracker(self, settings: MoshSettings, rate_hz: float) -> Tracker:
        """What follows this person through a stream of so many frames a second."""
        return Tracker(self.subject, self.prior, settings, rate_hz)


class LiveFit:
    """Follows one person's markers: ``step`` fits the next frame from itself and the two before it.

    ``labels`` name the M markers that ``step`` takes, in their order; ``layout`` names the N that
    are used, which are those in ``columns`` (N,). ``betas`` (B,) and ``latent_markers`` (N, 3) are
    the subject's. For one stream and one thread.
    """

    def __init__(
        self,
        known: KnownSubject,
        labels: Sequence[str],
        columns: Int[np.ndarray, " N"],
        settings: MoshSettings,
        rate_hz: float,
    ):
        self.body = known.body
        self.layout = known.layout
        self.labels = tuple(labels)
        self.betas = known.subject.shape.betas
        self.latent_markers = known.subject.shape.latent_markers
        self._columns = columns
        self._tracker = known.tracker(settings, rate_hz)

    def step(self, markers: Float[np.ndarray, "M 3"]) -> LiveFrame:
        """Pose (J, 3) in rad, trans (3,) in m and cost of the next frame, in the markers' own world
        frame.

        markers: those of ``labels``, in metres, NaN where missing. Pose and trans are NaN where
        nobody is seen: before a first frame shows enough markers (half of them, or four for a
        while), and when they were missing for half a second; who returns is found again. Raises
        HabitusError where the shape is another.
        """
        given = np.asarray(markers, dtype=np.float64)
        if given.shape != (len(self.labels), 3):
            raise HabitusError(
                f"markers have shape {given.shape}; expected ({len(self.labels)}, 3), one row a "
                "label"
            )
        return self._tracker.step(
            np.where((self._columns >= 0)[:, None], given[self._columns], np.nan)
        )
