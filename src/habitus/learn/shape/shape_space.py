"""The shape space: mean and principal directions of rest surfaces (S 4.2, T 5.4.2), also of those
with holes, whose unobserved vertices are imputed; and pose blend shapes that depend on its
coefficients (T 5.6, "Limitations").
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.learn.estimate import Estimate
from habitus.learn.options import SETTINGS
from habitus.mesh.registrations import Vertices

_BLOCK = 2**24  # numbers in a block of surfaces (128 MB); two are held at once
_NOISE = 1e-12  # of the largest variance: directions with less are rounding


@dataclass(frozen=True, eq=False)
class ShapeSpace:
    """Surfaces around their mean (metres): ``mean + directions @ betas``.

    A coefficient of 1 is one standard deviation, as in SMPL; directions are orthogonal.
    ``variances`` (m^2, summed over the vertices) are those along all directions, not only the B
    that are kept, in descending order.
    """

    mean: Float[np.ndarray, "V 3"]
    directions: Float[np.ndarray, "V 3 B"]
    variances: Float[np.ndarray, " K"]

    @property
    def num_betas(self) -> int:
        """B."""
        return self.directions.shape[-1]

    @property
    def cumulative_variance(self) -> Float[np.ndarray, " K"]:
        """The share of all variance that the first 1, 2, ... directions explain (S Fig. 9)."""
        return np.cumsum(self.variances) / self.variances.sum()

    def reconstruct(self, betas: Float[np.ndarray, "*b n"]) -> Float[np.ndarray, "*b V 3"]:
        """The surfaces that the first n of B coefficients give."""
        return self.mean + np.tensordot(betas, self.directions[..., : betas.shape[-1]], (-1, -1))

    def coefficients(self, surfaces: Float[np.ndarray, "*b V 3"]) -> Float[np.ndarray, "*b B"]:
        """The coefficients of the surfaces in the space that come nearest (least squares over
        vertices).
        """
        flat = self.directions.reshape(
            -1, self.num_betas
        )  # not orthogonal where a body brought them along
        offset = np.tensordot(surfaces - self.mean, self.directions, 2)
        return np.linalg.solve(flat.T @ flat, offset[..., None])[..., 0]


def shape_space_of(body: BodyModel) -> ShapeSpace:
    """The shape space of a body model, a unit of a coefficient one standard deviation."""
    return ShapeSpace(body.v_template, body.shapedirs, (body.shapedirs**2).sum((0, 1)))


def principal_shapes(
    surfaces: Vertices, count: int, *, weights: Float[np.ndarray, " S"] | None = None
) -> ShapeSpace:
    """PCA of surfaces (S, V, 3) in metres, all in one pose: the ``count`` directions of most
    variance (S 4.2, T 5.4.2).

    Surfaces are read in blocks, a few times each; what is decomposed is S x S or 3V x 3V, whichever
    is smaller. S surfaces vary in S - 1 directions at most: no more are returned, and none along
    which they do not vary. Variances are unbiased; ``weights`` (S,), not negative, say how much
    each surface counts. A direction's sign is such that the surface grows with its coefficient
    (moves away from the mean's middle) or, where it does neither, that the largest entry is
    positive. Raises HabitusError for fewer than two surfaces that differ, for numbers that are not
    finite, and where no direction is asked for.
    """
    if count < 1:
        raise HabitusError(f"{count} shape directions asked for; expected 1 or more")
    blocks = _Blocks(surfaces, _shares(surfaces.shape[0], weights))
    values, vectors = np.linalg.eigh(blocks.covariance() if blocks.tall else blocks.gram())
    freedom = min(np.count_nonzero(blocks.share) - 1, blocks.mean.size)
    variances = values[::-1][:freedom].clip(0.0)
    if variances[0] <= (_NOISE * np.linalg.norm(blocks.mean)) ** 2:
        raise HabitusError(f"all {len(blocks.share)} surfaces are alike; expected some that differ")
    kept = min(count, np.count_nonzero(variances > _NOISE * variances[0]))
    vectors = vectors[:, ::-1][:, :kept]
    flat = vectors * np.sqrt(variances[:kept]) if blocks.tall else blocks.combine(vectors)
    mean = blocks.mean.reshape(-1, 3)
    return ShapeSpace(mean, (flat * _signs(flat, mean)).reshape(*mean.shape, kept), variances)


class _Blocks:
    """The surfaces as rows, read a block at a time: without their mean, and scaled so that squares
    sum to variances.
    """

    def __init__(self, surfaces: Vertices, share: Float[np.ndarray, " S"]):
        self.surfaces = surfaces
        self.share = share
        self.scale = np.sqrt(share / (1 - (share**2).sum()))
        size = int(np.prod(surfaces.shape[1:]))
        step = max(1, _BLOCK // size)
        self.slices = [slice(k, min(k + step, len(share))) for k in range(0, len(share), step)]
        self.mean = sum((share[rows] @ self._read(rows) for rows in self.slices), np.zeros(size))
        if not np.isfinite(self.mean).all():
            raise HabitusError(
                "surfaces are not finite; expected numbers in metres: leave such surfaces out"
            )

    @property
    def tall(self) -> bool:
        """Whether there are more surfaces than numbers in one."""
        return len(self.share) > self.mean.size

    def covariance(self) -> Float[np.ndarray, "D D"]:
        total = np.zeros((self.mean.size, self.mean.size))
        for rows in self.slices:
            block = self._centred(rows)
            total += block.T @ block
        return total

    def gram(self) -> Float[np.ndarray, "S S"]:
        """Only its lower triangle is used: blocks above the diagonal are left out."""
        gram = np.zeros((len(self.share), len(self.share)))
        for k, rows in enumerate(self.slices):
            block = self._centred(rows)
            gram[rows, rows] = block @ block.T
            for below in self.slices[k + 1 :]:
                gram[below, rows] = self._centred(below) @ block.T
        return gram

    def combine(self, factors: Float[np.ndarray, "S B"]) -> Float[np.ndarray, "D B"]:
        """Sums of all rows times factors."""
        total = np.zeros((self.mean.size, factors.shape[1]))
        for rows in self.slices:
            total += self._centred(rows).T @ factors[rows]
        return total

    def _read(self, rows: slice) -> Float[np.ndarray, "n D"]:
        return np.array(self.surfaces[rows], dtype=np.float64).reshape(rows.stop - rows.start, -1)

    def _centred(self, rows: slice) -> Float[np.ndarray, "n D"]:
        block = self._read(rows)
        block -= self.mean
        block *= self.scale[rows, None]
        return block


def _shares(count: int, weights: Float[np.ndarray, " S"] | None) -> Float[np.ndarray, " S"]:
    """How much each surface counts, summing to 1."""
    counts = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if counts.shape != (count,) or not (counts >= 0).all() or not np.isfinite(counts).all():
        raise HabitusError(
            f"weights {counts.shape} of {count} surfaces; expected one finite number >= 0 for each"
        )
    if np.count_nonzero(counts) < 2:
        raise HabitusError(
            f"{np.count_nonzero(counts)} surfaces to learn shapes from; expected 2 or more"
        )
    return counts / counts.sum()


def _signs(
    flat: Float[np.ndarray, "D B"], mean: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, " B"]:
    outward = (mean - mean.mean(0)).ravel()
    growth = outward @ flat
    clear = np.abs(growth) > 1e-6 * np.linalg.norm(outward) * np.linalg.norm(flat, axis=0)
    largest = flat[np.abs(flat).argmax(0), np.arange(flat.shape[1])]
    return np.sign(np.where(clear, growth, largest))


def shapes_with_holes(
    surfaces: Vertices,
    seen: Bool[np.ndarray, "S V"],
    count: int,
    steps: int = SETTINGS.imputation_steps,
) -> tuple[Float[np.ndarray, "S V 3"], ShapeSpace]:
    """Surfaces (m) whose unseen vertices are replaced, and their shape space: `principal_shapes`,
    in turns with the most likely rest of each surface (expectation maximisation; Roweis, "EM
    algorithms for PCA and SPCA", 1998).

    Coefficients are drawn to the mean as much as the seen vertices' distance from the space asks
    for. Unseen vertices start where they are in ``surfaces``.
    """
    filled = np.array(surfaces[:], dtype=np.float64)
    rows = np.flatnonzero(~seen.all(1))
    for _ in range(steps):
        space = principal_shapes(filled, count)
        rest_variance = space.variances[space.num_betas :].sum() / space.mean.size
        for row in rows.tolist():
            filled[row, ~seen[row]] = _likely(
                space, filled[row], seen[row], max(rest_variance, 1e-10)
            )[~seen[row]]
    return filled, principal_shapes(filled, count)


def _likely(
    space: ShapeSpace,
    surface: Float[np.ndarray, "V 3"],
    seen: Bool[np.ndarray, " V"],
    variance: float,
) -> Float[np.ndarray, "V 3"]:
    """The surface of the space that is most likely, given some vertices, each with so much variance
    (m^2).
    """
    columns = space.directions[seen].reshape(-1, space.num_betas)
    offset = (surface - space.mean)[seen].ravel()
    betas = np.linalg.solve(
        columns.T @ columns + variance * np.eye(space.num_betas), columns.T @ offset
    )
    return space.reconstruct(betas)


def with_shape_features(
    estimate: Estimate, shape: ShapeSpace, regressor: Float[np.ndarray, "J V"], count: int
) -> Estimate:
    """The same estimate, whose blend shapes may from now on depend on the first ``count`` shape
    coefficients.

    What depends on them begins at zero, so that the energy is what it was. Each subject is
    described by the coefficients of its rest surface. Raises HabitusError where there are fewer.
    """
    if shape.num_betas < count:
        raise HabitusError(
            f"{count} shape features asked for, and people vary along {shape.num_betas} "
            "directions only; "
            "ask for fewer, or train on more people"
        )
    rig = estimate.rig
    assert rig.posedirs is not None
    more = np.zeros((*rig.posedirs.shape[:2], rig.posedirs.shape[2] * count))
    wider = replace(rig, posedirs=np.concatenate([rig.posedirs, more], -1), shape_features=count)
    placed = at_one_root(estimate.templates, regressor, regressor[0] @ shape.mean)
    return replace(estimate, rig=wider, descriptors=shape.coefficients(placed)[:, :count])


def at_one_root(
    surfaces: Float[np.ndarray, "S V 3"],
    regressor: Float[np.ndarray, "J V"],
    root: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "S V 3"]:
    """Surfaces moved so that their root joints are at one place (m): where a subject rests is not
    its shape.
    """
    return surfaces + (root - regressor[0] @ surfaces)[:, None]
