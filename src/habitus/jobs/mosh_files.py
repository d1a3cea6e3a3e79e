"""Where a marker fit's files go: the folder that ``habitus mosh`` writes, and single files by their
endings.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from habitus.errors import HabitusError, shown
from habitus.export import write_amass, write_glb, write_npz, write_obj_sequence
from habitus.export.amass import check_npz_style
from habitus.export.glb import thinning_note
from habitus.files import replaceable, whole_folder
from habitus.fit.markers.result import MarkerFit
from habitus.io.captures.read import Capture
from habitus.io.names import file_name
from habitus.kernels.threads import one_blas_thread
from habitus.report import metrics, write_metrics, write_report
from habitus.report.metrics import stage_seconds

OURS = ("body.npz", "body.glb", "metrics.json", "report.html", "obj", "layout.toml")
"""All names that `save_fit` may write into a capture's folder: a later fit replaces them, and
nothing else.
"""
_NPZ_STYLES: Mapping[str, Callable[[MarkerFit, Path], object]] = {
    "habitus": write_npz,
    "amass": write_amass,
}


def save_fit(
    fit: MarkerFit,
    folder: str | os.PathLike[str],
    obj: bool = False,
    npz_style: str = "habitus",
    minimal: bool = False,
) -> MarkerFit:
    """body.npz, body.glb, metrics.json and report.html in a folder that appears whole, also in an
    older one's place; layout.toml, where the layout was found by fitting.

    npz_style: "habitus", or "amass" as scripts for AMASS slice it; minimal leaves body.glb and
    report.html out. Files in the older folder that no fit writes stay. The fit comes back with its
    export time.
    """
    check_npz_style(npz_style, fit.body)
    began = time.perf_counter()
    fit = replace(fit, warnings=(*fit.warnings, *thinning_note(fit)))
    with (
        one_blas_thread(),
        whole_folder(folder, OURS) as partial,
        ThreadPoolExecutor(1) as beside_this,
    ):
        animated = None if minimal else beside_this.submit(write_glb, fit, partial / "body.glb")
        _NPZ_STYLES[npz_style](fit, partial / "body.npz")
        if obj:
            write_obj_sequence(fit, partial / "obj")
        if fit.found_layout:
            (partial / "layout.toml").write_text(fit.found_layout, encoding="utf-8")
        numbers = metrics(fit)
        if animated is not None:
            coming = {"body.npz", "body.glb", "metrics.json"} | {
                path.name for path in partial.iterdir()
            }
            write_report(
                fit,
                partial / "report.html",
                numbers,
                tuple(name for name in OURS if name in coming),
            )
            animated.result()
        seconds = {**fit.stage_seconds, "export": time.perf_counter() - began}
        stages = sum(value for name, value in seconds.items() if value and name != "total")
        fit = replace(fit, stage_seconds={**seconds, "total": stages})
        write_metrics(
            fit, partial / "metrics.json", numbers | {"stage_seconds": stage_seconds(fit)}
        )
    return fit


def capture_folders(out: Path, captures: Sequence[Capture], several: bool) -> dict[int, Path]:
    """The folder of each capture's results, by its id: of its name, and with several people that of
    its person.

    Raises HabitusError for names that no folder can have, for captures that would share one, and
    for a place that is taken by something else.
    """
    names = {}
    for capture in captures:
        name = file_name(capture.name, f"the capture {shown(capture.name)!r}")
        names[id(capture)] = (
            file_name(f"{name}_{capture.subject or 'unnamed'}") if several else name
        )
    twice = sorted({name for name in names.values() if list(names.values()).count(name) > 1})
    if twice:
        raise HabitusError(
            f"several captures are called {', '.join(twice)}, so their results would overwrite "
            "each other; "
            "expected names that differ; rename one, or fit them in separate runs"
        )
    return {key: replaceable(out / name) for key, name in names.items()}
