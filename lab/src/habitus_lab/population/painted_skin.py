"""Skin in colour, as finely as is asked for: of any place on a body, told at rest, the linear
albedo there.

Natural skin has patches, moles and freckles, a cap of hair, a striped shirt and shorts. Painted
people, as those of FAUST, carry stamps all over, so that no place of the skin looks like another.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.fit.selection.held_out import smooth_field
from habitus.fit.selection.problem import SELECTION

FRECKLES = 1500
MOLES = 120
STAMPS = 5000
FRECKLE, MOLE, STAMP = (0.001, 0.002), (0.0015, 0.004), (0.004, 0.012)
"""Metres: least and largest radius."""
SOFT = 0.001
"""Metres over which a spot's edge goes from one colour to the other: what a pixel of the camera
sees.
"""
PATCHES, MOTTLED, MOTTLES = 0.15, 0.04, 0.012
"""Spread of log albedo over some 8 cm and over `MOTTLES` metres."""


@dataclass(frozen=True, eq=False)
class Spots:
    """Round spots: centres (S, 3) at rest and radii (S,), m, colours (S, 3), linear, and how well
    they cover (S,).
    """

    centre: Float[np.ndarray, "S 3"]
    radius: Float[np.ndarray, " S"]
    colour: Float[np.ndarray, "S 3"]
    cover: Float[np.ndarray, " S"]

    @staticmethod
    def strewn(
        body: BodyModel,
        rng: np.random.Generator,
        radius: tuple[float, float],
        colour: Float[np.ndarray, "S 3"],
        cover: tuple[float, float],
    ) -> "Spots":
        """Spots evenly all over a body, one for each colour; radius and cover from and to."""
        corners = body.v_template[body.faces]
        count = len(colour)
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        face = rng.choice(len(area), count, p=area / area.sum())
        centre = np.einsum("sk,skc->sc", rng.dirichlet((1.0, 1.0, 1.0), count), corners[face])
        return Spots(centre, rng.uniform(*radius, count), colour, rng.uniform(*cover, count))

    def over(
        self, points: Float[np.ndarray, "N 3"], colour: Float[np.ndarray, "N 3"]
    ) -> Float[np.ndarray, "N 3"]:
        """Colours of places once they have these spots on them; where some overlap, the one that
        reaches furthest.
        """
        away, which = KDTree(self.centre).query(points, k=6)
        inside = np.clip(0.5 + (self.radius[which] - away) / SOFT, 0.0, 1.0)
        best = inside.argmax(1)[:, None]
        which = np.take_along_axis(which, best, 1)[:, 0]
        share = (np.take_along_axis(inside, best, 1)[:, 0] * self.cover[which])[:, None]
        return (1.0 - share) * colour + share * self.colour[which]


@dataclass(frozen=True, eq=False)
class PaintedSkin:
    """The skin of one person on a body's vertices at rest; ``cover`` (V, 3) is 1 under hair, shirt
    and shorts.

    ``colours`` (5, 3), linear: of skin, hair, shirt, its stripes (``stripe`` rad / m) and shorts.
    """

    rest: Float[np.ndarray, "V 3"]
    cover: Float[np.ndarray, "V 3"]
    colours: Float[np.ndarray, "5 3"]
    stripe: float
    on_skin: tuple[Spots, ...]
    on_all: tuple[Spots, ...]
    seed: int

    @staticmethod
    def of(body: BodyModel, rng: np.random.Generator, painted: bool = False) -> "PaintedSkin":
        """Somebody's skin and clothes, as they are or with stamps all over them."""
        skin = np.array([0.62, 0.44, 0.35]) * rng.uniform(0.45, 1.15)
        hair = np.array([0.10, 0.07, 0.05]) * rng.uniform(0.5, 4.0)
        colours = np.clip(np.stack([skin, hair, *rng.uniform(0.06, 0.7, (3, 3))]), 0.02, 0.95)
        on_skin = (
            Spots.strewn(
                body, rng, FRECKLE, np.tile(skin * (0.7, 0.55, 0.5), (FRECKLES, 1)), (0.2, 0.6)
            ),
            Spots.strewn(
                body, rng, MOLE, np.tile(skin * (0.35, 0.25, 0.22), (MOLES, 1)), (0.6, 0.95)
            ),
        )
        stamps = (
            Spots.strewn(body, rng, STAMP, rng.uniform(0.03, 0.7, (STAMPS, 3)), (0.9, 1.0))
            if painted
            else None
        )
        cover = np.stack(dressed(body), 1).astype(float)
        stripe = float(rng.uniform(60.0, 120.0))
        seed = int(rng.integers(1 << 30))
        on_all = () if stamps is None else (stamps,)
        return PaintedSkin(body.v_template, cover, colours, stripe, on_skin, on_all, seed)

    def albedo(
        self,
        corners: Int[np.ndarray, "N 3"],
        share: Float[np.ndarray, "N 3"],
        shift: float = 0.0,
        look: int = 0,
    ) -> Float[np.ndarray, "N 3"]:
        """Linear albedo of N places: the vertices of their triangles, and the weights of these.

        shift: metres (sd) that colours come from beside, alike over some 8 cm and in each ``look``
        another way, as of cameras whose calibration is off by a pixel.
        """
        points = np.einsum("nk,nkc->nc", share, self.rest[corners])
        if shift > 0.0:
            points = points + shift * smooth_field(points, np.random.default_rng([self.seed, look]))
        rng = np.random.default_rng(self.seed)
        patches = PATCHES * smooth_field(points, rng)[:, :1]
        fine = MOTTLED * smooth_field(points * (SELECTION.flesh_reach / MOTTLES), rng)[:, :1]
        colour = self.colours[0] * np.exp(patches + fine)
        for spots in self.on_skin:
            colour = spots.over(points, colour)
        hair, shirt, shorts = np.einsum("nk,nkc->cn", share, self.cover[corners]) > 0.5
        stripes = np.sin(points[:, 1] * self.stripe) > 0.3
        for where, tone in ((hair, 1), (shirt, 2), (shirt & stripes, 3), (shorts, 4)):
            colour[where] = self.colours[tone] * np.exp(2.0 * fine[where])
        for spots in self.on_all:
            colour = spots.over(points, colour)
        return np.clip(colour, 0.01, 0.95)


