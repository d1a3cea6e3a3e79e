"""Blend shapes that carry pose correctives and soft tissue into files of animation, chosen on the
poses that people take.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.rotations import matrix_from_rotvec

SAMPLES, WIDER, LOOSE = 1000, 2.0, 0.1
"""So many poses, of so many times the prior's variance, and so far beyond it in every axis of every
joint (rad).
"""


def sampled_rotations(body: BodyModel) -> Float[np.ndarray, "S J 3 3"]:
    """The same poses for every motion of a body, so that its files have the same blend shapes.

    From the body's own pose prior, or the one that comes along; wider, because animators go further
    than captures.
    """
    prior = prior_of(body).for_joints(body.joint_names)
    spread = WIDER * prior.covariance + LOOSE**2 * np.eye(len(prior.mean))
    rng = np.random.default_rng(0)
    vectors = (
        prior.mean + rng.normal(size=(SAMPLES, len(prior.mean))) @ np.linalg.cholesky(spread).T
    )
    turned = matrix_from_rotvec(vectors.reshape(SAMPLES, -1, 3))
    return np.concatenate([np.broadcast_to(np.eye(3), (SAMPLES, 1, 3, 3)), turned], axis=1)


def features(rotations: Float[np.ndarray, "T J 3 3"], joint: int) -> Float[np.ndarray, "T 9"]:
    """What a joint drives its blend shapes with: vec(R - I), rows first."""
    return (rotations[:, joint] - np.eye(3)).reshape(-1, 9)


@dataclass(frozen=True, eq=False)
class Drivers:
    """How joints drive K blend shapes, in every file and for every pose: a weight is (row . vec(R -
    I) - bias)^power, R its joint's rotation. No joint drives one whose row is zero.

    ``power`` is 1 with a ``bias`` of 0, or 2 for folds (`habitus.body.pose_features`), where the
    base is cut off at 0 and 1.
    """

    rows: Float[np.ndarray, "K 9"]
    bias: Float[np.ndarray, " K"]
    power: Float[np.ndarray, " K"]

    @classmethod
    def linear(cls, rows: Float[np.ndarray, "K 9"]) -> "Drivers":
        """Of blend shapes that are linear in vec(R - I); rows of zeros: that no joint drives."""
        return cls(rows, np.zeros(len(rows)), np.ones(len(rows)))

    @classmethod
    def together(cls, parts: Sequence["Drivers"]) -> "Drivers":
        """Those of all parts, in their order."""
        arrays = zip(*((part.rows, part.bias, part.power) for part in parts), strict=True)
        return cls(*map(np.concatenate, arrays))

    @property
    def live(self) -> Bool[np.ndarray, " K"]:
        """Which of them joints drive."""
        return np.any(self.rows, axis=1)

    @property
    def folds(self) -> Bool[np.ndarray, " K"]:
        """Which of them are folds."""
        return self.power == 2

    def __getitem__(self, some: Any) -> "Drivers":
        return Drivers(self.rows[some], self.bias[some], self.power[some])

    def weights(self, entries: Float[np.ndarray, "*batch #K 9"]) -> Float[np.ndarray, "*batch K"]:
        """The weights between 0 and 1 for vec(R - I) of each one's joint."""
        return np.clip((entries * self.rows).sum(-1) - self.bias, 0.0, 1.0) ** self.power

    def reached(self) -> Bool[np.ndarray, " K"]:
        """Which of them any rotation moves to their side."""
        most = np.array([furthest(row) for row in self.rows])
        return most - self.bias > 1e-6


WORST = 1e-4
"""How far from the fit the worst vertex of the worst frame may be that "auto" leaves, metres."""
CHECKED = 64
"""So many frames are looked at for that, those that what is left out can move most."""


@dataclass(frozen=True, eq=False)
class Block:
    """Blend shapes that belong together, of N vertices: n shapes (m) and, a motion each, their
    coefficients (T, n).

    Those of a joint are *live*, driven by what other programs know as well: its rotation, as
    ``drivers`` say. ``sample`` are coefficients in poses that people take.
    """

    name: str
    vertices: Int[np.ndarray, " N"]
    shapes: Float[np.ndarray, "N 3 n"]
    coefficients: tuple[Float[np.ndarray, "_ n"], ...]
    ends: tuple[str, ...] = ()
    drivers: Drivers | None = None
    sample: Float[np.ndarray, "S n"] | None = None

    @property
    def live(self) -> bool:
        """Whether a joint's rotation drives it."""
        return self.drivers is not None

    @property
    def folds(self) -> bool:
        """Whether these are a joint's folds, which no sums of them can stand for."""
        return self.drivers is not None and bool(self.drivers.folds.any())


