"""The `habitus` command: finds the subcommand and loads only that one; errors in one line, and
Ctrl-C, whenever it comes, in one line and exit code 130.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass
from types import FrameType
from typing import Any

from habitus import __version__
from habitus.errors import HabitusError, TorchIsAnExtra, shown

COMMANDS = {
    "mosh": "Fit a body to motion captures: body.npz, body.glb, metrics.json, report.html.",
    "archive": "Fit every capture below a folder, in parallel, and resume a stopped run: page and "
    "table of all results.",
    "label": "Label the points of an unlabelled capture, by a layout or by a labelled capture.",
    "live": "Follow one person through a live stream of markers or of cameras' keypoints: viewer, "
    "OSC and VMC, a result at the end.",
    "register": "Register scans of people to a body: surfaces in its topology, for training and "
    "measuring.",
    "rgbd": "Fit a body to images of a depth camera: shape, pose, light, albedo, measurements.",
    "cameras": "Fit bodies to 2D keypoints of calibrated cameras.",
    "gait": "Compute joint angles by convention, strides, and joint moments from force plates.",
    "measure": "Measure a person: height, mass, circumferences, breadths, lengths, with a picture "
    "of the tapes.",
    "body": "Estimate a person's body from some measurements: height, weight, sex, age, waist, …",
    "compare": "Compare two results of one capture: two fits, or those of two tools, on one page.",
    "exaggerate": "Scale the soft-tissue motion of a fit.",
    "retarget": "Transfer the motion of a fit to another body, a character or a humanoid robot, "
    "with foot contacts.",
    "export": "Write a fit for Blender, Maya, Unity, Unreal, OpenSim: FBX, USD, glTF, BVH, TRC, "
    "MOT.",
    "view": "Show bodies, results, motions and scans in the browser.",
    "markers": "Write virtual markers of a body in motion, or fill a capture's gaps from its fit.",
    "select-markers": "Choose the marker set that constrains a body best, for a given goal.",
    "select-poses": "Choose the poses that constrain a person's shape best.",
    "layout": "Show marker layouts, check one against a capture, draft a new one.",
    "train": "Learn a body model from registrations of people in poses.",
    "train-dynamics": "Learn how soft tissue moves from registrations of people in motion.",
    "evaluate": "Measure body models on registrations of unseen people.",
    "doctor": "Say what is installed, what is missing, and what this machine can do.",
}
"""Subcommands and their summaries; each is a module of this package (with _ for -)."""
VERBOSE = ("-v", "--verbose")
STOPPED = 130
"""A shell's exit code of a command that Ctrl-C ended."""
PIPE_CLOSED = 141
"""A shell's exit code of a command that ends because nobody reads on."""


@dataclass
class Stop:
    """What Ctrl-C does: the end of the process before work has begun, then a KeyboardInterrupt,
    then the end again.

    An exception would not do before: whoever imports modules may take it for a module that is
    missing. ``left`` says what a stopped run has left.
    """

    left: Callable[[], str] = lambda: "nothing was written"
    begun: bool = False
    asked: bool = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """As a handler of signals."""
        if self.begun and not self.asked:
            self.asked = True
            raise KeyboardInterrupt
        with suppress(Exception):
            sys.stdout.flush()
        with suppress(OSError):
            os.write(2, f"{self.line}\n".encode(errors="backslashreplace"))
        os._exit(STOPPED)

    @property
    def line(self) -> str:
        """The line that is printed then."""
        return f"habitus: stopped; {self.left()}"


@contextmanager
def on_ctrl_c(stop: Stop, stays: bool) -> Iterator[None]:
    """Let ``stop`` handle Ctrl-C, where it is not ignored or handled by somebody else; ``stays``:
    also afterwards.
    """
    try:
        mine = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        before = signal.signal(signal.SIGINT, stop) if mine else None
    except ValueError:  # another thread than the main one
        before = None
    try:
        yield
    finally:
        stop.begun = False
        if before is not None and not stays:
            signal.signal(signal.SIGINT, before)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; bad input gives one clear line and exit code 2, Ctrl-C keeps finished
    results.

    ``-v`` anywhere shows where an error was raised.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    verbose = any(word in VERBOSE for word in given)
    name, *rest = [word for word in given if word not in VERBOSE] or [""]
    stop = Stop()
    try:
        with on_ctrl_c(stop, stays=arguments is None), _writes_anything():
            if name in ("-h", "--help", "--version"):
                print(__version__ if name == "--version" else usage())
                sys.exit(0)
            if name not in COMMANDS:
                print(f"habitus: {_unknown(name)}", file=sys.stderr)
                sys.exit(2)
            code = _run(name, rest, verbose, stop)
            if code:
                sys.exit(code)
    except BrokenPipeError:
        for stream in (sys.stdout, sys.stderr):  # Python writes what is left in them as it ends
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        sys.exit(PIPE_CLOSED)