def dressed(
    body: BodyModel,
) -> tuple[Bool[np.ndarray, " V"], Bool[np.ndarray, " V"], Bool[np.ndarray, " V"]]:
    """Which vertices hair, shirt and shorts cover."""
    names = body.joint_names
    places = body.joint_template
    at = {
        name: places[names.index(name)]
        for name in ("head", "neck", "pelvis", "left_knee", "left_hip")
    }
    points = body.v_template
    part = np.array(names)[
        body.skinning_index[np.arange(len(points)), body.skinning_value.argmax(1)]
    ]
    top = points[:, 1].max()
    brow = at["head"][1] + 0.55 * (top - at["head"][1])
    hair = (part == "head") & (points[:, 1] > brow - 0.9 * np.maximum(0.02 - points[:, 2], 0.0))
    trunk = np.isin(part, ("spine1", "spine2", "spine3", "left_collar", "right_collar", "pelvis"))
    shirt = trunk & (points[:, 1] > at["pelvis"][1]) & (points[:, 1] < at["neck"][1])
    thigh = np.isin(part, ("left_hip", "right_hip", "pelvis"))
    low = at["left_hip"][1] + 0.45 * (at["left_knee"][1] - at["left_hip"][1])
    return hair, shirt, thigh & (points[:, 1] > low) & (points[:, 1] <= at["pelvis"][1])


def soft_light(rng: np.random.Generator) -> Float[np.ndarray, "9 3"]:
    """Light in a world with y up, over the nine `harmonic_terms`: much from everywhere, more from
    above and a side.
    """
    light = np.zeros((9, 3))
    light[0], light[1] = rng.uniform(0.7, 0.9), rng.uniform(0.1, 0.25)
    light[2:4], light[4:] = 0.12 * rng.normal(size=(2, 1)), 0.04 * rng.normal(size=(5, 1))
    return light * np.array([1.0, 0.95, 0.88]) ** rng.uniform(-0.5, 1.5)
