"""The data that dynamics are learned from: registrations of a person in motion, and the motion (S
6).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from habitus.body.joint_layouts import SMPL, SMPLH, SMPLX
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.mesh.registrations import Registrations, Vertices

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
        told = {"betas": self.betas, "pose": self.pose, "trans": self.trans}
        missing = [key for key, value in told.items() if value is None]
        if len(missing) == len(told):
            return self
        if self.pose is None or self.betas is None or self.trans is None:
            raise HabitusError(
                f"{self.name}: tells no {missing[0]}; expected betas, pose and trans, or none of "
                "them"
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
        found = np.zeros((len(self.pose), body.num_joints, 3))
        for k, name in enumerate(names):
            if name in body.joint_names:
                found[:, body.joint_names.index(name)] = self.pose[:, k]
            elif np.abs(self.pose[:, k]).max(initial=0.0) > 1e-6:
                raise HabitusError(f"{self.name}: joint {name!r} moves, which {body.name} has not")
        return found

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
                "if it has two); tell with vertex_ids which of them these are"
            )


def check_sequences(sequences: tuple[MovingSurface, ...]) -> float:
    """The rate of all. Raises HabitusError where there is none, or nothing to learn from."""
    rates = sorted({round(one.rate_hz, 6) for one in sequences})
    if not sequences or max(len(one) for one in sequences) < 5:
        raise HabitusError(
            f"{len(sequences)} sequences, none of five frames; expected people in motion"
        )
    if len(rates) > 1:
        told = ", ".join(f"{rate:g}" for rate in rates)
        raise HabitusError(
            f"sequences at {told} Hz; expected one rate, at which dynamics are learned: resample "
            "the others"
        )
    return sequences[0].rate_hz
