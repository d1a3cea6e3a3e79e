"""What do colours add to `habitus register`? (--texture; Bogo's appearance term, T 5.4)

    python benchmarks/register_textures.py [--people 3] [--kinds natural painted] [--out FILE]

Women are drawn from the women's body, which the neutral one knows only in part, each with skin off
it by 4 mm along its normals, the same in three poses; 60,000 points a scan and colours at 400,000
places, lit from somewhere else in each scan, noisy, and off by 0.3 mm (sd) along each axis, alike
over some 8 cm and other in every scan. Skin is natural (patches, freckles, moles, hair, striped
shirt, shorts) or painted all over with stamps. The scans are registered from nothing with the
default body, without colours and then with them. Told, in mm: how far vertices are from where they
are (mean, 95 %); of that what all scans of a woman share, which colours cannot tell; and what each
has of its own, all carried to rest by true turns.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import time
from dataclasses import replace

import numpy as np
from common import in_words, machine, parser, write_json
from coregister import POSES
from register_scans import full, hidden_vertices, outside, registrar
from rich.console import Console
from rich.table import Table

from habitus.body.jacobians import posed_skeleton
from habitus.fit.points.scan_colours import with_colours
from habitus.fit.points.scan_result import ScanFit
from habitus.fit.selection.held_out import smooth_field
from habitus.fit.selection.problem import SELECTION
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.painted_skin import PaintedSkin
from habitus_lab.population.scans import BONY, Scanner, scanned, stance

SCANNER = Scanner(points=60_000)


def woman(k: int, seed: int, painted: bool) -> dict:
    """True surfaces (m) in all poses, the turns (V, 3, 3) that took the skin there, and scans."""
    body = full("female")
    rng = np.random.default_rng([seed, k])
    bony = [j for j, name in enumerate(body.joint_names) if name.rpartition("_")[2] in BONY]
    betas = np.clip(rng.normal(size=body.num_betas), -2.5, 2.5)
    off = (
        SELECTION.flesh
        * smooth_field(body.v_template, rng)[:, :1]
        * (1 - 0.75 * body.skinning_weights[:, bony].sum(1))[:, None]
    )
    skin = PaintedSkin.of(body, np.random.default_rng([seed, k, 5]), painted)
    surfaces = []
    turns = []
    scans = []
    for i, name in enumerate(POSES):
        pose = stance(name, body.joint_names, rng)
        surface = np.asarray(body(betas, pose).vertices)
        surfaces.append(surface + off * vertex_normals(surface, body.faces))
        motions = posed_skeleton(body, body.rest_joints(betas), pose).motions[..., :3]
        u, _, v = np.linalg.svd(
            np.einsum("vk,vkij->vij", body.skinning_value, motions[body.skinning_index])
        )
        turns.append(u @ v)
        own = np.random.default_rng([seed, k, i])
        scans.append(scanned(surfaces[-1], outside(), SCANNER, own, f"{k} {name}", skin))
    return {"surfaces": surfaces, "turns": turns, "scans": scans}


def errors(made: dict, fits: list[ScanFit]) -> dict[str, float]:
    """How far vertices are from where they are (mm): all of it, what a woman's scans share, what is
    each one's own.
    """
    body = registrar().body
    off = []
    for truth, turn, fit in zip(made["surfaces"], made["turns"], fits, strict=True):
        true = (truth @ fit.to_body[:3, :3].T + fit.to_body[:3, 3])[body.full_vertices]
        off.append(np.einsum("vij,vi->vj", turn[body.full_vertices], 1e3 * (fit.vertices - true)))
    every = np.stack(off)[:, ~hidden_vertices(body)]
    shared = every.mean(0)
    parts = {"all": every, "shared": shared[None], "own": every - shared}
    return {
        f"{name}_{what}": float(np.mean([measure(np.linalg.norm(one, axis=1)) for one in part]))
        for name, part in parts.items()
        for what, measure in (("mean", np.mean), ("p95", lambda away: np.percentile(away, 95)))
    }


def main() -> None:
    """Run what is asked for, print it and write it."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--people", type=int, default=3)
    arguments.add_argument(
        "--kinds", nargs="*", default=["natural", "painted"], choices=("natural", "painted")
    )
    arguments.add_argument("--seed", type=int, default=88, help="88 was looked at in development")
    options = arguments.parse_args()
    where = machine()
    console = Console()
    rows = []
    for k in range(options.people):
        plain = None
        cpu = 0.0
        for kind in options.kinds:
            made = woman(k, options.seed, kind == "painted")
            if plain is None:  # geometry is the same
                begun = time.process_time()
                plain = registrar().register(
                    [replace(scan, colours=None) for scan in made["scans"]], up="+y"
                )
                cpu = (time.process_time() - begun) / len(plain)
                rows.append(
                    {"woman": k, "colours": "none", "cpu_seconds": cpu, **errors(made, plain)}
                )
            begun = time.process_time()
            fits = with_colours(registrar().settled(plain[0]), plain, made["scans"])
            more = (time.process_time() - begun) / len(fits)
            tones = [[fit.colours.before, fit.colours.after] for fit in fits]
            rows.append(
                {
                    "woman": k,
                    "colours": kind,
                    "cpu_seconds": cpu + more,
                    "tones": tones,
                    **errors(made, fits),
                }
            )
            console.print(rows[-1])
    table = Table("colours", "all, mean and 95 %", "shared", "own", "CPU seconds a scan", box=None)
    for kind in ("none", *options.kinds):
        some = [row for row in rows if row["colours"] == kind]
        means = {
            key: np.mean([row[key] for row in some])
            for key in some[0]
            if isinstance(some[0][key], float)
        }
        pairs = (
            f"{means[f'{name}_mean']:.2f}, {means[f'{name}_p95']:.2f}"
            for name in ("all", "shared", "own")
        )
        table.add_row(kind, *pairs, f"{means['cpu_seconds']:.1f}")
    console.print(table)
    console.print(in_words(where))
    write_json(options.out, {"machine": where, "rows": rows})


if __name__ == "__main__":
    main()
