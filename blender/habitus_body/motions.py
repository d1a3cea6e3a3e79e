# SPDX-License-Identifier: GPL-3.0-or-later
"""Motions on a person's bones: keyed from a file, read back from whatever moves the bones, and
their soft tissue.
"""

import bpy
import numpy as np
from mathutils import Matrix

from .bones import rest_quaternion
from .core import Motion, quaternions, rotation_vectors
from .person import TISSUE, UPRIGHT, body_of, points_of
from .tissue import simulated

_UNIT = 10.0
"""Coefficients in a shape key's 1: Blender cuts off what is above 10 of them."""


def animate(context, person, motion: Motion):
    """Key a motion on the person's bones, a key a frame from frame 1 on, at the scene's new
    rate.
    """
    armature, frames, names = person.parent, len(motion.pose), body_of(person).joint_names
    context.scene.render.fps = max(1, round(motion.rate))
    context.scene.render.fps_base = context.scene.render.fps / motion.rate
    context.scene.frame_start, context.scene.frame_end = 1, frames
    armature.matrix_world = Matrix((np.array(UPRIGHT.to_3x3()) @ motion.upright).tolist()).to_4x4()
    curves, times = (
        add_curves(armature, motion.name, "OBJECT"),
        np.arange(1, frames + 1, dtype=np.float32),
    )
    for joint, name in enumerate(names):
        values = _in_bone(quaternions(motion.pose[:, joint]), armature.pose.bones[name])
        flips = np.cumsum((values[1:] * values[:-1]).sum(-1) < 0) % 2
        values[1:][flips == 1] *= -1
        for part in range(4):
            key_curve(
                curves, f'pose.bones["{name}"].rotation_quaternion', part, times, values[:, part]
            )
    rest = np.array(armature.pose.bones[names[0]].bone.matrix_local.to_3x3())
    trans = motion.trans @ rest
    for part in range(3):
        key_curve(curves, f'pose.bones["{names[0]}"].location', part, times, trans[:, part])
    if motion.dynamics is not None and "dynamics_drive" in body_of(person).arrays:
        key_tissue(person, motion.dynamics, times)
    context.scene.frame_set(1)


def add_markers(context, person, arrays):
    """Markers of a fit as empties, keyed where they were seen; their parent, which stands as the
    person, comes back.

    arrays: those of the fit's body.npz. None where it holds no markers.
    """
    if "markers_obs" not in arrays:
        return None
    parent = bpy.data.objects.new("markers", None)
    context.collection.objects.link(parent)
    parent.matrix_world = person.parent.matrix_world
    for label, course in zip(
        arrays["labels_obs"], np.moveaxis(arrays["markers_obs"], 1, 0), strict=True
    ):
        marker = bpy.data.objects.new(str(label), None)
        marker.empty_display_type, marker.empty_display_size = "SPHERE", 0.01
        context.collection.objects.link(marker)
        marker.parent = parent
        seen = np.flatnonzero(np.isfinite(course).all(1))
        curves = add_curves(marker, f"marker {label}", "OBJECT") if len(seen) else None
        for part in range(3) if len(seen) else ():
            key_curve(curves, "location", part, (seen + 1).astype(np.float32), course[seen, part])
    context.scene.frame_set(1)
    return parent


def recorded(context, person) -> tuple:
    """The motion of the scene's frames: pose (T, J, 3; rad), trans (T, 3; m), frames' numbers, and
    their rate (Hz).

    In Blender's world, z up, whatever moves bones and armature: keys, constraints, drivers.
    """
    scene, armature = context.scene, person.parent
    names, frames = body_of(person).joint_names, np.arange(scene.frame_start, scene.frame_end + 1)
    root = body_of(person).joints(np.array(person.habitus_betas), person.habitus_age)[0]
    before, turns, trans = scene.frame_current, [], []
    for frame in frames:
        scene.frame_set(int(frame))
        posed = armature.evaluated_get(context.evaluated_depsgraph_get())
        whole = [(posed.matrix_world @ posed.pose.bones[name].matrix) for name in names]
        worlds = np.array(
            [
                each.to_quaternion() @ rest_quaternion(posed.pose.bones[name]).inverted()
                for each, name in zip(whole, names, strict=True)
            ]
        )
        turns.append(
            [
                _against(worlds, joint, parent)
                for joint, parent in enumerate(body_of(person).parents)
            ]
        )
        trans.append(np.array(whole[0].translation) - root)
    scene.frame_set(before)
    rate = scene.render.fps / scene.render.fps_base
    return rotation_vectors(np.array(turns)), np.array(trans), frames, rate


