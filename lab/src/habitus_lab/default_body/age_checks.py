"""Check the ages of finished bodies against the medians, and what random children look like in
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

from habitus_lab.default_body.growth import ADULT, BETWEEN, MEDIANS, SEXES, SOURCES, Median
from habitus_lab.default_body.intersections import intersecting_pairs, turned_over
from habitus_lab.default_body.ruler import NUMBERS, Ruler
from habitus_lab.default_body.sources import BODY_VERTICES
from habitus_lab.repository import BODIES

DRAWN = 50
DRAWN_YEARS = (5, 8, 12)
COMPARED = ("stature", "weight", "sitting_height", "leg_length", "head_girth")
PUBLISHED_SD = {
    "female": {5: 4.76, 8: 5.86, 12: 7.37},
    "male": {5: 4.63, 8: 5.77, 12: 7.44},
}  # cm, CDC 2000: M x S


@dataclass(frozen=True)
class Space:
    """What the checks need of one file."""

    template: np.ndarray  # (V, 3)
    shapedirs: np.ndarray  # (V, 3, B)
    years: np.ndarray  # (A,)
    agedirs: np.ndarray  # (V, 3, A)
    skin: np.ndarray  # (F, 3) without eyeballs
    ruler: Ruler

    def at(self, years: float) -> np.ndarray:
        """(V, 3) mean body of an age, linear between those of the file."""
        right = int(np.clip(np.searchsorted(self.years, years), 1, len(self.years) - 1))
        share = (years - self.years[right - 1]) / (self.years[right] - self.years[right - 1])
        share = float(np.clip(share, 0, 1))
        return (
            self.template
            + (1 - share) * self.agedirs[..., right - 1]
            + share * self.agedirs[..., right]
        )

    def drawn(self, years: float, count: int, rng: np.random.Generator) -> np.ndarray:
        """(N, V, 3) bodies of an age with betas from N(0, I); shapes scaled by the age's stature
        over the adult's.
        """
        body = self.at(years)
        scale = np.ptp(body[:BODY_VERTICES, 1]) / np.ptp(self.template[:BODY_VERTICES, 1])
        betas = rng.normal(size=(count, self.shapedirs.shape[-1]))
        return body + scale * np.einsum("vcb,nb->nvc", self.shapedirs, betas)


def read_space(path: Path) -> Space:
    """One of the shipped files."""
    with np.load(path) as file:
        template = file["v_template"].astype(float)
        faces = file["faces"]
        skin = faces[(faces < BODY_VERTICES).all(1)]
        ages = file["age_years"], file["agedirs"].astype(float)
        shapedirs = file["shapedirs"].astype(float)
        mirror = file["mirror"]
    return Space(template, shapedirs, *ages, skin, Ruler(template, mirror, skin))


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
            "crossing_pairs": len(intersecting_pairs(space.at(years), space.skin)),
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


def random_children(space: Space, years: int, rng: np.random.Generator) -> dict[str, float]:
    """Spread of stature and weight of drawn children, and how many are clean."""
    bodies = space.drawn(years, DRAWN, rng)
    numbers = space.ruler(bodies)
    cut = np.array([len(intersecting_pairs(body, space.skin)) > 0 for body in bodies])
    turned = np.array([turned_over(body, space.skin, space.at(years)).any() for body in bodies])
    return {
        "drawn": DRAWN,
        "stature_sd_cm": round(100 * float(numbers[:, 0].std()), 2),
        "weight_5_50_95_kg": np.percentile(numbers[:, 1], (5, 50, 95)).round(1).tolist(),
        "cut_themselves": float(cut.mean()),
        "turned_triangles": float(turned.mean()),
    }


def check(folder: Path) -> dict:
    """Everything, for the three files of a folder."""
    spaces = {name: read_space(folder / f"{name}.npz") for name in (*SEXES, "neutral")}
    medians = MEDIANS | {"neutral": mean_medians()}
    rng = np.random.default_rng(0)
    return {
        "ages": {name: compare(space, medians[name]) for name, space in spaces.items()},
        "between": {sex: between(spaces[sex], sex) for sex in SEXES},
        "random_children": {
            sex: {years: random_children(spaces[sex], years, rng) for years in DRAWN_YEARS}
            for sex in SEXES
        },
        "published_stature_sd_cm": PUBLISHED_SD,
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
    lines += [
        "",
        "| drawn children | years | sd of stature cm (published) | cut themselves | turned "
        "triangles |",
    ]
    lines += ["|---|---|---|---|---|"]
    for sex, ages in numbers["random_children"].items():
        for years, row in ages.items():
            spread = f"{row['stature_sd_cm']:.1f} ({PUBLISHED_SD[sex][years]:.1f})"
            shares = f"{row['cut_themselves']:.0%} | {row['turned_triangles']:.0%}"
            lines.append(f"| {sex} | {years} | {spread} | {shares} |")
    return "\n".join(lines) + "\n"


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