@contextmanager
def _writes_anything() -> Iterator[None]:
    """What the terminal's encoding does not hold is written as an escape; what was written is out
    at the end.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, ValueError):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        yield
    finally:
        sys.stdout.flush()


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


def _run(name: str, arguments: list[str], verbose: bool, stop: Stop) -> int:
    from importlib import import_module

    try:
        with TorchIsAnExtra(f"habitus {name}"):
            with _without_collection():  # modules stay
                command, options = _parsed(name, arguments)
                for module in command.NEEDS:
                    import_module(module)
            stop.left = lambda: command.left(options)
            stop.begun = True
            return command.run(options) or 0
    except HabitusError as error:
        return _refused(error, verbose)
    except BaseException as error:
        if stop.asked or isinstance(error, KeyboardInterrupt):
            print(stop.line, file=sys.stderr)
            return STOPPED
        if isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
            return _refused(HabitusError(f"{error}; check the path and its permissions"), verbose)
        raise


@contextmanager
def _without_collection() -> Iterator[None]:
    """No garbage is collected, and what there is at the end is left out of later collections."""
    import gc

    collected = gc.isenabled()
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        if collected:
            gc.enable()


def _refused(error: HabitusError, verbose: bool) -> int:
    """Print the error; called while it, or its cause, is handled. Returns the exit code."""
    if verbose:
        import traceback

        traceback.print_exc()
    print(f"habitus: {error}", file=sys.stderr)
    return 2


def _parsed(name: str, arguments: list[str]) -> tuple[Any, Any]:
    """The command's module and its options."""
    from importlib import import_module
    from inspect import cleandoc

    import tyro

    command = import_module(f"habitus.cli.{name.replace('-', '_')}")
    _check_names(name, arguments, command.OPTIONS)
    config = (tyro.conf.OmitSubcommandPrefixes, tyro.conf.DisallowNone)
    prog = f"habitus {name}"
    about = cleandoc(command.ABOUT)
    with _unwrapped_help():
        options = tyro.cli(
            command.OPTIONS, args=arguments, prog=prog, description=about, config=config
        )
    return command, options


@contextmanager
def _unwrapped_help() -> Iterator[None]:
    """Docstrings of options without the line breaks and indentation of the source, which tyro would
    show in the help.
    """
    import docstring_parser

    parse = docstring_parser.parse_from_object

    def unwrapped(kind: object) -> Any:
        parsed = parse(kind)
        for option in parsed.params:
            option.description = " ".join((option.description or "").split()) or None
        return parsed

    docstring_parser.parse_from_object = unwrapped
    try:
        yield
    finally:
        docstring_parser.parse_from_object = parse


ALSO_CALLED = {
    "gender": ("sex",),
    "rate": ("fps",),
    "hz": ("fps",),
    "to": ("out",),
    "output": ("out",),
    "jobs": ("workers",),
    "threads": ("workers",),
    "model": ("body",),
    "mass": ("weight",),
    "stature": ("height",),
    "correctives": ("bake-correctives",),
}
"""What options are called elsewhere, and here."""


def _check_names(command: str, arguments: list[str], options: Any) -> None:
    """Raise HabitusError for an option that the command does not have and that resembles one of
    its own.
    """
    from difflib import get_close_matches

    if not is_dataclass(options):
        return  # it has commands of its own
    known = [field.name.replace("_", "-") for field in fields(options)]
    for word in arguments:
        given = word.partition("=")[0].removeprefix("--").replace("_", "-")
        if not word.startswith("--") or given.removeprefix("no-") in (*known, "", "help"):
            continue
        near = [name for name in ALSO_CALLED.get(given, ()) if name in known]
        near = near or get_close_matches(given, known, 1, 0.75)
        if near:
            raise HabitusError(
                f"habitus {command} has no option --{shown(given)}; did you mean --{near[0]}?"
            )


def _unknown(name: str) -> str:
    from difflib import get_close_matches

    listed = ", ".join(COMMANDS)
    if not name:
        return f"no command was given; expected one of {listed}; see habitus --help"
    near = get_close_matches(name, COMMANDS, n=1)
    hint = f"did you mean habitus {near[0]}?" if near else "see habitus --help"
    return f"there is no command {shown(name)!r}; expected one of {listed}; {hint}"


if __name__ == "__main__":
    main()
