# SPDX-License-Identifier: Apache-2.0
"""habitus in Unreal's editor (5.0 and later, plug-ins Python Editor Script and Editor Scripting
Utilities).

    import habitus_unreal
    habitus_unreal.import_person("C:/walk.fbx", "/Game/People")  # mesh, skeleton, morph targets, take
    habitus_unreal.bake("/Game/dance", "C:/walk.correctives.json", "/Game/People/walk")  # another motion of it

`bake` writes the weights of the pose blend shapes into an animation as curves that are called like
the morph targets, so that skin bulges in any motion: of another take, retargeted, or keyed by hand.
It is an editor's script: it runs once for an animation, not in the game.
"""

import os

import unreal
from habitus_correctives import Correctives, from_quaternions


def import_person(path, folder, skeleton=None):
    """Import an .fbx of habitus export; paths of what was made come back.

    The capture's own rate is kept. skeleton: path of one that is there already, whose animations it
    shall share. Raises ValueError where nothing was imported.
    """
    options = unreal.FbxImportUI()
    chosen = {
        "automated_import_should_detect_type": False,
        "mesh_type_to_import": unreal.FBXImportType.FBXIT_SKELETAL_MESH,
        "original_import_type": unreal.FBXImportType.FBXIT_SKELETAL_MESH,
        "import_mesh": True,
        "import_as_skeletal": True,
        "import_animations": True,
        "create_physics_asset": False,
    }
    for name, value in chosen.items():
        options.set_editor_property(name, value)
    if skeleton:
        options.set_editor_property("skeleton", unreal.load_asset(skeleton))
    mesh = options.get_editor_property("skeletal_mesh_import_data")
    for name, value in {
        "import_morph_targets": True,
        "convert_scene": True,
        "convert_scene_unit": True,
    }.items():
        mesh.set_editor_property(name, value)
    motion = options.get_editor_property("anim_sequence_import_data")
    for name, value in {
        "use_default_sample_rate": False,
        "custom_sample_rate": 0,
        "convert_scene": True,
    }.items():
        motion.set_editor_property(name, value)
    task = unreal.AssetImportTask()
    for name, value in {
        "filename": os.path.abspath(path),
        "destination_path": folder,
        "options": options,
        "automated": True,
        "replace_existing": True,
        "save": True,
    }.items():
        task.set_editor_property(name, value)
    unreal.AssetToolsHelpers.get_asset_tools().import_asset_tasks([task])
    found = [str(each) for each in task.get_editor_property("imported_object_paths")]
    if not found:
        raise ValueError(f"{path}: nothing was imported; the editor's log says why")
    return found


def bake(animation, path, mesh):
    """Write the weights of pose blend shapes into an animation as curves; the number of curves
    comes back.

    animation, mesh: paths of an animation sequence and of a skeletal mesh of habitus export; path:
    its .correctives.json. Curves of these names are replaced; those that stay below a thousandth
    are left out. Raises ValueError where these do not belong together.
    """
    with open(path, encoding="utf-8") as file:
        told = Correctives(file.read())
    sequence, body = unreal.load_asset(animation), unreal.load_asset(mesh)
    for asset, name in ((sequence, animation), (body, mesh)):
        if asset is None:
            raise ValueError(f"there is no {name}")
    library, poses = unreal.AnimationLibrary, unreal.AnimPoseExtensions
    options = unreal.AnimPoseEvaluationOptions()
    options.set_editor_property("optional_skeletal_mesh", body)
    count = max(2, library.get_num_frames(sequence) + 1)
    times = [sequence.get_play_length() * k / (count - 1) for k in range(count)]
    weights, axes = [], None
    for time in times:
        pose = poses.get_anim_pose_at_time(sequence, time, options)
        if axes is None:
            axes = told.axes(_rests(told, pose))
        weights.append(told.weights(_turns(told, pose), axes))
    written = 0
    for channel, name in enumerate(told.channels):
        if library.does_curve_exist(sequence, name, unreal.RawCurveTrackTypes.RCT_FLOAT):
            library.remove_curve(sequence, name)
        values = [each[channel] for each in weights]
        if max(values) > 1e-3:
            library.add_curve(sequence, name, unreal.RawCurveTrackTypes.RCT_FLOAT, False)
            library.add_float_curve_keys(sequence, name, times, values)
            written += 1
    unreal.EditorAssetLibrary.save_loaded_asset(sequence)
    return written


def _known(told, pose):
    names = {str(name) for name in unreal.AnimPoseExtensions.get_bone_names(pose)}
    return [name for name in told.joints if name in names]


def _rests(told, pose):
    found = {}
    for name in _known(told, pose):
        place = unreal.AnimPoseExtensions.get_ref_bone_pose(
            pose, name, unreal.AnimPoseSpaces.WORLD
        ).translation
        found[name] = (place.x, place.y, place.z)
    return found


def _turns(told, pose):
    found, space = {}, unreal.AnimPoseSpaces.WORLD
    for name in _known(told, pose):
        rest = unreal.AnimPoseExtensions.get_ref_bone_pose(pose, name, space).rotation
        now = unreal.AnimPoseExtensions.get_bone_pose(pose, name, space).rotation
        found[name] = from_quaternions(
            (rest.x, rest.y, rest.z, rest.w), (now.x, now.y, now.z, now.w)
        )
    return found
