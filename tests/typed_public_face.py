"""What typed programs do with the public face: `make types` reads it with mypy, strictly; nobody
runs it.
"""

from pathlib import Path
from typing import Any, assert_type

import numpy as np

import habitus as hb
from habitus.body.anatomical_angles import AngleTable
from habitus.body.model import BodyModel
from habitus.io.captures.read import Capture
from habitus.jobs.comparing import Comparison
from habitus.jobs.gait import GaitResult
from habitus.jobs.results import MarkerResult, Motion
from habitus.markers.layouts import MarkerLayout
from habitus.observe.camera import Camera


def bodies() -> None:
    body = hb.load_body("default")
    hb.save_body(body, "SMPL_NEUTRAL.pkl", shape_directions=300)
    assert_type(body, BodyModel)
    surface = body(betas=[1.5], pose={"left_elbow": (0, -1.2, 0)})
    surface.export("posed.ply")
    assert_type(body.measure(surface)["height_m"], float)
    hb.write_surface(surface, Path("posed.glb"))
    person = hb.body_from_measurements(height=1.7, weight=60.0)
    print(person.measurements["waist_circumference_m"] + 0.1)


def markers(body: BodyModel) -> None:
    capture = hb.read_capture("walk.c3d")
    assert_type(capture, Capture)
    assert_type(hb.load_layout("cmu-41"), MarkerLayout)
    mosh = hb.Mosh(layout="auto", weights=hb.MoshWeights(surface=50))
    fit = mosh.fit(capture, body, progress=tell)
    assert_type(fit, MarkerResult)
    assert_type(fit.vertices(10), np.ndarray[tuple[Any, ...], np.dtype[Any]])
    assert_type(fit.verdict.level, str)
    assert_type(fit.guessed.spread, np.ndarray[tuple[Any, ...], np.dtype[Any]])
    print(fit.errors_mm.mean(), fit.joints(range(3)), [suspect.label for suspect in fit.suspects])
    fit.save("results/walk")
    fit.export("walk.fbx", fps=30)
    live = mosh.start(capture[:200], body)
    print(live.step(capture.markers[200]).trans)
    assert_type(mosh.fit([capture, capture], body), list[MarkerResult])
    assert_type(hb.mosh("walk.c3d", "results", soft_tissue=False), list[MarkerResult])
    assert_type(hb.compare(fit, "other/walk", out="compared"), Comparison)
    hb.write_trc(capture, "walk.trc")


def tell(stage: str, share: float) -> None:
    print(stage, share)


def motions(fit: MarkerResult) -> None:
    motion = hb.load_motion("results/walk/body.npz")
    assert_type(motion, Motion)
    assert_type(hb.load_fit("results/walk/body.npz"), MarkerResult)
    hb.export_file(motion, "walk.fbx")
    assert_type(fit.angles("isb"), AngleTable)
    assert_type(hb.gait(fit, "walk.c3d", mass=70.0), GaitResult)
    hb.exaggerate(fit, 2.0)
    hb.export_file(motion, "walk.npz", topology="smplx")
    print(hb.export_file(motion, "walk.npz", model="SMPLX_NEUTRAL.npz").error_mm)
    print(hb.register_vertices("her.npz", "smplx", own_surface=True).verdict)
    hb.retarget(fit, "female")
    print(hb.retarget_to_character(fit, "character.glb", out="moved.glb").slip)
    hb.retarget_to_robot(fit, "g1.xml", out="g1.npz").save("g1.csv")
    hb.simulate_soft_tissue(fit.body, fit.betas, fit.pose, fit.trans, fit.rate_hz)
    hb.virtual_markers(fit, "cmu-41")
    hb.fill_capture(fit, "walk.c3d", "filled.c3d")


def selections() -> None:
    hb.select_markers(pool=114, start="mosh-47", keep=(25,))
    hb.select_poses(layout="mosh-47", count=5)
    assert_type(hb.label("walk.c3d", layout="cmu-41").capture(), Capture)
    hb.live("natnet", out="results")
    hb.archive("captures", "results")


def scans_and_images() -> None:
    (scan,) = hb.register_scans(["anna.ply"], "default")
    print(scan.verdict, scan.vertices.shape)
    hb.register_scans(["anna.ply", "anna_up.ply"], "default", texture=True)
    hb.fit_rgbd(hb.read_views("views"), hb.load_body("default"))
    rig = hb.read_calibration("Calib.toml")
    for person_fit in hb.fit_cameras(hb.read_detections("pose", 60.0), rig, people="auto"):
        print(person_fit.verdict, person_fit.vertices(0).shape)
    for person in hb.split_people(hb.read_views("views")):
        hb.fit_rgbd(person)
    fingers = hb.load_body("default", joints="smplh")
    fingers(pose=hb.hand_pose(fingers, "fist", ("left",), amount=0.5))


def models() -> None:
    trained = hb.Trainer(skinning="lbs").fit(
        hb.open_registrations("people.npz"), template="default"
    )
    print(trained)
    hb.train(["people.npz"], "trained", template="template.npz")
    hb.train_dynamics(["people.npz"], "moving", body="default")
    hb.evaluate(["model.npz"], "people.npz", out="measured")


def images(vertices: np.ndarray, faces: np.ndarray) -> None:
    camera = hb.Camera.of(640, 480)
    assert_type(camera, Camera)
    frame = hb.draw(camera, vertices, faces)
    print(frame.image(vertices).shape, frame.depth().shape)


def inversion(body: hb.BodyModel) -> None:
    rest = hb.Term(lambda x: x - np.ones(3), weight=2.0)
    found = hb.minimize({"rest": rest}, {"x": np.zeros(3)}, max_iterations=5)
    hb.minimize({"pose": lambda pose: pose.ravel()}, body.state(), fixed=["betas"])
    print(found.values["x"], hb.terms.PosePrior, body.name)


def errors() -> str:
    try:
        hb.load_body("nobody")
    except hb.HabitusError as error:
        return f"{hb.__version__}: {error}"
    return ""


def keypoints(body: hb.BodyModel) -> None:
    cameras = hb.Keypoints("pose", "Calib.toml", fps=60, delay=0.5)
    fit = hb.Fit(body, [hb.Markers("walk.c3d"), cameras]).solve()
    print(fit.residuals_mm, fit.results[0].verdict)


def sensors(body: hb.BodyModel, points: np.ndarray) -> None:
    fit = hb.Fit(
        body,
        [hb.Markers("walk.c3d"), hb.Depth("views", frames=(10, 45)), hb.Scan(points)],
        settings=hb.FitSettings(frames=8),
    ).solve()
    print(fit.vertices("frame 10").shape, fit.motion, fit.residuals_mm, fit.measurements)
