"""How fast is the renderer? Images and gradients against OpenGL and Mitsuba 3 in one run; threads;
the first call.

    python benchmarks/render_speed.py [--parts race sizes threads start] [--runs 40] [--out
    render_speed.json]

- race: the torus of `render_scenes.py` (13,776 triangles, 640x480). Colour and depth by `habitus`
  and by OpenGL without
  a window (moderngl, llvmpipe), both read back into main memory, and both again without faces seen
  from behind, as
  suits a closed mesh. The gradient of a mean squared difference with respect to all vertices,
  albedo, light and the
  camera's numbers together; Mitsuba's `prb_projective` with respect to vertices. They take turns
  call by call, so that
  a slow moment of the machine hits all. `render_peers.py` shows that they draw the same.
- sizes: colour and depth of the same torus at 160x120 and at 640x480, ten calls of each in a row,
  as a fit makes them.
- threads: one and two, each in processes of their own.
- start: the first image and the first gradient of a process, with an empty kernel cache (compiled)
  and a filled one.

Medians of `--runs` calls (Mitsuba: fewer), after one that is not counted. What is not installed is
named and left out. `render_growth.py` has the time against size.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from common import in_words, machine, parser, write_json
from render_peers import Missing, Mitsuba, OpenGL
from render_scenes import (
    SIZE,
    forward,
    gradient,
    moved,
    show,
    take_turns,
    torus_scene,
    vertex_gradient,
)

GOALS = {
    "colour and depth": 6.0,
    "colour and depth, culled": 6.0,
    "gradient to everything": 30.0,
    "compiling": 8000.0,
    "start": 1000.0,
}
"""Milliseconds on two cores; the start with a filled cache."""
CULLED = ", culled"
PARTS = ("race", "sizes", "threads", "start")
SMALL, IN_A_ROW, TIMES = (160, 120), 10, 3.0
"""A small image, calls in a row, and how many times as fast as a large one it is meant to be."""
LAPS = ("torch", "imports", "scene", "first image", "first gradient", "image", "gradient")
START = """
import time
began = [time.perf_counter()]
def lap(): began.append(time.perf_counter())
import torch; lap()
import render_scenes as r; lap()
scene = r.torus_scene()
leaves, target, colours = scene.leaves(), torch.zeros(*scene.size[::-1], 3), scene.colours; lap()
for _ in range(2):
    r.forward(scene, colours); lap()
    r.gradient(leaves, target); lap()
