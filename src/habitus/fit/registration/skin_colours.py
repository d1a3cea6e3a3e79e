"""The colours of a person's skin, shared by all scans of them (Bogo et al. 2014): texture, and the
light of each scan.

    log(I_kp + d) = T(b_kp) + h(n_kp) . L_k

T are tones (log of linear colours) at the nodes of a `SkinGrid`, one texture for all scans k; p is
a coloured point, b its place on the registered surface, n the normal there, h harmonics up to order
2, L_k what light does in scan k. What a scan is held against is the texture of all others: its own
colours would hold it where it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from habitus.fit.registration.nearest import Nearest, Topology, nearest
from habitus.fit.registration.skin_grid import SkinGrid
from habitus.mesh.normals import face_normals
from habitus.observe.harmonics import harmonic_terms
from habitus.residuals.robust import geman_mcclure_weight
from habitus.residuals.surface_points import PointMatches

DARK, NOISE = 0.004, 0.008
"""Linear light below which all is black, and the noise (sd) of a camera's pixels."""
CERTAIN = 0.1
"""Noise of a tone that halves what it counts."""
REACH = 0.006
"""Metres from the surface beyond which a coloured point hardly counts."""
LEAST_COSINE = 0.4
SMOOTHINGS = 3
"""Times that the texture is averaged over neighbouring nodes."""
LIGHT_ROUNDS, LIGHT_HELD = 3, 0.01
"""Solves of light and texture in turn, and the weight of no light at all against that of all
points.
"""
GAIN_PIECES = 2
GAIN_SMOOTHINGS = 20
PASSES = 2
"""Means of what the means before left: without these a tone is that of the middle of some points,
not of the node.
"""
SEEN, LEAST_SHARE = 0.1, 0.6
"""Coloured points for each node from which on its tone is trusted, and their least share of what
other scans have.
"""
TRUSTED = 0.5
"""How surely a tone is to be seen to be compared."""
GRAIN = 22.0
"""Pieces of a grid that make up one independent tone of a texture so often averaged."""


@dataclass(frozen=True, eq=False)
class ColourCloud:
    """Coloured points (N, 3) of a scan, m and y up, normals (N, 3), outward, and tones (N, 3), in
    random order.
    """

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    tones: Float[np.ndarray, "N 3"]
    certain: Float[np.ndarray, " N"]

    @staticmethod
    def of(
        points: Float[np.ndarray, "N 3"],
        normals: Float[np.ndarray, "N 3"],
        colours: Float[np.ndarray, "N 3"],
    ) -> "ColourCloud":
        """From linear colours; what is dark is less certain."""
        bright = np.maximum(colours, DARK)
        return ColourCloud(
            points, normals, np.log(bright), 1.0 / (1.0 + (NOISE / CERTAIN / bright.mean(1)) ** 2)
        )

    def first(self, count: int) -> "ColourCloud":
        """Some of them."""
        return ColourCloud(
            self.points[:count], self.normals[:count], self.tones[:count], self.certain[:count]
        )


@dataclass(frozen=True, eq=False)
class Sight:
    """Where on a surface a scan's coloured points belong, and how much each counts (N,)."""

    found: Nearest
    weight: Float[np.ndarray, " N"]

    @staticmethod
    def of(topology: Topology, surface: Float[np.ndarray, "V 3"], cloud: ColourCloud) -> "Sight":
        """On a surface (m)."""
        found = nearest(topology, surface, cloud.points, cloud.normals)
        away = np.linalg.norm(cloud.points - found.place, axis=1)
        return Sight(
            found, geman_mcclure_weight(away, REACH) * (found.cosine > LEAST_COSINE) * cloud.certain
        )


