"""FBX 7.4, binary: the body with its skeleton, skin, blend channels and motion, for Maya, Unity,
Unreal, Blender.
"""

import os
from typing import TYPE_CHECKING

from habitus.errors import shown
from habitus.export.animation import Animation, animate, body_at, one_sided
from habitus.export.faces import face_weights, with_face
from habitus.export.fbx.body import add_channels, add_mesh, add_skeleton, add_skin
from habitus.export.fbx.motion import add_motion
from habitus.export.fbx.nodes import document
from habitus.export.fbx.scene import Objects, top_nodes
from habitus.export.rigging import Bones, rigged
from habitus.export.skins import painted
from habitus.files import atomic_write

if TYPE_CHECKING:
    from habitus.body.motion import Moving


def write_fbx(
    fit: "Moving",
    path: str | os.PathLike[str],
    *,
    correctives: str = "auto",
    detail: str = "full",
    face: bool = False,
    skin: str | float | None = None,
    bones: Bones | None = None,
) -> Animation:
    """Write a motion as one binary .fbx, atomically; what was written comes back.

    Centimetres, +y up, the motion's own rate, one take with the capture's name. The mesh is the
    shaped body at rest, quads and texture coordinates where the body has them; the skeleton's limbs
    are the body's joints, with ``bones`` as for `habitus.export.rigging.rigged`. Pose blend shapes
    and soft tissue are blend channels between 0 and 100 percent (``correctives``:
    `habitus.export.correctives.morphs_of`), forth and back where they go both ways; with soft
    tissue joints move, too. ``detail``: "full", or "coarse", the mesh that was fitted.
    ``face``: with a blend channel for each of the face's units (`habitus.export.faces`). ``skin``:
    as for `habitus.export.glb.write_glb`; the texture is in the file. Raises HabitusError for
    another skin, where pose blend shapes are not linear in vec(R - I), and where the file cannot be
    written.
    """
    animation = one_sided(animate(fit, correctives=correctives, body=body_at(fit, detail)))
    if face:
        animation = with_face(animation, face_weights(fit))
    animation = rigged(animation, bones or Bones(), loose=True)
    take = shown(fit.capture_name, 200)
    objects = Objects()
    limbs = add_skeleton(objects, animation)
    covered = painted(animation, skin)
    mesh, geometry = add_mesh(objects, covered.animation, "body", covered.picture)
    add_skin(objects, animation, mesh, geometry, limbs)
    channels = add_channels(objects, animation, geometry)
    add_motion(objects, animation, take, limbs, channels)
    content = document(top_nodes(objects, take, len(fit.pose), animation.rate_hz))
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return animation
