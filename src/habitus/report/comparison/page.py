"""The page of a comparison: one HTML file with two bodies on one clock, curves of what is between
them, and tables.
"""

from collections.abc import Mapping, Sequence
from html import escape
from string import Template
from typing import Any

import numpy as np

from habitus.body.joint_angles import joint_angles
from habitus.body.motion import Moving
from habitus.errors import shown
from habitus.fit.markers.result import MarkerFit
from habitus.report.comparison import tables
from habitus.report.comparison.differences import Differences
from habitus.report.facts import LONGEST_NAME
from habitus.report.fit.blob import Blob
from habitus.report.fit.plots import ANGLE_FRAMES, PLOT_BINS, bin_edges, bin_means
from habitus.report.fit.scene import add_scene
from habitus.report.shell import VIEWER, WITHOUT_SCRIPT, asset, player, shell
from habitus.results.metrics import finite

SCRIPTS = (*VIEWER, "compare_player.js", "compare_main.js")
LAYERS = 9


def comparison_page(
    found: Differences,
    numbers: Mapping[str, Any],
    names: tuple[str, str],
    links: Sequence[str | None] = (None, None),
) -> str:
    """The page as text; ``numbers`` is what compare.json holds, ``links`` lead to the reports that
    there are.
    """
    told = (shown(names[0], LONGEST_NAME), shown(names[1], LONGEST_NAME))
    ours = Blob()
    theirs = Blob()
    data = _side(found.a, ours) | {"other": _side(found.b, theirs)}
    _add_curves(found, ours)
    data |= {
        "end": float(found.pairing.times[-1]),
        "offset": _offset(found),
        "angles": _add_angles(found, ours),
        "name": f"{shown(found.a.capture_name, LONGEST_NAME)}-compared",
    }
    for side, blob in ((data, ours), (data["other"], theirs)):
        side |= {"arrays": blob.contents, "bytes": blob.size}
    capture = shown(found.a.capture_name, LONGEST_NAME)
    content = Template(asset("compare.html")).substitute(
        head=tables.head(found, numbers, told),
        player=_player(told),
        note=_note(data),
        aparttext=tables.apart_text(found),
        worst=tables.worst(numbers),
        sections=tables.sections(found, numbers),
        files=tables.reports(links),
    )
    arrays = {"arrays-a": ours.base64(), "arrays-b": theirs.base64()}
    return shell(
        f"{capture}: {told[0]} and {told[1]} · habitus",
        content,
        data=finite(data),
        arrays=arrays,
        scripts=SCRIPTS,
        styles=["compare.css"],
        without_script=WITHOUT_SCRIPT,
    )


def _side(moving: Moving, blob: Blob) -> dict[str, Any]:
    """What the player must know of one result."""
    labels = (
        [shown(label, LONGEST_NAME) for label in moving.labels]
        if isinstance(moving, MarkerFit)
        else []
    )
    scene = add_scene(moving, blob, last_stage=True)
    return {
        "labels": labels,
        "frames": moving.num_frames,
        "rate": float(moving.rate_hz),
        "scene": scene.facts,
    }


def _offset(found: Differences) -> float:
    """Seconds from A's first frame to B's."""
    pairing = found.pairing
    return float(pairing.times[0] - pairing.frames[1][0] / found.b.rate_hz)


def _add_curves(found: Differences, blob: Blob) -> None:
    edges = bin_edges(len(found.pairing.times), PLOT_BINS)
    blob.add("times", found.pairing.times[edges].astype("f4"))
    curves = {"apart/joints": found.joints.mean(1), "apart/centred": found.centred.mean(1)}
    if found.skin is not None:
        curves |= {"apart/skin": found.skin[:, 0], "apart/worst": found.skin[:, 2]}
    if found.markers is not None:
        near = found.pairing.nearest
        for side, fit, rows in zip("ab", (found.a, found.b), near, strict=True):
            curves[f"error/{side}"] = _mean_error(np.asarray(fit.errors_mm)[rows])  # type: ignore[attr-defined]
    for name, values in curves.items():
        blob.add(name, bin_means(values, edges).astype("f4"))


def _mean_error(errors: np.ndarray) -> np.ndarray:
    seen = np.isfinite(errors)
    count = seen.sum(1)
    return np.where(count > 0, np.where(seen, errors, 0).sum(1) / np.maximum(count, 1), np.nan)


def _add_angles(found: Differences, blob: Blob) -> list[dict[str, str]]:
    """Joint angles that both bodies have, in tenths of degrees; gives the names, sides and owners
    of their rows.
    """
    some = bin_edges(len(found.pairing.times), ANGLE_FRAMES)
    both = [
        joint_angles(m.body, m.betas, np.asarray(m.pose)[rows[some]])
        for m, rows in zip((found.a, found.b), found.pairing.nearest, strict=True)
    ]
    rows = [
        ({"name": name, "side": side, "whose": whose}, angles[name][side])
        for name, sides in both[0].items()
        for side in sides
        for whose, angles in zip("AB", both, strict=True)
        if side in both[0].get(name, {}) and side in both[1].get(name, {})
    ]
    if rows:
        tenths = 10 * np.column_stack([values for _, values in rows])
        blob.add("angles", np.round(np.clip(tenths, -32768, 32767)).astype("i2"), True)
        frames = found.pairing.times[some] * found.a.rate_hz
        blob.add("angleFrames", np.round(frames).astype("u4"))
    return [told for told, _ in rows]


def _player(names: tuple[str, str]) -> str:
    tags = "".join(
        f"<span class='side-{letter.lower()}'><i class='letter'>{letter}</i> "
        f"<b>{escape(name)}</b></span>"
        for letter, name in zip("AB", names, strict=True)
    )
    return player(
        "Two fitted bodies, A and B, at the same moment, side by side or one over the other.",
        asset("player_pair.html"),
        LAYERS,
        "<dt>V</dt><dd>side by side, overlay</dd>",
        f"<div class='tags'>{tags}</div>",
    )


def _note(data: Mapping[str, Any]) -> str:
    """Where the player thins, as curves and tables do not."""
    rates = [side["scene"]["rate"] for side in (data, data["other"])]
    if not any(side["scene"]["stride"] > 1 for side in (data, data["other"])):
        return ""
    text = (
        f"The player draws {rates[0]:.3g} frames a second of A and {rates[1]:.3g} of B; curves "
        "and tables use all."
    )
    return f"<p class='note'>{escape(text)}</p>"
