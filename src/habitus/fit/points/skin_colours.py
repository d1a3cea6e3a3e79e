"""The colours of a person's skin, shared by all scans of them: texture, and the light of each scan
(Bogo, Romero, Loper, Black, *FAUST*, 2014).

    log(I_kp + d) = T(b_kp) + h(n_kp) . L_k

T are tones (log of linear colours) at the nodes of a `SkinGrid`, which cuts each triangle of the
body into n² alike and has no seams; there is one texture for all scans k. p is
a coloured point, b its place on the registered surface, n the normal there, h harmonics up to order
2, L_k what light does in scan k. What a scan is held against is the texture of all others: its own
colours would hold it where it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from habitus.fit.points.correspondences import Correspondences, Topology, find_correspondences
from habitus.fit.points.scan_colour_settings import ScanColourSettings
from habitus.fit.points.settings import SCANS
from habitus.fit.points.skin_grid import SkinGrid
from habitus.mesh.normals import face_normals
from habitus.observe.light import harmonic_terms
from habitus.residuals.points import PointObservations
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import Stage, alternate
from habitus.solve.terms import Quadratic, Term, geman_mcclure_weight


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
        settings: ScanColourSettings = SCANS.colours,
    ) -> "ColourCloud":
        """From linear colours; what is dark is less certain."""
        bright = np.maximum(colours, settings.dark)
        noise = settings.noise / settings.certain / bright.mean(1)
        return ColourCloud(points, normals, np.log(bright), 1.0 / (1.0 + noise**2))

    def first(self, count: int) -> "ColourCloud":
        """Some of them."""
        return ColourCloud(
            self.points[:count], self.normals[:count], self.tones[:count], self.certain[:count]
        )


@dataclass(frozen=True, eq=False)
class ColourMatch:
    """The correspondences of a scan's coloured points on a surface, and the weight of each (N,)."""

    correspondences: Correspondences
    weight: Float[np.ndarray, " N"]

    @staticmethod
    def of(
        topology: Topology,
        surface: Float[np.ndarray, "V 3"],
        cloud: ColourCloud,
        settings: ScanColourSettings = SCANS.colours,
    ) -> "ColourMatch":
        """On a surface (m)."""
        correspondences = find_correspondences(topology, surface, cloud.points, cloud.normals)
        weight = correspondences.weights(cloud.points, settings.scale, settings.min_cosine)
        return ColourMatch(correspondences, weight * cloud.certain)


@dataclass(frozen=True, eq=False)
class SharedSkin:
    """Tones (K, G, 3) of each scan's skin at the nodes of a grid, its light taken out, and how
    surely they are seen there (K, G), 0 to 1; ``noise`` (3,): what single points differ by (robust
    sd); ``status``: of the solve of all lights (`habitus.solve.minimize`).
    """

    grid: SkinGrid
    each: Float[np.ndarray, "K G 3"]
    seen: Float[np.ndarray, "K G"]
    noise: Float[np.ndarray, " 3"]
    settings: ScanColourSettings = SCANS.colours
    status: str = "iterations"

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
        others, observed = self.without(k)
        both = (observed > self.settings.compared) & (self.seen[k] > self.settings.compared)
        return np.sqrt(((others - self.each[k]) ** 2).mean(1)) * both


def find_skin(
    grid: SkinGrid,
    clouds: Sequence[ColourCloud],
    matches: Sequence[ColourMatch],
    settings: ScanColourSettings = SCANS.colours,
) -> SharedSkin:
    """Texture and light of all scans: of each step the texture is that of the present light, and
    the lights then solve

        1/2 sum_kp w_kp |log(I_kp + d) - T(b_kp) - h(n_kp) . L_k|^2 + 1/2 r sum_k w_k |L_k|^2

    (r: ``light_ridge``, w_k: the sum of scan k's weights). Gains and robust weights are renewed
    with the texture.
    """
    rounds = _Rounds.of(grid, clouds, matches, settings)

    def terms_at(values: dict[str, Any], stage: Stage, step: int) -> dict[str, Term]:
        nonlocal rounds
        if step:
            rounds = rounds.gains_and_weights(values["light"]).texture(values["light"])
        return {"light": rounds.light_term()}

    minimized = alternate(
        terms_at,
        {"light": np.zeros((len(clouds), 9, 3))},
        [Stage(settings.light_rounds + 1)],
        steps=Levenberg(0.0),
        blocks=("light",),
    )
    rounds = rounds.gains_and_weights(minimized.values["light"])
    return SharedSkin(grid, rounds.each, rounds.seen, rounds.noise, settings, minimized.status)


