"""habitus: the state of the human body (shape, pose, soft tissue), estimated by inverting forward
models.

```python
import habitus as hb

body = hb.load_body("default")
fit = hb.Mosh(layout="auto").fit("walk.c3d", body)
fit.vertices(10), fit.joints(), fit.errors_mm
fit.save("results/walk")
```

`habitus.mosh("walk.c3d", "results")` does what the command ``habitus mosh walk.c3d --out results``
does. Lengths are metres, angles radians, and a capture keeps its own world frame; the project's
``docs/conventions.md`` has the rest.
"""

import sys

from habitus.errors import HabitusError, TorchIsAnExtra

__version__ = "0.1.0"
__all__ = [
    "BodyModel",
    "Camera",
    "Depth",
    "Fit",
    "FitSettings",
    "HabitusError",
    "Keypoints",
    "Markers",
    "Mosh",
    "MoshWeights",
    "Scan",
    "Term",
    "Trainer",
    "__version__",
    "archive",
    "body_from_measurements",
    "compare",
    "draw",
    "evaluate",
    "exaggerate",
    "export_file",
    "fill_capture",
    "fit_cameras",
    "fit_rgbd",
    "gait",
    "hand_pose",
    "label",
    "live",
    "load_body",
    "load_fit",
    "load_layout",
    "load_motion",
    "minimize",
    "mosh",
    "open_registrations",
    "read_calibration",
    "read_capture",
    "read_detections",
    "read_views",
    "register_scans",
    "register_vertices",
    "retarget",
    "retarget_to_character",
    "retarget_to_robot",
    "save_body",
    "select_markers",
    "select_poses",
    "simulate_soft_tissue",
    "split_people",
    "terms",
    "train",
    "train_dynamics",
    "virtual_markers",
    "write_surface",
    "write_trc",
]

_MODULES = {
    "BodyModel": "habitus.body.model",
    "Camera": "habitus.observe.camera",
    "Depth": "habitus.jobs.sensors",
    "Fit": "habitus.jobs.sensors",
    "FitSettings": "habitus.fit.body_fit",
    "Keypoints": "habitus.jobs.sensors",
    "Markers": "habitus.jobs.sensors",
    "Mosh": "habitus.jobs.mosh",
    "MoshWeights": "habitus.fit.markers.settings",
    "Scan": "habitus.jobs.sensors",
    "Term": "habitus.solve.terms",
    "Trainer": "habitus.jobs.train",
    "archive": "habitus.jobs.archive.run",
    "body_from_measurements": "habitus.jobs.estimates",
    "compare": "habitus.jobs.comparing",
    "draw": "habitus.render.draw",
    "evaluate": "habitus.jobs.evaluate",
    "exaggerate": "habitus.jobs.motions",
    "export_file": "habitus.jobs.exporting",
    "fill_capture": "habitus.jobs.virtual_markers",
    "fit_cameras": "habitus.jobs.cameras",
    "fit_rgbd": "habitus.jobs.rgbd",
    "gait": "habitus.jobs.gait",
    "hand_pose": "habitus.body.hands",
    "label": "habitus.jobs.label",
    "live": "habitus.jobs.live",
    "load_body": "habitus.io.models.bodies",
    "load_fit": "habitus.jobs.results",
    "load_layout": "habitus.io.layouts.files",
    "load_motion": "habitus.jobs.results",
    "minimize": "habitus.solve.minimize",
    "mosh": "habitus.jobs.mosh",
    "open_registrations": "habitus.io.registrations.open",
    "read_calibration": "habitus.io.cameras.read",
    "read_detections": "habitus.io.keypoints.read",
    "read_capture": "habitus.io.captures.read",
    "register_scans": "habitus.jobs.register",
    "register_vertices": "habitus.jobs.topologies",
    "read_views": "habitus.io.rgbd.read",
    "retarget": "habitus.jobs.motions",
    "retarget_to_character": "habitus.jobs.characters",
    "retarget_to_robot": "habitus.jobs.robots",
    "save_body": "habitus.io.models.bodies",
    "select_markers": "habitus.jobs.selection",
    "select_poses": "habitus.jobs.selection",
    "simulate_soft_tissue": "habitus.body.soft_tissue",
    "split_people": "habitus.fit.points.people_in_view",
    "terms": "habitus.residuals.terms",
    "train": "habitus.jobs.train",
    "train_dynamics": "habitus.jobs.train_dynamics",
    "virtual_markers": "habitus.jobs.virtual_markers",
    "write_surface": "habitus.body.surface_files",
    "write_trc": "habitus.export.trc",
}
_WHOLE_MODULES = {"terms"}


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> object:
    """Load a name of the public face when it is first asked for: ``import habitus`` alone costs
    nothing.
    """
    if name not in _MODULES:
        raise AttributeError(
            f"module 'habitus' has no attribute {name!r}{_did_you_mean(name)}", name=name
        )
    from importlib import import_module

    with TorchIsAnExtra(f"habitus.{name}"):
        module = import_module(_MODULES[name])
    value = module if name in _WHOLE_MODULES else getattr(module, name)
    globals()[name] = value
    return value


class _PublicFace(type(sys)):
    """Keeps `habitus.evaluate` and `habitus.gait` functions when the packages of these names are
    imported, which would take their place.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _MODULES and name not in _WHOLE_MODULES and isinstance(value, type(sys))):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _PublicFace


def _did_you_mean(name: str) -> str:
    if name.startswith("_"):
        return ""
    from difflib import get_close_matches

    near = get_close_matches(name, __all__, n=1)
    return (
        f"; did you mean {near[0]!r}?"
        if near
        else f"; there are {', '.join(n for n in __all__ if n[0] != '_')}"
    )
