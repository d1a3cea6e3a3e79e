"""The motion in an FBX file: one take, a key a frame for what moves, straight lines between
them.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.export.animation import Animation
from habitus.export.euler import continuous_angles
from habitus.export.fbx.body import CM
from habitus.export.fbx.nodes import Node, Packed, packed
from habitus.export.fbx.scene import Objects, prop, props, ticks

_LINEAR = 0x6104
"""Straight lines, as other programs flag them."""
_STILL = 1e-7


class Curves:
    """A layer of one take, and curves on it that share their times."""

    def __init__(self, objects: Objects, take: str, frames: int, rate_hz: float) -> None:
        times = ticks(np.arange(frames), rate_hz)
        span = (("LocalStart", times[0]), ("LocalStop", times[-1]), ("ReferenceStart", times[0]))
        named = (
            prop(name, "KTime", "Time", "", at)
            for name, at in (*span, ("ReferenceStop", times[-1]))
        )
        stack = objects.add("AnimationStack", take, "", [props(*named)], "AnimStack")
        self.objects = objects
        self.layer = objects.add("AnimationLayer", "BaseLayer", "", (), "AnimLayer")
        objects.link(self.layer, stack)
        self._times: Packed = packed(times)
        linear = np.array([0.0, 0.0, 9.419963346924634e-30, 0.0], np.float32)
        self._attributes = (
            Node("KeyAttrFlags", (np.array([_LINEAR], np.int32),)),
            Node("KeyAttrDataFloat", (linear,)),
            Node("KeyAttrRefCount", (np.array([frames], np.int32),)),
        )

    def add(
        self,
        target: np.int64,
        name: str,
        short: str,
        parts: Sequence[str],
        values: Float[np.ndarray, "T n"],
        rest: Float[np.ndarray, " n"],
    ) -> None:
        """Move the property ``name`` of an object; nothing is added where it stays as it rests."""
        if np.abs(values - rest).max() < _STILL:
            return
        told = (
            prop(f"d|{part}", "Number", "", "A", float(value))
            for part, value in zip(parts, rest, strict=True)
        )
        node = self.objects.add("AnimationCurveNode", short, "", [props(*told)], "AnimCurveNode")
        self.objects.link(node, self.layer)
        self.objects.link(node, target, name)
        for part, column, value in zip(parts, values.T, rest, strict=True):
            keys = (
                Node("KeyTime", (self._times,)),
                Node("KeyValueFloat", (column.astype(np.float32),)),
            )
            nodes = [
                Node("Default", (float(value),)),
                Node("KeyVer", (4009,)),
                *keys,
                *self._attributes,
            ]
            curve = self.objects.add("AnimationCurve", "", "", nodes, "AnimCurve")
            self.objects.link(curve, node, f"d|{part}")


def add_motion(
    objects: Objects,
    animation: Animation,
    take: str,
    limbs: Sequence[np.int64],
    channels: Sequence[np.int64],
) -> None:
    """One take: joints turn and, where shape moves them, move; blend channels rise and fall."""
    track = animation.tracks[0]
    curves = Curves(objects, take, len(track.quaternions), animation.rate_hz)
    local = animation.skeleton.local_rest
    angles = continuous_angles(_from_rest(track.quaternions, local[:, :3, :3]), "xyz")
    places = CM * track.joint_translations
    for bone, limb in enumerate(limbs):
        rest = CM * local[bone, :3, 3]
        curves.add(limb, "Lcl Translation", "T", "XYZ", places[:, bone], rest)
        curves.add(limb, "Lcl Rotation", "R", "XYZ", angles[:, bone], np.zeros(3))
    for channel, weights in zip(channels, track.morph_weights.T, strict=True):
        percent = 100.0 * weights[:, None]
        curves.add(
            channel, "DeformPercent", "DeformPercent", ["DeformPercent"], percent, np.zeros(1)
        )


def _from_rest(
    quaternions: Float[np.ndarray, "T N 4"], rest: Float[np.ndarray, "N 3 3"]
) -> Float[np.ndarray, "T N 4"]:
    """How bones are turned after their PreRotation."""
    if np.array_equal(rest, np.broadcast_to(np.eye(3), rest.shape)):
        return quaternions
    before = Rotation.from_matrix(rest).inv().as_quat()
    turns = Rotation.from_quat(np.tile(before, (len(quaternions), 1, 1)).reshape(-1, 4))
    return (
        (turns * Rotation.from_quat(quaternions.reshape(-1, 4)))
        .as_quat()
        .reshape(quaternions.shape)
    )
