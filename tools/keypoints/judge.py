"""Bodies from a real detector's keypoints in pictures of made people in motion, with and without
the places that were learned of it.

    python tools/keypoints/judge.py make FOLDER CAPTURE... [--people 2]
    for camera in FOLDER/*/cam*; do python tools/keypoints/detect.py $camera; done
    python tools/keypoints/judge.py fit FOLDER

``make``: for each capture and person a scene of four cameras around the person, a folder of
pictures each. ``fit``: joint error (mm) of `habitus.fit_cameras`, over all joints of 24 and frames.
"""

import argparse
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
from pictures import SIZE, dressed, motions, picture
from PIL import Image

import habitus as hb
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import Detections
from habitus.observe.keypoints import convention_names
from habitus_lab.population.camera_scenes import ring

FRAMES, STEP = 40, 4
CAMERAS = 4
FOCAL = 700.0


def make(options: argparse.Namespace) -> None:
    """Render the scenes."""
    number = 0
    for path in options.captures:
        (fit,) = hb.mosh(path)
        (pose,) = motions([path])
        rate = fit.rate_hz / STEP
        for person in range(options.people):
            rng = np.random.default_rng([options.seed, number])
            body = hb.load_body(str(rng.choice(["female", "male"]))).full
            assert body is not None
            betas = np.clip(rng.normal(size=body.num_betas), -2.5, 2.5)
            rows = np.arange(person * 7, len(pose), STEP)[:FRAMES]
            surfaces = [np.asarray(body(betas, pose[t], np.zeros(3)).vertices) for t in rows]
            colours = dressed(body, rng)
            cameras = []
            for k, camera in enumerate(ring(CAMERAS, surfaces[0].mean(0), 3.5).cameras):
                own = replace(
                    camera, width=SIZE, height=SIZE, focal=np.full(2, FOCAL),
                    centre=np.full(2, SIZE / 2.0),
                )  # fmt: skip
                folder = options.folder / f"{number:02d}" / f"cam{k + 1}"
                folder.mkdir(parents=True, exist_ok=True)
                for t, vertices in enumerate(surfaces):
                    still = np.random.default_rng(number)  # one background a camera
                    image = picture(own, vertices, body.faces, colours, still)
                    Image.fromarray(image).save(folder / f"{t:05d}.png")
                cameras.append(own)
            truth = {
                "capture": path.stem,
                "body": body.name,
                "betas": betas,
                "pose": pose[rows],
                "rate": rate,
                "rig": CameraRig(tuple(cameras)),
            }
            (options.folder / f"{number:02d}" / "truth.pkl").write_bytes(pickle.dumps(truth))
            number += 1


def fit(options: argparse.Namespace) -> None:
    """Fit with the learned places and without, and print the errors."""
    names = convention_names(options.convention)
    rows = []
    for folder in sorted(path for path in options.folder.iterdir() if path.is_dir()):
        truth = pickle.loads((folder / "truth.pkl").read_bytes())
        body = hb.load_body("female" if "female" in truth["body"] else "male")
        found = np.stack(
            [
                np.load(folder / f"cam{k + 1}" / "detections.npz")["keypoints"]
                for k in range(CAMERAS)
            ],
            1,
        )
        seen = np.isfinite(found).all(-1)
        true = np.array([body(truth["betas"], p, np.zeros(3)).joints for p in truth["pose"]])
        errors = []
        for convention in (options.convention, "named"):
            detections = Detections(
                folder.name, convention, names, truth["rig"].names,
                np.where(seen[..., None], found[..., :2], np.nan)[:, :, None],
                np.where(seen, found[..., 2], 0.0)[:, :, None], truth["rate"],
            )  # fmt: skip
            (result,) = hb.fit_cameras(detections, truth["rig"], keep_cameras=True)
            kept = slice(result.first_frame, result.first_frame + len(result.pose))
            off = 1e3 * np.linalg.norm(result.joints()[:, :24] - true[kept], axis=-1)
            errors.append((off.mean(), np.percentile(off, 95), result.verdict.level))
        rows.append(errors)
        print(folder.name, truth["capture"], *(f"{a:.1f} {b:.1f} {c}" for a, b, c in errors))
    mean = np.array([[row[:2] for row in errors] for errors in rows]).mean(0)
    print(f"mean, 95 %: learned {mean[0, 0]:.1f} {mean[0, 1]:.1f}, "
          f"not {mean[1, 0]:.1f} {mean[1, 1]:.1f} mm")  # fmt: skip


def main() -> None:
    """``make`` or ``fit``."""
    options = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    options.add_argument("what", choices=("make", "fit"))
    options.add_argument("folder", type=Path)
    options.add_argument("captures", nargs="*", type=Path)
    options.add_argument("--convention", default="blazepose33")
    options.add_argument("--people", type=int, default=2)
    options.add_argument("--seed", type=int, default=3)
    asked = options.parse_args()
    (make if asked.what == "make" else fit)(asked)


if __name__ == "__main__":
    main()