@dataclass(frozen=True, eq=False)
class Morphs:
    """K morphs, their names, and for each motion their weights, between -1 and 1.

    ``residual`` and ``worst`` (m) are what they cannot express: RMS over vertices and frames, and
    the largest of the frames looked at. ``drivers`` give the weights of live ones in every file and
    for every pose. ``elsewhere`` (m) is the largest distance in poses that people take.
    """

    shapes: Float[np.ndarray, "K V 3"]
    names: tuple[str, ...]
    weights: tuple[Float[np.ndarray, "_ K"], ...]
    drivers: Drivers
    residual: float = 0.0
    worst: float = 0.0
    elsewhere: float = 0.0


def check_correctives(text: str) -> tuple[str, int]:
    """What "auto", "all", "none", "live:96" or "pca:16" asks for, and how many. Raises HabitusError
    for others.
    """
    kind, _, count = text.partition(":")
    if kind in ("auto", "all", "none") and not count:
        return kind, 0
    if kind in ("live", "pca") and count.isdecimal() and 0 < int(count) <= 4096:
        return kind, int(count)
    raise HabitusError(
        f"correctives are {text!r}; expected auto, all, none, or the number of morphs, as in "
        "live:96 or pca:16"
    )


def morphs_of(blocks: Sequence[Block], vertices: int, frames: Sequence[int], mode: str) -> Morphs:
    """The morphs that a file is given for motions of so many ``frames``.

    mode: "none"; "all", each of the blend shapes that joints drive as it is; "auto", the fewest
    directions that leave no vertex further away than `WORST`, each of what one joint drives;
    "live:96", so many directions of what joints drive, those that poses of people need most, the
    same for every motion of the body; "pca:16", so many principal directions of all together. Soft
    tissue comes in principal directions. Folds come as they are, beside the 96 of "live:96".
    """
    kind, count = check_correctives(mode)
    blocks = [block for block in blocks if block.shapes.any()]
    if not blocks:
        return Morphs(
            np.zeros((0, vertices, 3)),
            (),
            tuple(np.zeros((n, 0)) for n in frames),
            Drivers.linear(np.zeros((0, 9))),
        )
    if kind == "pca":
        return principal(blocks, vertices, count, 0.0)
    if kind == "live":
        return _most_needed(blocks, vertices, count)
    local = [_exact(each) if each.live and kind == "all" else _baked(each) for each in blocks]
    together = _together(local, vertices)
    if kind == "none":
        return _kept(together, np.arange(0), *_worst(together, np.arange(len(together.names))))
    return _fewest(together, 0.0 if kind == "all" else WORST)


def principal(blocks: Sequence[Block], vertices: int, max_count: int, tolerance: float) -> Morphs:
    """Principal directions of all blocks together: the fewest whose RMS residual is below
    ``tolerance`` (m), or `most`.

    The best that so many morphs can do on average, each of them over the whole body.
    """
    rows = [np.zeros((vertices, 3, block.shapes.shape[-1])) for block in blocks]
    for dense, block in zip(rows, blocks, strict=True):
        dense[block.vertices] = block.shapes
    terms = tuple(
        np.hstack(each) for each in zip(*(block.coefficients for block in blocks), strict=True)
    )
    name = "_and_".join(dict.fromkeys(_family(block) for block in reversed(blocks)))
    whole = Block(name, np.arange(vertices), np.concatenate(rows, -1), terms)
    values, modes, weighing = _modes(whole, terms)
    left = np.sqrt(
        np.append(np.cumsum(values[::-1])[::-1], 0.0) / (vertices * sum(map(len, terms)))
    )
    kept = int(min(max_count, np.argmax(left <= max(tolerance, 1e-9)), len(values)))
    shapes, rows = _scaled(whole, terms, modes[:, :kept], weighing[:, :kept])
    return Morphs(
        np.moveaxis(shapes, -1, 0),
        _numbered(name, kept),
        tuple(c @ rows for c in terms),
        Drivers.linear(np.zeros((kept, 9))),
        float(left[kept]),
        _left_out(whole, terms, modes[:, kept:], weighing[:, kept:]),
    )


def _left_out(
    block: Block,
    terms: Sequence[Float[np.ndarray, "_ n"]],
    modes: Float[np.ndarray, "n K"],
    weighing: Float[np.ndarray, "n K"],
) -> float:
    """The largest distance (m) by which these directions move vertices in the frames that they move
    most, by energy; twice as many as by reach, as the farthest vertex may be in any of them.
    """
    weights = np.concatenate([c @ weighing for c in terms])
    frames = np.argsort(-np.einsum("tk,tk->t", weights, weights))[: 2 * CHECKED]
    moved = weights[frames] @ modes.T @ block.shapes.reshape(-1, len(modes)).T
    return float(np.sqrt(_squares(moved.reshape(len(frames), -1, 3)).max(initial=0.0)))


def _family(block: Block) -> str:
    return "pose" if block.live else "soft_tissue"  # dynamics, too


