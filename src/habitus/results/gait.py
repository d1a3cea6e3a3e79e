"""The result folder of a gait analysis: tables as CSV, numbers as JSON, and a page."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.anatomical_angles import split_side
from habitus.body.anatomy import SIDES
from habitus.files import whole_folder, write_text
from habitus.gait.analysis import GaitAnalysis
from habitus.gait.cycles import POINTS, Stride, normalised, symmetry
from habitus.io.captures.c3d_relabel import write_with_outputs
from habitus.results.save import finite, write_json
from habitus.types import PathLike

GAIT_FILES = (
    "angles.csv",
    "cycles.csv",
    "dynamics.csv",
    "gait.json",
    "gait.html",
    "gait.c3d",
    "opensim",
)
UNSURE = "_not_validated"
"""Ending of the columns of angles that are not validated."""
NUMBERS = {
    "stride_time_s": lambda stride: stride.seconds,
    "stride_length_m": lambda stride: stride.length,
    "speed_m_s": lambda stride: stride.speed,
    "cadence_steps_min": lambda stride: stride.cadence,
    "stance_share": lambda stride: stride.stance,
    "step_length_m": lambda stride: stride.step_length,
    "step_width_m": lambda stride: stride.step_width,
    "double_support_share": lambda stride: stride.double_support,
}
"""Of each stride."""


def save_gait(
    analysis: GaitAnalysis,
    folder: PathLike,
    page: Callable[..., str] | None = None,
    capture: PathLike | None = None,
    opensim: Callable[[Path], object] | None = None,
) -> None:
    """Write angles.csv, cycles.csv, dynamics.csv (where there are forces), gait.json and gait.html;
    of a ``capture`` a copy with model outputs, gait.c3d. opensim: writes into the folder opensim/,
    and what the check of a model says, if it gives one, stands in gait.json and on the page
    (``page(analysis, opensim=check)``).

    Raises HabitusError where the folder cannot be written.
    """
    angles = analysis.angles
    names = angle_columns(angles.names, angles.validated)
    with whole_folder(folder, GAIT_FILES) as partial:
        write_text(partial / "angles.csv", _over_time(names, angles.values, analysis.rate_hz))
        write_text(partial / "cycles.csv", _cycles_csv(analysis))
        if analysis.contacts:
            curves = analysis.dynamics
            heads = [f"{n}_{_plain(u)}" for n, u in zip(curves.names, curves.units, strict=True)]
            heads += [f"residual_{axis}_N" for axis in "xyz"]
            values = np.column_stack([curves.values, analysis.residual])
            write_text(partial / "dynamics.csv", _over_time(heads, values, analysis.rate_hz))
        checked = None
        if opensim is not None:
            (partial / "opensim").mkdir()
            checked = opensim(partial / "opensim")
        own = {"opensim": checked} if isinstance(checked, Mapping) else {}
        write_json(partial / "gait.json", gait_numbers(analysis) | own)
        if page is not None:
            write_text(partial / "gait.html", page(analysis, **own))
        if capture is not None:
            write_with_outputs(capture, model_outputs(analysis), partial / "gait.c3d")


def model_outputs(
    analysis: GaitAnalysis,
) -> dict[str, dict[str, Float[np.ndarray, "T 3"]]]:
    """Angles (degrees), moments (Nmm/kg) and powers (W/kg, in z) as a C3D file's model outputs:
    LKneeAngles_habitus holds the three angles of the left knee in the order of the tables. The
    ending distinguishes them from Plug-in Gait's.
    """
    groups = {"ANGLES": _triples(analysis.angles.names, analysis.angles.values, "Angles")}
    if analysis.contacts:
        names, values = analysis.dynamics.names, analysis.dynamics.values
        kinds = (("MOMENTS", "moment", 1e3), ("POWERS", "power", 1.0))
        for group, ending, factor in kinds:
            own = [k for k, name in enumerate(names) if name.endswith(ending)]
            title = ending.capitalize()
            some = [names[k] for k in own]
            groups[group] = _triples(some, factor * values[:, own], title, group == "POWERS")
    return groups


def _triples(
    names: Sequence[str], values: Float[np.ndarray, "T N"], kind: str, last: bool = False
) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Columns of one joint beside each other; single ones first, or ``last``."""
    out: dict[str, Float[np.ndarray, "T 3"]] = {}
    filled: dict[str, int] = {}
    for name, column in zip(names, values.T, strict=True):
        side, plain = split_side(name)
        joint = plain.partition("_")[0]
        label = f"{side[:1].upper()}{joint.capitalize()}{kind}_habitus"
        table = out.setdefault(label, np.zeros((len(values), 3)))
        place = 2 if last else filled.get(label, 0)
        filled[label] = filled.get(label, 0) + 1
        if place < 3:
            table[:, place] = column
    return out


def angle_columns(names: Sequence[str], validated: Bool[np.ndarray, " N"]) -> list[str]:
    """Heads of the columns of angles: their names, units, and a warning where they need one."""
    return [
        f"{name}_deg{'' if sure else UNSURE}" for name, sure in zip(names, validated, strict=True)
    ]


