"""Body shape, poses and places from depth views (T 4.6.1): segmentation, start, staged solves of
the bodies that are tried, limbs tried again, skin offsets, appearance.
"""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.gender import female_probability
from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.points.appearance import Appearance, ColourShift, find_appearance
from habitus.fit.points.clothes import hair_notes
from habitus.fit.points.colour_views import Look
from habitus.fit.points.depth_energy import (
    DepthEnergy,
    SkinnedState,
)
from habitus.fit.points.depth_evidence import gather
from habitus.fit.points.depth_limbs import retry_limbs
from habitus.fit.points.depth_result import RgbdFit
from habitus.fit.points.depth_settings import STANDARD, RgbdSettings
from habitus.fit.points.depth_start import (
    Start,
    find_start,
    scaled_to_height,
)
from habitus.fit.points.prepared_views import PreparedView, segment
from habitus.fit.points.skin_offsets import SkinField
from habitus.kernels.threads import one_blas_thread
from habitus.observe.camera import RgbdCapture
from habitus.solve.minimize import Minimized


@dataclass(frozen=True, eq=False)
class ViewsFit:
    """Result of all stages: the chosen body and its name; the state, the skin offset (V,; m) and
    the observed surfaces, which include skin offset, clothes and hair; the thickness (V,; m) of
    measured hair; the prepared views; light and albedo (None without colours); the cost before each
    step and by term; the cost of each body that was tried, after its first steps with skin offsets;
    the misfit of each view at the start; seconds by stage; ``notes`` name the views that were left
    out, and why.
    """

    body: BodyModel
    kind: str
    state: BodyState
    skin: Float[np.ndarray, " V"]
    seen: Float[np.ndarray, "K V 3"]
    hair: Float[np.ndarray, " V"]
    prepared_views: tuple[PreparedView, ...]
    appearance: Appearance | None
    costs: tuple[float, ...]
    terms: Mapping[str, float]
    tried: Mapping[str, float]
    start_misfit: tuple[float, ...]
    seconds: Mapping[str, float]
    status: str
    notes: tuple[str, ...] = ()


def fit_state(
    capture: RgbdCapture,
    bodies: BodyModel | Mapping[str, BodyModel],
    settings: RgbdSettings = STANDARD,
    turns: Sequence[float | None] | None = None,
    start: Float[np.ndarray, "K J 3"] | None = None,
) -> ViewsFit:
    """Shape, poses and places: E_C + E_D + E_F + E_P + E_S + E_Q (T eq. 4.3), and the outlines.

    bodies: one, or several by name: the first, neutral one finds the start. The body of the sex as
    which its shape is classified (`habitus.body.gender`) is tried next, and the one with the lower
    cost after the first steps with skin offsets is fitted. turns: degrees by which the person is
    turned in each view, to the person's left; unknown ones are None. start: a pose for each view to
    begin with in place of trying some, turned by up to 30 degrees otherwise; the translation comes
    from the person's pixels. Views without a person are left out and named in ``notes``. Raises
    HabitusError where no view shows a person, and for another number of turns or poses than views.
    """
    given = tuple(turns) if turns is not None else (None,) * len(capture.views)
    if len(given) != len(capture.views):
        raise HabitusError(f"{len(given)} turns for {len(capture.views)} views; give one for each")
    if start is not None and np.shape(start)[0] != len(capture.views):
        raise HabitusError(
            f"{len(start)} poses to start from for {len(capture.views)} views; give one for each"
        )
    named = {"": bodies} if isinstance(bodies, BodyModel) else dict(bodies)
    with one_blas_thread():
        return _fitted(capture, named, settings, given, start)


