"""How old the person of a fit is: told by hand, or by the capture's file."""

import math

import numpy as np

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.jobs.subjects import Person

AUTO = "auto"


def read_age(age: float | str | None) -> float | None:
    """The age that is asked for in years; None for none, and for "auto". Raises HabitusError for
    what is no age.
    """
    if age is None or age == AUTO:
        return None
    try:
        years = float(age)
    except (TypeError, ValueError):
        years = math.nan
    if not math.isfinite(years):
        raise HabitusError(
            f"age is {age!r}; expected years, such as 8, or auto for what the capture's file says"
        )
    return years


def at_age(body: BodyModel, age: float | None) -> BodyModel:
    """The body at an age in years; as it is where there is none, or where it has that one. Raises
    HabitusError.
    """
    return body if age is None or body.age == age else body.at_age(age)


def told_age(
    body: BodyModel, age: float | str | None, person: Person
) -> tuple[BodyModel, tuple[str, ...]]:
    """With "auto" the body at the age that all files of a person agree on, or at the nearest that
    it knows.

    What was done about the age comes with it in a sentence.
    """
    if age != AUTO:
        return body, ()
    if body.ages is None:
        return body, (f"age auto: the body {body.called} knows of no other ages",)
    said = {
        years
        for capture in person.captures
        if isinstance(years := capture.recorded.get("age_years"), float | int)
    }
    if len(said) != 1:
        why = "the files differ" if said else "the capture's file says none"
        return body, (f"age auto: {why}: the body is that of a grown person",)
    told = said.pop()
    years = float(np.clip(told, *body.ages.years[[0, -1]]))
    near = "" if years == told else f", the nearest age that the body knows is {years:g}"
    return body.at_age(years), (f"age auto: the capture's file says {told:g} years{near}",)
