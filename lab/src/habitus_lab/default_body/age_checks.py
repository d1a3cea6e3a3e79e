"""Check the ages of finished bodies against the medians, and random people of every age in
numbers.

python -m habitus_lab.default_body.age_checks --json ages.json --markdown ages.md

Needs the shipped files alone. The table goes into lab/README.md, section "Ages".
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from habitus_lab.default_body.growth import (
    ADULT,
    BETWEEN,
    MEDIANS,
    SEXES,
    SOURCES,
    SPREAD,
    Median,
)
from habitus_lab.default_body.intersections import intersecting_pairs, turned_over
from habitus_lab.default_body.ruler import NUMBERS, Ruler
from habitus_lab.default_body.sources import BODY_VERTICES
from habitus_lab.repository import BODIES

DRAWN = 60
DRAWN_YEARS = (1, 1.5, 2, 3, 4, 5, 8, 12, 15, 20, 40, 70, 80, 90)
COMPARED = ("stature", "weight", "sitting_height", "leg_length", "head_girth")


@dataclass(frozen=True)
class Space:
    """What the checks need of one file."""

    template: np.ndarray  # (V, 3)
    shapedirs: np.ndarray  # (V, 3, B)
    years: np.ndarray  # (A,)
    agedirs: np.ndarray  # (V, 3, A)
    spread: np.ndarray  # (A,)
    skins: tuple[np.ndarray, ...]  # (F, 3) each without eyeballs: the full mesh and the coarse one
    ruler: Ruler

    def shares(self, years: float) -> np.ndarray:
        """(A,) of the file's ages, linear between them."""
        return np.array([np.interp(years, self.years, unit) for unit in np.eye(len(self.years))])

    def at(self, years: float) -> np.ndarray:
        """(V, 3) mean body of an age."""
        return self.template + self.agedirs @ self.shares(years)

    def drawn(self, years: float, count: int, rng: np.random.Generator) -> np.ndarray:
        """(N, V, 3) bodies of an age with betas from N(0, I); shapes scaled by the age's stature
        over the adult's, times the age's spread.
        """
        body = self.at(years)
        heights = self.template[:BODY_VERTICES, 1, None] + self.agedirs[:BODY_VERTICES, 1]
        tall = np.ptp(heights, axis=0) / np.ptp(self.template[:BODY_VERTICES, 1])
        scale = tall * self.spread @ self.shares(years)
        betas = rng.normal(size=(count, self.shapedirs.shape[-1]))
        return body + scale * np.einsum("vcb,nb->nvc", self.shapedirs, betas)


def read_space(path: Path) -> Space:
    """One of the shipped files."""
    with np.load(path) as file:
        template = file["v_template"].astype(float)
        faces = file["faces"]
        coarse = file["coarse_vertices"][file["coarse_faces"]]
        skins = tuple(each[(each < BODY_VERTICES).all(1)] for each in (faces, coarse))
        ages = file["age_years"], file["agedirs"].astype(float), file["age_spread"]
        shapedirs = file["shapedirs"].astype(float)
        mirror = file["mirror"]
    return Space(template, shapedirs, *ages, skins, Ruler(template, mirror, skins[0]))


def numbers_at(space: Space, years: float) -> dict[str, float]:
    """The ruler's numbers and the leg length of the mean body of an age."""
    found = dict(zip(NUMBERS, space.ruler(space.at(years)[None])[0].tolist(), strict=True))
    return found | {"leg_length": found["stature"] - found["sitting_height"]}


def compare(space: Space, medians: dict[int, Median]) -> dict[int, dict]:
    """Years -> measured, median and relative error in per cent of the published numbers."""
    table = {}
    for years, median in medians.items():
        found = numbers_at(space, years)
        wanted = {name: getattr(median, name) for name in COMPARED}
        table[years] = {
            "measured": {name: round(value, 4) for name, value in found.items()},
            "median": {name: round(value, 4) for name, value in wanted.items()},
            "error_percent": {
                name: round(100 * (found[name] / wanted[name] - 1), 2) for name in COMPARED
            },
            "heads_in_stature": round(found["stature"] / found["head_height"], 2),
            "crossing_pairs": [len(intersecting_pairs(space.at(years), f)) for f in space.skins],
        }
    return table


def mean_medians() -> dict[int, Median]:
    """The neutral body's: midway between women and men, sources as theirs."""
    middle = {}
    for years, woman in MEDIANS["female"].items():
        man = MEDIANS["male"][years]
        stature = (woman.stature + man.stature) / 2
        sitting = (woman.sitting_height + man.sitting_height) / 2 / stature
        weight = (woman.weight + man.weight) / 2
        girth = (woman.head_girth + man.head_girth) / 2
        height = (woman.head_height + man.head_height) / 2
        middle[years] = Median(
            stature,
            weight,
            woman.size_source,
            sitting,
            woman.sitting_source,
            girth,
            woman.head_source,
            height,
        )
    return middle


