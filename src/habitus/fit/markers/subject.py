"""A subject from a few frames of all captures: the shape stage, and labels that are wrong
throughout. Exchanged pairs are put right, and markers far from the layout's places lose their
weight.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, islice

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.energy import Placement, place
from habitus.fit.markers.recordings import Recording, shape_frames
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.shape import HOPELESS, ShapeFit, Subject, shape_stage
from habitus.fit.markers.start import start_frames, trunk_weights
from habitus.fit.markers.suspects import (
    crossed_placements,
    exchange,
    exchange_gains,
    far_placements,
    lengths,
)
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach, default_markers

__all__ = ["fit_subject"]

Pair = tuple[int, int]
MIRROR = np.array([-1.0, 1.0, 1.0])


def fit_subject(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    settings: MoshSettings,
) -> Subject:
    """The shape stage on a few frames of all captures; pairs of labels exchanged throughout are
    found and put right, and markers that are not the layout's lose their weight.
    """
    began = time.perf_counter()
    prior = prior.for_joints(body.joint_names)
    observed, sources = shape_frames(recordings, settings)
    stage = _ShapeStage(body, place(layout, body), prior, settings)
    shape = stage.fit(observed)
    exchanged: tuple[Pair, ...] = ()
    misplaced: tuple[int, ...] = ()
    if shape.status != HOPELESS:
        shape, exchanged = stage.with_labels_exchanged(shape, observed)
        observed = exchange(observed, exchanged)
        misplaced = stage.misplaced(shape, observed)
        if misplaced:
            others = ~np.isin(np.arange(len(layout)), misplaced)
            kept = np.where(others[:, None], observed, np.nan)
            shape = stage.fit(kept, shape)
    seconds = time.perf_counter() - began
    return Subject(body, prior, layout, shape, exchanged, misplaced, seconds, sources)


@dataclass(frozen=True)
class _ShapeStage:
    """What the shape stage of any labelling is given. `observed` is always (F, M, 3), metres, NaN
    where missing.
    """

    body: BodyModel
    placement: Placement
    prior: PosePrior
    settings: MoshSettings

    def fit(self, observed: np.ndarray, start: ShapeFit | None = None) -> ShapeFit:
        """Betas, latent markers and poses, begun from plain poses of the mean person or from the
        poses of another fit.
        """
        pose, trans = (start.pose, start.trans) if start else self._started(observed)
        return shape_stage(
            self.body, self.placement, observed, self.prior, pose, trans, self.settings
        )

    def with_labels_exchanged(
        self, shape: ShapeFit, observed: np.ndarray
    ) -> tuple[ShapeFit, tuple[Pair, ...]]:
        """The fit with pairs of labels exchanged that are exchanged throughout, and the pairs.

        First those whose latent markers sit at each other's places, then the others one at a time.
        """
        exchanged = crossed_placements(
            shape.latent_markers, self._places(shape.betas), self.settings.suspects
        )
        if exchanged:
            observed = exchange(observed, exchanged)
            shape = self.fit(observed)
        while pair := self._exchanged_pair(shape, observed, exchanged):
            observed = exchange(observed, [pair])
            better = self.fit(observed)
            if set(pair).intersection(self.misplaced(better, observed)):
                break
            shape = better
            exchanged = (*exchanged, pair)
        return shape, exchanged

    def _exchanged_pair(
        self, shape: ShapeFit, observed: np.ndarray, exchanged: tuple[Pair, ...]
    ) -> Pair | None:
        """One more exchanged pair, or None.

        Each of a few doubtful pairs is exchanged for the first step of the annealing, whose loss is
        not robust yet. The pair of the lowest cost is taken, if both of its markers end at their
        places and the cost is below `SuspectSettings.exchanged_cost` of the cost as labelled.
        """
        known = {marker for pair in exchanged for marker in pair}
        doubtful = dict.fromkeys(
            (min(pair), max(pair))
            for pair in (
                *self._nearer_exchanged(shape, observed),
                *self._near_misplaced(shape, observed),
            )
            if not known.intersection(pair)
        )
        if not doubtful:
            return None
        first = replace(self.settings, annealing=self.settings.annealing[:1], last_repeats=1)
        brief = replace(self, settings=first)
        lowest = self.settings.suspects.exchanged_cost * _cost(brief.fit(observed))
        best = None
        for pair in islice(doubtful, self.settings.suspects.exchanges_tried):
            trial = exchange(observed, [pair])
            fit = brief.fit(trial)
            if _cost(fit) < lowest and not set(pair).intersection(brief.misplaced(fit, trial)):
                lowest = _cost(fit)
                best = pair
        return best

    def misplaced(self, shape: ShapeFit, observed: np.ndarray) -> tuple[int, ...]:
        """Markers too far from the layout's places to be the ones meant."""
        return far_placements(
            shape.latent_markers,
            self._places(shape.betas),
            self.placement.place_spread,
            lengths(observed - self._predicted(shape)),
            self.settings.suspects,
        )

    def _nearer_exchanged(self, shape: ShapeFit, observed: np.ndarray) -> list[Pair]:
        """Pairs whose residuals are shorter with their labels exchanged, the largest gain first; a
        sound fit has none.
        """
        gains = np.triu(exchange_gains(observed, self._predicted(shape)), 1)
        first, second = np.nonzero(gains > 0)
        order = np.argsort(-gains[first, second])
        return list(zip(first[order].tolist(), second[order].tolist(), strict=True))

    def _near_misplaced(self, shape: ShapeFit, observed: np.ndarray) -> list[Pair]:
        """Pairs of misplaced markers; of a misplaced marker or a neighbour of one with its partner
        on the other side; and of a misplaced marker with its neighbours.
        """
        places = self._places(shape.betas)
        misplaced = self.misplaced(shape, observed)
        near = {
            marker: _nearest(shape.latent_markers[marker], places, marker)[
                : self.settings.suspects.neighbours
            ]
            for marker in misplaced
        }
        around = dict.fromkeys([*misplaced, *chain.from_iterable(near.values())])
        return [
            *combinations(misplaced, 2),
            *((k, _nearest(places[k] * MIRROR, places, k)[0]) for k in around),
            *((marker, other) for marker, others in near.items() for other in others),
        ]

    def _places(self, betas: np.ndarray) -> Float[np.ndarray, "M 3"]:
        """The layout's places on a body at rest (m)."""
        return default_markers(self.body, betas, self.placement.vertices, self.placement.distance)

    def _predicted(self, shape: ShapeFit) -> Float[np.ndarray, "F M 3"]:
        rig = marked_body(self.body, shape.betas, shape.attachment)
        return predict(rig, shape.pose, shape.trans)

    def _started(
        self, observed: np.ndarray
    ) -> tuple[Float[np.ndarray, "F J 3"], Float[np.ndarray, "F 3"]]:
        """Pose and trans that the shape stage begins with, of the mean person."""
        body = self.body
        mean = np.zeros(body.num_betas)
        attachment = attach(self._places(mean), body.rest_vertices(mean), body.faces)
        rig = marked_body(body, mean, attachment)
        trunk = trunk_weights(body, self.placement.vertices, self.settings.start)
        aligning = trunk if self.settings.start_markers == "trunk" else np.ones_like(trunk)
        return start_frames(
            rig, body.joint_names, aligning, observed, self.prior, self.settings.start
        )


def _nearest(place: np.ndarray, places: np.ndarray, without: int) -> list[int]:
    """Markers sorted by the distance of their places from `place`, without one of them."""
    order = np.argsort(np.linalg.norm(places - place, axis=1)).tolist()
    order.remove(without)
    return order


def _cost(shape: ShapeFit) -> float:
    return sum(shape.costs.values())