def gait_numbers(analysis: GaitAnalysis) -> dict[str, Any]:
    """The analysis in numbers, for programs."""
    strides = analysis.strides
    return finite(
        {
            "capture": analysis.name,
            "fit_verdict": fit_verdict(analysis),
            "rate_hz": analysis.rate_hz,
            "convention": analysis.angles.convention,
            "angles_not_validated": [
                name
                for name, sure in zip(analysis.angles.names, analysis.angles.validated, strict=True)
                if not sure
            ],
            "landmarks_from_markers": dict(analysis.angles.sources),
            "hip_centre_from_harrington_mm": dict(analysis.centres_mm),
            "mass_kg": analysis.masses.total,
            "mass_source": analysis.masses.source,
            "events": {
                side: {
                    "strikes_s": own.strikes.tolist(),
                    "offs_s": own.offs.tolist(),
                    "source": own.source,
                }
                for side, own in analysis.events.items()
            },
            "strides": [
                {"side": s.side, "start_s": s.start, "off_s": s.off, "end_s": s.end}
                | {name: number(s) for name, number in NUMBERS.items()}
                for s in strides
            ],
            "means": stride_means(strides),
            "symmetry": {
                name: symmetry(*(_known(strides, side, name) for side in SIDES)) for name in NUMBERS
            },
            "contacts": [
                {
                    "plate": contact.plate,
                    "side": contact.side or None,
                    "start_s": contact.start,
                    "end_s": contact.end,
                    "distance_m": contact.distance,
                    "refused": contact.refused or None,
                }
                for contact in analysis.contacts
            ],
            "residual_share_of_weight": analysis.residual_share,
            "residual_vertical_bias": analysis.vertical_bias,
            "notes": list(analysis.notes),
        }
    )


def stride_means(strides: Sequence[Stride]) -> dict[str, dict[str, float | None]]:
    """Mean numbers of each side's strides, None where there are none."""
    return {
        side: {
            name: float(np.mean(known)) if (known := _known(strides, side, name)) else None
            for name in NUMBERS
        }
        for side in SIDES
    }


def side_curves(
    analysis: GaitAnalysis, side: str
) -> tuple[list[str], Float[np.ndarray, "n 101 N"]]:
    """The curves of a side's strides over 101 points: angles of this side and of the middle of the
    body, moments, powers and ground forces; names without the side.
    """
    names, columns = [], []
    tables = [(analysis.angles.names, analysis.angles.values)]
    if analysis.contacts:
        tables.append((analysis.dynamics.names, analysis.dynamics.values))
    for heads, values in tables:
        for head, column in zip(heads, values.T, strict=True):
            owner, plain = split_side(head)
            if owner in ("", side):
                names.append(plain)
                columns.append(column)
    table = np.column_stack(columns)
    own = [s for s in analysis.strides if s.side == side]
    curves = [normalised(table, analysis.rate_hz, s.start, s.end) for s in own]
    return names, np.stack(curves) if curves else np.zeros((0, POINTS, len(names)))


def not_validated(analysis: GaitAnalysis) -> set[str]:
    """Angles that are not validated, on one side at least; names without the side."""
    table = analysis.angles
    return {
        split_side(name)[1]
        for name, sure in zip(table.names, table.validated, strict=True)
        if not sure
    }


def units_of(analysis: GaitAnalysis) -> dict[str, str]:
    """The units of forces, moments and powers, by their names without the side."""
    curves = analysis.dynamics
    return {split_side(n)[1]: unit for n, unit in zip(curves.names, curves.units, strict=True)}


def fit_verdict(analysis: GaitAnalysis) -> dict[str, Any] | None:
    """The verdict of the fit that was analysed, None for a motion without one."""
    verdict = getattr(analysis.motion, "verdict", None)
    return None if verdict is None else verdict.entry()


def _known(strides: Sequence[Stride], side: str, name: str) -> list[float]:
    values = [NUMBERS[name](stride) for stride in strides if stride.side == side]
    return [float(value) for value in values if value is not None]


def _plain(unit: str) -> str:
    return unit.replace("/", "_")


def _over_time(names: Sequence[str], values: Float[np.ndarray, "T N"], rate_hz: float) -> str:
    """A table over time, a row a frame."""
    rows = np.column_stack([np.arange(len(values)) / rate_hz, values])
    return _csv(["time_s", *names], rows)


def _cycles_csv(analysis: GaitAnalysis) -> str:
    """A row for each percent of each stride; left and right under the same heads."""
    unsure, units = not_validated(analysis), units_of(analysis)
    lines: list[str] = []
    for side in SIDES:
        names, curves = side_curves(analysis, side)
        if not lines:
            heads = [
                f"{name}_{_plain(units[name])}"
                if name in units
                else f"{name}_deg{UNSURE if name in unsure else ''}"
                for name in names
            ]
            lines.append(",".join(["side", "stride", "percent", *heads]))
        for number, curve in enumerate(curves, 1):
            for percent, row in enumerate(curve):
                lines.append(",".join([side, str(number), str(percent), *_cells(row)]))
    return "\n".join(lines) + "\n"


def _csv(heads: Sequence[str], rows: Float[np.ndarray, "n N"]) -> str:
    return "\n".join([",".join(heads), *(",".join(_cells(row)) for row in rows)]) + "\n"


def _cells(row: Iterable[float]) -> list[str]:
    """Numbers to four decimals; empty where there is none."""
    return ["" if value != value else f"{value:.4f}" for value in row]
