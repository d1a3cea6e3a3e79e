"""The body model of a person: finger joints where markers need them; age and sex as given, as
recorded in the capture, or estimated by a neutral fit.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakValueDictionary

import numpy as np

from habitus.body.gender import SURE, UNDECIDED, said_of
from habitus.body.hands import FINGERS, SIDES
from habitus.body.joint_layouts import find_layout
from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.markers.recipe import iterate_fits
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.verdict import FAILED
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.jobs.options import SubjectOptions
from habitus.jobs.subjects import Person, person_of
from habitus.markers.layouts import MarkerLayout
from habitus.results.save import fit_female_probability
from habitus.types import PathLike, Progress

MIN_FINGER_MARKERS = 3
"""Markers on the fingers of one hand for which ``joints`` "auto" chooses a body with finger joints:
fewer do not determine how fingers bend.
"""
ON_FINGER = 0.9
"""Share of the skinning weights that finger joints have where a marker counts as one on a finger:
knuckles, which the wrist moves too, have 0.7.
"""
NEUTRAL = ("default", "neutral")
"""Bundled bodies that have a model of each sex."""
_IN_USE: WeakValueDictionary[tuple[str, str | None, float | None, int | None], BodyModel] = (
    WeakValueDictionary()
)
"""Bundled bodies in use, by name, joints, age and betas; each result of a job holds one."""


@dataclass(frozen=True)
class PersonBody:
    """The body model of one person: which, how likely the neutral shape is a woman's, and notes for
    the fit's warnings.
    """

    body: BodyModel
    sex: str
    female_probability: float | None = None
    notes: tuple[str, ...] = ()

    def noted(self, fit: MarkerFit) -> MarkerFit:
        """A fit of this body that records the choice."""
        warnings = (*fit.warnings, *self.notes)
        return fit.annotated(
            gender=self.sex, female_probability=self.female_probability, warnings=warnings
        )


def loaded(
    body: PathLike | BodyModel,
    joints: str = "auto",
    age: float | None = None,
    num_betas: int | None = None,
) -> BodyModel:
    """The body itself, or the one of this name or file, with these joints, at an age in years;
    ``num_betas`` as in `load_body`. A bundled body that is in use is shared, not loaded again:
    results hold their body. Raises HabitusError.
    """
    joint_set = None if joints == "auto" else joints
    if isinstance(body, BodyModel):
        return at_age(body if joint_set is None else body.with_joints(joint_set), age)
    key = os.fspath(body), joint_set, age, num_betas
    model = _IN_USE.get(key)
    if model is None:
        model = at_age(load_body(key[0], joints=joint_set, num_betas=num_betas), age)
        if key[0] in SHIPPED:
            _IN_USE[key] = model
    return model


def with_fingers(
    people: Sequence[Person], body: BodyModel, given: PathLike | BodyModel, joints: str
) -> tuple[list[Person], BodyModel]:
    """The people with their finger markers, and a body that has fingers; both unchanged where there
    are none.

    A body with finger joints uses the markers on fingers. With ``joints`` "auto", a bundled body
    (``given`` by name) gets finger joints where a person has `MIN_FINGER_MARKERS` on the skin of
    the fingers of one hand, whatever their labels and layout.
    """
    by_name = joints == "auto" and not isinstance(given, BodyModel) and str(given) in SHIPPED
    if not (by_name or has_fingers(body)):
        return list(people), body
    fingered = [
        person_of(each.captures, each.layout_choice, fingers=True) if each.left_fingers else each
        for each in people
    ]
    if has_fingers(body):
        return fingered, body
    layouts = [each.layout for each in fingered]
    if not any(_most_on_one_hand(each, body, _HANDS) >= MIN_FINGER_MARKERS for each in layouts):
        return list(people), body
    model = loaded(str(given), "smplh", body.age)
    if not any(_most_on_one_hand(each, model, _FINGERS) >= MIN_FINGER_MARKERS for each in layouts):
        return list(people), body
    return fingered, model


def has_fingers(body: BodyModel) -> bool:
    """Whether a body has finger joints."""
    return "left_index1" in body.joint_names


_HANDS = ("hand",)
_FINGERS = tuple(f"{finger}{k}" for finger in (*FINGERS, "thumb") for k in (1, 2, 3))


def _most_on_one_hand(layout: MarkerLayout, body: BodyModel, parts: Sequence[str]) -> int:
    """Markers on skin that these joints of the left or the right hand move, of the hand with
    more.
    """
    weights = body.skinning_weights[layout.vertices(body)]
    places = {name: k for k, name in enumerate(body.joint_names)}
    shares = (
        weights[:, [places[f"{side}_{part}"] for part in parts]].sum(axis=1) for side in SIDES
    )
    return max(int(np.count_nonzero(share >= ON_FINGER)) for share in shares)


# -- age -------------------------------------------------------------------------------------------


def at_age(body: BodyModel, age: float | None) -> BodyModel:
    """The body at an age in years; unchanged where there is none. Raises HabitusError."""
    return body if age is None or body.age == age else body.at_age(age)


def aged_body(
    body: BodyModel, age: float | str | None, person: Person
) -> tuple[BodyModel, tuple[str, ...]]:
    """With "auto" the body at the age on which all files of a person agree, or at the nearest that
    it supports; and a note about it.
    """
    if age != "auto":
        return body, ()
    if body.ages is None:
        return body, (f"age auto: the body {body.called} has no ages",)
    recorded = {
        years
        for capture in person.captures
        if isinstance(years := capture.recorded.get("age_years"), float | int)
    }
    if len(recorded) != 1:
        why = "the files differ" if recorded else "the capture's file gives none"
        return body, (f"age auto: {why}: the body is an adult's",)
    given = recorded.pop()
    years = float(np.clip(given, *body.ages.years[[0, -1]]))
    nearest = "" if years == given else f", the nearest age of the body is {years:g}"
    return body.at_age(years), (f"age auto: the capture's file says {given:g} years{nearest}",)


# -- sex -------------------------------------------------------------------------------------------


def of_sex(body: BodyModel, sex: str) -> BodyModel:
    """The model of a sex that belongs to this body. Raises HabitusError where it has none."""
    if sex in ("neutral", body.name):
        return body
    if body.name not in NEUTRAL:
        raise HabitusError(
            f"{body.name} has no {sex} model, only its own; leave sex at neutral or auto"
        )
    layout = find_layout(body.parents)
    model = load_body(sex, joints=layout and layout.name)
    if model.num_betas != body.num_betas:
        model = model.with_betas(min(model.num_betas, body.num_betas))
    return at_age(model, body.age)


def body_of(
    body: BodyModel,
    options: SubjectOptions,
    person: Person,
    settings: MoshSettings,
    progress: Progress,
) -> PersonBody:
    """The model of a person, at the age given or recorded, of the sex given, recorded or
    estimated.
    """
    aged, notes = aged_body(body, options.age, person)
    choice = choose_sex(aged, options.sex, person, settings, progress)
    return replace(choice, notes=(*notes, *choice.notes))


def choose_sex(
    body: BodyModel, sex: str, person: Person, settings: MoshSettings, progress: Progress
) -> PersonBody:
    """The model of a person: with "auto" that of the sex in the capture's file, or else of the sex
    that a fit of the neutral model is sure of; the neutral one where it cannot tell.
    """
    if sex != "auto":
        return PersonBody(of_sex(body, sex), sex)
    if body.name not in NEUTRAL:
        note = f"sex auto: the body {body.name} has one model, so none had to be chosen"
        return PersonBody(body, "neutral", notes=(note,))
    if (recorded := _recorded_sex(person)) is not None:
        note = f"sex auto: the capture's file says {recorded}"
        return PersonBody(of_sex(body, recorded), recorded, notes=(note,))
    progress("sex", 0.0)
    return _estimated_sex(body, person, settings)


def _estimated_sex(body: BodyModel, person: Person, settings: MoshSettings) -> PersonBody:
    quick = replace(settings, soft_tissue=False)
    fit = next(iterate_fits(body, prior_of(body), person.layout, person.recordings, quick))
    failed = fit.verdict.level == FAILED
    probability = None if failed else fit_female_probability(fit)
    if probability is None:
        why = "the neutral fit failed" if failed else f"{body.called} has no classifier of sex"
        note = f"sex auto: {why}, so the neutral model was kept"
        return PersonBody(body, "neutral", notes=(note,))
    sex = said_of(probability)
    if sex == UNDECIDED:
        note = (
            f"sex auto: undecided (P(female) {probability:.2f}, sure from {SURE:g} on): "
            "the neutral model was kept"
        )
        return PersonBody(body, "neutral", probability, (note,))
    certainty = probability if sex == "female" else 1.0 - probability
    note = (
        f"sex auto: the neutral shape is {sex} with probability {certainty:.2f}: fitted with "
        f"the {sex} model"
    )
    return PersonBody(of_sex(body, sex), sex, probability, (note,))


def _recorded_sex(person: Person) -> str | None:
    """The sex on which all files that state one agree."""
    recorded = {capture.recorded.get("sex") for capture in person.captures} & {"female", "male"}
    return str(recorded.pop()) if len(recorded) == 1 else None
