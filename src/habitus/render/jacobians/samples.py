"""From samples to pixels as sparse matrices: what explicit derivatives of images (`images.py`) are
assembled of.

A pixel is the value at its centre, and for each edge fragment in it weight * (value outside - value
inside): the sum of `render/README.md`. Matrices have a block for each pair of a pixel and a row of
some table (vertices, texels, ...): as many numbers down as the image has channels, and as many
across as the row has numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from habitus.errors import HabitusError
from habitus.render.frame import AVERAGED, Frame
from habitus.render.kernels.images import HUGE
from habitus.render.triangles import share_of_pixel

Array: TypeAlias = np.ndarray
Csr: TypeAlias = Any
"""A `scipy.sparse.csr_array`, whose own annotations are of no help."""
Bsr: TypeAlias = Any
"""A `scipy.sparse.bsr_array`."""
Entries: TypeAlias = tuple[Array, Array, Array]
"""Blocks (M, a, b) and where they are added: pixels (M,) and rows of the table (M,)."""


def as_array64(tensor: Tensor) -> Array:
    """A tensor as a NumPy array: float64 for floating types, integers as they are."""
    numbers = tensor.detach().cpu().numpy()
    return numbers.astype(np.float64) if numbers.dtype.kind == "f" else numbers


@dataclass(frozen=True, eq=False)
class Table:
    """R rows of numbers at the corners of faces, and how they come from `given` rows.

    Each lies between two given ones, `ends`, at `fraction`: that of cut number `cut` of `cuts`, or
    0 where it is -1.
    """

    faces: Int[Array, "F 3"]
    ends: Int[Array, "R 2"]
    cut: Int[Array, " R"]
    fraction: Float[Array, " R"]
    given: int
    cuts: int

    @staticmethod
    def of(frame: Frame, given: int | None = None, faces: Array | None = None) -> "Table":
        """That of values of vertices, or of `given` values that belong to the corners of triangles
        by `faces`.
        """
        clipped = frame.clipped
        given = frame.num_vertices if given is None else given
        own = np.repeat(np.arange(given)[:, None], 2, 1)
        none = np.full(given, -1)
        if clipped is None:
            faces = as_array64(frame.triangles.faces) if faces is None else faces
            return Table(faces, own, none, np.zeros(given), given, 0)
        fractions = as_array64(clipped.cut_fraction)
        if faces is None:
            ends = np.concatenate([own, as_array64(clipped.cut_ends)])
            cut = np.append(none, np.arange(len(fractions)))
            rows = as_array64(clipped.triangles.faces)
        else:
            corners = faces[as_array64(clipped.source_face)]
            ends = np.take_along_axis(corners[:, None], as_array64(clipped.corner_ends), 2).reshape(
                -1, 2
            )
            cut = as_array64(clipped.corner_cut).ravel()
            cut = np.where(cut < len(fractions), cut, -1)
            rows = np.arange(len(cut)).reshape(-1, 3)
        return Table(rows, ends, cut, np.append(fractions, 0.0)[cut], given, len(fractions))

    def at_rows(self, values: Float[Array, "U c"]) -> Float[Array, "R c"]:
        """The table's numbers."""
        fraction = self.fraction[:, None]
        return (1.0 - fraction) * values[self.ends[:, 0]] + fraction * values[self.ends[:, 1]]

    def to_given(self, width: int) -> Csr:
        """The derivative of the table's numbers, `width` a row, to those given: (R width, U
        width).
        """
        rows = np.repeat(np.arange(len(self.ends)), 2)
        shares = np.stack([1.0 - self.fraction, self.fraction], 1)
        shape = len(self.ends), self.given
        matrix = sparse.coo_array((shares.ravel(), (rows, self.ends.ravel())), shape=shape)
        return sparse.kron(matrix, sparse.eye_array(width), format="csr")

    def to_fractions(self, values: Float[Array, "U c"]) -> Csr:
        """The derivative of the table's numbers to the fractions of cuts: (R c, K)."""
        width = values.shape[1]
        rows = np.flatnonzero(self.cut >= 0)
        derivatives = values[self.ends[rows, 1]] - values[self.ends[rows, 0]]
        where = (rows[:, None] * width + np.arange(width)).ravel(), np.repeat(self.cut[rows], width)
        return sparse.csr_array(
            (derivatives.ravel(), where), shape=(len(self.ends) * width, self.cuts)
        )


