"""How a body's blend shapes become the few morphs of a file: all of them, or principal directions of this motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError

WORST = 1e-4
"""How far from the fit the worst vertex of the worst frame may be that "auto" leaves, metres."""
CHECKED = 64
"""So many frames are looked at for that, those that what is left out can move most."""


@dataclass(frozen=True, eq=False)
class Block:
    """Blend shapes that belong together, of N vertices: n shapes (m) and, a motion each, their coefficients (T, n).

    ``live`` shapes are driven by something that other programs know as well, coefficients within -2 and 2.
    """

    name: str
    vertices: Int[np.ndarray, " N"]
    shapes: Float[np.ndarray, "N 3 n"]
    coefficients: tuple[Float[np.ndarray, "T n"], ...]
    ends: tuple[str, ...] = ()
    live: bool = False


@dataclass(frozen=True, eq=False)
class Morphs:
    """K morphs, their names, and for each motion their weights, between -1 and 1.

    ``residual`` and ``worst`` (m) are what they cannot express: RMS over vertices and frames, and the largest of the
    frames looked at. The weights of ``live`` ones are half of what drives them, in every file.
    """

    shapes: Float[np.ndarray, "K V 3"]
    names: tuple[str, ...]
    weights: tuple[Float[np.ndarray, "T K"], ...]
    live: Bool[np.ndarray, " K"]
    residual: float = 0.0
    worst: float = 0.0


def check_correctives(text: str) -> tuple[str, int]:
    """What "auto", "all", "none" or "pca:16" asks for, and how many. Raises HabitusError for anything else."""
    kind, _, count = text.partition(":")
    if kind in ("auto", "all", "none") and not count:
        return kind, 0
    if kind == "pca" and count.isdecimal() and 0 < int(count) <= 4096:
        return kind, int(count)
    raise HabitusError(f"correctives are {text!r}; expected auto, all, none, or the number of morphs, as in pca:16")


def morphs_of(blocks: Sequence[Block], vertices: int, frames: Sequence[int], wanted: str) -> Morphs:
    """The morphs that a file is given for motions of so many ``frames``.

    wanted: "none"; "all", each of the blend shapes that joints drive as it is; "auto", the fewest directions that leave
    no vertex further away than `WORST`, each of what one joint drives; "pca:16", so many principal directions of all
    together. Soft tissue comes in principal directions.
    """
    kind, count = check_correctives(wanted)
    blocks = [block for block in blocks if block.shapes.any()]
    if not blocks:
        return Morphs(np.zeros((0, vertices, 3)), (), tuple(np.zeros((n, 0)) for n in frames), np.zeros(0, bool))
    if kind == "pca":
        return principal(blocks, vertices, count, 0.0)
    local = [_exact(block) if kind == "all" and block.live else _directions(block) for block in blocks]
    together = _together(local, vertices)
    if kind == "none":
        return _kept(together, np.arange(0), *_worst(together, np.arange(len(together.names))))
    return _fewest(together, 0.0 if kind == "all" else WORST)


def principal(blocks: Sequence[Block], vertices: int, most: int, tolerance: float) -> Morphs:
    """Principal directions of all blocks together: the fewest whose RMS residual is below ``tolerance`` (m), or `most`.

    The best that so many morphs can do on average, each of them over the whole body.
    """
    rows = [np.zeros((vertices, 3, block.shapes.shape[-1])) for block in blocks]
    for dense, block in zip(rows, blocks, strict=True):
        dense[block.vertices] = block.shapes
    terms = tuple(np.hstack(each) for each in zip(*(block.coefficients for block in blocks), strict=True))
    name = "_and_".join(dict.fromkeys(_family(block) for block in reversed(blocks)))
    whole = Block(name, np.arange(vertices), np.concatenate(rows, -1), terms)
    values, shapes, weights = _components(whole)
    left = np.sqrt(np.append(np.cumsum(values[::-1])[::-1], 0.0) / (vertices * sum(map(len, terms))))
    kept = int(min(most, np.argmax(left <= max(tolerance, 1e-9)), len(values)))
    found = Morphs(
        np.moveaxis(shapes, -1, 0), _numbered(name, len(values)), tuple(weights), np.zeros(len(values), bool)
    )
    return _kept(found, np.arange(kept), float(left[kept]))


def _family(block: Block) -> str:
    return "pose" if block.live else "soft_tissue"  # dynamics, too


def _numbered(name: str, count: int) -> tuple[str, ...]:
    name = "pose_correction" if name == "pose" else name
    return tuple(f"{name}_{k + 1:02d}" for k in range(count))


def _components(block: Block) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Energies (K), directions (N, 3, K) and weights (T, K) of the deformation D = B C^T of a block, largest first.

    With B^T B = U U^T (U from its eigenvectors) the columns of Q = B U^-T are orthonormal and the principal directions
    of D are Q v, v the leading eigenvectors of U^T (C^T C) U: no (3N, T) matrix is ever built.
    """
    flat = block.shapes.reshape(-1, block.shapes.shape[-1])
    squares, axes = np.linalg.eigh(flat.T @ flat)
    used = squares > 1e-13 * squares[-1]
    root, inverse = axes[:, used] * np.sqrt(squares[used]), axes[:, used] / np.sqrt(squares[used])
    values, turn = np.linalg.eigh(root.T @ sum(c.T @ c for c in block.coefficients) @ root)
    values, turn = np.maximum(values[::-1], 0.0), turn[:, ::-1]
    moved = values > 1e-20 * max(values[0], 1e-20)
    values, turn = values[moved], turn[:, moved]
    weights = [c @ (root @ turn) for c in block.coefficients]
    scale = np.maximum(np.abs(np.concatenate(weights)).max(axis=0, initial=0.0), 1e-12)
    shapes = (flat @ (inverse @ turn) * scale).reshape(len(block.vertices), 3, -1)
    return values, shapes, [w / scale for w in weights]