def _fitted(
    capture: RgbdCapture,
    bodies: Mapping[str, BodyModel],
    settings: RgbdSettings,
    turns: tuple[float | None, ...],
    given: Float[np.ndarray, "K J 3"] | None,
) -> ViewsFit:
    clock = [time.perf_counter()]
    views, kept, notes = _prepared(capture, settings)
    turns = tuple(turns[k] for k in kept)
    given = None if given is None else np.asarray(given)[kept]
    clock.append(time.perf_counter())
    first = next(iter(bodies))
    energy = DepthEnergy.of(bodies[first], views, settings)
    with ThreadPoolExecutor(1) as beside:
        fields = {
            name: beside.submit(SkinField.of, body, settings) for name, body in bodies.items()
        }
        start = find_start(energy, turns, given)
        clock.append(time.perf_counter())
        neutral, start = _best_facing(first, energy, fields[first].result(), start)
        names = _likely_bodies(bodies[first], neutral.state.betas, [*bodies][1:])
        rivals = [
            _rival(name, bodies[name], neutral, fields[name].result(), start) for name in names
        ]
    chosen = min([neutral, *rivals], key=lambda one: one.history[-1])
    energy, field = chosen.energy, chosen.field
    state, means = retry_limbs(energy, chosen.state.body, start.means)
    clock.append(time.perf_counter())
    placed = replace(chosen.state, pose=state.pose, trans=state.trans)
    settled = energy.with_skin(placed, means, field)
    clock.append(time.perf_counter())
    ended, skinned, shown = _with_colour(energy, settled, means, field)
    clock.append(time.perf_counter())
    stages = ("segment", "start", "depth", "skin", "colour")
    seconds: dict[str, float] = dict(zip(stages, np.diff(clock).tolist(), strict=True))
    history = (*chosen.history, *settled.history)
    return ViewsFit(
        body=energy.body,
        kind=chosen.name,
        state=skinned.body,
        skin=field.offset(skinned.skin),
        seen=field.seen(energy.surfaces(skinned), skinned.skin),
        hair=field.hair,
        prepared_views=energy.views,
        appearance=shown,
        costs=history if ended is settled else (*history, *ended.history),
        terms=dict(ended.costs),
        tried={one.name: one.history[-1] for one in (neutral, *rivals) if len(bodies) > 1},
        start_misfit=start.misfits,
        seconds=seconds,
        status=ended.status,
        notes=notes,
    )


def _prepared(
    capture: RgbdCapture, settings: RgbdSettings
) -> tuple[list[PreparedView], list[int], tuple[str, ...]]:
    """The views that show a person, their numbers in the capture, and a note on each other view.

    Raises HabitusError where no view shows a person.
    """
    prepared: list[PreparedView] = []
    kept: list[int] = []
    errors: list[HabitusError] = []
    for k, view in enumerate(each.in_camera_frame() for each in capture.views):
        try:
            prepared.append(
                PreparedView.of(view, segment(view, settings.segmentation), settings.segmentation)
            )
            kept.append(k)
        except HabitusError as error:
            errors.append(error)
    if not prepared:
        more = f" ({len(errors)} views like this)" if len(errors) > 1 else ""
        raise HabitusError(f"{errors[0]}{more}")
    return prepared, kept, tuple(f"a view was left out: {error}" for error in errors)


@dataclass(frozen=True, eq=False)
class _Attempt:
    """A body after the first steps with its skin offsets."""

    name: str
    energy: DepthEnergy
    field: SkinField
    state: SkinnedState
    history: tuple[float, ...]


def _rival(
    name: str,
    body: BodyModel,
    first: _Attempt,
    field: SkinField,
    start: Start,
) -> _Attempt:
    """Another body from the first one's poses, below the hair that was measured with that."""
    views, settings = first.energy.views, first.energy.settings
    energy = DepthEnergy.of(body, views, settings)
    betas = scaled_to_height(body, list(views), settings.search)
    state = replace(start.state, betas=betas)
    return _attempt(name, energy, field, state, start.means, first.field.hair)


def _best_facing(
    name: str, energy: DepthEnergy, field: SkinField, start: Start
) -> tuple[_Attempt, Start]:
    """The first body fitted from a start, and from those in which a view faces the other way: the
    fit of the lowest cost, and its start. Pixels are nearly as close to a body that faces the wrong
    way, but its shape and pose are less likely.
    """

    def attempt(start: Start) -> tuple[_Attempt, Start]:
        return _attempt(name, energy, field, start.state, start.means), start

    best = attempt(start)
    for k, other in enumerate(start.opposite):
        if other is not None:
            turned = attempt(best[1].with_view(k, other))
            best = min(best, turned, key=lambda tried: tried[0].history[-1])
    return best


def _attempt(
    name: str,
    energy: DepthEnergy,
    field: SkinField,
    start: BodyState,
    means: np.ndarray,
    hair: Float[np.ndarray, " V"] | None = None,
) -> _Attempt:
    """A body after all stages without skin offsets and the first steps with them. hair: thickness
    (m) where it is known; None: it is measured between the two.
    """
    coarse = energy.minimized(start, means, energy.settings.stages)
    state = coarse.state
    field = field.with_hair(energy.hair(state) if hair is None else hair)
    bare = SkinnedState(state.betas, state.pose, state.trans, np.zeros(field.count))
    skinned = energy.with_skin(bare, means, field)
    return _Attempt(name, energy, field, skinned.state, (*coarse.history, *skinned.history))