@dataclass(frozen=True, eq=False)
class Samples:
    """The samples of a frame as NumPy arrays. Corners are in the order of their vertices' numbers,
    not as drawn.

    order: where each face's corners come from. coordinates: perspective-correct barycentric ones.
    """

    faces: Int[Array, " N"]
    order: Int[Array, "F 3"]
    coordinates: Float[Array, "N 3"]
    corners: Int[Array, "N 3"]
    screen: Float[Array, "V 3"]
    exact: bool

    @staticmethod
    def of(frame: Frame) -> "Samples":
        """Those that a frame's images take values at; with the thesis' filter only the pixels'
        centres.
        """
        count = (
            len(frame.visibility.faces) if frame.mode in AVERAGED else len(frame.visibility.pixels)
        )
        faces = as_array64(frame.visibility.faces[:count])
        table = as_array64(frame.triangles.faces)
        order = np.argsort(table, axis=1)
        coordinates = np.take_along_axis(as_array64(frame.samples[:count]), order[faces], 1)
        corners = np.take_along_axis(table, order, 1)[faces]
        return Samples(
            faces, order, coordinates, corners, as_array64(frame.screen), frame.visibility.exact
        )

    def rows(self, table: Table) -> Int[Array, "N 3"]:
        """The rows of a table at the samples' corners."""
        return np.take_along_axis(table.faces, self.order, 1)[self.faces]

    def flat(self) -> Float[Array, "N 3"]:
        """Barycentric coordinates on the screen."""
        weighted = self.coordinates * self.screen[self.corners, 2]
        return weighted / weighted.sum(1, keepdims=True)

    def to_screen(self, derivatives: Float[Array, "C 3 N"]) -> Float[Array, "N 3 C 3"]:
        """The derivative to u, v, z of the corners, of what has these to barycentric coordinates;
        points are fixed.

        With l the coordinates on the screen, moving corner j by d moves l by -(grad l) l_j d; b_i =
        (l_i / z_i) / sum. On slivers that counts by `share_of_pixel` only, unless `exact`.
        """
        out = np.empty((len(self.corners), 3, len(derivatives), 3))
        for begin in range(0, len(out), AT_ONCE):
            some = slice(begin, begin + AT_ONCE)
            corners = np.ascontiguousarray(self.screen[self.corners[some]].transpose(2, 1, 0))
            coordinates = np.ascontiguousarray(self.coordinates[some].T)
            _to_screen(corners, coordinates, derivatives[:, :, some], self.exact, out[some])
        return out


AT_ONCE = 4096
"""Samples whose numbers stay close to the processor."""


def _to_screen(
    corners: Float[Array, "3 3 n"],
    b: Float[Array, "3 n"],
    derivatives: Array,
    exact: bool,
    out: Array,
) -> None:
    """`Samples.to_screen` of some samples, whose corners have these u, v and z, written to
    `out`.
    """
    x, y, z = corners
    inverse = 1.0 / z
    depth = (b * z).sum(0)
    flat = b * z / depth
    depth = 1.0 / (flat * inverse).sum(0)
    across = np.roll(y, -1, 0) - np.roll(y, -2, 0)
    down = np.roll(x, -2, 0) - np.roll(x, -1, 0)
    counts = (
        1.0
        if exact
        else as_array64(share_of_pixel(torch.from_numpy(np.stack([x, y], -1).transpose(1, 0, 2))))
    )
    scale = -counts / ((x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0]))
    for c, derivative in enumerate(derivatives):
        scaled = (derivative - (derivative * b).sum(0)) * (depth * inverse)
        out[:, :, c, 0] = (flat * ((scaled * across).sum(0) * scale)).T
        out[:, :, c, 1] = (flat * ((scaled * down).sum(0) * scale)).T
        out[:, :, c, 2] = (-scaled * flat * inverse).T


