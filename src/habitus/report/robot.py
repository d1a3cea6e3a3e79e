"""The page of a motion on a robot: person and robot on one clock, what the robot cannot follow, its
feet and its limits; one HTML file that opens offline.
"""

from collections.abc import Iterable, Mapping
from html import escape
from string import Template
from typing import Any

import numpy as np

from habitus.body.motion import BodyMotion
from habitus.errors import shown
from habitus.fit.retarget.robot_body import robot_motion
from habitus.fit.retarget.robot_quality import RobotQuality
from habitus.fit.retarget.robots import RobotRetargeting
from habitus.report.comparison.page import SCRIPTS
from habitus.report.fit.scene import PLOT_BINS, add_scene, bin_edges, bin_means
from habitus.report.shell import (
    MAX_NAME,
    NO_SCRIPT,
    Blob,
    Tile,
    asset,
    banner,
    card,
    columns,
    heading,
    numbers_table,
    player,
    shell,
    tiles,
)
from habitus.results.save import finite

LAYERS = ("body", "glass", "skeleton")
"""Layers of the player that a pair without markers has."""
CURVES = (
    {"array": "direction/mean", "name": "All segments, mean", "on": True, "style": "final"},
    {"array": "direction/worst", "name": "Worst segment", "on": False, "style": "worst"},
)
PLAYER = "The person and the robot at the same moment, side by side or one over the other."
DRAWN = (
    "The robot is drawn by the capsules of its table of pairs and rods between its links: its own "
    "meshes are not read."
)


def robot_page(result: RobotRetargeting, quality: RobotQuality, person: BodyMotion) -> str:
    """The page as text. ``person`` is the motion that the robot follows, +y up from the ground."""
    ours, theirs = Blob(), Blob()
    robot = robot_motion(result.motion, result.pairs)
    data = _side(person, ours) | {"other": _side(robot, theirs)}
    edges = bin_edges(person.num_frames, PLOT_BINS)
    ours.add("times", (np.arange(person.num_frames)[edges] / person.rate_hz).astype("f4"))
    angles = np.array(list(quality.directions.values()))
    ours.add("direction/mean", bin_means(angles.mean(axis=0), edges).astype("f4"))
    ours.add("direction/worst", bin_means(angles.max(axis=0), edges).astype("f4"))
    data |= {
        "end": (person.num_frames - 1) / person.rate_hz,
        "offset": 0.0,
        "name": f"{shown(person.capture_name, MAX_NAME)}-on-{shown(robot.capture_name, MAX_NAME)}",
        "curves": list(CURVES),
        "unit": "°",
        "angles": [],
    }
    for side, blob in ((data, ours), (data["other"], theirs)):
        side |= {"arrays": blob.contents, "bytes": blob.size}
    name = shown(robot.capture_name, MAX_NAME)
    content = Template(asset("robot.html")).substitute(
        head=_head(result, quality, person),
        player=player(PLAYER, asset("player_robot.html"), len(LAYERS), PAIR_KEY, _tags(name)),
        sections=columns(_segments(quality), _limits(quality)) + card("About", f"<p>{DRAWN}</p>"),
    )
    return shell(
        f"{shown(person.capture_name, MAX_NAME)} on {name} · habitus",
        content,
        data=finite(data),
        arrays={"arrays-a": ours.base64(), "arrays-b": theirs.base64()},
        scripts=SCRIPTS,
        styles=["compare.css"],
        without_script=NO_SCRIPT,
    )


PAIR_KEY = "<dt>V</dt><dd>side by side, overlay</dd>"


def _tags(name: str) -> str:
    sides = (("A", "Person"), ("B", name))
    tags = "".join(
        f"<span class='side-{letter.lower()}'><i class='letter'>{letter}</i> "
        f"<b>{escape(text)}</b></span>"
        for letter, text in sides
    )
    return f"<div class='tags'>{tags}</div>"


