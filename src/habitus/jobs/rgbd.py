"""Bodies from depth cameras: a folder of views in, a folder of results out (T 4.6.1)."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.points.depth import fit_views
from habitus.fit.points.depth_result import RgbdFit
from habitus.fit.points.depth_settings import RgbdSettings
from habitus.fit.points.people_in_view import split_people
from habitus.io.rgbd.read import read_views
from habitus.jobs.bodies import loaded
from habitus.jobs.options import DepthOptions, RgbdOptions, takes
from habitus.jobs.results import Exportable, with_methods
from habitus.observe.camera import RgbdCapture
from habitus.report.rgbd import rgbd_page
from habitus.results.depth import DEPTH_FILES, save_depth
from habitus.results.save import result_lock
from habitus.types import PathLike


class DepthResult(Exportable, RgbdFit):
    """A fit to depth views that can write itself."""

    @classmethod
    def of(cls, fit: RgbdFit) -> Self:
        """The same fit, with the methods."""
        return with_methods(cls, fit)

    def save(self, folder: PathLike) -> None:
        """Write body.npz, body.glb, measurements.csv, metrics.json and report.html, as ``habitus
        rgbd`` does.

        Raises HabitusError where the folder cannot be written.
        """
        save_depth(self, folder, rgbd_page)


@takes(DepthOptions)
def fit_rgbd(
    views: RgbdCapture | PathLike,
    body: BodyModel | PathLike = "default",
    *,
    options: DepthOptions,
) -> DepthResult:
    """The body of a person whom a depth camera saw in one view or several (T 4.6.1), its poses,
    light and albedo.

    views: the result of `habitus.read_views`, or the folder it reads. body: a model, a file,
    "neutral", "female", "male", or "default": the neutral one, or that of the sex as which the
    neutral shape is classified, whichever has the lower cost. ``turns``: None where unknown. Raises
    HabitusError for folders without views, and where no person is found in one.
    """
    capture = views if isinstance(views, RgbdCapture) else read_views(views)
    settings = options.settings or RgbdSettings()
    turns = options.turns or None
    if isinstance(body, str) and body == "default":
        kinds = {name: loaded(name, "auto", options.age) for name in ("neutral", "female", "male")}
        return DepthResult.of(fit_views(capture, kinds, settings, turns))
    model = loaded(body, "auto", options.age)
    name = model.name if isinstance(body, BodyModel) else str(body)
    sex = name if name in ("female", "male") else "neutral"
    return DepthResult.of(fit_views(capture, model, settings, turns, name, sex))


@takes(RgbdOptions)
def rgbd(
    folder: PathLike,
    out: PathLike,
    body: BodyModel | PathLike = "default",
    *,
    options: RgbdOptions,
    progress: Callable[[str], Any] = lambda text: None,
) -> DepthResult:
    """Read a folder of views, fit, and write the results into the folder ``out``, as ``habitus
    rgbd`` does. Raises HabitusError.
    """
    if options.people != "one":
        raise HabitusError(
            f"people is {options.people!r}; expected 'one' (rgbd_people fits everybody in a view)"
        )
    with result_lock(out, DEPTH_FILES):
        progress("reading")
        capture = read_views(folder, options.views or None, options.depth_unit, options.cameras)
        return _fitted(capture, out, body, options, progress)


@takes(RgbdOptions)
def rgbd_people(
    folder: PathLike,
    out: PathLike,
    body: BodyModel | PathLike = "default",
    *,
    options: RgbdOptions,
    progress: Callable[[str], Any] = lambda text: None,
) -> list[DepthResult]:
    """Everybody in the one view of a folder or .pcd file, from left to right, each fitted and
    written into a folder ``out``/person_N, as ``habitus rgbd --people all`` does.

    Raises HabitusError where nobody is found, for several views, and where nobody could be fitted.
    """
    progress("reading")
    capture = read_views(folder, options.views or None, options.depth_unit, options.cameras)
    fits = []
    problems = []
    for k, person in enumerate(split_people(capture), 1):
        own = Path(out) / f"person_{k}"
        with result_lock(own, DEPTH_FILES):
            try:
                fits.append(_fitted(person, own, body, options, progress))
            except HabitusError as error:
                problems.append(f"person {k}: {error}")
                progress(problems[-1])
    if not fits:
        raise HabitusError(problems[0])
    return fits


def _fitted(
    capture: RgbdCapture,
    out: PathLike,
    body: BodyModel | PathLike,
    options: RgbdOptions,
    progress: Callable[[str], Any],
) -> DepthResult:
    """A capture fitted and written."""
    progress(f"fitting {len(capture.views)} view{'s' * (len(capture.views) != 1)}")
    layers = {"clothes": options.clothes_mm, "hair": options.hair_mm}
    metres = {name: 1e-3 * value for name, value in layers.items() if value is not None}
    settings = replace(options.settings or RgbdSettings(), **metres)
    if options.hair_mm is not None:
        settings = replace(settings, measured_hair=None)
    fit = fit_rgbd(capture, body, turns=options.turns, settings=settings, age=options.age)
    progress("writing")
    fit.save(out)
    return fit
