"""Derivatives of images to the screen (df/dU), and of the screen to vertices and cameras (dU/dV,
dU/dC; T eq. 4.2).
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor

from habitus.errors import HabitusError
from habitus.observe.camera import Camera
from habitus.observe.lens import distortion_slope
from habitus.render.clipping import Clipped
from habitus.render.filters import differences
from habitus.render.frame import Frame
from habitus.render.jacobians.samples import Array, Bsr, Csr, Entries, Mix, Samples, as_array64
from habitus.rotations import matrix_from_rotvec

CAMERA_FIELDS = ("rotation", "translation", "focal_length", "principal_point", "distortion")


@dataclass(frozen=True, eq=False)
class ScreenJacobian:
    """The derivative of an image (H, W, C) to what is drawn, and through it to vertices and
    cameras.

    blocks: (H W C, 3 V') to u, v (pixels) and z (metres) of the V' vertices of `frame.screen`;
    those that the near plane cut off edges come last. cuts: (H W C, K) to the fractions at which
    these divide their edges, by which their values change; None where nothing is cut.
    """

    frame: Frame
    blocks: Bsr
    cuts: Csr | None

    @cached_property
    def screen(self) -> Csr:
        """df/dU, (H W C, 3 V')."""
        return self.blocks.tocsr()

    def to_vertices(self, camera: Camera, vertices: Float[Tensor, "V 3"]) -> Csr:
        """df/dV = df/dU dU/dV, (H W C, 3 V). Camera and vertices: those of the frame, else
        HabitusError.
        """
        to_screen, to_cuts = vertex_jacobian(*self._checked(camera, vertices), self.frame.clipped)
        matrix = (self.blocks @ to_screen).tocsr()
        return matrix if self.cuts is None else matrix + self.cuts @ to_cuts

    def to_camera(
        self, camera: Camera, vertices: Float[Tensor, "V 3"], names: Sequence[str] = CAMERA_FIELDS
    ) -> dict[str, Float[np.ndarray, "N P"]]:
        """df/dC, dense (H W C, P), by the camera's fields; without distortion where the lens has
        None.
        """
        if unknown := set(names) - set(CAMERA_FIELDS):
            raise HabitusError(
                f"camera has no {', '.join(sorted(unknown))} to differentiate by; see CAMERA_FIELDS"
            )
        jacobian, columns = camera_jacobian(
            *self._checked(camera, vertices), self.frame.clipped, names
        )
        width = self.blocks.shape[1]
        found = self.screen @ jacobian[:width]
        if self.cuts is not None:
            found += self.cuts @ jacobian[width:]
        return {name: found[:, where] for name, where in columns.items()}

    def chain(self, camera: Camera, vertices: Float[Tensor, "V 3"], jacobian: Any) -> Any:
        """df/dp = df/dV dV/dp for parameters p of one's own that move the vertices, such as a pose:
        (H W C, P).

        jacobian: dV/dp, (3 V, P) or (V, 3, *P), an array or a tensor, which gives a dense array, or
        sparse, which gives a sparse one. It costs one product of a sparse matrix with P columns.
        """
        to_screen, to_cuts = vertex_jacobian(*self._checked(camera, vertices), self.frame.clipped)
        given = matrix(jacobian, to_screen.shape[1], "derivatives of the vertices")
        product = self.screen @ (to_screen @ given)
        return product if self.cuts is None else product + self.cuts @ (to_cuts @ given)

    def _checked(self, camera: Camera, vertices: Tensor) -> tuple[Camera, Tensor]:
        """Both in float64 on the CPU; HabitusError where the frame does not show them."""
        expected = (self.frame.num_vertices, 3)
        if tuple(vertices.shape) != expected or camera.batch_shape:
            raise HabitusError(
                f"got vertices {tuple(vertices.shape)} and cameras {tuple(camera.batch_shape)}; "
                f"expected {expected} and "
                "the single camera of the frame"
            )
        names = [field for field in CAMERA_FIELDS if getattr(camera, field) is not None]
        values = {name: getattr(camera, name).detach().cpu().double() for name in names}
        camera = dataclasses.replace(camera, **values)
        vertices = vertices.detach().cpu().double()
        found = as_array64(camera.screen(vertices))
        shown = as_array64(self.frame.screen)[: len(vertices)]
        front = found[:, 2] >= camera.near
        if not np.allclose(found[front], shown[front], rtol=1e-4, atol=1e-2):
            raise HabitusError(
                "the frame shows other vertices, or by another camera; expected those it was "
                "drawn with"
            )
        return camera, vertices


def screen_blocks(
    frame: Frame,
    samples: Samples,
    mix: Mix,
    derivatives: Float[Array, "C 3 N"] | None,
    image: Float[Tensor, "H W C"] | None,
    is_depth: bool = False,
) -> Bsr:
    """The derivative of an image to u, v and z of each vertex of the screen.

    derivatives: of the samples' values to barycentric coordinates, None where they have none.
    image: itself, where the thesis' filter asks for it. is_depth: whether values are z.
    """
    channels = mix.jump.shape[1]
    count = len(samples.corners)
    more = []
    if derivatives is None or frame.mode == "filter":
        blocks = np.zeros((count, 3, channels, 3))
    else:
        blocks = samples.to_screen(derivatives)
    if is_depth:
        blocks[:, :, 0, 2] += samples.coordinates
    if frame.mode == "filter" and image is not None:
        blocks[..., :2], *more = _filtered(frame, samples, image)
    elif len(mix.jump):
        more = _swept(frame, samples, mix)
    return mix.spread(samples.corners, blocks, len(frame.screen), *more)


def _swept(frame: Frame, samples: Samples, mix: Mix) -> list[Entries]:
    """The area swept by moving edges (`fragment_weights`) times the jump, for both ends of each
    edge.
    """
    fragments = frame.visibility.fragments
    assert fragments is not None
    start, end, outward, tail, head = map(
        as_array64,
        (fragments.start, fragments.end, fragments.outward, fragments.tail, fragments.head),
    )
    step = samples.screen[head, :2] - samples.screen[tail, :2]
    swept = -(outward * (end - start))[:, None] * np.stack([step[:, 1], -step[:, 0]], 1)
    return _at_ends(
        as_array64(fragments.pixel),
        tail,
        head,
        (start + end) / 2,
        mix.jump[:, :, None] * swept[:, None],
    )


def _filtered(frame: Frame, samples: Samples, image: Tensor) -> tuple[Array, *tuple[Entries, ...]]:
    """What the thesis' filter (`filters.py`) makes of motion: blocks of the corners of pixels'
    faces, and of edges.
    """
    derivatives = -np.stack(
        [as_array64(differences(image.detach(), frame.boundary, axis)) for axis in (1, 0)], -1
    )
    derivatives = derivatives.reshape(-1, image.shape[-1], 2)
    pixels = as_array64(frame.visibility.pixels)
    fragments = frame.visibility.fragments
    inside = samples.flat() * ~as_array64(frame.boundary).ravel()[pixels, None]
    blocks = inside[:, :, None, None] * derivatives[pixels][:, None]
    if fragments is None:
        return (blocks,)
    kept = ~as_array64(fragments.seam)
    pixel, tail, head, start, end = (
        as_array64(x)[kept]
        for x in (fragments.pixel, fragments.tail, fragments.head, fragments.start, fragments.end)
    )
    lengths = (end - start) * np.linalg.norm(
        samples.screen[head, :2] - samples.screen[tail, :2], axis=1
    )
    share = lengths / np.bincount(pixel, lengths, minlength=len(derivatives)).clip(min=1e-30)[pixel]
    return blocks, *_at_ends(
        pixel, tail, head, (start + end) / 2, share[:, None, None] * derivatives[pixel]
    )


def _at_ends(
    pixel: Array, tail: Array, head: Array, middle: Array, derivatives: Float[Array, "S C 2"]
) -> list[Entries]:
    """Derivatives to the midpoints of fragments, as derivatives to both ends of their edges."""
    blocks = np.concatenate([derivatives, np.zeros_like(derivatives[..., :1])], -1)
    at_head = middle[:, None, None] * blocks
    return [(pixel, tail, blocks - at_head), (pixel, head, at_head)]


def drawn(
    camera: Camera, vertices: Float[Tensor, "*#batch V 3"], clipped: Clipped | None
) -> Float[Tensor, "*batch D"]:
    """The numbers that an image depends on by its geometry: the screen, flat, and behind it the
    fractions of cuts.

    Differentiable; which edges are cut is held.
    """
    points = camera.to_camera(vertices)
    fractions = None
    if clipped is not None:
        points, fractions = _with_cuts(points, clipped, camera.near)
    pixels = camera.project_camera_points(points)
    screen = torch.cat([pixels, points[..., 2:].expand(*pixels.shape[:-1], 1)], -1).flatten(-2)
    return (
        screen
        if fractions is None
        else torch.cat([screen, fractions.expand(*screen.shape[:-1], -1)], -1)
    )


def _with_cuts(
    points: Float[Tensor, "*batch V 3"], clipped: Clipped, near: float
) -> tuple[Tensor, Tensor]:
    """Points in the camera's frame with those at cuts behind them, and the fractions of these."""
    behind, front = points[..., clipped.cut_ends.cpu(), :].unbind(-2)
    fraction = (near - behind[..., 2]) / (front[..., 2] - behind[..., 2])
    return torch.cat([points, behind + fraction[..., None] * (front - behind)], -2), fraction


def camera_jacobian(
    camera: Camera, vertices: Float[Tensor, "V 3"], clipped: Clipped | None, names: Sequence[str]
) -> tuple[Float[np.ndarray, "D P"], dict[str, slice]]:
    """dU/dC: the derivative of `drawn` to fields of the camera, and which columns are whose.

    Forward differentiation goes along all P directions at once.
    """
    fields = {name: getattr(camera, name) for name in names if getattr(camera, name) is not None}
    ends = np.cumsum([0, *(len(value) for value in fields.values())]).tolist()
    columns = [slice(*pair) for pair in pairwise(ends)]
    if not fields:
        return np.zeros((drawn(camera, vertices, clipped).numel(), 0)), {}
    steps = torch.eye(ends[-1], dtype=torch.float64)

    def moved(*values: Tensor) -> Tensor:
        return drawn(camera.replace(**dict(zip(fields, values, strict=True))), vertices, clipped)

    batch = tuple(value.repeat(len(steps), 1) for value in fields.values())
    derivatives = torch.func.jvp(
        moved, batch, tuple(steps[:, where].contiguous() for where in columns)
    )[1]
    return np.ascontiguousarray(derivatives.numpy().T), dict(zip(fields, columns, strict=True))


def vertex_jacobian(
    camera: Camera, vertices: Float[Tensor, "V 3"], clipped: Clipped | None
) -> tuple[Bsr, sparse.csr_array | None]:
    """dU/dV, (3 V', 3 V), and the derivative of the cuts' fractions (K, 3 V), None without cuts.

    With d = b - a an edge of the camera's frame, t the fraction at which it is cut, n its normal:
    dt = -n.((1 - t) da + t db)/d.n, and the cut moves by (1 - d n^T / d.n) ((1 - t) da + t db).
    """
    points = camera.to_camera(vertices)
    turn = as_array64(matrix_from_rotvec(camera.rotation))
    count = len(points)
    own = np.arange(len(points), dtype=np.int32)
    if clipped is None:
        starts = np.arange(count + 1, dtype=np.int32)
        return _blocks(_projection_jacobian(camera, points) @ turn, own, starts, count, count), None
    points, fraction = _with_cuts(points, clipped, camera.near)
    projected = _projection_jacobian(camera, points)
    ends = as_array64(clipped.cut_ends)
    shares = np.stack([1.0 - as_array64(fraction), as_array64(fraction)], 1)[:, :, None, None]
    edge = as_array64(points)[ends[:, 1]] - as_array64(points)[ends[:, 0]]
    to_fraction = -turn[2] / edge[:, 2, None]
    at_cut = projected[count:] @ (turn + edge[:, :, None] * to_fraction[:, None])
    blocks = np.concatenate(
        [projected[:count] @ turn, (shares * at_cut[:, None]).reshape(-1, 3, 3)]
    )
    columns = np.append(own, ends.ravel())
    two = 2 * np.arange(len(ends) + 1)
    to_screen = _blocks(blocks, columns, np.append(own, count + two), len(points), count)
    to_fractions = (shares * to_fraction[:, None, None]).reshape(-1, 1, 3)
    return to_screen, _blocks(to_fractions, ends.ravel(), two, len(ends), count).tocsr()


def _projection_jacobian(
    camera: Camera, points: Float[Tensor, "V 3"]
) -> Float[np.ndarray, "V 3 3"]:
    """How u, v, z (rows) change with points in the camera's frame.

    In closed form: forward differentiation in torch works on one thread at a time.
    """
    depth = points[:, 2:].clamp(min=camera.near / 2)
    plane = points[:, :2] / depth
    by_point = torch.zeros((len(points), 3, 3), dtype=points.dtype)
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / depth[:, 0]
    by_point[:, :2, 2] = torch.where(points[:, 2:] >= camera.near / 2, -plane / depth, 0.0)
    if camera.distortion is not None:
        xx, xy, yy = distortion_slope(plane, camera.distortion)
        turned = torch.stack([xx, xy, xy, yy], -1).reshape(-1, 2, 2)
        by_point[:, :2] = turned @ by_point[:, :2]
    by_point[:, :2] *= camera.focal_length[:, None]
    by_point[:, 2, 2] = 1.0
    return by_point.numpy()


def _blocks(blocks: Array, columns: Array, starts: Array, rows: int, width: int) -> Bsr:
    down, across = blocks.shape[1:]
    structure = columns.astype(np.int32), starts.astype(np.int32)
    return sparse.bsr_array(
        (blocks, *structure), shape=(down * rows, across * width), blocksize=(down, across)
    )


def matrix(given: Any, rows: int, what: str) -> Any:
    """A derivative that a user gave, as a float64 matrix of so many rows, or sparse as it is."""
    if not sparse.issparse(given):
        given = as_array64(given) if isinstance(given, Tensor) else np.asarray(given, np.float64)
        if given.size % max(rows, 1) == 0 and given.ndim > 1:
            given = given.reshape(rows, -1) if rows else given.reshape(0, given.shape[-1])
    if given.ndim != 2 or given.shape[0] != rows:
        raise HabitusError(
            f"{what} are {tuple(given.shape)}; expected {rows} rows, a column for each parameter"
        )
    return given