def _directions(block: Block) -> tuple[Block, tuple[str, ...]]:
    """A block in its principal directions, weights between -1 and 1."""
    _, shapes, weights = _components(block)
    return Block(block.name, block.vertices, shapes, tuple(weights)), _numbered(block.name, shapes.shape[-1])


def _exact(block: Block) -> tuple[Block, tuple[str, ...]]:
    """A block as it is: twice the shapes by half of what drives them."""
    halves = tuple(0.5 * c for c in block.coefficients)
    return Block(block.name, block.vertices, 2.0 * block.shapes, halves, live=True), tuple(
        f"{block.name}_{end}" for end in block.ends
    )


def _together(parts: Sequence[tuple[Block, tuple[str, ...]]], vertices: int) -> Morphs:
    names = tuple(name for _, names in parts for name in names)
    shapes, first = np.zeros((len(names), vertices, 3)), 0
    for block, own in parts:
        shapes[first : first + len(own), block.vertices] = np.moveaxis(block.shapes, -1, 0)
        first += len(own)
    weights = tuple(np.hstack(each) for each in zip(*(block.coefficients for block, _ in parts), strict=True))
    live = np.concatenate([np.full(len(own), block.live) for block, own in parts])
    return Morphs(shapes, names, weights, live)


def _fewest(morphs: Morphs, worst: float) -> Morphs:
    """Without the smallest of those that are not live, as many as leave no vertex further away than ``worst`` (m)."""
    weights = np.concatenate(morphs.weights)
    reach = np.linalg.norm(morphs.shapes, axis=-1).max(axis=1) * np.abs(weights).max(axis=0)
    order = np.argsort(np.where(morphs.live, np.inf, reach), kind="stable")
    fewest, most = 0, int(np.searchsorted(reach[order], max(worst, 1e-9)))  # one alone may not be too much
    while fewest < most:
        middle = (fewest + most + 1) // 2
        fewest, most = (middle, most) if _worst(morphs, order[:middle], weights)[1] <= worst else (fewest, middle - 1)
    rms, far = _worst(morphs, order[:fewest], weights)
    return _kept(morphs, np.sort(order[fewest:]), rms, far)


def _worst(morphs: Morphs, left: np.ndarray, weights: np.ndarray | None = None) -> tuple[float, float]:
    """RMS and largest distance (m) by which these morphs move vertices in the frames that they can move most."""
    if not len(left):
        return 0.0, 0.0
    drive = (np.concatenate(morphs.weights) if weights is None else weights)[:, left]
    shapes = morphs.shapes[left].reshape(len(left), -1)
    most = np.abs(drive) @ np.abs(shapes).max(axis=1)
    frames = np.argsort(-most)[:CHECKED]
    away = np.linalg.norm((drive[frames] @ shapes).reshape(len(frames), -1, 3), axis=-1)
    return float(np.sqrt((away**2).mean())), float(away.max())


def _kept(morphs: Morphs, rows: np.ndarray, residual: float, worst: float | None = None) -> Morphs:
    """Some of the morphs; ``worst`` is measured where it is not known."""
    if worst is None:
        left = np.setdiff1d(np.arange(len(morphs.names)), rows)
        worst = _worst(morphs, left)[1]
    names = tuple(morphs.names[k] for k in rows)
    weights = tuple(w[:, rows] for w in morphs.weights)
    return Morphs(morphs.shapes[rows], names, weights, morphs.live[rows], residual, worst)
