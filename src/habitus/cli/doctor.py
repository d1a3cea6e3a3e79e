"""`habitus doctor`: what is installed, what is missing, and what this machine can do."""

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from habitus.cli.screen import plain, screen
from habitus.jobs.options import Flag

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Doctor:
    """Say what is installed, which extras are missing and what they are for, and what the machine
    can do.

    Exit code 2 where something that habitus needs is broken. Paste the output into a report of a
    bug.
    """

    json: Flag = False
    """Print JSON."""


OPTIONS = Doctor
ABOUT = Doctor.__doc__
NEEDS = ("habitus.jobs.doctor",)
COLOURS = {"ok": "green", "missing": "yellow", "broken": "red"}


def run(options: Doctor, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError where something is broken."""
    from habitus.errors import HabitusError
    from habitus.jobs.doctor import diagnose

    console = console or screen()
    found = diagnose()
    if options.json:
        sections = {
            name: [asdict(check) for check in part] for name, part in found.sections.items()
        }
        print(json.dumps({"sound": found.sound, **sections}, indent=1))
    else:
        for name, part in found.sections.items():
            console.print(name, style="bold", highlight=False)
            for check in part:
                mark = f"[{COLOURS[check.level]}]{check.level:8}[/]"
                console.print(
                    f"  {mark}{plain(check.name):22}{plain(check.text)}",
                    highlight=False,
                    soft_wrap=True,
                )
    if not found.sound:
        raise HabitusError("something that habitus needs is broken; see above")


def left(options: Doctor) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
