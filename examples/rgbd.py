"""A person before a depth camera, made up and found again: views on disk, shape, girths, pictures
(T 4.6.1).

python examples/rgbd.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

import habitus as hb
from habitus.io.rgbd.write import write_views
from habitus_lab.population.rgbd_people import planted_rest, rgbd_scene


def main(folder: str = "demo_out/rgbd", scale: float = 0.5) -> None:
    """Two views, 45 degrees apart, under the noise of a Kinect, in images `scale` times as
    large.
    """
    body = hb.load_body("default")
    rng = np.random.default_rng(3)
    scene = rgbd_scene(body, rest := planted_rest(body, rng), rng, sensor="kinect-v1", scale=scale)
    write_views(scene.capture, Path(folder) / "views")
    fit = hb.fit_rgbd(hb.read_views(Path(folder) / "views"), body)
    fit.save(Path(folder) / "results")
    for name, true in body.measure_rest(rest).items():
        if name in ("height_m", "waist_circumference_m"):
            print(f"{name}: {100 * fit.measurements[name]:.1f} cm, in truth {100 * true:.1f}")
    print(fit.verdict)


if __name__ == "__main__":
    main(*sys.argv[1:2])
