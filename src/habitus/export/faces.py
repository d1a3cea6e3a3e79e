"""A body's face units as blend shapes of files, under their own names, for programs that drive
faces by ARKit's.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.export.animation import Animation
from habitus.export.correctives import Drivers
from habitus.parallel.blocks import every_nth_frame

if TYPE_CHECKING:
    from habitus.body.motion import Moving


def face_weights(moving: "Moving", stride: int = 1) -> Float[np.ndarray, "_ U"] | None:
    """Weights of the face's units in every ``stride``-th frame, where the motion has them."""
    return None if moving.face is None else every_nth_frame(moving.face, stride)


def with_face(animation: Animation, weights: Float[np.ndarray, "T U"] | None) -> Animation:
    """The animation of one track with a blend shape for each of the body's face units, which move
    by ``weights`` where there are such.

    Turns of jaw and eyes are in the blend shapes, as straight motion: a program that knows names
    and nothing else opens mouths and moves gazes. Bones stay free besides. Raises HabitusError for
    a body without units.
    """
    body = animation.body
    if body.face is None:
        raise HabitusError(
            f"{body.called} has no face units to write; expected neutral, female or male"
        )
    kept = {joint: joint for joint in range(body.num_joints) if joint not in body.face.joints}
    rest = animation.rest_vertices, animation.rest_joints
    face = body.face.with_joints(kept, *rest, body.skinning_weights)
    shapes = np.zeros((len(face.unit_names), body.num_vertices, 3), np.float32)
    shapes[:, face.vertices] = face.unit_directions.transpose(2, 0, 1)
    track = animation.tracks[0]
    frames = len(track.quaternions)
    given = np.zeros((frames, len(shapes))) if weights is None else weights
    both = np.concatenate([track.morph_weights.reshape(frames, -1), given], axis=1)
    none = Drivers.linear(np.zeros((len(shapes), 9)))
    return replace(
        animation,
        morphs=np.concatenate([animation.morphs.reshape(-1, *shapes.shape[1:]), shapes]),
        tracks=(replace(track, morph_weights=np.clip(both, 0.0, 1.0)),),
        morph_names=(*animation.morph_names, *face.unit_names),
        morph_drivers=Drivers.together([animation.morph_drivers, none]),
    )
