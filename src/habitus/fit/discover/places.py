"""Places found ever more finely: the shape stage and the best place of each label in turn (M 6)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.discover.settings import DISCOVER, DiscoverSettings
from habitus.fit.discover.skin import Skin
from habitus.fit.discover.starts import Known, places_of, squared_distances
from habitus.fit.markers.energy import Placement
from habitus.fit.markers.shape import ShapeFit, shape_stage
from habitus.observe.marker_prediction import marked_body, predict


@dataclass(frozen=True)
class Seated:
    """M labels seated on a body: the vertex of each (M,), how surely (M,), the shape stage's result
    on F frames, errors (F, M) in metres, the cost of it all, and the posterior over the skin's
    places.
    """

    vertices: np.ndarray
    shape: ShapeFit
    errors: Float[np.ndarray, "F M"]
    posterior: Float[np.ndarray, "M K"]

    @property
    def cost(self) -> float:
        """Of all terms together."""
        return float(sum(self.shape.costs.values()))


def seated(
    body: BodyModel,
    skin: Skin,
    observed: Float[np.ndarray, "F M 3"],
    prior: PosePrior,
    betas: Float[np.ndarray, " B"],
    pose: Float[np.ndarray, "F J 3"],
    trans: Float[np.ndarray, "F 3"],
    known: Known = 0.0,
    rounds: tuple[float, ...] = DISCOVER.place_spreads,
    settings: DiscoverSettings = DISCOVER,
) -> Seated:
    """Labels each at its best place, then shape, latent markers and poses, round by round; in the
    end each label is where its latent marker came to lie.
    """
    count = observed.shape[1]
    for spread in rounds:
        vertices = skin.vertices[
            np.argmax(_likely(body, skin, observed, betas, pose, trans, known, settings), axis=1)
        ]
        lengths = (skin.distance, settings.distance_spread, spread)
        placement = Placement(vertices, *(np.full(count, length) for length in lengths))
        shape = shape_stage(body, placement, observed, prior, pose, trans, settings.fit)
        betas = shape.betas
        pose = shape.pose
        trans = shape.trans
    predicted = predict(marked_body(body, betas, shape.attachment), pose, trans)
    likely = _likely(body, skin, observed, betas, pose, trans, known, settings)
    exponent = likely * (settings.place_sigma / settings.certainty_sigma) ** 2
    posterior = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    errors = np.linalg.norm(predicted - observed, axis=2)
    vertices = KDTree(body.rest_vertices(betas)).query(shape.latent_markers)[1]
    return Seated(
        np.asarray(vertices), shape, errors, posterior / posterior.sum(axis=1, keepdims=True)
    )


def _likely(body, skin, observed, betas, pose, trans, known, settings) -> Float[np.ndarray, "M K"]:
    """Logarithms of how likely each label is at each place, but for a constant."""
    squared = squared_distances(places_of(skin.on(body, betas), pose[None], trans[None]), observed)[
        0
    ]
    return known - squared / (2.0 * settings.place_sigma**2)


def within(
    seated: Seated, skin: Skin, template: Float[np.ndarray, "V 3"], reach: float
) -> Float[np.ndarray, " M"]:
    """How likely each label sits within ``reach`` metres of the place that was found (M,)."""
    distances = np.linalg.norm(skin.points[None] - template[seated.vertices][:, None], axis=2)
    return np.sum(seated.posterior * (distances < reach), axis=1)


def off_body(seated: Seated, max_distance: float) -> Bool[np.ndarray, " M"]:
    """Labels that lie further than ``max_distance`` metres from where they would sit, at the
    median of the frames.
    """
    errors = np.where(np.isfinite(seated.errors), seated.errors, np.inf)
    count = np.isfinite(seated.errors).sum(axis=0)
    middle = np.sort(errors, axis=0)[np.maximum(count - 1, 0) // 2, np.arange(errors.shape[1])]
    return middle > max_distance