def _numbered(name: str, count: int) -> tuple[str, ...]:
    name = "pose_correction" if name == "pose" else name
    return tuple(f"{name}_{k + 1:02d}" for k in range(count))


def _components(
    block: Block, terms: Sequence[Float[np.ndarray, "_ n"]]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "N 3 K"], Float[np.ndarray, "n K"]]:
    """Energies, directions and what turns coefficients into weights, of the deformation D = B C^T,
    largest first.

    The weights of ``terms`` are within -1 and 1.
    """
    values, modes, weighing = _modes(block, terms)
    return values, *_scaled(block, terms, modes, weighing)


def _modes(
    block: Block, terms: Sequence[Float[np.ndarray, "_ n"]]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "n K"], Float[np.ndarray, "n K"]]:
    """Energies of D = B C^T, largest first, orthonormal directions as combinations of B's columns,
    and what turns coefficients into their weights.

    With B^T B = U U^T (U from its eigenvectors) the columns of Q = B U^-T are orthonormal and the
    principal directions of D are Q v, v the leading eigenvectors of U^T (C^T C) U: no (3N, T)
    matrix is ever built.
    """
    flat = block.shapes.reshape(-1, block.shapes.shape[-1])
    squares, axes = np.linalg.eigh(flat.T @ flat)
    used = squares > 1e-13 * squares[-1]
    root = axes[:, used] * np.sqrt(squares[used])
    inverse = axes[:, used] / np.sqrt(squares[used])
    values, turn = np.linalg.eigh(root.T @ sum(c.T @ c for c in terms) @ root)
    values = np.maximum(values[::-1], 0.0)
    turn = turn[:, ::-1]
    moved = values > 1e-20 * max(values[0], 1e-20)
    values = values[moved]
    turn = turn[:, moved]
    return values, inverse @ turn, root @ turn


def _scaled(
    block: Block,
    terms: Sequence[Float[np.ndarray, "_ n"]],
    modes: Float[np.ndarray, "n K"],
    weighing: Float[np.ndarray, "n K"],
) -> tuple[Float[np.ndarray, "N 3 K"], Float[np.ndarray, "n K"]]:
    """Directions whose weights are within -1 and 1, and what turns coefficients into these."""
    scale = np.maximum(
        np.abs(np.concatenate([c @ weighing for c in terms])).max(axis=0, initial=0.0), 1e-12
    )
    # a row a direction: what takes them one after another reads memory in order
    flat = block.shapes.reshape(-1, len(modes))
    shapes = ((modes * scale).T @ flat.T).reshape(-1, len(block.vertices), 3)
    return np.moveaxis(shapes, 0, -1), weighing / scale


def _baked(block: Block) -> tuple[Block, tuple[str, ...]]:
    """A block for one motion alone: folds as they are, others in their principal directions."""
    if not block.folds:
        return _directions(block)
    block, names = _exact(block)
    return replace(block, drivers=None), names


def _directions(block: Block) -> tuple[Block, tuple[str, ...]]:
    """A block in its principal directions, weights between -1 and 1."""
    _, shapes, weighing = _components(block, block.coefficients)
    weights = tuple(c @ weighing for c in block.coefficients)
    return Block(block.name, block.vertices, shapes, weights), _numbered(
        block.name, shapes.shape[-1]
    )


def _most_needed(blocks: Sequence[Block], vertices: int, count: int) -> Morphs:
    """So many directions of what joints drive, those with the most energy in their samples; folds
    and soft tissue beside them.
    """
    energies = []
    parts = []
    usual = []
    for block in blocks:
        if block.drivers is None or block.sample is None or block.folds:
            parts.append(_exact(block) if block.folds else _directions(block))
            energies.append(np.full(len(parts[-1][1]), np.inf))
            usual += [] if block.sample is None else [block.sample]
            continue
        values, shapes, weighing = _components(block, [block.sample])
        rows = weighing.T @ block.drivers.rows
        size = np.array([max(furthest(row), furthest(-row)) for row in rows])
        weighing /= size
        weights = tuple(c @ weighing for c in block.coefficients)
        driven = Drivers.linear(rows / size[:, None])
        own = Block(block.name, block.vertices, shapes * size, weights, drivers=driven)
        parts.append((own, _numbered(block.name, len(values))))
        energies.append(values)
        usual.append(block.sample @ weighing)
    whole = _together(parts, vertices)
    order = np.argsort(-np.concatenate(energies), kind="stable")
    rows = np.sort(order[: count + int(np.isinf(np.concatenate(energies)).sum())])
    left = np.setdiff1d(np.arange(len(order)), rows)
    poses = np.zeros((len(usual[0]) if usual else 0, len(order)))
    poses[:, whole.drivers.live] = np.hstack(usual) if usual else 0.0
    kept = _kept(whole, rows, *_worst(whole, left))
    return replace(kept, elsewhere=_worst(whole, left, poses)[1])


