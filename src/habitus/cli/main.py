"""The `habitus` command: finds the subcommand and loads only that one; errors in one line."""

import sys

from habitus import __version__
from habitus.errors import HabitusError, TorchIsAnExtra

COMMANDS = {
    "mosh": "Fit a body to motion captures: body.npz, body.glb, metrics.json, report.html.",
    "layout": "Show marker layouts, hold one against a capture, start a new one.",
    "train": "Learn a body model from registrations of people in poses.",
    "evaluate": "Measure body models on registrations of people that they have not seen.",
}
"""Subcommands, each a module of this package, and what they do."""
VERBOSE = ("-v", "--verbose")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; bad input gives one clear line and exit code 2, Ctrl-C leaves what is finished.

    ``-v`` anywhere shows where an error was raised.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    verbose = any(word in VERBOSE for word in given)
    name, *rest = [word for word in given if word not in VERBOSE] or [""]
    if name in ("-h", "--help", "--version"):
        print(__version__ if name == "--version" else usage())
        sys.exit(0)
    if name not in COMMANDS:
        print(f"habitus: {_unknown(name)}", file=sys.stderr)
        sys.exit(2)
    _run(name, rest, verbose)


def usage() -> str:
    """The help of the whole command."""
    width = max(map(len, COMMANDS))
    lines = "\n".join(f"  {name:{width}}  {text}" for name, text in COMMANDS.items())
    return f"""usage: habitus COMMAND … [-v]

The state of the human body (shape, pose, soft tissue), estimated from motion captures.

commands:
{lines}

options:
  -h, --help     Show this, or with a command its options: habitus mosh --help
  --version      Show the version.
  -v, --verbose  Show where an error was raised."""


def _run(name: str, arguments: list[str], verbose: bool) -> None:
    from importlib import import_module

    import tyro

    options = None
    try:
        with TorchIsAnExtra(f"habitus {name}"):
            command = import_module(f"habitus.cli.{name}")
            prog, config = f"habitus {name}", (tyro.conf.OmitSubcommandPrefixes,)
            options = tyro.cli(command.OPTIONS, args=arguments, prog=prog, description=command.ABOUT, config=config)
            code = command.run(options)
    except HabitusError as error:
        if verbose:
            import traceback

            traceback.print_exc()
        print(f"habitus: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        told = "nothing was written" if options is None else command.left(options)
        print(f"habitus: stopped; {told}", file=sys.stderr)
        sys.exit(130)
    if code:
        sys.exit(code)


def _unknown(name: str) -> str:
    from difflib import get_close_matches

    listed = ", ".join(COMMANDS)
    if not name:
        return f"no command was given; expected one of {listed}; see habitus --help"
    near = get_close_matches(name, COMMANDS, n=1)
    hint = f"did you mean habitus {near[0]}?" if near else "see habitus --help"
    return f"there is no command {name!r}; expected one of {listed}; {hint}"


if __name__ == "__main__":
    main()
