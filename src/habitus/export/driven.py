"""How bones drive a file's blend shapes, as JSON beside it: for Unity, Maya, Unreal and scripts of
any program.

The weight of a channel is ``clip(row . vec(R - I) - bias, 0, 1) ^ power``; R is the rotation of its
joint against its parent, both counted from rest, in the body's axes, x to its left, y up, z
forward; rows of R first. It holds for every pose, not only for those of the file's motion. Edition
1 has no bias and no power, which are 0 and 1 then: bodies without folds have it.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.export.animation import Animation
from habitus.files import atomic_write

FORMAT = "habitus-correctives"
LINEAR, FOLDS = 1, 2
"""Editions: without and with ``bias`` and ``power``."""
ENDING = ".correctives.json"


def write_drivers(animation: Animation, beside: str | os.PathLike[str]) -> Path | None:
    """Write ``walk.correctives.json`` beside ``walk.fbx``, atomically; nothing where no joint
    drives a blend shape.

    animation: as a file has it (`habitus.export.animation.one_sided`). Its path comes back. Raises
    HabitusError where it cannot be written.
    """
    if not animation.morph_drivers.live.any():
        return None
    path = Path(beside).with_suffix(ENDING)
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(drivers(animation), indent=1), encoding="utf-8")
    return path


def drivers(animation: Animation) -> Mapping[str, Any]:
    """The joints with where they rest (m), and the channels that joints drive, in the file's
    order.
    """
    body, skeleton = animation.body, animation.skeleton
    names = tuple(skeleton.names[bone] for bone in skeleton.own)
    joints = [
        {"name": name, "parent": "" if parent < 0 else names[parent], "rest": _short(place)}
        for name, parent, place in zip(names, body.parents, animation.rest_joints, strict=True)
    ]
    driven = animation.morph_drivers
    live = np.flatnonzero(driven.live)
    joint = [_joint(animation.morph_names[k], body.joint_names) for k in live]
    rows, bias = _from_rest(animation, driven.rows[live], driven.bias[live], joint)
    edition = FOLDS if driven.folds.any() or bias.any() else LINEAR
    channels = []
    for k, of, row, less in zip(live, joint, rows, bias, strict=True):
        channel = {"name": animation.morph_names[k], "joint": names[of], "row": _short(row)}
        if edition == FOLDS:
            channel |= {"bias": _short(less[None])[0], "power": float(driven.power[k])}
        channels.append(channel)
    return {
        "format": FORMAT,
        "version": edition,
        "body": body.name,
        "joints": joints,
        "channels": channels,
    }


def _joint(channel: str, names: tuple[str, ...]) -> int:
    """The joint that a channel's name begins with: "left_knee" of "left_knee_01_back"."""
    return names.index(max((name for name in names if channel.startswith(f"{name}_")), key=len))


def _from_rest(
    animation: Animation,
    rows: Float[np.ndarray, "K 9"],
    bias: Float[np.ndarray, " K"],
    joints: list[int],
) -> tuple[Float[np.ndarray, "K 9"], Float[np.ndarray, " K"]]:
    """Rows and biases for rotations counted from the file's rest pose, not from the zero pose.

    With joints that rest turned by Q and parents by P, L of the zero pose is P^T R Q.
    """
    turned, parents = animation.skeleton.turned, animation.body.parents
    still = np.broadcast_to(np.eye(3), turned.shape)
    if np.array_equal(turned, still):
        return rows, bias
    own = turned[joints]
    above = np.where(
        np.array(parents)[joints, None, None] < 0, np.eye(3), turned[np.array(parents)[joints]]
    )
    moved = (above @ rows.reshape(-1, 3, 3) @ own.transpose(0, 2, 1)).reshape(-1, 9)
    unit = np.eye(3).reshape(-1)
    return moved, bias + rows @ unit - moved @ unit


def _short(values: np.ndarray) -> list[float]:
    return [float(f"{value:.8g}") for value in values]
