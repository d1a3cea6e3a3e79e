"""A body in motion: one person, a pose and a place in every frame, soft tissue where there is
such.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.state import BodySurface

Frames = int | slice | Sequence[int] | None
_BATCH = 32


class Moving:
    """What can be asked of every body in motion: of a fit of markers, and of a `BodyMotion`.

    T frames, J joints, B betas; metres, radians, a world of its own whose ``up_axis`` is told.
    """

    face: Float[np.ndarray, "T U"] | None = None

    if TYPE_CHECKING:
        body: BodyModel
        betas: Float[np.ndarray, " B"]
        pose: Float[np.ndarray, "T J 3"]
        trans: Float[np.ndarray, "T 3"]
        soft_tissue: Float[np.ndarray, "T B"] | None
        dynamics: Float[np.ndarray, "T D"] | None
        rate_hz: float
        up_axis: str
        capture_name: str
        body_name: str
        gender: str

        @property
        def pose_stage(self) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]: ...  # noqa: D102

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.pose)

    def vertices(self, frames: Frames = None) -> Float[np.ndarray, "*frames V 3"]:
        """The surface (T, V, 3) in metres, world frame, soft tissue included; of one frame (V, 3).

        frames: all (None), one number, a slice, or a sequence of numbers.
        """
        return self._posed(frames, "vertices")

    def joints(self, frames: Frames = None) -> Float[np.ndarray, "*frames J 3"]:
        """The joints (T, J, 3) in metres, world frame, soft tissue included; of one frame (J,
        3).
        """
        return self._posed(frames, "joints", vertices=[0])

    def _posed(
        self, frames: Frames, what: str, vertices: Sequence[int] | None = None
    ) -> np.ndarray:
        rows = np.arange(self.num_frames)[
            slice(None)
            if frames is None
            else list(frames)
            if isinstance(frames, Sequence)
            else frames
        ]
        posed = np.concatenate(
            [getattr(part, what) for part in self.surfaces(np.atleast_1d(rows), vertices)]
        )
        return posed[0] if np.ndim(rows) == 0 else posed

    @property
    def finest_body(self) -> BodyModel:
        """The body at its full level of detail, which files show; the fitted one where it has no
        other.
        """
        return self.body.full or self.body

    def surfaces(
        self,
        rows: Sequence[int] | np.ndarray,
        vertices: Sequence[int] | np.ndarray | None = None,
        body: BodyModel | None = None,
    ) -> Iterator[BodySurface]:
        """Surfaces of the frames ``rows``, a few frames each, in order; of all vertices or of some.

        ``body`` stands in for the fitted one (`finest_body`).
        """
        rows = np.asarray(rows, dtype=np.int64)
        body = body or self.body
        for start in range(0, max(len(rows), 1), _BATCH):
            some = rows[start : start + _BATCH]
            soft = 0.0 if self.soft_tissue is None else self.soft_tissue[some]
            betas = np.tile(self.betas, (len(some), 1)) + soft
            moving = None if self.dynamics is None else self.dynamics[some]
            face = None if self.face is None else self.face[some]
            given = betas, self.pose[some], self.trans[some]
            yield body(*given, vertices=vertices, dynamics=moving, face=face)

    def points(self, vertices: Sequence[int] | np.ndarray) -> Float[np.ndarray, "T N 3"]:
        """Some vertices (N ids) in every frame, metres, world frame, soft tissue included."""
        return np.concatenate(
            [part.vertices for part in self.surfaces(np.arange(self.num_frames), vertices)]
        )


@dataclass(frozen=True, eq=False)
class BodyMotion(Moving):
    """A body in motion that is no fit: exaggerated, retargeted, or read from a file that holds no
    markers.

    T frames, J joints, B betas, metres and radians in a world whose ``up_axis`` is told.
    ``soft_tissue`` (T, B) adds to ``betas`` frame by frame, ``dynamics`` (T, D) are coefficients of
    the body's dynamic blend shapes, ``face`` (T, U) weights of its face's units. ``made`` says in
    sentences where it comes from and what was done to it; files keep that.
    """

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    rate_hz: float
    up_axis: str = "+z"
    soft_tissue: Float[np.ndarray, "T B"] | None = None
    dynamics: Float[np.ndarray, "T D"] | None = None
    face: Float[np.ndarray, "T U"] | None = None
    capture_name: str = "motion"
    body_name: str = ""
    gender: str = "neutral"
    made: tuple[str, ...] = ()

    @property
    def pose_stage(self) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
        """Pose and trans, as a fit has them before soft tissue is let go."""
        return self.pose, self.trans

    @classmethod
    def of(cls, moving: Any) -> "BodyMotion":
        """The motion of a fit (`habitus.fit.markers.result.MarkerFit`) without its markers; a
        motion as it is.
        """
        if isinstance(moving, BodyMotion):
            return moving
        made = (f"fitted to the markers of {moving.capture_name} (layout {moving.layout_name})",)
        shared = {name: getattr(moving, name) for name in _SHARED}
        return cls(**shared, made=made)


_SHARED = (
    "body",
    "betas",
    "pose",
    "trans",
    "rate_hz",
    "up_axis",
    "soft_tissue",
    "dynamics",
    "face",
    "capture_name",
    "body_name",
    "gender",
)