@dataclass(frozen=True, eq=False)
class Mix:
    """The sum of `render/README.md`, pixels from samples: the first of them alone, others beside
    edge fragments with a fragment's weight.

    jump: what the image jumps by at each of S fragments, from inside to outside; 0 where it is not
    finite.
    """

    size: int
    pixels: Int[Array, " P"]
    pixel: Int[Array, " M"]
    sample: Int[Array, " M"]
    weight: Float[Array, " M"]
    jump: Float[Array, "S C"]

    @staticmethod
    def of(frame: Frame, found: Float[Array, "N C"], background: Any) -> "Mix":
        """That of values found at the samples before a background."""
        size = frame.height * frame.width
        visibility = frame.visibility
        pixels = as_array64(visibility.pixels)
        fragments = visibility.fragments
        nothing = np.zeros(0, np.int64)
        channels = found.shape[1]
        behind = _background(frame, background, channels)
        if frame.mode not in AVERAGED or fragments is None or not len(fragments.pixel):
            return Mix(size, pixels, nothing, nothing, np.zeros(0), np.zeros((0, channels)))
        pixel = as_array64(fragments.pixel)
        weight = as_array64(fragments.weight)
        sides = [as_array64(rows) for rows in (frame.visibility.inner, frame.visibility.outer)]
        there = behind[pixel // frame.width, pixel % frame.width]
        inside, outside = (
            np.where(rows[:, None] >= 0, found[rows], there) if len(found) else there
            for rows in sides
        )
        with np.errstate(invalid="ignore"):
            jump = outside - inside
        finite = np.abs(jump) < HUGE
        if not (finite == finite[:, :1]).all():
            raise HabitusError(
                "some channels jump by an infinite amount where others do not; take derivatives "
                "of them apart"
            )
        kept = [(rows >= 0) & finite[:, 0] for rows in sides]
        return Mix(
            size,
            pixels,
            np.concatenate([pixel[side] for side in kept]),
            np.concatenate([rows[side] for rows, side in zip(sides, kept, strict=True)]),
            np.concatenate([-weight[kept[0]], weight[kept[1]]]),
            np.where(finite, jump, 0.0),
        )

    def spread(
        self, rows: Int[Array, "N k"], blocks: Float[Array, "N k a b"], width: int, *more: Entries
    ) -> Bsr:
        """The matrix of pixels by a table of `width` rows, from what k rows of it do to each
        sample; and `more`.
        """
        count, k, *block = len(self.pixels), *blocks.shape[1:]
        shape = self.size * block[0], width * block[1]
        one = blocks[:count].reshape(count * k, *block), rows[:count].astype(np.int32).ravel()
        starts = _starts(k * np.bincount(self.pixels, minlength=self.size))
        centres = sparse.bsr_array((*one, starts), shape=shape, blocksize=block)
        beside = blocks[self.sample] * self.weight[:, None, None, None]
        entries = (
            self.pixel.repeat(k),
            rows[self.sample].ravel(),
            beside.reshape(len(beside) * k, *block),
        )
        rest = _gathered([entries, *more], width, self.size, tuple(block))
        return centres + rest if rest.nnz else centres


def _gathered(entries: Sequence[Entries], width: int, size: int, block: tuple[int, int]) -> Bsr:
    """Blocks at the same place added up."""
    pixel, row, blocks = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    keys, where = np.unique(pixel * width + row, return_inverse=True)
    flat = sparse.csr_array(
        (np.ones(len(where)), (where, np.arange(len(where)))), shape=(len(keys), len(where))
    )
    total = (flat @ blocks.reshape(len(blocks), block[0] * block[1])).reshape(len(keys), *block)
    pixel, row = np.divmod(keys, max(width, 1))
    structure = row.astype(np.int32), _starts(np.bincount(pixel, minlength=size))
    return sparse.bsr_array(
        (total, *structure), shape=(size * block[0], width * block[1]), blocksize=block
    )


def _starts(counts: Int[Array, " R"]) -> Int[Array, " R+1"]:
    return np.append(0, np.cumsum(counts)).astype(np.int32)


def per_channel(blocks: Bsr, width: int) -> Csr:
    """A matrix of pixels by rows with a number for each channel (blocks C high), as one of channels
    by channels.

    Channel c of a pixel then depends on number c of a row, or on the only one where a row has
    `width` 1.
    """
    matrix = blocks.tocsr()
    channels = blocks.blocksize[0]
    channel = np.arange(matrix.shape[0], dtype=np.int32) % channels if width > 1 else 0
    columns = matrix.indices * width + np.repeat(
        np.broadcast_to(channel, matrix.shape[0]), np.diff(matrix.indptr)
    )
    matrix = sparse.csr_array(
        (matrix.data, columns, matrix.indptr), shape=(matrix.shape[0], matrix.shape[1] * width)
    )
    matrix.sum_duplicates()
    return matrix


def _background(frame: Frame, background: Any, channels: int) -> Float[Array, "H W C"]:
    given = (
        as_array64(background)
        if isinstance(background, Tensor)
        else np.asarray(background, np.float64)
    )
    shape = frame.height, frame.width, channels
    try:
        return np.broadcast_to(given, shape)
    except ValueError:
        raise HabitusError(
            f"background is {given.shape}; expected one number, ({channels},) or {shape}"
        ) from None