def _side(moving: BodyMotion, blob: Blob) -> dict[str, Any]:
    """What the player reads of one of the two."""
    scene = add_scene(moving, blob, last_stage=True)
    return {
        "labels": [],
        "frames": moving.num_frames,
        "rate": float(moving.rate_hz),
        "scene": scene.facts,
    }


def _head(result: RobotRetargeting, quality: RobotQuality, person: BodyMotion) -> str:
    motion = result.motion
    facts = (
        f"{motion.robot.name} ({motion.robot.num_joints} joints)",
        f"{motion.num_frames} frames at {motion.rate_hz:g} Hz",
        f"table of pairs {result.pairs.name}",
        f"places scaled by {result.scale:.2f}",
    )
    return (
        heading(person.capture_name, facts)
        + banner(quality.verdict.entry())
        + tiles(_tiles(result, quality))
    )


def _tiles(result: RobotRetargeting, quality: RobotQuality) -> Iterable[Tile]:
    yield (
        "Directions",
        f"{quality.mean_free_direction:.1f}",
        "°",
        f"off on average where no limit holds ({quality.mean_direction:.1f}° in all frames)",
    )
    slip = f"heels and toes that stand ({quality.standing:.1f} s)"
    yield "Slip", f"{1e3 * quality.slip:.1f}", "mm/s", slip
    if quality.resting:
        rest = f"hands at rest on the ground ({quality.resting:.1f} s)"
        yield "Slip of hands", f"{1e3 * quality.palm_slip:.1f}", "mm/s", rest
    yield "Penetration", f"{1e3 * quality.penetration:.1f}", "mm", "deepest below the ground"
    yield "Overlap", f"{1e3 * quality.overlap:.1f}", "mm", "deepest of two links"


def _segments(quality: RobotQuality) -> str:
    rows = [
        (
            name.replace("_", " "),
            f"{angles.mean():.1f}",
            f"{np.percentile(angles, 95):.1f}",
            f"{100 * quality.unreached(name):.0f}",
        )
        for name, angles in sorted(quality.directions.items(), key=lambda item: -item[1].mean())
    ]
    heads = ("Segment", "Mean °", "95 % °", "% of frames beyond 15°")
    lead = "Angle to the person's segment; the largest of its directions."
    return card("Segments", numbers_table(rows, heads), lead)


def _limits(quality: RobotQuality) -> str:
    rows = [
        (name, f"{100 * share:.0f}", f"{100 * quality.at_speed[name]:.0f}")
        for name, share in sorted(quality.at_limit.items(), key=lambda item: -item[1])
        if share > 0.0 or quality.at_speed[name] > 0.0
    ]
    lead = "No limit is passed. Joints that are at one in some frames:"
    if not rows:
        return card("Limits", "<p class='quiet'>No joint is at a limit in any frame.</p>")
    return card("Limits", numbers_table(rows, ("Joint", "% at an end", "% at full speed")), lead)


def robot_numbers(result: RobotRetargeting, quality: RobotQuality) -> Mapping[str, Any]:
    """The numbers of the page, for programs."""
    return {
        "robot": result.motion.robot.name,
        "pairs": result.pairs.name,
        "frames": result.motion.num_frames,
        "rate_hz": result.motion.rate_hz,
        "scale": result.scale,
        "direction_degrees": {
            "mean": quality.mean_direction,
            "mean_where_free": quality.mean_free_direction,
            "segments": {name: float(angles.mean()) for name, angles in quality.directions.items()},
        },
        "slip_mm_s": 1e3 * quality.slip,
        "standing_s": quality.standing,
        "palm_slip_mm_s": 1e3 * quality.palm_slip,
        "hands_at_rest_s": quality.resting,
        "penetration_mm": 1e3 * quality.penetration,
        "overlap_mm": 1e3 * quality.overlap,
        "share_at_limit": quality.at_limit,
        "share_at_speed_limit": quality.at_speed,
        "solver": {"status": result.status, "iterations": result.iterations},
        "verdict": quality.verdict.entry(),
    }