@dataclass(frozen=True, eq=False)
class _Rounds:
    """What `find_skin` holds within a step, of K scans with N_k coloured points: harmonics (N_k, 9)
    and tables from nodes, texture with its confidence, what it leaves of each point's tone, gains,
    and robust weights.
    """

    grid: SkinGrid
    coarse: SkinGrid
    clouds: Sequence[ColourCloud]
    certain: list[Float[np.ndarray, " _"]]
    shapes: list[Float[np.ndarray, "_ 9"]]
    tables: list[csr_array]
    coarse_tables: list[csr_array]
    settings: ScanColourSettings
    left: list[Float[np.ndarray, "_ 3"]]
    gains: list[Float[np.ndarray, "_ 3"]]
    weights: list[Float[np.ndarray, " _"]]
    each: Float[np.ndarray, "K G 3"]
    seen: Float[np.ndarray, "K G"]
    noise: Float[np.ndarray, " 3"]

    @staticmethod
    def of(
        grid: SkinGrid,
        clouds: Sequence[ColourCloud],
        matches: Sequence[ColourMatch],
        settings: ScanColourSettings,
    ) -> "_Rounds":
        """Before the first step: a texture of one tone, and no gain."""
        coarse = SkinGrid.of(grid.faces, settings.gain_pieces)
        places = [
            (match.correspondences.face, match.correspondences.barycentric) for match in matches
        ]
        certain = [match.weight for match in matches]
        middle = np.median(
            np.concatenate(
                [
                    cloud.tones[w > settings.noise_weight]
                    for cloud, w in zip(clouds, certain, strict=True)
                ]
            ),
            axis=0,
        )
        return _Rounds(
            grid,
            coarse,
            clouds,
            certain,
            [harmonic_terms(match.correspondences.normal) for match in matches],
            [grid.weights(*place) for place in places],
            [coarse.weights(*place) for place in places],
            settings,
            left=[cloud.tones - middle for cloud in clouds],
            gains=[np.zeros_like(cloud.tones) for cloud in clouds],
            weights=certain,
            each=np.zeros((len(clouds), grid.size, 3)),
            seen=np.zeros((len(clouds), grid.size)),
            noise=np.ones(3),
        )

    def texture(self, light: Float[np.ndarray, "K 9 3"]) -> "_Rounds":
        """With the texture of tones without light and gain."""
        tones = [
            cloud.tones - shape @ light_of_scan - gain
            for cloud, shape, light_of_scan, gain in zip(
                self.clouds, self.shapes, light, self.gains, strict=True
            )
        ]
        textures = [
            _at_nodes(self.grid, *scan, self.settings)
            for scan in zip(self.tables, self.certain, tones, strict=True)
        ]
        each, mass = (np.stack(part) for part in zip(*textures, strict=True))
        seen = _confidence(mass, self.settings)
        skin = _mean(each, seen)[0]
        left = [
            cloud.tones - table @ skin
            for cloud, table in zip(self.clouds, self.tables, strict=True)
        ]
        return replace(self, each=each, seen=seen, left=left)

    def gains_and_weights(self, light: Float[np.ndarray, "K 9 3"]) -> "_Rounds":
        """With gains, noise and robust weights of what texture and light leave; the first light is
        of one tone, and has neither.
        """
        if not self.seen.any():
            return self
        left = [
            each - shape @ light_of_scan
            for each, shape, light_of_scan in zip(self.left, self.shapes, light, strict=True)
        ]
        gains = [
            _gain(self.coarse, *scan, self.settings)
            for scan in zip(self.coarse_tables, self.weights, left, strict=True)
        ]
        left = [each - gain for each, gain in zip(left, gains, strict=True)]
        low = self.settings.noise_weight
        noise = _spread(
            np.concatenate([each[w > low] for each, w in zip(left, self.certain, strict=True)])
        )
        scale = self.settings.outlier_spreads
        weights = [
            w * geman_mcclure_weight(np.sqrt(((each / noise) ** 2).mean(1)), scale)
            for each, w in zip(left, self.certain, strict=True)
        ]
        return replace(self, gains=gains, noise=noise, weights=weights)

    def light_term(self) -> Term:
        """The lights (K, 9, 3) of all scans, the texture held."""
        matrices = []
        pulls = []
        square = 0.0
        for shape, weight, left in zip(self.shapes, self.weights, self.left, strict=True):
            weighed = shape * weight[:, None]
            ridge = self.settings.light_ridge * weight.sum() * np.eye(9)
            matrices.append(weighed.T @ shape + ridge)
            pulls.append(weighed.T @ left)
            square += float(weight @ (left**2).sum(1))
        matrix = np.stack(matrices)
        pull = np.stack(pulls)
        block = np.einsum("kij,cd->kicjd", matrix, np.eye(3)).reshape(len(matrix), 27, 27)

        def residual(light: np.ndarray) -> Quadratic:
            slope = matrix @ light - pull
            cost = 0.5 * (square + float((light * (slope - pull)).sum()))
            return Quadratic(cost, lambda: ({"light": slope}, {("light", "light"): block}))

        return Term(residual)


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
) -> PointObservations:
    """Where colours would have places on the surface (m) of scan k, along it: grad T . dx = T -
    tone in all channels.

    T is the texture of the others; moving all at once, each goes its part of the way. A row's
    spread is that of tones, and of ``loose`` metres by which skin may slide for other reasons; rows
    closer than the texture's grain share what it tells.
    """
    table = skin.grid.weights(places.face, places.share)
    others, observed = skin.without(k)
    differences = table @ (others - skin.each[k])
    seen = np.minimum(table @ observed, table @ skin.seen[k])
    half = 0.5 * (others + skin.each[k])
    slope = skin.grid.slopes(half, surface, places.face, places.share)
    noise = _spread(differences[seen > skin.settings.compared])
    spread = np.sqrt(noise**2 + (loose * np.linalg.norm(slope, axis=2)) ** 2)
    weight = seen * geman_mcclure_weight(np.sqrt(((differences / spread) ** 2).mean(1)), 3.0)
    grain = np.maximum(skin.settings.grain * places.faces_area[places.face] / skin.grid.n**2, 1e-9)
    root = np.sqrt(weight * np.minimum(places.area / grain, 1.0))[:, None]
    rows = (root / spread)[..., None] * slope
    steps = (1.0 - 1.0 / len(skin.each)) * root * differences / spread
    size, axes = np.linalg.eigh(np.einsum("nci,ncj->nij", rows, rows))
    size = np.maximum(size[:, 1:], 0.0)
    axes = axes[:, :, 1:].transpose(0, 2, 1)  # the two along the skin
    good = size > 1e-6 * size.max(initial=1e-30)
    step = good * np.einsum("nkj,ncj,nc->nk", axes, rows, steps) / np.where(good, size, 1.0)
    place = np.einsum("nk,nkc->nc", places.share, surface[skin.grid.faces[places.face]])
    target = place + np.einsum("nk,nkc->nc", step, axes)
    return PointObservations(
        places.face, places.share, target, (np.sqrt(size) * good)[..., None] * axes
    )