def furthest(row: Float[np.ndarray, " 9"]) -> float:
    """The most that row . vec(R - I) can be, of all rotations R: Wahba's problem."""
    matrix = row.reshape(3, 3)
    u, sizes, v = np.linalg.svd(matrix)
    sizes[2] *= np.sign(np.linalg.det(u) * np.linalg.det(v))
    return float(sizes.sum() - np.trace(matrix))


def _exact(block: Block) -> tuple[Block, tuple[str, ...]]:
    """A block as it is: folds, or twice the shapes by half of what drives them."""
    names = tuple(f"{block.name}_{end}" for end in block.ends)
    if block.drivers is None or block.folds:
        return block, names
    halves = tuple(0.5 * c for c in block.coefficients)
    driven = Drivers.linear(0.5 * block.drivers.rows)
    return Block(block.name, block.vertices, 2.0 * block.shapes, halves, drivers=driven), names


def _together(parts: Sequence[tuple[Block, tuple[str, ...]]], vertices: int) -> Morphs:
    names = tuple(name for _, names in parts for name in names)
    shapes = np.zeros((len(names), vertices, 3), np.float32)  # as files hold them
    first = 0
    for block, own in parts:
        shapes[first : first + len(own), block.vertices] = np.moveaxis(block.shapes, -1, 0)
        first += len(own)
    weights = tuple(
        np.hstack(each) for each in zip(*(block.coefficients for block, _ in parts), strict=True)
    )
    drivers = Drivers.together(
        [block.drivers or Drivers.linear(np.zeros((len(own), 9))) for block, own in parts]
    )
    return Morphs(shapes, names, weights, drivers)


def _fewest(morphs: Morphs, worst: float) -> Morphs:
    """Without the smallest of those that are not live, as many as leave no vertex further away than
    ``worst`` (m).
    """
    weights = np.concatenate(morphs.weights)
    reach = np.sqrt(_squares(morphs.shapes).max(axis=1)) * np.abs(weights).max(axis=0)
    reach[morphs.drivers.live] = np.inf  # also of joints that this motion leaves still
    order = np.argsort(reach, kind="stable")
    fewest = 0
    largest = _largest(morphs.shapes)
    most = int(np.searchsorted(reach[order], max(worst, 1e-9)))  # one alone may not be too much
    while fewest < most:
        middle = (fewest + most + 1) // 2
        fewest, most = (
            (middle, most)
            if _worst(morphs, order[:middle], weights, largest)[1] <= worst
            else (fewest, middle - 1)
        )
    rms, far = _worst(morphs, order[:fewest], weights, largest)
    return _kept(morphs, np.sort(order[fewest:]), rms, far)


def _worst(
    morphs: Morphs,
    left: np.ndarray,
    weights: np.ndarray | None = None,
    largest: Float[np.ndarray, " K"] | None = None,
) -> tuple[float, float]:
    """RMS and largest distance (m) by which these morphs move vertices in the frames that they can
    move most; ``largest``: `_largest` of all of them, where it is known.
    """
    if not len(left):
        return 0.0, 0.0
    largest = _largest(morphs.shapes) if largest is None else largest
    drive = np.concatenate(morphs.weights) if weights is None else weights
    most = np.abs(drive[:, left]) @ largest[left]
    frames = np.argsort(-most)[:CHECKED]
    some = np.zeros((len(frames), len(morphs.shapes)), morphs.shapes.dtype)
    some[:, left] = drive[np.ix_(frames, left)]  # to pick shapes would copy them
    moved = some @ morphs.shapes.reshape(len(morphs.shapes), -1)
    squares = _squares(moved.reshape(len(frames), -1, 3))
    return float(np.sqrt(squares.mean())), float(np.sqrt(squares.max()))


def _largest(shapes: Float[np.ndarray, "K V 3"]) -> Float[np.ndarray, " K"]:
    """The largest offset (m) of each along an axis."""
    flat = shapes.reshape(len(shapes), -1)
    return np.maximum(flat.max(axis=1), -flat.min(axis=1))


def _squares(offsets: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Squared lengths; `numpy.linalg.norm` takes ten times as long along three numbers."""
    return np.einsum("...c,...c->...", offsets, offsets)


def _kept(morphs: Morphs, rows: np.ndarray, residual: float, worst: float) -> Morphs:
    """Some of the morphs."""
    if len(rows) == len(morphs.names):
        return replace(morphs, residual=residual, worst=worst)
    names = tuple(morphs.names[k] for k in rows)
    weights = tuple(w[:, rows] for w in morphs.weights)
    return Morphs(morphs.shapes[rows], names, weights, morphs.drivers[rows], residual, worst)
