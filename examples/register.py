"""A scan of somebody made up, in millimetres and z up, registered from nothing: how far from the
truth is it?
"""

import numpy as np

import habitus as hb
from habitus.fit.points.scan import Scan
from habitus_lab.population.scans import Scanner, person, scanned, stance


def main() -> None:
    """Make a scan, register it, compare."""
    body = hb.load_body("default")
    rng = np.random.default_rng(1)
    truth = person(body, stance("A", body.joint_names, rng), rng)  # vertices in metres, y up
    scan = scanned(truth, body.faces, Scanner(points=12_000), rng)
    (fit,) = hb.register_scans([Scan("anna", 1000 * scan.points[:, [2, 0, 1]])], body, up="+z")
    there = 1000 * truth[:, [2, 0, 1]] @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
    print(
        "distance",
        *(f"{1e3 * value:.2f}" for value in np.percentile(fit.to_surface, (50, 95))),
        "mm of the scan",
    )
    print(
        "truth",
        f"{1e3 * np.linalg.norm(fit.vertices - there, axis=1)[fit.weights > 0.5].mean():.2f}",
        "mm",
    )
    print("height", f"{fit.measurements['height_m']:.3f}", "m;", fit.verdict)


if __name__ == "__main__":
    main()