def _likely_bodies(first: BodyModel, betas: Float[np.ndarray, " B"], names: list[str]) -> list[str]:
    """Names of the bodies to try after the first: that of the sex as which the first body's
    classifier reads betas, or all of them where it has no classifier.

    Costs alone do not determine the sex: a real person lies in neither body's space, and the wider
    space explains depth better.
    """
    probability = female_probability(first, betas, 0.0)
    if probability is None:
        return names
    sex = "female" if probability > 0.5 else "male"
    return [name for name in names if name == sex]


def _with_colour(
    energy: DepthEnergy, settled: Minimized, means: Float[np.ndarray, "K J 3"], field: SkinField
) -> tuple[Minimized, SkinnedState, Appearance | None]:
    """Steps with colour, where there is colour of the person and of the background; light and
    albedo at the end.

    Colour of one view alone does not enter the shape, since albedo explains there what the shape
    should: waists of twelve people were 4.3 cm off (RMSE) with these steps, 1.7 without.
    """
    faces = energy.body.faces
    looks = energy.settings.appearance
    state = settled.state
    views = energy.views
    shown = find_appearance(
        views, field.seen(energy.surfaces(state), state.skin), faces, None, looks
    )
    few = len(views) < 2 or not energy.settings.colour_levels
    if few or shown is None or shown.shift.overlap is None:
        return settled, state, shown
    minimized, state, look = energy.with_colour(state, Look.of(shown, looks), means, field)
    shift = ColourShift(look.shift, shown.shift.overlap)
    seen = field.seen(energy.surfaces(state), state.skin)
    return minimized, state, find_appearance(views, seen, faces, shift, looks)


def fit_views(
    capture: RgbdCapture,
    bodies: BodyModel | Mapping[str, BodyModel],
    settings: RgbdSettings = STANDARD,
    turns: Sequence[float | None] | None = None,
    name: str | None = None,
    gender: str = "neutral",
    start: Float[np.ndarray, "K J 3"] | None = None,
) -> RgbdFit:
    """A person's shape, poses, light and albedo from views of depth and colour (T 4.6.1), and what
    they are worth.

    bodies, turns, start: as `fit_state` takes them; of several bodies the names say which are
    women's and men's. name, gender: of the body where there is but one. Raises HabitusError as
    `fit_state`.
    """
    fit = fit_state(capture, bodies, settings, turns, start)
    began = time.perf_counter()
    state = fit.state
    evidence = gather(
        fit.body, state, fit.prepared_views, settings, fit.seen, fit.skin, fit.hair, fit.status
    )
    sex_note = ()
    if not isinstance(bodies, BodyModel):
        name = gender = fit.kind
        sex_note = (_who(fit),) if len(bodies) > 1 else ()
    return RgbdFit(
        capture_name=capture.name,
        body_name=name or fit.body.name,
        body=fit.body,
        betas=state.betas,
        pose=state.pose,
        trans=state.trans,
        prepared_views=fit.prepared_views,
        evidence=evidence,
        appearance=fit.appearance,
        costs=fit.terms,
        body_costs=fit.tried,
        stage_seconds={**fit.seconds, "judge": time.perf_counter() - began},
        settings=asdict(settings),
        warnings=(
            *capture.notes,
            *fit.notes,
            *sex_note,
            *hair_notes(fit.hair),
            *_lost(fit.prepared_views, fit.appearance),
        ),
        gender=gender,
        skin=fit.skin,
        hair=fit.hair,
        status=fit.status,
    )


def _who(fit: ViewsFit) -> str:
    """The note on the body that was chosen."""
    if fit.kind == next(iter(fit.tried)):
        return (
            "the views do not determine the sex: the neutral body is used; choose one with --body "
            "female or male"
        )
    return (
        f"the {fit.kind} body explains the views best; choose another with --body neutral, female "
        "or male"
    )


def _lost(views: tuple[PreparedView, ...], appearance: Appearance | None) -> tuple[str, ...]:
    """What was not there, and what that costs."""
    notes = []
    if len(views) == 1:
        notes.append("one view: girths rest on the shape space more than with two")
    by_planes = [s.view.name or "the view" for s in views if s.segmentation == "planes"]
    if by_planes:
        notes.append(
            f"{', '.join(by_planes)}: no background image and no mask; the person was segmented "
            "by distance from floor and walls"
        )
    if not any(view.on_floor for view in views):
        notes.append("no floor was found: height rests on what is seen, and up is the camera's")
    if appearance is None:
        notes.append("no colour: light, albedo and texture were left out")
    elif appearance.shift.overlap is None:
        notes.append(
            "no colour of the empty room: the colour camera was taken to be where its calibration "
            "says"
        )
    return tuple(notes)
