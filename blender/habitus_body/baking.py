# SPDX-License-Identifier: GPL-3.0-or-later
"""An FBX of a person in motion: what follows the bones here is keyed, so that other programs show
it, too.
"""

import bpy
import numpy as np

from .core import matrices
from .motions import add_curves, key_curve, recorded
from .person import KEY, TISSUE, body_of, correct, points_of

ENTRIES = [f"{row}{column}" for row in "xyz" for column in "xyz"]


def write_fbx(context, person, path):
    """The scene's frames as FBX; how many blend shapes follow the bones comes back.

    These are the body's own, entry by entry of R - I and fold by fold, called as `habitus export
    --bake-correctives all` calls them, so that a .correctives.json of that drives them in other
    poses.
    """
    if not hasattr(bpy.types, "EXPORT_SCENE_OT_fbx"):
        bpy.ops.preferences.addon_enable(module="io_scene_fbx")
    with _baked(context, person) as names, _selected(context, person, person.parent):
        bpy.ops.export_scene.fbx(
            filepath=path,
            use_selection=True,
            object_types={"ARMATURE", "MESH"},
            add_leaf_bones=False,
            bake_anim_use_nla_strips=False,
            bake_anim_use_all_actions=False,
            bake_anim_simplify_factor=0.0,
        )
        return len(names)


class _baked:
    """A person's correctives as keyed shape keys; live again afterwards."""

    def __init__(self, context, person):
        self.context, self.person, self.keys = context, person, person.data.shape_keys

    def __enter__(self):
        person, blocks = self.person, self.keys.key_blocks
        pose, _, frames, _ = recorded(self.context, person)
        tissue = [key for key in blocks if key.name.startswith(TISSUE)]
        weights = self._values(tissue, frames)
        data = self.keys.animation_data
        self.before = (data.action, getattr(data, "action_slot", None)) if data else None
        rest, tall = points_of(blocks["Basis"]), body_of(person).grown(person.habitus_age)[1]
        person["habitus_baked"] = 1
        blocks[KEY].data.foreach_set("co", rest.ravel())
        curves, self.names = add_curves(self.keys, "baked", "KEY"), []
        model, turned = body_of(person), matrices(pose)
        driven = (*_drivable(model, turned, tall), *_folds(model, person, turned, tall))
        for name, vertices, shape, values in (*driven, *_both_ways(tissue, weights, rest)):
            moved = rest.copy()
            moved[vertices] += shape
            key = person.shape_key_add(name=name, from_mix=False)
            key.data.foreach_set("co", moved.ravel())
            key_curve(
                curves, f'key_blocks["{name}"].value', None, frames.astype(np.float32), values
            )
            self.names.append(name)
        for key in tissue:
            key.value = 0.0
        return self.names

    def _values(self, keys, frames):
        """The weights of shape keys in these frames, (K, T)."""
        if not keys:
            return np.zeros((0, len(frames)))
        values, before = [], self.context.scene.frame_current
        for frame in frames:
            self.context.scene.frame_set(int(frame))
            values.append([key.value for key in keys])
        self.context.scene.frame_set(before)
        return np.array(values).reshape(-1, len(keys)).T

    def __exit__(self, *_):
        baked = self.keys.animation_data.action
        for name in self.names:
            self.person.shape_key_remove(self.keys.key_blocks[name])
        if self.before is None or self.before[0] is None:
            self.keys.animation_data_clear()
        else:
            self.keys.animation_data.action = self.before[0]
            if self.before[1] is not None:
                self.keys.animation_data.action_slot = self.before[1]
        bpy.data.actions.remove(baked)
        del self.person["habitus_baked"]
        self.context.scene.frame_set(self.context.scene.frame_current)
        correct(self.person)


class _selected:
    """These objects alone are selected."""

    def __init__(self, context, *things):
        self.layer, self.things = context.view_layer, things

    def __enter__(self):
        self.before = [thing for thing in self.layer.objects if thing.select_get()]
        for thing in self.layer.objects:
            thing.select_set(thing in self.things)

    def __exit__(self, *_):
        for thing in self.layer.objects:
            thing.select_set(thing in self.before)


def _both_ways(keys, weights, rest):
    """Soft tissue's shape keys forth and back, weights between 0 and 1: other programs cut off what
    is not.
    """
    for key, values in zip(keys, weights, strict=True):
        shape = points_of(key) - rest
        for sign, end in ((1.0, "_forth"), (-1.0, "_back")):
            most = np.maximum(sign * values, 0.0).max(initial=0.0)
            if most > 1e-6:
                yield (
                    key.name + end,
                    slice(None),
                    sign * most * shape,
                    np.maximum(sign * values, 0.0) / most,
                )


def _drivable(model, rotations, tall):
    """Names, vertices, shapes (N, 3) and weights (T,) of the blend shapes that these turns (T, J,
    3, 3) need.
    """
    arrays = model.arrays
    for k, joint in enumerate(model.drivers):
        rows = slice(arrays["pose_start"][k], arrays["pose_start"][k + 1])
        vertices, values = arrays["pose_vertices"][rows], arrays["pose_values"][rows]
        halves = 0.5 * (rotations[:, joint] - np.eye(3)).reshape(-1, 9)
        for entry, end in enumerate(ENTRIES):
            for sign, back in ((1.0, ""), (-1.0, "_back")):
                weights = np.maximum(sign * halves[:, entry], 0.0)
                if len(vertices) and weights.max() > 1e-6:
                    yield (
                        f"{model.joint_names[joint]}_{end}{back}",
                        vertices,
                        2 * sign * tall * values[..., entry],
                        weights,
                    )


def _folds(model, person, rotations, tall):
    """The same of the folds that these turns need."""
    for k, weights in enumerate(model.folded(rotations).T):
        vertices, shape = model.fold(k, np.array(person.habitus_betas))
        if len(vertices) and weights.max() > 1e-6:
            yield str(model.arrays["fold_names"][k]), vertices, tall * shape, weights
