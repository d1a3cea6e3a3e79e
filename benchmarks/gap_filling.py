"""Gaps of a real capture filled from its fit: how far from what was there, against cubics and
straight lines.

python benchmarks/gap_filling.py CAPTURE.c3d [--gaps 60] [--seconds 0.25 0.5 1.0] [--out FILE.json]
[--picture FILE.png]

Gaps of single markers are planted where the capture has none, the capture is fitted with them, and
the fit fills them.
"""

import tempfile
from pathlib import Path

import numpy as np
from common import machine, parser, write_json
from scipy.interpolate import CubicSpline

import habitus as hb
from habitus.arrays import runs
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture


def planted(
    capture: Capture, gaps: int, seconds: list[float], rng: np.random.Generator
) -> tuple[Capture, np.ndarray]:
    """The capture with gaps, and which samples are hidden (T, M); no two gaps of a marker within a
    second.
    """
    hidden = np.zeros(capture.markers.shape[:2], bool)
    taken = ~np.isfinite(capture.markers[..., 0])
    made = 0
    margin = round(0.5 * capture.rate_hz)
    for _ in range(100 * gaps):
        length = round(seconds[made % len(seconds)] * capture.rate_hz)
        first = rng.integers(margin, len(capture) - length - margin)
        marker = rng.integers(capture.markers.shape[1])
        if not taken[first - margin : first + length + margin, marker].any():
            hidden[first : first + length, marker] = taken[first : first + length, marker] = True
            made += 1
        if made == gaps:
            break
    markers = np.where(hidden[..., None], np.nan, capture.markers)
    return Capture(capture.name, capture.labels, markers, capture.rate_hz, capture.up_axis), hidden


def interpolated(
    markers: np.ndarray, marker: int, first: int, last: int
) -> tuple[np.ndarray, np.ndarray]:
    """A cubic through the samples on both sides, and the straight line."""
    gap = np.arange(first, last + 1)
    near = np.r_[first - 10 : first, last + 1 : last + 11]
    near = near[(near >= 0) & (near < len(markers))]
    near = near[np.isfinite(markers[near, marker, 0])]
    share = ((gap - first + 1) / (last - first + 2))[:, None]
    straight = (1 - share) * markers[first - 1, marker] + share * markers[last + 1, marker]
    return CubicSpline(near, markers[near, marker])(gap), straight


def main() -> None:
    """Plant, fit, fill, and compare."""
    arguments = parser(__doc__)
    arguments.add_argument("capture", type=Path)
    arguments.add_argument("--gaps", type=int, default=60)
    arguments.add_argument("--seconds", type=float, nargs="+", default=[0.25, 0.5, 1.0])
    arguments.add_argument("--out", type=Path)
    arguments.add_argument("--picture", type=Path)
    options = arguments.parse_args()
    truth = hb.read_capture(options.capture)
    gappy, hidden = planted(truth, options.gaps, options.seconds, np.random.default_rng(0))
    with tempfile.TemporaryDirectory() as folder:
        write_c3d(gappy, Path(folder) / "gappy.c3d")
        fit = hb.mosh(Path(folder) / "gappy.c3d")[0]
        found = hb.fill_capture(fit, Path(folder) / "gappy.c3d")
    errors: dict[float, dict[str, list[float]]] = {}
    left_empty = 0
    shown = []
    for marker in range(hidden.shape[1]):
        for first, stop in runs(hidden[:, marker]):
            last = stop - 1
            gap = slice(first, stop)
            ways = dict(
                zip(
                    ("cubic", "straight"),
                    interpolated(gappy.markers, marker, first, last),
                    strict=True,
                )
            )
            ways["body"] = found.capture.markers[gap, marker]
            if not np.isfinite(ways["body"]).all():
                left_empty += 1
                continue
            length = round((last - first + 1) / truth.rate_hz, 3)
            for name, way in ways.items():
                off = 1e3 * np.linalg.norm(way - truth.markers[gap, marker], axis=1).mean()
                errors.setdefault(length, {}).setdefault(name, []).append(float(off))
            shown.append((marker, first, last, ways))
    numbers = {
        "machine": machine(),
        "capture": truth.name,
        "left_empty": left_empty,
        "mean_mm": {
            str(s): {n: float(np.mean(v)) for n, v in each.items()}
            for s, each in sorted(errors.items())
        },
        "gaps": {str(s): len(each["body"]) for s, each in errors.items()},
    }
    print(f"{truth.name}: {left_empty} gaps left empty")
    for length, each in sorted(errors.items()):
        told = ", ".join(
            f"{name} {np.mean(each[name]):.1f} mm" for name in ("body", "cubic", "straight")
        )
        print(f"{length:.2f} s ({len(each['body'])} gaps): {told}")
    if options.out:
        write_json(options.out, numbers)
    if options.picture:
        draw(truth, shown, options.picture)


def draw(truth: Capture, shown: list, path: Path) -> None:
    """The three gaps in which the marker moves most: its height as measured and as filled."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    span = lambda one: np.ptp(truth.markers[one[1] : one[2] + 1, one[0]], axis=0).max()  # noqa: E731
    axis = "xyz".index(truth.up_axis[1])
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.2))
    for plot, (marker, first, last, ways) in zip(axes, sorted(shown, key=span)[-3:], strict=True):
        around = np.arange(max(first - 40, 0), min(last + 41, len(truth)))
        gap = np.arange(first, last + 1)
        plot.plot(
            around / truth.rate_hz,
            truth.markers[around, marker, axis],
            color="#566472",
            lw=3,
            label="measured",
        )
        plot.plot(
            gap / truth.rate_hz,
            ways["body"][:, axis],
            color="#d9480f",
            lw=1.5,
            label="filled by the body",
        )
        plot.plot(
            gap / truth.rate_hz, ways["cubic"][:, axis], "--", color="#0b6e7f", lw=1, label="cubic"
        )
        plot.set(title=truth.labels[marker], xlabel="s", ylabel="height (m)")
    axes[0].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()
