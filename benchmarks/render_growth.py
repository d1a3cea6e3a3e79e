"""How does the renderer's time grow? Against pixels and against triangles (T 4.6, Fig 4-6), OpenGL
beside it.

    python benchmarks/render_growth.py [--runs 20] [--plots docs/images] [--out render_growth.json]

The torus of `render_scenes.py` from 160x120 to 2048x2048, and at 640x480 with a thousand to a
million triangles: colour and depth, and the gradient of a mean squared difference with respect to
everything. That time grows no faster than pixels plus triangles shows in the fit time = fixed +
pixels + triangles, none of them negative, and in the exponents of growth between the two largest of
each sweep: 1 is in proportion. Medians of `--runs` calls after one that is not counted, taken in
turns.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import math
from collections.abc import Iterable
from pathlib import Path
from statistics import median

import numpy as np
from common import in_words, machine, parser, write_json
from render_peers import Missing, OpenGL
from render_scenes import SIZE, TRIANGLES, forward, gradient, moved, show, take_turns, torus_scene
from scipy.optimize import nnls

SIZES = ((160, 120), (320, 240), (640, 480), (1280, 960), (2048, 2048))
COUNTS = (1_000, 3_000, 13_776, 50_000, 200_000, 1_000_000)
WORKS = {"image": "colour and depth", "gradient": "gradient to everything"}


def sweep(cases: Iterable[tuple[tuple[int, int], int]], runs: int) -> list[dict]:
    """Medians in ms of image and gradient, and of OpenGL's image where it is there, for each (size,
    triangles).
    """
    rows = []
    for size, triangles in cases:
        scene = torus_scene(size, triangles)
        colours = scene.colours
        leaves = scene.leaves()
        target = forward(moved(scene), colours)[0]
        peer = _opengl(scene)
        works = {
            "image": lambda s=scene, c=colours: forward(s, c),
            "gradient": lambda s=leaves, t=target: gradient(s, t),
        }
        times = take_turns({**works, **({"opengl": peer.draw} if peer else {})}, runs)
        if peer:
            peer.context.release()
        medians = {f"{name}_ms": median(values) for name, values in times.items()}
        rows.append(
            {
                "size": size,
                "pixels": math.prod(size),
                "triangles": len(scene.triangles.faces),
                **medians,
            }
        )
        print(f"{size[0]}x{size[1]}, {rows[-1]['triangles']:,} triangles: done", flush=True)
    return rows


def _opengl(scene) -> OpenGL | None:
    try:
        return OpenGL(scene)
    except Missing:
        return None


def fit(by_pixels: list[dict], by_triangles: list[dict], what: str) -> dict:
    """time = fixed + pixels + triangles by least relative squares, and exponents between the two
    largest.
    """
    rows = by_pixels + by_triangles
    times = np.array([row[what] for row in rows])
    terms = np.array([[1.0, row["pixels"], row["triangles"]] for row in rows])
    found, _ = nnls(terms / times[:, None], np.ones(len(rows)))
    result = {
        "fixed_ms": found[0],
        "ns_per_pixel": 1e6 * found[1],
        "ns_per_triangle": 1e6 * found[2],
    }
    result["furthest_off"] = float(np.abs(terms @ found / times - 1).max())
    for name, (small, large) in (("pixels", by_pixels[-2:]), ("triangles", by_triangles[-2:])):
        result[f"exponent_{name}"] = math.log(large[what] / small[what]) / math.log(
            large[name] / small[name]
        )
    return result


def fitted(found: dict, row: dict) -> float:
    """What the fit says of a row, ms."""
    return found["fixed_ms"] + 1e-6 * (
        found["ns_per_pixel"] * row["pixels"] + found["ns_per_triangle"] * row["triangles"]
    )


def plot(rows: list[dict], against: str, fits: dict[str, dict], title: str, path: Path) -> None:
    """Rendering only, and rendering with derivatives, against pixels or triangles."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(8, 3.3), dpi=90, layout="constrained")
    at = [row[against] for row in rows]
    for axes, (what, words) in zip(figure.subplots(1, 2), WORKS.items(), strict=True):
        axes.loglog(at, [row[f"{what}_ms"] for row in rows], "o-", label="habitus")
        axes.loglog(
            at, [fitted(fits[what], row) for row in rows], "k:", label="fixed + pixels + triangles"
        )
        if what == "image" and all("opengl_ms" in row for row in rows):
            axes.loglog(
                at,
                [row["opengl_ms"] for row in rows],
                "s--",
                color="0.6",
                label="OpenGL (llvmpipe)",
            )
        axes.set(title=words, xlabel=against, ylabel="ms")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize="small")
    figure.suptitle(title, fontsize="small")
    figure.savefig(path, pil_kwargs={"optimize": True})
    print(f"wrote {path}")


def main() -> None:
    """Measure, print both sweeps and the fits, write JSON and, if asked, plots."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--runs", type=int, default=20, help="calls of each, counted")
    arguments.add_argument(
        "--plots", type=Path, metavar="FOLDER", help="where to draw render-speed-*.png"
    )
    options = arguments.parse_args()
    where = machine()
    title = in_words(where)
    by_pixels = sweep([(size, TRIANGLES) for size in SIZES], options.runs)
    by_triangles = sweep([(SIZE, count) for count in COUNTS], options.runs)
    rows = by_pixels + by_triangles
    cells = [[f"{r['size'][0]}x{r['size'][1]}", f"{r['triangles']:,}"] for r in rows]
    times = [[r["image_ms"], r["gradient_ms"], r.get("opengl_ms", "")] for r in rows]
    heads = ("size", "triangles", *WORKS.values(), "OpenGL, colour and depth")
    show(f"ms: {title}", heads, [a + b for a, b in zip(cells, times, strict=True)])
    fits = {what: fit(by_pixels, by_triangles, f"{what}_ms") for what in WORKS}
    heads = ("", *(name.replace("_", " ") for name in fits["image"]))
    show(
        "time = fixed + pixels + triangles",
        heads,
        [(WORKS[what], *found.values()) for what, found in fits.items()],
    )
    if options.plots:
        place = title.split(", load")[0]
        head = f"{TRIANGLES:,} triangles; {place}"
        options.plots.mkdir(parents=True, exist_ok=True)
        plot(by_pixels, "pixels", fits, head, options.plots / "render-speed-pixels.png")
        head = f"{SIZE[0]}x{SIZE[1]}; {place}"
        plot(by_triangles, "triangles", fits, head, options.plots / "render-speed-triangles.png")
    write_json(
        options.out,
        {"machine": where, "by_pixels": by_pixels, "by_triangles": by_triangles, "fits": fits},
    )


if __name__ == "__main__":
    main()
