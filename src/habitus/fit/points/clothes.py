"""Clothes and hair of a scanned person: the distance between scan and skin.

    w_p -> w_p min(1, c noise^2 / (e |d_p|))    where the scan lies outside the surface by d_p

Tight clothes and hair lie on the skin with a known thickness. Loose clothes hang off it by unknown
distances, exponentially distributed with mean e, and touch it in places. A point outside the
surface therefore pulls with a constant force, 1 / e, instead of one that grows with the distance
(written as a weight, as in iteratively reweighted least squares), and a point inside as before: the
skin comes to lie where few points are inside of it. Neighbouring points of cloth are not
independent; c = min(1, `ClothesSettings.points` / N) counts all N as that many. Under loose clothes
the surface is the model with its skin offsets, and its vertices have weight 0.

Hair that no option describes is part of the surface: the skin offsets of the scalp then have the
mean and the standard deviation `hair_thickness`, and in fits without offsets its points weigh
`HairSettings.weight`. Otherwise the model's head grows until it fills the hair.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.body.model import BodyModel
from habitus.fit.points.correspondences import Correspondences
from habitus.fit.points.depth_settings import STANDARD
from habitus.fit.points.settings import ClothesSettings, HairSettings
from habitus.fit.points.skin_offsets import cover_of, scalp
from habitus.fit.verdict import BODY, part_of_joint

REGIONS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "trunk": ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar"),
        "upper arms": ("left_shoulder", "right_shoulder"),
        "forearms": ("left_elbow", "right_elbow"),
        "thighs": ("left_hip", "right_hip"),
        "lower legs": ("left_knee", "right_knee"),
        "head": ("head",),
    }
)
"""Parts of the body for which the distance of cloth from the skin is reported, by their joints."""


@dataclass(frozen=True, eq=False)
class Clothes:
    """Of each vertex of a body: ``thickness`` (V,; m) of tight clothes and hair, ``ease`` (V,; m),
    the mean distance of loose ones from the skin, 0 where there are none, and ``covered`` (V,), 1
    where there may be loose ones and 0 elsewhere.
    """

    thickness: Float[np.ndarray, " V"]
    ease: Float[np.ndarray, " V"]
    covered: Float[np.ndarray, " V"]
    settings: ClothesSettings

    @staticmethod
    def of(body: BodyModel, settings: ClothesSettings) -> "Clothes":
        """The clothes of a body; computed once."""
        hair = scalp(body, STANDARD.hairline)
        thickness = settings.thickness * cover_of(body, STANDARD.clothed) + settings.hair * hair
        parts = zip(body.joint_names, part_of_joint(body.joint_names, body.parents), strict=True)
        clothed = [part == BODY and name not in settings.bare for name, part in parts]
        loose = body.skinning_weights[:, clothed].sum(1)
        ease = settings.ease * loose + settings.hair_ease * hair
        covered = (settings.ease > 0.0) * loose + (settings.hair_ease > 0.0) * hair
        return Clothes(thickness, ease, np.minimum(covered, 1.0), settings)

    @property
    def loose(self) -> bool:
        """Whether anything hangs off the skin."""
        return bool(self.ease.any())

    def factor(
        self,
        correspondences: Correspondences,
        corners: Int[np.ndarray, "N 3"],
        points: Float[np.ndarray, "N 3"],
        variance: float,
    ) -> Float[np.ndarray, " N"]:
        """The factor of each point's weight, which is 1 / ``variance`` (m^2) without clothes.
        corners: the vertices of its face.
        """
        pull = (self.ease[corners] * correspondences.barycentric).sum(1)
        pull *= np.maximum(correspondences.outside(points), 0.0)
        share = min(1.0, self.settings.points / len(points))
        return np.minimum(1.0, share * variance / np.maximum(pull, 1e-12))

    def hanging(
        self,
        correspondences: Correspondences,
        corners: Int[np.ndarray, "N 3"],
        points: Float[np.ndarray, "N 3"],
    ) -> Bool[np.ndarray, " N"]:
        """Which points are cloth (or hair) off the skin."""
        ease = (self.ease[corners] * correspondences.barycentric).sum(1)
        outside = correspondences.outside(points)
        off = (outside > self.settings.touching) | (correspondences.cosine < self.settings.aside)
        near = correspondences.distances(points) < self.settings.furthest
        return (ease > 0.0) & off & near


def hair_thickness(
    outside: Float[np.ndarray, " N"],
    distance: Float[np.ndarray, " N"],
    scalp: Float[np.ndarray, " N"],
    settings: HairSettings,
) -> float:
    """The median distance (m) of points outside a model's scalp; 0 if they are inside or show no
    scalp. outside: signed distance of each point along the model's normal (m); distance: from its
    correspondence (m); scalp: how much hair may grow there, 0..1.
    """
    outside = outside[(distance < settings.most_thickness) & (scalp > settings.least_scalp)]
    return max(0.0, float(np.median(outside))) if len(outside) else 0.0


def hair_notes(hair: Float[np.ndarray, " V"]) -> tuple[str, ...]:
    """The note about hair of a thickness (m); none where there is none."""
    cm = 100.0 * hair.max(initial=0.0)
    note = f"the hair is about {cm:.0f} cm thick; height and head are measured without it"
    return (note,) if cm else ()