@dataclass(frozen=True, eq=False)
class SharedSkin:
    """Tones (K, G, 3) of each scan's skin at the nodes of a grid, its light taken out, and how
    surely they are seen there (K, G), 0 to 1; ``noise`` (3,): what single points differ by (robust
    sd).
    """

    grid: SkinGrid
    each: Float[np.ndarray, "K G 3"]
    seen: Float[np.ndarray, "K G"]
    noise: Float[np.ndarray, " 3"]

    @property
    def tones(self) -> Float[np.ndarray, "G 3"]:
        """The texture, 0 where no scan shows the skin."""
        return _mean(self.each, self.seen)[0]

    def without(self, k: int) -> tuple[Float[np.ndarray, "G 3"], Float[np.ndarray, " G"]]:
        """The texture of all scans but k, and how surely one of them shows it."""
        others = np.arange(len(self.each)) != k
        return _mean(self.each[others], self.seen[others])

    def apart(self, k: int) -> Float[np.ndarray, " G"]:
        """How far the tones of scan k are from the others' (root mean square of channels), 0 where
        either is unseen.
        """
        others, told = self.without(k)
        both = (told > TRUSTED) & (self.seen[k] > TRUSTED)
        return np.sqrt(((others - self.each[k]) ** 2).mean(1)) * both


def find_skin(grid: SkinGrid, clouds: Sequence[ColourCloud], sights: Sequence[Sight]) -> SharedSkin:
    """Texture and lights of all scans, solved in turn; for lights, colours that stand out count
    less.
    """
    wide = SkinGrid.of(grid.faces, GAIN_PIECES)
    count = range(len(clouds))
    shapes = [harmonic_terms(sight.found.normal) for sight in sights]
    tables = [grid.weights(sight.found.face, sight.found.barycentric) for sight in sights]
    rough = [wide.weights(sight.found.face, sight.found.barycentric) for sight in sights]
    weights = [sight.weight for sight in sights]
    middle = np.median(
        np.concatenate([cloud.tones[w > 0.1] for cloud, w in zip(clouds, weights, strict=True)]),
        axis=0,
    )
    light = [shapes[k] @ _light(shapes[k], clouds[k].tones - middle, weights[k]) for k in count]
    for _ in range(LIGHT_ROUNDS):
        found = [
            _at_nodes(grid, tables[k], sights[k].weight, clouds[k].tones - light[k]) for k in count
        ]
        each, mass = (np.stack(part) for part in zip(*found, strict=True))
        seen = _surely(mass)
        skin = _mean(each, seen)[0]
        apart = [clouds[k].tones - tables[k] @ skin for k in count]
        light = [shapes[k] @ _light(shapes[k], apart[k], weights[k]) for k in count]
        light = [light[k] + _gain(wide, rough[k], weights[k], apart[k] - light[k]) for k in count]
        left = [apart[k] - light[k] for k in count]
        noise = _spread(np.concatenate([left[k][sights[k].weight > 0.1] for k in count]))
        weights = [
            sights[k].weight * geman_mcclure_weight(np.sqrt(((left[k] / noise) ** 2).mean(1)), 3.0)
            for k in count
        ]
    return SharedSkin(grid, each, seen, noise)


@dataclass(frozen=True, eq=False)
class Places:
    """Places (N,) evenly all over a skin: faces, weights of corners (N, 3), and the area (m^2) that
    each stands for.
    """

    face: Int[np.ndarray, " N"]
    share: Float[np.ndarray, "N 3"]
    area: float
    faces_area: Float[np.ndarray, " F"]

    @staticmethod
    def of(
        surface: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], count: int
    ) -> "Places":
        """Drawn once, always the same."""
        rng = np.random.default_rng(0)
        area = 0.5 * np.linalg.norm(face_normals(surface, faces), axis=1)
        face = rng.choice(len(faces), count, p=area / area.sum())
        return Places(face, rng.dirichlet((1.0, 1.0, 1.0), count), float(area.sum() / count), area)


