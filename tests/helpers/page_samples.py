"""What pages are made of, without a fit: a registered scan, a fit to depth views."""

from types import SimpleNamespace

import numpy as np

from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_result import ScanFit
from habitus.io.models.bodies import load_body
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera


def registered(text: str) -> ScanFit:
    """A body that lies 4 mm outside its model, and its own vertices as a scan of it; ``text`` is the
    scan's name and a note.
    """
    body = load_body("default")
    pose = np.zeros((body.num_joints, 3))
    model = np.asarray(body(np.zeros(body.num_betas), pose).vertices)
    normals = vertex_normals(model, body.faces)
    surface = model + 0.004 * normals
    away = np.linspace(0.0, 0.004, len(surface))
    return ScanFit(
        scan_name=text,
        body_name="default",
        body=body,
        betas=np.zeros(body.num_betas),
        pose=pose,
        trans=np.zeros(3),
        vertices=surface,
        model_vertices=model,
        rest_vertices=surface,
        weights=np.linspace(0.0, 1.0, len(surface)),
        cloud=Cloud(surface, normals),
        to_surface=away,
        to_model=away,
        far_from_surface=away,
        matched=1.0,
        lost=0.0,
        rival=None,
        pose_distance=0.5,
        to_body=np.eye(4),
        up_axis="+y",
        notes=(text,),
    )


def depth_fit(text: str) -> tuple[SimpleNamespace, dict]:
    """A body three metres before a camera, which sees a plane there, and the numbers of its page;
    ``text`` is every name in it.
    """
    body = load_body("default")
    pose = np.zeros((1, body.num_joints, 3))
    pose[0, 0, 0] = np.pi  # the camera's y points down
    vertices = np.asarray(body(np.zeros(body.num_betas), pose[0], np.array([0, 0, 3.0])).vertices)
    mask = np.zeros((48, 64), bool)
    mask[4:44, 24:40] = True
    view = SimpleNamespace(name=text, depth=np.where(mask, 3.0, 0.0), colour=None)
    sight = SimpleNamespace(view=view, mask=mask, camera=Camera.of(64, 48), colour_camera=None)
    seen = SimpleNamespace(
        name=text, turn_deg=0.0, median_mm=3.0, noise_mm=2.0, bias_mm=0.5, explained=0.98,
        outside=0.01, overlap=0.95, on_floor=False,
    )  # fmt: skip
    measured = body.measure(np.zeros(body.num_betas))
    fit = SimpleNamespace(
        capture_name=text, body_name=text, body=body, betas=np.zeros(body.num_betas), pose=pose,
        trans=np.array([[0, 0, 3.0]]), prepared_views=[sight], evidence=SimpleNamespace(views=[seen]),
        appearance=None, skin=None, warnings=(text,), measurements=measured,
        vertices=lambda view=None: vertices if view is not None else vertices[None],
    )  # fmt: skip
    numbers = {
        "views": [{"name": text, "explained_fraction": 0.98}],
        "segmentation": text,
        "verdict": {"level": "doubtful", "reasons": [text]},
        "depth_error_mm": {"median": 3.0, "p95": 9.0},
        "stage_seconds": {"read": 1.0},
        "status": text,
        "costs": {text: 1.0, "depth": 2.0},
    }
    return fit, numbers
