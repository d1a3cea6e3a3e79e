"""The report: one HTML file that opens offline and holds the moving body, the plots and the
numbers.
"""

import os
from collections.abc import Sequence
from html import escape
from string import Template
from typing import TYPE_CHECKING, Any

from habitus.errors import shown
from habitus.files import write_text
from habitus.report.fit import sections
from habitus.report.fit.blob import Blob
from habitus.report.fit.plots import ANGLE_FRAMES, add_angles, add_plots
from habitus.report.fit.scene import Scene, add_scene
from habitus.report.fit.suspicion import suspicions
from habitus.report.fit.words import LONGEST_NAME, downloads
from habitus.report.shell import VIEWER, WITHOUT_SCRIPT, asset, player, shell
from habitus.results.metrics import finite, marker_metrics

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

SCRIPTS = (*VIEWER, "page_markers.js", "page_main.js")
LAYERS = 8


def write_report(
    fit: "MarkerFit",
    path: str | os.PathLike[str],
    numbers: dict[str, Any] | None = None,
    files: Sequence[str] = (),
) -> None:
    """Write the report of a ``MarkerFit`` as one HTML file, atomically.

    ``numbers`` is ``marker_metrics(fit)`` where the caller has it already; ``files`` are names of
    files beside the page that it offers for download. Long captures are thinned for the player and
    the joint angles only; errors, gaps and numbers hold every frame. Raises HabitusError where the
    file cannot be written.
    """
    write_text(path, report_page(fit, numbers, files))


def report_page(
    fit: "MarkerFit", given: dict[str, Any] | None = None, files: Sequence[str] = ()
) -> str:
    """The report as text; ``given`` is ``marker_metrics(fit)`` where there is one, ``files`` lie
    beside the page.
    """
    numbers = _readable(finite(marker_metrics(fit) if given is None else given))
    blob = Blob()
    scene = add_scene(fit, blob)
    data = {
        "name": numbers["capture"],
        "labels": [shown(label, LONGEST_NAME) for label in fit.labels],
        "frames": numbers["frames"],
        "rate": numbers["rate_hz"],
        "scene": scene.facts,
        "plots": add_plots(fit, blob),
        "angles": add_angles(fit, blob),
        "measured": sections.lengths(numbers["body_measurements"]),
        "suspects": suspicions(fit),
        "arrays": blob.contents,
        "bytes": blob.size,
    }
    content = Template(asset("page.html")).substitute(
        head=sections.head(fit, numbers),
        player=_player(scene),
        note=_note(fit, scene),
        anglenote=_angle_note(fit),
        bars="; the pale bar is the pose stage" if len(scene.facts["stages"]) > 1 else "",
        files=downloads(files),
        sections="\n".join(_sections(fit, numbers, scene)),
    )
    title = f"{shown(fit.capture_name, LONGEST_NAME)} · habitus"
    return shell(
        title,
        content,
        data=finite(data),
        arrays={"report-arrays": blob.base64()},
        scripts=SCRIPTS,
        without_script=WITHOUT_SCRIPT,
    )


def _player(scene: Scene) -> str:
    return player(
        "The fitted body with observed and predicted markers.",
        Template(asset("player_fit.html")).substitute(
            stages=_stage_buttons(scene), some=_some_layers(scene)
        ),
        LAYERS,
        "<dt>V</dt><dd>motion, placement</dd><dt>S</dt><dd>soft tissue</dd>",
        "<p class='hint placement-only'>Latent markers on the resting body; hover for the "
        "distance from the skin.</p>",
    )


def _some_layers(scene: Scene) -> str:
    """Buttons of what not every fit has: guessed parts, tapes."""
    guessed = (
        '<button type="button" data-layer="guessed" class="motion-only" title="Striped: no marker '
        'tells how it is">'
        '<i class="swatch guessed"></i>Guessed</button>'
    )
    tapes = (
        '<button type="button" data-layer="tapes" class="placement-only" title="Where tapes lie">'
        '<i class="swatch tapes"></i>Tapes</button>'
    )
    return guessed * bool(scene.facts["guessed"]) + tapes * bool(scene.facts["tapes"])


def _readable(numbers: dict[str, Any]) -> dict[str, Any]:
    """The same numbers with names and warnings as a page can show them, whatever the capture's file
    held.
    """
    names = {key: shown(numbers[key], LONGEST_NAME) for key in ("capture", "body", "layout")}
    return numbers | names | {"warnings": [shown(text, 1000) for text in numbers["warnings"]]}


def _sections(fit: "MarkerFit", numbers: dict[str, Any], scene: Scene) -> list[str]:
    return [
        sections.findings(fit, numbers, scene),
        sections.held_out(numbers),
        sections.body_and_timing(fit, numbers, scene),
        sections.details(fit),
    ]


def _stage_buttons(scene: Scene) -> str:
    if len(scene.facts["stages"]) < 2:
        return ""
    return (
        '<div class="segments motion-only" role="group" aria-label="Stage">'
        '<button type="button" data-stage="pose" title="The rigid shape of the pose stage '
        '(S)">Pose</button>'
        '<button type="button" data-stage="soft_tissue" title="With soft tissue (S)">Soft '
        "tissue</button></div>"
    )


def _note(fit: "MarkerFit", scene: Scene) -> str:
    texts = []
    missed = 1e3 * scene.facts["morphResidual"]
    if scene.stride > 1:
        rates = f"{scene.facts['rate']:.3g} of {fit.rate_hz:g} Hz"
        texts.append(
            f"The player shows {_every(scene.stride)} frame ({rates}); plots and numbers use all "
            "of them."
        )
    if missed > 0.5:
        texts.append(
            f"It draws pose and soft-tissue shape to {missed:.1f} mm RMS; the exports are closer."
        )
    if fit.body.skinning != "lbs":
        texts.append(
            "It blends linearly where the body blends dual quaternions: strongly twisted joints "
            "look thinner."
        )
    return f"<p class='note'>{escape(' '.join(texts))}</p>" if texts else ""


def _angle_note(fit: "MarkerFit") -> str:
    if len(fit.pose) <= ANGLE_FRAMES:
        return ""
    return f" About one frame in {len(fit.pose) / ANGLE_FRAMES:.1f} is drawn."


def _every(stride: int) -> str:
    ending = (
        "th" if stride % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(stride % 10, "th")
    )
    return f"every {stride:,}{ending}"
