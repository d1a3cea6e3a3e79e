"""Held-out markers: left out of everything, then predicted at the layout's default place (MoSh 8.1)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.mosh import Recording, fit_markers, place
from habitus.fit.result import HeldOut, MarkerFit
from habitus.fit.settings import MoshSettings
from habitus.observe.kernels import predict
from habitus.observe.layouts import MarkerLayout
from habitus.observe.markers import attach
from habitus.observe.rest import RestShape
from habitus.observe.rig import marker_rig
from habitus.residuals.pose_prior import PosePrior


def hold_out(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    labels: Sequence[str],
    settings: MoshSettings,
) -> tuple[MarkerFit, ...]:
    """A fit without ``labels`` that carries their errors. Raises HabitusError for a label that the layout does not hold."""
    unknown = sorted(set(labels) - set(layout.labels))
    if unknown:
        raise HabitusError(f"cannot hold out {', '.join(unknown)}: not among the matched labels {', '.join(layout.labels)}")
    out = np.isin(layout.labels, labels)
    kept = replace(layout, markers=tuple(m for m, o in zip(layout.markers, out, strict=True) if not o))
    gone = replace(layout, markers=tuple(m for m, o in zip(layout.markers, out, strict=True) if o))
    fits = fit_markers(body, prior, kept, [replace(r, observed=r.observed[:, ~out]) for r in recordings], settings)
    return tuple(
        replace(fit, held_out=_errors(fit, gone, r.observed[:, out])) for fit, r in zip(fits, recordings, strict=True)
    )


def hold_out_by_rotation(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    every: int,
    settings: MoshSettings,
) -> tuple[HeldOut, ...]:
    """Each marker's held-out error, one in ``every`` left out at a time: as many fits as ``every``, for each recording."""
    if not 2 <= every <= len(layout):
        raise HabitusError(f"hold-out-every is {every}; expected 2 to {len(layout)}, the number of matched markers")
    folds = [hold_out(body, prior, layout, recordings, layout.labels[k::every], settings) for k in range(every)]
    return tuple(_merged([fold[r].held_out for fold in folds]) for r in range(len(recordings)))


def _errors(fit: MarkerFit, gone: MarkerLayout, observed: np.ndarray) -> HeldOut:
    rest, placement = RestShape(fit.body), place(gone, fit.body)
    latent, _ = rest.default_markers(fit.betas, placement.vertices, placement.distance)
    rig = marker_rig(fit.body, fit.betas, attach(latent, rest.vertices(fit.betas), rest.faces))
    posed = np.linalg.norm(predict(rig, *fit.pose_stage) - observed, axis=2)
    if fit.soft_tissue is None:
        return HeldOut(gone.labels, posed, None)
    return HeldOut(gone.labels, posed, np.linalg.norm(predict(rig, fit.pose, fit.trans, fit.soft_tissue) - observed, axis=2))


def _merged(parts: Sequence[HeldOut | None]) -> HeldOut:
    known = [part for part in parts if part is not None]
    soft = [part.soft_tissue for part in known if part.soft_tissue is not None]
    return HeldOut(
        tuple(label for part in known for label in part.labels),
        np.concatenate([part.pose for part in known], axis=1),
        np.concatenate(soft, axis=1) if len(soft) == len(known) else None,
    )
