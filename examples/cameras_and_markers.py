"""A made person whom two cameras see and who wears six markers: fitted to the markers, to the
cameras, and to both at once.

python examples/cameras_and_markers.py [SEED]
"""

import sys

import numpy as np
from two_sensors import motion

import habitus as hb
from habitus.io.captures.read import Capture
from habitus.markers.layouts import Marker, MarkerLayout
from habitus_lab.population.camera_scenes import camera_scene

PLACES = ("left_acromion", "right_acromion", "sacrum", "left_knee_lateral", "right_knee_lateral",
          "c7")  # fmt: skip
FRAMES = tuple(range(0, 60, 5))
"""Frames that are solved."""
JOINTS = 22


def main(seed: int = 0) -> dict[str, float]:
    """Mean errors of joints (mm)."""
    rng = np.random.default_rng(seed)
    person, body = hb.load_body("female"), hb.load_body("neutral")
    pose, trans = motion(person, 60, rng)
    scene = camera_scene(person, pose, trans, 50.0, 2, rng)
    surface = person(np.tile(scene.betas, (len(pose), 1)), pose, trans)
    truth = np.asarray(surface.joints)[:, :JOINTS]
    places = [person.landmarks[name] for name in PLACES]
    markers = np.asarray(surface.vertices)[:, places]
    markers = markers + 0.001 * rng.normal(size=markers.shape)
    layout = MarkerLayout(
        "six", tuple(Marker(name, landmark=name, distance=0.0) for name in PLACES)
    )
    capture = Capture("six", PLACES, markers, 50.0, "+y")

    sensor = hb.Markers(capture, layout=layout, frames=FRAMES)
    settings = hb.FitSettings(motion=False)
    nothing = {"nothing": lambda betas: 0.0 * betas}
    keypoints = hb.Keypoints(scene.detections, scene.rig)
    fits = {
        "six markers": hb.Fit(body, sensor, settings, nothing).solve(),
        "both at once": hb.Fit(body, [sensor, keypoints], settings).solve(),
    }
    errors = {
        name: 1e3 * float(np.linalg.norm(_joints(fit) - truth[list(FRAMES)], axis=-1).mean())
        for name, fit in fits.items()
    }
    (alone,) = hb.fit_cameras(scene.detections, scene.rig)
    seen = [t for t in FRAMES if 0 <= t - alone.first_frame < alone.num_frames]
    found = alone.joints([t - alone.first_frame for t in seen])[:, :JOINTS]
    apart = np.linalg.norm(found - truth[seen], axis=-1)
    return {"two cameras, all frames": 1e3 * float(apart.mean()), **errors}


def _joints(fit: object) -> np.ndarray:
    count = len(FRAMES)
    betas = np.tile(fit.betas, (count, 1))
    return np.asarray(fit.body(betas, fit.pose[:count], fit.trans[:count]).joints)[:, :JOINTS]


if __name__ == "__main__":
    for name, error in main(int(sys.argv[1]) if len(sys.argv) > 1 else 0).items():
        print(f"{name}: {error:.1f} mm")
