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
    body = animation.body
    names = animation.body.joint_names
    joints = [
        {"name": name, "parent": "" if parent < 0 else names[parent], "rest": _short(place)}
        for name, parent, place in zip(names, body.parents, animation.rest_joints, strict=True)
    ]
    driven = animation.morph_drivers
    edition = FOLDS if driven.folds.any() else LINEAR
    channels = []
    for k in np.flatnonzero(driven.live):
        name = animation.morph_names[k]
        channel = {"name": name, "joint": _joint(name, names), "row": _short(driven.rows[k])}
        if edition == FOLDS:
            channel |= {"bias": _short(driven.bias[[k]])[0], "power": float(driven.power[k])}
        channels.append(channel)
    return {
        "format": FORMAT,
        "version": edition,
        "body": body.name,
        "joints": joints,
        "channels": channels,
    }


def _joint(channel: str, names: tuple[str, ...]) -> str:
    """The joint that a channel's name begins with: "left_knee" of "left_knee_01_back"."""
    return max((name for name in names if channel.startswith(f"{name}_")), key=len)


def _short(values: np.ndarray) -> list[float]:
    return [float(f"{value:.8g}") for value in values]
