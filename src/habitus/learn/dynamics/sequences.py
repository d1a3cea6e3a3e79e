"""The data that dynamics are learned from (S 6): registrations of a person in motion with the
motion, and their residuals from the body, carried back to the rest pose.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from habitus.body.joint_layouts import SMPL, SMPLH, SMPLX
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.learn.dynamics.settings import DYNAMICS, DynamicsSettings
from habitus.learn.posing.rig import Rig
from habitus.learn.posing.surface import posed
from habitus.mesh.registrations import Registrations, Vertices
from habitus.parallel.workers import Workers

_LAYOUTS = {len(layout.joint_names): layout.joint_names for layout in (SMPL, SMPLH, SMPLX)}


@dataclass(frozen=True, eq=False)
class MovingSurface:
    """T registrations of one person, frame after frame, and, as far as known, shape, pose (rad) and
    place (m).

    ``still`` are surfaces of the same frames without dynamics: the person at rest in that pose, as
    a simulation knows it; without, that is what the body says. ``joint_names`` are those of the
    pose where they are not the body's; ``vertex_ids`` the body's vertices that the registrations
    are of, where they are not of all.
    """

    name: str
    subject: str
    rate_hz: float
    registrations: Registrations
    betas: Float[np.ndarray, " B"] | None = None
    pose: Float[np.ndarray, "T J 3"] | None = None
    trans: Float[np.ndarray, "T 3"] | None = None
    still: Vertices | None = None
    joint_names: tuple[str, ...] | None = None
    vertex_ids: Int[np.ndarray, " V"] | None = None

    def __len__(self) -> int:
        return len(self.registrations)

    def for_body(self, body: BodyModel) -> "MovingSurface":
        """The same with betas and pose as this body has them. Raises HabitusError where they are
        not of such a body.
        """
        self._check_vertices(body)
        given = {"betas": self.betas, "pose": self.pose, "trans": self.trans}
        missing = [key for key, value in given.items() if value is None]
        if len(missing) == len(given):
            return self
        if self.pose is None or self.betas is None or self.trans is None:
            raise HabitusError(
                f"{self.name}: has no {missing[0]}; expected betas, pose and trans, or none of them"
            )
        frames = len(self)
        if len(self.betas) > body.num_betas or self.betas.ndim != 1:
            raise HabitusError(
                f"{self.name}: betas of shape {self.betas.shape}; expected {body.num_betas} or "
                "fewer"
            )
        if self.pose.ndim != 3 or len(self.pose) != frames or self.trans.shape != (frames, 3):
            raise HabitusError(
                f"{self.name}: pose of shape {self.pose.shape} and trans of {self.trans.shape}; "
                "expected "
                f"({frames}, J, 3) and ({frames}, 3)"
            )
        betas = np.zeros(body.num_betas)
        betas[: len(self.betas)] = self.betas
        return replace(self, betas=betas, pose=self._pose_of(body), joint_names=body.joint_names)

    def _pose_of(self, body: BodyModel) -> np.ndarray:
        assert self.pose is not None
        count = self.pose.shape[1]
        if self.joint_names is None and count == body.num_joints:
            return self.pose
        names = self.joint_names or _LAYOUTS.get(count, ())
        if len(names) != count:
            raise HabitusError(
                f"{self.name}: a pose of {count} joints without names; {body.name} has "
                f"{body.num_joints}"
            )
        values = np.zeros((len(self.pose), body.num_joints, 3))
        for k, name in enumerate(names):
            if name in body.joint_names:
                values[:, body.joint_names.index(name)] = self.pose[:, k]
            elif np.abs(self.pose[:, k]).max(initial=0.0) > 1e-6:
                raise HabitusError(f"{self.name}: joint {name!r} moves, which {body.name} has not")
        return values

    def _check_vertices(self, body: BodyModel) -> None:
        count = self.registrations.num_vertices
        ids = self.vertex_ids
        expected = body.num_vertices if ids is None else len(ids)
        if count != expected or (
            ids is not None and not 0 <= ids.min() <= ids.max() < body.num_vertices
        ):
            raise HabitusError(
                f"{self.name}: registrations of {count} vertices; {body.name} has "
                f"{body.num_vertices} (its full level, "
                "if it has two); name these vertices with vertex_ids"
            )


def check_sequences(sequences: tuple[MovingSurface, ...]) -> float:
    """The rate of all. Raises HabitusError where there is none, or nothing to learn from."""
    rates = sorted({round(sequence.rate_hz, 6) for sequence in sequences})
    if not sequences or max(len(sequence) for sequence in sequences) < 5:
        raise HabitusError(
            f"{len(sequences)} sequences, none of five frames; expected people in motion"
        )
    if len(rates) > 1:
        given = ", ".join(f"{rate:g}" for rate in rates)
        raise HabitusError(
            f"sequences at {given} Hz; expected one rate, at which dynamics are learned: resample "
            "the others"
        )
    return sequences[0].rate_hz


_BLOCK = 64  # frames carried back together: bounds memory, changes no result


@dataclass(frozen=True, eq=False)
class _Shared:
    body: BodyModel
    rig: Rig
    sequences: Sequence[MovingSurface]
    settings: DynamicsSettings


def rest_residuals(
    body: BodyModel,
    sequences: Sequence[MovingSurface],
    workers: Workers,
    settings: DynamicsSettings = DYNAMICS,
) -> Iterator[tuple[int, Float[np.ndarray, "n M"]]]:
    """Which sequence, and the residuals (m; M = 3 V, vertex by vertex) of its next frames: sequence
    after sequence.

    Sequences know betas, pose and trans. Vertices that are not seen in a frame, of weight 0, count
    as not moved, others as much as they are trusted.
    """
    rig = Rig(
        body.parents, body.skinning, body.pose_features, body.shape_features,
        body.skinning_index, body.skinning_value, None,
    )  # fmt: skip
    shared = _Shared(body, rig, sequences, settings)
    items = [
        (k, first)
        for k, sequence in enumerate(sequences)
        for first in range(0, len(sequence), _BLOCK)
    ]
    for (k, _), block in zip(items, workers.map(_block, shared, items), strict=True):
        yield k, block


def _block(shared: _Shared, item: tuple[int, int]) -> Float[np.ndarray, "n M"]:
    sequence = shared.sequences[item[0]]
    first = item[1]
    frames = range(first, min(first + _BLOCK, len(sequence)))
    return np.stack([offset.ravel() for offset in _residuals(shared, sequence, frames)])


def _residuals(
    shared: _Shared, sequence: MovingSurface, frames: range
) -> Iterator[Float[np.ndarray, "V 3"]]:
    body = shared.body
    pose = sequence.pose
    trans = sequence.trans
    assert pose is not None and trans is not None
    ids = slice(None) if sequence.vertex_ids is None else sequence.vertex_ids
    if sequence.still is not None:
        source = sequence.still
        still = [np.asarray(source[frame], float) for frame in frames]
    else:
        some = slice(frames.start, frames.stop)
        still = list(body(sequence.betas, pose[some], trans[some]).vertices[:, ids])
    for frame, at_rest in zip(frames, still, strict=True):
        values, weight = sequence.registrations.read_seen(frame)
        offset = np.zeros((body.num_vertices, 3))
        offset[ids] = values - at_rest
        if weight is not None:
            offset[ids] *= weight[:, None]
        yield unposed(posed(shared.rig, pose[frame]).turn, offset, shared.settings)


def unposed(
    turn: Float[np.ndarray, "V 3 3"],
    offset: Float[np.ndarray, "V 3"],
    settings: DynamicsSettings = DYNAMICS,
) -> Float[np.ndarray, "V 3"]:
    """Offsets d at rest with turn d = away, for the blended rotations of skinning.

    Where these squeeze a volume below ``squeezed`` of itself (deep folds, strong twists), d is the
    minimum of |turn d - away|^2 + mu |d|^2 instead; mu rises smoothly from 0 there to ``damping``
    where nothing is left.
    """
    a = turn[:, 0]
    b = turn[:, 1]
    c = turn[:, 2]
    across = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = np.einsum("vi,vi->v", a, across[0])
    flat = volume < settings.squeezed
    total = sum(side * offset[:, k, None] for k, side in enumerate(across))
    values = total / np.where(flat, 1.0, volume)[:, None]
    if flat.any():
        left = np.maximum(volume[flat], 0.0) / settings.squeezed
        mu = settings.damping * (1.0 - left) ** 2
        back = turn[flat].swapaxes(-1, -2)
        matrix = back @ turn[flat] + mu[:, None, None] * np.eye(3)
        values[flat] = np.linalg.solve(matrix, back @ offset[flat][..., None])[..., 0]
    return values
