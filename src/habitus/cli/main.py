"""The `habitus` command: one thin file a subcommand, errors in one line."""

import sys
from typing import Annotated

import tyro

from habitus.cli import evaluate as evaluate_command
from habitus.cli import layout
from habitus.cli import mosh as mosh_command
from habitus.cli import train as train_command
from habitus.cli.evaluate import Evaluate
from habitus.cli.layout import Check, New, Show
from habitus.cli.mosh import Mosh
from habitus.cli.train import Train
from habitus.errors import HabitusError

_Layout = Annotated[
    Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[New, tyro.conf.subcommand("new")],
    tyro.conf.subcommand("layout", description="Show marker layouts, hold one against a capture, start a new one."),
]
Command = (
    Annotated[Mosh, tyro.conf.subcommand("mosh")]
    | _Layout
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; bad input gives one clear line and exit code 2, Ctrl-C leaves what is finished."""
    options = tyro.cli(Command, args=arguments, prog="habitus", config=(tyro.conf.OmitSubcommandPrefixes,))
    try:
        if isinstance(options, Mosh):
            mosh_command.run(options)
        elif isinstance(options, Train):
            train_command.run(options)
        elif isinstance(options, Evaluate):
            evaluate_command.run(options)
        else:
            layout.run(options)
    except HabitusError as error:
        print(f"habitus: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"habitus: stopped; {_left(options)}", file=sys.stderr)
        sys.exit(130)


def _left(options: Command) -> str:
    """What a command that was stopped has left."""
    if isinstance(options, Train):
        if next(options.out.glob("**/progress.npz"), None) is None:
            return f"there is no checkpoint in {options.out} yet"
        return f"the checkpoint in {options.out} is whole: the same command without --restart goes on from there"
    if isinstance(options, Evaluate):
        return f"nothing was written to {options.out}"
    return "captures that were finished are whole"


if __name__ == "__main__":
    main()
