"""The few classes of Unreal's editor that habitus_unreal uses, as its Python reference describes
them.
"""

import types
from dataclasses import dataclass, field
from typing import Any


class Editable:
    """An object with editor properties, of which the known ones can be set."""

    known: tuple[str, ...] = ()

    def __init__(self, **given: Any):
        self.held: dict[str, Any] = dict(given)

    def set_editor_property(self, name: str, value: Any) -> None:
        assert name in self.known, f"{type(self).__name__} has no property {name}"
        self.held[name] = value

    def get_editor_property(self, name: str) -> Any:
        return self.held[name]


class FbxMesh(Editable):
    known = ("import_morph_targets", "convert_scene", "convert_scene_unit")


class FbxMotion(Editable):
    known = ("use_default_sample_rate", "custom_sample_rate", "convert_scene")


class FbxImportUI(Editable):
    known = (
        "automated_import_should_detect_type mesh_type_to_import original_import_type import_mesh "
        "import_as_skeletal "
        "import_animations create_physics_asset skeleton"
    ).split()

    def __init__(self):
        super().__init__(skeletal_mesh_import_data=FbxMesh(), anim_sequence_import_data=FbxMotion())


class AssetImportTask(Editable):
    known = ("filename", "destination_path", "options", "automated", "replace_existing", "save")


class AnimPoseEvaluationOptions(Editable):
    known = ("optional_skeletal_mesh",)


@dataclass
class Sequence:
    """An animation: of each of its frames, and at rest, bones' places and quaternions (x, y, z, w)
    in the component.
    """

    names: list[str]
    rest: Any
    frames: Any
    rate: float
    curves: dict[str, Any] = field(default_factory=dict)
    saved: bool = False

    def get_play_length(self) -> float:
        return (len(self.frames) - 1) / self.rate


def module(assets: dict[str, Any], imported: list[Any]) -> types.ModuleType:
    """What `import unreal` finds: assets by their paths, and tasks that an import is given."""
    unreal = types.ModuleType("unreal")
    for each in (FbxImportUI, AssetImportTask, AnimPoseEvaluationOptions):
        setattr(unreal, each.__name__, each)
    unreal.FBXImportType = types.SimpleNamespace(FBXIT_SKELETAL_MESH=1)
    unreal.RawCurveTrackTypes = types.SimpleNamespace(RCT_FLOAT=0)
    unreal.AnimPoseSpaces = types.SimpleNamespace(WORLD=1)
    unreal.load_asset = assets.get

    def import_asset_tasks(tasks: list[AssetImportTask]) -> None:
        imported.extend(tasks)
        for task in tasks:
            found = task.held["filename"].endswith("walk.fbx")
            task.held["imported_object_paths"] = (
                [f"{task.held['destination_path']}/walk"] if found else []
            )

    tools = types.SimpleNamespace(import_asset_tasks=import_asset_tasks)
    unreal.AssetToolsHelpers = types.SimpleNamespace(get_asset_tools=lambda: tools)
    unreal.EditorAssetLibrary = types.SimpleNamespace(
        save_loaded_asset=lambda asset: setattr(asset, "saved", True)
    )
    unreal.AnimationLibrary = _curves()
    unreal.AnimPoseExtensions = _poses()
    return unreal


def _curves() -> types.SimpleNamespace:
    def add_curve(sequence: Sequence, name: str, kind: int, meta: bool) -> None:
        assert name not in sequence.curves and kind == 0 and not meta
        sequence.curves[name] = []

    def add_float_curve_keys(
        sequence: Sequence, name: str, times: list[float], values: list[float]
    ) -> None:
        assert (
            len(times) == len(values)
            and min(times) >= 0
            and max(times) <= sequence.get_play_length() + 1e-9
        )
        sequence.curves[name] += zip(times, values, strict=True)

    return types.SimpleNamespace(
        get_num_frames=lambda sequence: len(sequence.frames) - 1,  # keys between which it plays
        does_curve_exist=lambda sequence, name, kind: name in sequence.curves,
        remove_curve=lambda sequence, name: sequence.curves.pop(name),
        add_curve=add_curve,
        add_float_curve_keys=add_float_curve_keys,
    )


def _poses() -> types.SimpleNamespace:
    def transform(pair: Any, bone: int) -> types.SimpleNamespace:
        places, turns = pair
        place = types.SimpleNamespace(**dict(zip("xyz", places[bone], strict=True)))
        return types.SimpleNamespace(
            translation=place,
            rotation=types.SimpleNamespace(**dict(zip("xyzw", turns[bone], strict=True))),
        )

    def at_time(
        sequence: Sequence, time: float, options: AnimPoseEvaluationOptions
    ) -> tuple[Sequence, int]:
        assert options.held["optional_skeletal_mesh"] is not None
        return sequence, round(time * sequence.rate)

    def bone(pose: tuple[Sequence, int], name: str, space: int) -> types.SimpleNamespace:
        assert space == 1
        return transform(pose[0].frames[pose[1]], pose[0].names.index(name))

    def rest(pose: tuple[Sequence, int], name: str, space: int) -> types.SimpleNamespace:
        assert space == 1
        return transform(pose[0].rest, pose[0].names.index(name))

    return types.SimpleNamespace(
        get_anim_pose_at_time=at_time,
        get_bone_names=lambda pose: pose[0].names,
        get_bone_pose=bone,
        get_ref_bone_pose=rest,
    )