def colour_matches(
    skin: SharedSkin, k: int, places: Places, surface: Float[np.ndarray, "V 3"], loose: float = 0.0
) -> PointMatches:
    """Where colours would have places on the surface (m) of scan k, along it: grad T . dx = T -
    tone in all channels.

    T is the texture of the others; moving all at once, each goes its part of the way. A row's
    spread is that of tones, and of ``loose`` metres by which skin may slide for other reasons; rows
    closer than the texture's grain share what it tells.
    """
    table = skin.grid.weights(places.face, places.share)
    others, told = skin.without(k)
    apart = table @ (others - skin.each[k])
    seen = np.minimum(table @ told, table @ skin.seen[k])
    half = 0.5 * (others + skin.each[k])
    slope = skin.grid.slopes(half, surface, places.face, places.share)
    noise = _spread(apart[seen > TRUSTED])
    spread = np.sqrt(noise**2 + (loose * np.linalg.norm(slope, axis=2)) ** 2)
    weight = seen * geman_mcclure_weight(np.sqrt(((apart / spread) ** 2).mean(1)), 3.0)
    grain = np.maximum(GRAIN * places.faces_area[places.face] / skin.grid.n**2, 1e-9)
    root = np.sqrt(weight * np.minimum(places.area / grain, 1.0))[:, None]
    rows = (root / spread)[..., None] * slope
    wanted = (1.0 - 1.0 / len(skin.each)) * root * apart / spread
    size, axes = np.linalg.eigh(np.einsum("nci,ncj->nij", rows, rows))
    size = np.maximum(size[:, 1:], 0.0)
    axes = axes[:, :, 1:].transpose(0, 2, 1)  # the two along the skin
    good = size > 1e-6 * size.max(initial=1e-30)
    step = good * np.einsum("nkj,ncj,nc->nk", axes, rows, wanted) / np.where(good, size, 1.0)
    place = np.einsum("nk,nkc->nc", places.share, surface[skin.grid.faces[places.face]])
    target = place + np.einsum("nk,nkc->nc", step, axes)
    return PointMatches(places.face, places.share, target, (np.sqrt(size) * good)[..., None] * axes)


def _light(shape: np.ndarray, apart: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, "9 3"]:
    weighed = shape * weight[:, None]
    return np.linalg.solve(
        weighed.T @ shape + LIGHT_HELD * weight.sum() * np.eye(9), weighed.T @ apart
    )


def _gain(
    wide: SkinGrid, table: csr_array, weight: np.ndarray, apart: np.ndarray
) -> Float[np.ndarray, "N 3"]:
    """What light does that no harmonic does: shadows, light from the skin beside; alike over some 3
    cm.
    """
    sums = table.T @ np.column_stack([weight[:, None] * apart, weight])
    sums = wide.smoothed(sums, GAIN_SMOOTHINGS)
    return table @ (sums[:, :3] / np.maximum(sums[:, 3:], 1e-6))


def _at_nodes(
    grid: SkinGrid, table: csr_array, weight: np.ndarray, tone: np.ndarray
) -> tuple[Float[np.ndarray, "G 3"], Float[np.ndarray, " G"]]:
    """Tones at nodes, and the points about them: means about them, and means of what these leave
    (Barnes 1964).
    """
    back = csr_array(table.T)
    mass = grid.smoothed(back @ weight[:, None], SMOOTHINGS)
    values = np.zeros((grid.size, 3))
    for _ in range(PASSES):
        values += grid.smoothed(
            back @ (weight[:, None] * (tone - table @ values)), SMOOTHINGS
        ) / np.maximum(mass, 1e-6)
    return values, mass[:, 0]


def _surely(mass: Float[np.ndarray, "K G"]) -> Float[np.ndarray, "K G"]:
    """How surely nodes are seen: at the border of a hole tones are those of one side alone."""
    share = mass / np.maximum(mass.max(0), 1e-9)
    return np.clip((share - LEAST_SHARE) / 0.2, 0.0, 1.0) * np.clip(mass / SEEN, 0.0, 1.0)


def _mean(
    each: np.ndarray, seen: np.ndarray
) -> tuple[Float[np.ndarray, "G 3"], Float[np.ndarray, " G"]]:
    whole = np.maximum(seen.sum(0), 1e-9)
    return np.einsum("kgc,kg->gc", each, seen) / whole[:, None], seen.max(0)


def _spread(apart: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " 3"]:
    return np.maximum(1.4826 * np.median(np.abs(apart), axis=0), 0.003)