def between(space: Space, sex: str) -> dict[int, dict[str, float]]:
    """Years between those of the file -> relative error in per cent of stature and weight."""
    found = {}
    for years, (stature, weight) in BETWEEN[sex].items():
        have = numbers_at(space, years)
        found[years] = {
            "stature": round(100 * (have["stature"] / stature - 1), 2),
            "weight": round(100 * (have["weight"] / weight - 1), 2),
        }
    return found


def random_people(space: Space, years: float, rng: np.random.Generator) -> dict[str, float]:
    """Spread of stature and weight of drawn people of an age, and how many are clean."""
    bodies = space.drawn(years, DRAWN, rng)
    numbers = space.ruler(bodies)
    mean = space.at(years)
    cut = [any(len(intersecting_pairs(body, faces)) for faces in space.skins) for body in bodies]
    turned = [turned_over(body, space.skins[0], mean).any() for body in bodies]
    return {
        "drawn": DRAWN,
        "stature_sd_cm": round(100 * float(numbers[:, 0].std()), 2),
        "weight_5_50_95_kg": np.percentile(numbers[:, 1], (5, 50, 95)).round(1).tolist(),
        "weight_sd_percent": round(100 * float(np.log(numbers[:, 1]).std()), 1),
        "cut_themselves": float(np.mean(cut)),
        "turned_triangles": float(np.mean(turned)),
    }


def check(folder: Path) -> dict:
    """Everything, for the three files of a folder."""
    spaces = {name: read_space(folder / f"{name}.npz") for name in (*SEXES, "neutral")}
    medians = MEDIANS | {"neutral": mean_medians()}
    rng = np.random.default_rng(0)
    return {
        "ages": {name: compare(space, medians[name]) for name, space in spaces.items()},
        "between": {sex: between(spaces[sex], sex) for sex in SEXES},
        "spread": {name: space.spread.round(2).tolist() for name, space in spaces.items()},
        "random_people": {
            name: {years: random_people(space, years, rng) for years in DRAWN_YEARS}
            for name, space in spaces.items()
        },
        "sources": SOURCES,
    }


def markdown(numbers: dict) -> str:
    """Tables of the docs' section."""
    lines = [
        "| | years | stature m | weight kg | sitting height m | head girth m | sources | largest "
        "error % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for sex in SEXES:
        for years, row in numbers["ages"][sex].items():
            have = row["measured"]
            median = row["median"]
            of = MEDIANS[sex][years]
            pairs = " | ".join(
                f"{have[name]:.{digits}f} ({median[name]:.{digits}f})"
                for name, digits in (
                    ("stature", 3),
                    ("weight", 1),
                    ("sitting_height", 3),
                    ("head_girth", 3),
                )
            )
            sources = ", ".join(dict.fromkeys((of.size_source, of.sitting_source, of.head_source)))
            worst = max(abs(error) for error in row["error_percent"].values())
            error = "the people's mean" if years == ADULT else f"{worst:.1f}"
            lines.append(f"| {sex} | {years} | {pairs} | {sources} | {error} |")
    lines += ["", "Measured, and in brackets the median. Sources:", ""]
    lines += [f"- `{key}`: {text}" for key, text in SOURCES.items()]
    lines += ["", "| between | stature, weight: error % |", "|---|---|"]
    for sex, found in numbers["between"].items():
        errors = "; ".join(f"{y}: {e['stature']}, {e['weight']}" for y, e in found.items())
        lines.append(f"| {sex} | {errors} |")
    lines += [
        "",
        "| drawn people | years | sd of stature cm (published) | of weight % (published) "
        "| cut themselves | turned triangles |",
        "|---|---|---|---|---|---|",
    ]
    for name, ages in numbers["random_people"].items():
        for years, row in ages.items():
            tall, heavy = _published(name, years)
            shares = f"{row['cut_themselves']:.0%} | {row['turned_triangles']:.0%}"
            spread = f"{row['stature_sd_cm']:.1f}{tall} | {row['weight_sd_percent']:.0f}{heavy}"
            lines.append(f"| {name} | {years} | {spread} | {shares} |")
    return "\n".join(lines) + "\n"


def _published(name: str, years: float) -> tuple[str, str]:
    """Standard deviations of stature and weight in brackets, where a table gives them."""
    if years not in SPREAD.get(name, {}):
        return "", ""
    tall, heavy = SPREAD[name][years]
    return f" ({100 * tall * MEDIANS[name][years].stature:.1f})", f" ({100 * heavy:.0f})"


def main() -> None:
    """Measure the shipped files and write JSON and markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", type=Path, default=BODIES)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--markdown", type=Path, required=True)
    options = parser.parse_args()
    numbers = check(options.bodies)
    options.json.write_text(json.dumps(numbers, indent=1))
    options.markdown.write_text(markdown(numbers))


if __name__ == "__main__":
    main()