def _gain(
    wide: SkinGrid,
    table: csr_array,
    weight: np.ndarray,
    differences: np.ndarray,
    settings: ScanColourSettings,
) -> Float[np.ndarray, "N 3"]:
    """What light does that no harmonic does: shadows, light from the skin beside; alike over some 3
    cm.
    """
    sums = table.T @ np.column_stack([weight[:, None] * differences, weight])
    sums = wide.smoothed(sums, settings.gain_smoothings)
    return table @ (sums[:, :3] / np.maximum(sums[:, 3:], 1e-6))


def _at_nodes(
    grid: SkinGrid,
    table: csr_array,
    weight: np.ndarray,
    tone: np.ndarray,
    settings: ScanColourSettings,
) -> tuple[Float[np.ndarray, "G 3"], Float[np.ndarray, " G"]]:
    """Tones at nodes, and the points about them: means about them, and means of what these leave
    (Barnes 1964).
    """
    back = csr_array(table.T)
    mass = grid.smoothed(back @ weight[:, None], settings.smoothings)
    values = np.zeros((grid.size, 3))
    for _ in range(settings.passes):
        values += grid.smoothed(
            back @ (weight[:, None] * (tone - table @ values)), settings.smoothings
        ) / np.maximum(mass, 1e-6)
    return values, mass[:, 0]


def _confidence(
    mass: Float[np.ndarray, "K G"], settings: ScanColourSettings
) -> Float[np.ndarray, "K G"]:
    """Of the tones at nodes, 0 to 1: at the border of a hole tones are those of one side alone."""
    share = mass / np.maximum(mass.max(0), 1e-9)
    return np.clip((share - settings.min_share) / 0.2, 0.0, 1.0) * np.clip(
        mass / settings.min_points, 0.0, 1.0
    )


def _mean(
    each: np.ndarray, seen: np.ndarray
) -> tuple[Float[np.ndarray, "G 3"], Float[np.ndarray, " G"]]:
    whole = np.maximum(seen.sum(0), 1e-9)
    return np.einsum("kgc,kg->gc", each, seen) / whole[:, None], seen.max(0)


def _spread(differences: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " 3"]:
    return np.maximum(1.4826 * np.median(np.abs(differences), axis=0), 0.003)