def _in_bone(turns, bone):
    """Turns (T, 4; w first) in the body's axes as those of a bone, which rests turned."""
    rest = np.array(rest_quaternion(bone))
    return _product(_product(rest * [1, -1, -1, -1], turns), rest)


def _against(worlds, joint, parent):
    """A joint's turn against its parent (w first)."""
    if parent < 0:
        return worlds[joint]
    return _product(worlds[parent] * [1, -1, -1, -1], worlds[joint])


def _product(first, second):
    """Quaternions (..., 4; w first) one after the other."""
    (a, b, c, d), (w, x, y, z) = np.moveaxis(first, -1, 0), np.moveaxis(second, -1, 0)
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def write_motion(context, person, path):
    """The scene's frames as an npz under AMASS's names, which habitus reads. The number of frames
    comes back.
    """
    pose, trans, _, rate = recorded(context, person)
    model = body_of(person)
    arrays = {
        "poses": pose.reshape(len(pose), -1),
        "trans": trans,
        "betas": np.array(person.habitus_betas)[: model.num_betas],
        "mocap_framerate": np.array(rate),
        "surface_model_type": np.array(model.name),
        "gender": np.array(model.name if model.name in ("female", "male") else "neutral"),
        "joint_names": np.array(model.joint_names),
        "up_axis": np.array("+z"),
        "made": np.array(["written by Blender"]),
    }
    if person.habitus_age > 0 and len(model.ages):
        arrays["age_years"] = np.array(
            float(np.clip(person.habitus_age, model.ages[0], model.ages[-1]))
        )
    np.savez(path, **arrays)
    return len(pose)


def simulate(context, person, strength):
    """Soft tissue of the scene's frames, keyed. Raises ValueError for bodies without any and for
    slow rates.
    """
    pose, trans, frames, rate = recorded(context, person)
    coefficients = simulated(
        body_of(person),
        np.array(person.habitus_betas),
        person.habitus_age,
        pose,
        trans,
        rate,
        strength,
    )
    key_tissue(person, coefficients, frames.astype(np.float32))


def key_tissue(person, coefficients, times):
    """Shape keys of soft tissue with their coefficients (T, D) keyed, in the place of those that
    were there.
    """
    model = body_of(person)
    clear_tissue(person)
    directions = model.grown(person.habitus_age)[1] * model.arrays["dynamics_directions"]
    keys = person.data.shape_keys
    rest, curves = points_of(keys.key_blocks["Basis"]), add_curves(keys, "soft tissue", "KEY")
    for k, column in enumerate(np.asarray(coefficients, np.float64).T):
        key = person.shape_key_add(name=f"{TISSUE}{k + 1}", from_mix=False)
        key.data.foreach_set("co", (rest + _UNIT * directions[..., k]).astype(np.float32).ravel())
        key.slider_min, key.slider_max = -10.0, 10.0
        key_curve(curves, f'key_blocks["{key.name}"].value', None, times, column / _UNIT)


def clear_tissue(person):
    """Without the shape keys of soft tissue."""
    for key in list(person.data.shape_keys.key_blocks):
        if key.name.startswith(TISSUE):
            person.shape_key_remove(key)
    person.data.shape_keys.animation_data_clear()


def add_curves(thing, name, kind):
    """The curves of a new action, in old Blenders and in those whose actions have layers and
    slots.
    """
    action = bpy.data.actions.new(name)
    data = thing.animation_data_create()
    data.action = action
    if hasattr(action, "fcurves"):
        return action.fcurves
    slot = action.slots.new(kind, thing.name)
    data.action_slot = slot
    return (
        action.layers.new("motion")
        .strips.new(type="KEYFRAME")
        .channelbag(slot, ensure=True)
        .fcurves
    )


def key_curve(curves, path, part, times, values):
    """One curve of values (T,) at frames (T,), straight lines between them; ``part`` of a vector,
    or None.
    """
    curve = curves.new(path) if part is None else curves.new(path, index=part)
    curve.keyframe_points.add(len(times))
    curve.keyframe_points.foreach_set("co", np.stack([times, values], 1).astype(np.float32).ravel())
    curve.keyframe_points.foreach_set(
        "interpolation", np.ones(len(times), np.int32)
    )  # straight lines
    curve.update()