import json; print(json.dumps([1e3 * (b - a) for a, b in zip(began, began[1:])]))
"""


def race(runs: int, samples: Iterable[int]) -> dict:
    """Everybody on the one scene: medians in ms of calls taken in turns, and how many times as fast
    as OpenGL.
    """
    contestants = ours()
    missing = []
    scene = torus_scene()
    for name, floats in (("OpenGL, 8 bits", False), ("OpenGL, floats", True)):
        for word, cull in (("", False), (CULLED, True)):
            try:
                contestants[name + word] = OpenGL(scene, floats, cull).draw
            except Missing as problem:
                missing = [str(problem)]
    times = take_turns(contestants, runs)
    ratios = {
        name: median(
            np.array(theirs)
            / np.array(times["colour and depth" + (CULLED if CULLED in name else "")])
        )
        for name, theirs in times.items()
        if name.startswith("OpenGL")
    }
    try:
        target = forward(moved(scene), scene.colours)[0]
        peer = Mitsuba(scene, scene.colours, target.numpy())
        for count in samples:
            works = {f"Mitsuba, {count} a pixel": lambda count=count: peer.gradient(count)}
            works["vertices"] = contestants["gradient to vertices"]
            found = take_turns(works, max(3, runs // (2 if count == 1 else 8)))
            ratio = median(
                np.array(found[f"Mitsuba, {count} a pixel"]) / np.array(found.pop("vertices"))
            )
            times = {**times, **found}
            ratios = {**ratios, **dict.fromkeys(found, ratio)}
    except Missing as problem:
        missing.append(str(problem))
    return {
        "rows": {name: summary(values) for name, values in times.items()},
        "times_as_fast_as": ratios,
        "missing": missing,
    }


def ours() -> dict[str, Callable]:
    """What `habitus` does in the race, by name; float32 and the default boundary where nothing else
    is said.
    """
    works: dict[str, Callable] = {}
    for dtype, word in ((torch.float32, ""), (torch.float64, ", float64")):
        scene = torus_scene(dtype=dtype)
        colours = scene.colours
        leaves = scene.leaves()
        target = forward(moved(scene), colours)[0]
        works["colour and depth" + word] = lambda s=scene, c=colours: forward(s, c)
        works["gradient to everything" + word] = lambda s=leaves, t=target: gradient(s, t)
        if not word:
            works["colour and depth" + CULLED] = lambda s=scene, c=colours: forward(s, c, cull=True)
            works["colour and depth, no edges"] = lambda s=scene, c=colours: forward(s, c, "none")
            works["gradient to everything, filter"] = lambda s=leaves, t=target: gradient(
                s, t, "filter"
            )
            works["gradient to vertices"] = lambda s=scene, c=colours, t=target: vertex_gradient(
                s, c, t
            )
    return works


def summary(times: list[float]) -> dict:
    """Median, quartiles and number of calls."""
    low, middle, high = np.percentile(times, [25, 50, 75])
    return {
        "median_ms": float(middle),
        "quartiles_ms": [float(low), float(high)],
        "runs": len(times),
    }


def sizes(runs: int) -> list[dict]:
    """Medians in ms of images of two sizes, `IN_A_ROW` calls of each before the other's turn.

    One contestant after the other: for some time after OpenGL has drawn, all else takes longer.
    """
    scenes = [torus_scene(size) for size in (SMALL, SIZE)]
    works = {"habitus": [lambda s=scene, c=scene.colours: forward(s, c) for scene in scenes]}
    with suppress(Missing):
        works["OpenGL, 8 bits"] = [OpenGL(scene).draw for scene in scenes]
    rows = []
    for name, pair in works.items():
        blocks = {
            k: lambda w=work: [w() for _ in range(IN_A_ROW)]
            for k, work in zip(("small", "large"), pair, strict=True)
        }
        found = take_turns(blocks, runs)
        small, large = (median(found[size]) / IN_A_ROW for size in ("small", "large"))
        rows.append({"": name, "160x120": small, "640x480": large, "times": large / small})
    return rows


def threads(runs: int) -> list[dict]:
    """Image and gradient with one and with two threads: the median over three processes each, in
    turns.
    """
    found: dict[int, list[dict]] = {1: [], 2: []}
    for _ in range(3):
        for count, results in found.items():
            environment = {"NUMBA_NUM_THREADS": str(count), "OMP_NUM_THREADS": str(count)}
            results.append(_child([__file__, "--child", "--runs", str(runs)], environment))
    return [
        {"threads": count, **{name: median(one[name] for one in results) for name in results[0]}}
        for count, results in found.items()
    ]


def start() -> list[dict]:
    """A process' first image and gradient, ms: with an empty kernel cache, then (median of three)
    with a filled one.
    """
    with tempfile.TemporaryDirectory() as folder:
        cold, *warm = [_child(["-c", START], {"NUMBA_CACHE_DIR": folder}) for _ in range(4)]
    rows = []
    for word, times in (("empty", cold), ("filled", np.median(warm, 0).tolist())):
        laps = dict(zip(LAPS, times, strict=True))
        first = laps["first image"] + laps["first gradient"]
        later = laps["image"] + laps["gradient"]
        rows.append(
            {"cache": word, **laps, "compiling": first - later, "start": laps["imports"] + first}
        )
    return rows


def _child(line: list[str], environment: dict[str, str]) -> Any:
    """What a Python process of its own prints last, as JSON."""
    run = subprocess.run(
        [sys.executable, *line],
        cwd=Path(__file__).resolve().parent,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    if run.returncode:
        raise SystemExit(run.stderr)
    return json.loads(run.stdout.splitlines()[-1])


def show_race(found: dict, title: str) -> None:
    """Medians beside goals; ratios and what was missing below."""
    rows = [
        (
            name,
            row["median_ms"],
            "{:.3g} - {:.3g}".format(*row["quartiles_ms"]),
            row["runs"],
            GOALS.get(name, ""),
        )
        for name, row in found["rows"].items()
    ]
    words = [
        f"{ratio:.2f} times as fast as {name}" for name, ratio in found["times_as_fast_as"].items()
    ]
    caption = "like with like, call by call: " + ", ".join(words) if words else ""
    show(
        f"race, ms: {title}",
        ("", "median", "quartiles", "runs", "goal"),
        rows,
        "; ".join(filter(None, [caption, *found["missing"]])),
    )


def show_start(rows: list[dict], title: str) -> None:
    """Laps of the two processes."""
    caption = (
        "compiling: what first calls take beyond later ones; start: imports but torch's, and "
        "first calls; "
        f"goals: {GOALS['compiling']:g} to compile, {GOALS['start']:g} to start with a filled cache"
    )
    show(f"start, ms: {title}", rows[0], [row.values() for row in rows], caption)


def main() -> None:
    """Measure the parts asked for, print tables, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    arguments.add_argument("--runs", type=int, default=40, help="calls of each, counted")
    arguments.add_argument(
        "--samples", type=int, nargs="*", default=(1, 16), help="rays a pixel of Mitsuba's"
    )
    arguments.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = arguments.parse_args()
    if options.child:
        chosen = {name: work for name, work in ours().items() if name in GOALS}
        print(
            json.dumps(
                {name: median(times) for name, times in take_turns(chosen, options.runs).items()}
            )
        )
        return
    where = machine()
    title = in_words(where)
    content = {"machine": where, "goals_ms": GOALS}
    if "race" in options.parts:
        content["race"] = race(options.runs, options.samples)
        show_race(content["race"], title)
    if "sizes" in options.parts:
        content["sizes"] = sizes(options.runs)
        rows = [row.values() for row in content["sizes"]]
        show(f"sizes, ms: {title}", content["sizes"][0], rows, f"goal: {TIMES:g} times")
    if "threads" in options.parts:
        content["threads"] = threads(options.runs)
        show(
            f"threads, ms: {title}",
            content["threads"][0],
            [row.values() for row in content["threads"]],
        )
    if "start" in options.parts:
        content["start"] = start()
        show_start(content["start"], title)
    write_json(options.out, content)


if __name__ == "__main__":
    main()
