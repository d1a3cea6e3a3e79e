"""Binary glTF 2.0: the shaped body as a skinned mesh with its motion, for Blender, game engines and
web viewers.
"""

import os
from typing import TYPE_CHECKING

import numpy as np
import pygltflib as gl

from habitus import __version__
from habitus.body.surface_files import (
    GltfBuffer,
    add_picture,
    gltf_material,
    gltf_primitive,
    unit_float32,
)
from habitus.errors import shown
from habitus.export.animation import Animation, animate, body_at, one_sided
from habitus.export.faces import face_weights, with_face
from habitus.export.seams import seams_of
from habitus.export.skins import ROUGHNESS, painted
from habitus.files import atomic_write

if TYPE_CHECKING:
    from habitus.body.motion import Moving

GLB_FRAMES = 36_000
"""Most frames that an animation is given by itself: readers hold every key of every joint in
memory.
"""


def write_glb(
    fit: "Moving",
    path: str | os.PathLike[str],
    *,
    stride: int | None = None,
    correctives: str = "auto",
    detail: str = "full",
    face: bool = False,
    skin: str | float | None = None,
) -> Animation:
    """Write a ``MarkerFit`` as one .glb file, atomically.

    Metres, +y up (the capture's up axis is turned there), the capture's rate (every ``stride``-th
    frame; by itself all of up to `GLB_FRAMES` frames, and of longer captures as many as stay below
    that). The mesh is the shaped body at zero pose, at its full level of detail where it has one;
    joints are nodes with rotation tracks and the root with a translation track. Soft tissue and
    pose blend shapes become morph targets (``correctives``:
    `habitus.export.correctives.morphs_of`), each a pair, forth and back, with weights between 0 and
    1, named by what they hold (``soft_tissue_01``, ``left_knee_01_back``). Where the body has
    texture coordinates, so has the mesh, with vertices doubled along the seams. With soft tissue
    every joint has a translation track, because shape moves joints. glTF knows linear blend
    skinning only, so a "dqbs" body is approximate near strongly twisted joints. ``detail``: "full",
    or "coarse", the mesh that was fitted. ``face``: with a morph target for each of the face's
    units (`habitus.export.faces`). ``skin``: a tone of the default body's skin as its texture
    (`habitus.body.skin.skin_tone`); other bodies and the coarse mesh stay plain. What was written
    comes back. Raises HabitusError for another skin, and where the file cannot be written.
    """
    shown_body = body_at(fit, detail)
    animation = one_sided(
        animate(fit, stride=stride or glb_stride(fit), correctives=correctives, body=shown_body)
    )
    if face:
        animation = with_face(animation, face_weights(fit, stride or glb_stride(fit)))
    covered = painted(animation, skin)
    document = _document(covered.animation, shown(fit.capture_name, 200))
    if covered.picture is not None:
        add_picture(document, covered.picture, ROUGHNESS)
    with atomic_write(path) as temporary:
        temporary.write_bytes(b"".join(document.save_to_bytes()))
    return animation


