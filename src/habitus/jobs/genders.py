"""Which of the body's models fits a person: the one asked for, or that of the sex of which the
markers are sure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from habitus.body.gender import CANNOT_TELL, SURE, said_of
from habitus.body.joint_layouts import find_layout
from habitus.body.model import BodyModel
from habitus.body.shipped_prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.markers.recipe import iterate_fits
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.verdict import FAILED
from habitus.io.models.bodies import load_body
from habitus.jobs.ages import at_age, told_age
from habitus.jobs.subjects import Person
from habitus.results.metrics import fit_female_probability
from habitus.types import Progress

SEXES = ("neutral", "female", "male", "auto")
NEUTRAL = ("default", "neutral")


@dataclass(frozen=True)
class Chosen:
    """A body's model for one person: which, how likely the neutral shape is a woman's, and what
    must be said of it.
    """

    body: BodyModel
    sex: str
    female_probability: float | None = None
    notes: tuple[str, ...] = ()

    def told(self, fit: MarkerFit) -> MarkerFit:
        """A fit of this body that says which it is."""
        warnings = (*fit.warnings, *self.notes)
        return replace(
            fit, gender=self.sex, female_probability=self.female_probability, warnings=warnings
        )


def check_sex(sex: str) -> None:
    """Raises HabitusError for a sex that is not known."""
    if sex not in SEXES:
        raise HabitusError(f"sex is {sex!r}; expected one of {', '.join(SEXES)}")


def of_sex(body: BodyModel, sex: str) -> BodyModel:
    """The model of a sex that belongs to this body. Raises HabitusError where it has none."""
    if sex in ("neutral", body.name):
        return body
    if body.name not in NEUTRAL:
        raise HabitusError(
            f"{body.name} has no {sex} model, only its own; leave sex at neutral or auto"
        )
    layout = find_layout(body.parents)
    found = load_body(sex, joints=layout and layout.name)
    found = (
        found
        if found.num_betas == body.num_betas
        else found.with_betas(min(found.num_betas, body.num_betas))
    )
    return at_age(found, body.age)


def model_of(
    body: BodyModel,
    age: float | str | None,
    sex: str,
    person: Person,
    settings: MoshSettings,
    progress: Progress,
) -> Chosen:
    """`choose`, at the age that is asked for or told by the person's files."""
    aged, notes = told_age(body, age, person)
    chosen = choose(aged, sex, person, settings, progress)
    return replace(chosen, notes=(*notes, *chosen.notes))


def choose(
    body: BodyModel, sex: str, person: Person, settings: MoshSettings, progress: Progress
) -> Chosen:
    """The model of a person: with "auto" that of the sex in the capture's file, or else of the sex
    that a fit of the neutral model is sure of; the neutral one where it cannot tell.
    """
    if sex != "auto":
        return Chosen(of_sex(body, sex), sex)
    if body.name not in NEUTRAL:
        note = f"sex auto: the body {body.name} is one model, so none had to be chosen"
        return Chosen(body, "neutral", notes=(note,))
    if (told := _told(person)) is not None:
        return Chosen(
            of_sex(body, told), told, notes=(f"sex auto: the capture's file says {told}",)
        )
    progress("sex", 0.0)
    return _estimated(body, person, settings)


def _estimated(body: BodyModel, person: Person, settings: MoshSettings) -> Chosen:
    quick = replace(settings, soft_tissue=False)
    fit = next(iterate_fits(body, prior_of(body), person.layout, person.recordings, quick))
    probability = None if fit.verdict.level == FAILED else fit_female_probability(fit)
    if probability is None:
        why = (
            "the neutral fit failed"
            if fit.verdict.level == FAILED
            else f"{body.called} has no classifier of sex"
        )
        return Chosen(body, "neutral", notes=(f"sex auto: {why}, so the neutral model was kept",))
    said = said_of(probability)
    if said == CANNOT_TELL:
        note = (
            f"sex auto: cannot tell (P(female) {probability:.2f}, sure from {SURE:g} on): "
            "the neutral model was kept"
        )
        return Chosen(body, "neutral", probability, (note,))
    sure = probability if said == "female" else 1.0 - probability
    note = (
        f"sex auto: the neutral shape is {said} with probability {sure:.2f}: fitted with "
        f"the {said} model"
    )
    return Chosen(of_sex(body, said), said, probability, (note,))


def _told(person: Person) -> str | None:
    """The sex that all files that say one agree on."""
    told: Sequence[object] = [capture.recorded.get("sex") for capture in person.captures]
    said = {sex for sex in told if sex in ("female", "male")}
    return str(said.pop()) if len(said) == 1 else None
