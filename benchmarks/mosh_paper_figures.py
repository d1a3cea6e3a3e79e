"""Figures of `mosh_paper.py` in the manner of M Figs 6 and 8, the paper's own numbers beside ours.

    python benchmarks/mosh_paper_figures.py mosh_paper.json docs/images

The paper's text gives a held-out error of 34 mm at 67 markers, 7.9 mm of observed error, 6.2 with
soft tissue, and 34.1 and 33.9 mm held out (M 8.4, 9); the rest of its curves is in pictures only
and not drawn.
"""

import json
import sys
from pathlib import Path

import numpy as np

PAPER = {
    "observed_pose": 7.9,
    "observed_soft_tissue": 6.2,
    "held_out_pose": 34.1,
    "held_out_soft_tissue": 33.9,
}
INK = "#333333"
OURS = "#2a78b8"
REAL = "#c4622d"
OTHER = "#8a8a8a"


def draw(found: dict, folder: Path) -> None:
    """paper-markers.png and paper-soft-tissue.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.6), dpi=90, sharex=True)
    _shape(axes[0], found["synthetic"])
    _held_out(axes[1], found["synthetic"], found["real"])
    figure.tight_layout()
    figure.savefig(folder / "paper-markers.png", pil_kwargs={"optimize": True})
    figure, axis = plt.subplots(figsize=(7.2, 3.4), dpi=90)
    _soft_tissue(axis, found["synthetic"], found["real"])
    figure.tight_layout()
    figure.savefig(folder / "paper-soft-tissue.png", pil_kwargs={"optimize": True})
    plt.close("all")


def _means(rows: list[dict], key: str) -> tuple[list[int], np.ndarray, np.ndarray]:
    counts = sorted({row["markers"] for row in rows})
    values = [[row[key] for row in rows if row["markers"] == count] for count in counts]
    return counts, np.array([np.mean(v) for v in values]), np.array([np.std(v) for v in values])


def _shape(axis, rows: list[dict]) -> None:
    counts, mean, sd = _means(rows, "shape")
    axis.errorbar(
        counts,
        mean,
        sd,
        color=OURS,
        marker="o",
        capsize=3,
        label="synthetic people, ± 1 sd of people",
    )
    for count, value in zip(counts, mean, strict=True):
        axis.annotate(
            f"{value:.1f}",
            (count, value),
            (4, 6),
            textcoords="offset points",
            color=INK,
            fontsize=8,
        )
    axis.set(
        xlabel="markers", ylabel="shape error, mm", title="Shape (as M Fig 6 left)", ylim=(0, None)
    )
    axis.legend(frameon=False, fontsize=8)
    _plain(axis)


def _held_out(axis, synthetic: list[dict], real: list[dict]) -> None:
    counts, mean, sd = _means(synthetic, "held_out_soft_tissue")
    axis.errorbar(
        counts, mean, sd, color=OURS, marker="o", capsize=3, label="synthetic, 22 held out"
    )
    for k, name in enumerate(dict.fromkeys(row["capture"] for row in real)):
        rows = sorted(
            (row for row in real if row["capture"] == name), key=lambda row: row["markers"]
        )
        xs = [row["markers"] for row in rows]
        label = (
            ("real, a fifth held out", "real, where the prior expects them")
            if k == 0
            else (None, None)
        )
        axis.plot(
            xs,
            [r["held_out_soft_tissue"] for r in rows],
            color=REAL,
            alpha=0.6,
            lw=1,
            label=label[0],
        )
        axis.plot(
            xs,
            [r["expected_soft_tissue"] for r in rows],
            color=OTHER,
            alpha=0.7,
            lw=1,
            ls=":",
            label=label[1],
        )
    axis.plot(
        [67],
        [PAPER["held_out_soft_tissue"]],
        "*",
        color=INK,
        ms=11,
        label="the paper, 67 of 89: 33.9 mm",
    )
    axis.set(
        xlabel="markers",
        ylabel="held-out error, mm",
        title="Held-out markers (as M Fig 6 right)",
        ylim=(0, None),
    )
    axis.legend(frameon=False, fontsize=8)
    _plain(axis)


def _soft_tissue(axis, synthetic: list[dict], real: list[dict]) -> None:
    most = max(row["markers"] for row in synthetic)
    groups = {
        "the paper": PAPER,
        "synthetic": {
            key: np.mean([r[key] for r in synthetic if r["markers"] == most]) for key in PAPER
        },
        "real captures": {key: np.mean([r[key] for r in real if r["all"]]) for key in PAPER},
    }
    words = ("observed", "observed,\nsoft tissue", "held out", "held out,\nsoft tissue")
    for k, (name, values) in enumerate(groups.items()):
        places = np.arange(len(words)) + 0.27 * (k - 1)
        bars = axis.bar(
            places, [values[key] for key in PAPER], 0.25, label=name, color=(OTHER, OURS, REAL)[k]
        )
        axis.bar_label(bars, fmt="%.1f", fontsize=8, color=INK)
    axis.set_xticks(np.arange(len(words)), words)
    axis.set(ylabel="mean error, mm", title="With and without soft tissue (M 9)")
    axis.legend(frameon=False, fontsize=8)
    _plain(axis)


def _plain(axis) -> None:
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(axis="y", alpha=0.25)


if __name__ == "__main__":
    draw(json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2]))