def glb_stride(fit: "Moving") -> int:
    """How many frames of the capture make one of the animation that `write_glb` writes by
    itself.
    """
    return max(1, -(-len(fit.pose) // GLB_FRAMES))


def thinning_note(fit: "Moving") -> tuple[str, ...]:
    """A sentence where the animation leaves frames out."""
    stride = glb_stride(fit)
    if stride == 1:
        return ()
    return (
        f"{len(fit.pose):,} frames are too many for one animation: body.glb holds one in {stride} "
        f"({fit.rate_hz / stride:.3g} Hz), body.npz holds all",
    )


def _document(animation: Animation, name: str) -> gl.GLTF2:
    joints = len(animation.body.parents)
    document = gl.GLTF2(
        asset=gl.Asset(version="2.0", generator=f"habitus {__version__}"),
        scene=0,
        scenes=[gl.Scene(name=name, nodes=[0, joints])],
        nodes=[*_joint_nodes(animation), gl.Node(name=name, mesh=0, skin=0)],
        materials=[gltf_material()],
    )
    buffer = GltfBuffer(document)
    document.meshes.append(_mesh(animation, buffer))
    document.skins.append(_skin(animation, buffer))
    document.animations.append(_tracks(animation, buffer, name))
    return buffer.closed()


def _joint_nodes(animation: Animation) -> list[gl.Node]:
    parents = animation.body.parents
    joints = animation.rest_joints
    return [
        gl.Node(
            name=name,
            translation=(joints[j] - (joints[parents[j]] if parents[j] >= 0 else 0.0)).tolist(),
            rotation=[0.0, 0.0, 0.0, 1.0],
            children=[c for c, p in enumerate(parents) if p == j],
        )
        for j, name in enumerate(animation.body.joint_names)
    ]


def _mesh(animation: Animation, buffer: GltfBuffer) -> gl.Mesh:
    seams = seams_of(animation.body)
    array = gl.ARRAY_BUFFER
    primitive = gltf_primitive(animation.rest_vertices, animation.body.faces, buffer, seams)
    for k, (index, value) in enumerate(_influences(animation)):
        setattr(
            primitive.attributes, f"JOINTS_{k}", buffer.add(index[seams.source], gl.VEC4, array)
        )
        setattr(
            primitive.attributes, f"WEIGHTS_{k}", buffer.add(value[seams.source], gl.VEC4, array)
        )
    targets = [
        gl.Attributes(POSITION=buffer.add_morph(morph[seams.source].astype("f4")))
        for morph in animation.morphs
    ]
    primitive.targets = targets
    extras = {"targetNames": list(animation.morph_names)} if targets else {}
    return gl.Mesh(name="body", primitives=[primitive], weights=[0.0] * len(targets), extras=extras)


def _influences(animation: Animation) -> list[tuple[np.ndarray, np.ndarray]]:
    """Joint indices and weights in groups of four, heaviest first; weights of a vertex sum to one
    in float32.
    """
    given = animation.body.skinning_index
    count = len(animation.body.parents)
    dense = np.zeros((len(given), count))
    np.add.at(
        dense, (np.arange(len(given))[:, None], given), animation.body.skinning_value
    )  # no joint twice
    index = np.argsort(-dense, axis=1, kind="stable")[:, : given.shape[1]]
    value = np.take_along_axis(dense, index, axis=1)
    value = (value / value.sum(axis=1, keepdims=True)).astype("f4")
    value[:, 0] = 1.0 - value[:, 1:].sum(axis=1, dtype=np.float64)
    index = np.where(value > 0, index, 0)
    padding = ((0, 0), (0, -value.shape[1] % 4))
    index = np.pad(index, padding)
    value = np.pad(value, padding)
    small = "u1" if count <= 256 else "u2"
    return [
        (index[:, k : k + 4].astype(small), value[:, k : k + 4])
        for k in range(0, value.shape[1], 4)
    ]


def _skin(animation: Animation, buffer: GltfBuffer) -> gl.Skin:
    joints = len(animation.body.parents)
    inverse = np.tile(np.eye(4, dtype="f4"), (joints, 1, 1))
    inverse[:, 3, :3] = -animation.rest_joints  # glTF matrices are column-major
    bind = buffer.add(inverse.reshape(joints, 16), gl.MAT4)
    return gl.Skin(
        name="skeleton", joints=list(range(joints)), skeleton=0, inverseBindMatrices=bind
    )


def _tracks(animation: Animation, buffer: GltfBuffer, name: str) -> gl.Animation:
    motion = animation.tracks[0]
    frames, joints = motion.quaternions.shape[:2]
    joints_move = np.ptp(motion.joint_translations[:, 1:], axis=0).max(initial=0.0) > 0
    times = buffer.add((np.arange(frames) / animation.rate_hz).astype("f4"), gl.SCALAR, bounds=True)
    tracks = gl.Animation(name=name, samplers=[], channels=[])

    def track(node: int, path: str, values: np.ndarray, kind: str) -> None:
        tracks.samplers.append(
            gl.AnimationSampler(
                input=times, output=buffer.add(values, kind), interpolation="LINEAR"
            )
        )
        target = gl.AnimationChannelTarget(node=node, path=path)
        tracks.channels.append(gl.AnimationChannel(sampler=len(tracks.samplers) - 1, target=target))

    quaternions = unit_float32(motion.quaternions)
    translations = motion.joint_translations.astype("f4")
    for joint in range(joints):
        track(joint, "rotation", quaternions[:, joint], gl.VEC4)
        if joint == 0 or joints_move:
            track(joint, "translation", translations[:, joint], gl.VEC3)
    if motion.morph_weights.shape[1]:
        track(joints, "weights", motion.morph_weights.astype("f4"), gl.SCALAR)
    return tracks
