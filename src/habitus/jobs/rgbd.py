"""Bodies from depth cameras: a folder of views in, a folder of results out (T 4.6.1)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self

from habitus.body.model import BodyModel
from habitus.fit.points.depth import fit_views
from habitus.fit.points.depth_result import RgbdFit
from habitus.fit.points.settings import RgbdSettings
from habitus.io.rgbd.read import read_views
from habitus.jobs.bodies import loaded
from habitus.jobs.results import Exportable, with_methods
from habitus.observe.depth_views import RgbdCapture
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


def fit_rgbd(
    views: RgbdCapture | PathLike,
    body: BodyModel | PathLike = "default",
    *,
    turns: Sequence[float | None] | None = None,
    settings: RgbdSettings | None = None,
    age: float | None = None,
) -> DepthResult:
    """The body of a person whom a depth camera saw in one view or several (T 4.6.1), its poses,
    light and albedo.

    views: what `habitus.read_views` gives, or the folder it reads. body: a model, a file,
    "neutral", "female", "male", or "default": women's or men's, whichever explains the views
    better, the neutral one where neither does. turns: degrees by which the person was turned in
    each view, to the person's left; None where unknown, as all are by themselves. age: in years, of
    the body. Raises HabitusError for folders that hold no views, and where nobody is found in one.
    """
    capture = views if isinstance(views, RgbdCapture) else read_views(views)
    settings = settings or RgbdSettings()
    if isinstance(body, str) and body == "default":
        kinds = {name: loaded(name, "auto", age) for name in ("neutral", "female", "male")}
        return DepthResult.of(fit_views(capture, kinds, settings, turns))
    model = loaded(body, "auto", age)
    name = model.name if isinstance(body, BodyModel) else str(body)
    gender = name if name in ("female", "male") else "neutral"
    return DepthResult.of(fit_views(capture, model, settings, turns, name, gender))


def rgbd(
    folder: PathLike,
    out: PathLike,
    *,
    body: BodyModel | PathLike = "default",
    views: Sequence[int] | None = None,
    turns: Sequence[float | None] | None = None,
    depth_unit: float | None = None,
    cameras: PathLike | None = None,
    age: float | None = None,
    clothes_mm: float | None = None,
    hair_mm: float | None = None,
    progress: Callable[[str], Any] | None = None,
) -> DepthResult:
    """Read a folder of views, fit, and write the results into the folder ``out``; what ``habitus
    rgbd`` does.

    views, depth_unit, cameras: as `habitus.read_views` takes them. clothes_mm, hair_mm: that lie on
    the skin of trunk and thighs and on the head, and are taken off; as in `RgbdSettings` where not
    given. Raises HabitusError.
    """
    tell = progress or (lambda text: None)
    with result_lock(out, DEPTH_FILES):
        tell("reading")
        capture = read_views(folder, views, depth_unit, cameras)
        tell(f"fitting {len(capture.views)} view{'s' * (len(capture.views) != 1)}")
        told = {"clothes": clothes_mm, "hair": hair_mm}
        settings = replace(
            RgbdSettings(),
            **{name: 1e-3 * value for name, value in told.items() if value is not None},
        )
        fit = fit_rgbd(capture, body, turns=turns, settings=settings, age=age)
        tell("writing")
        fit.save(out)
        return fit
