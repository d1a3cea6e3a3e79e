"""The `habitus` command's first lines, also as `python -m habitus`: from them on, Ctrl-C is one
line and exit code 130, while the command itself is still being imported.
"""

import os
import signal


def start() -> None:
    """Run the command line; `habitus.cli.main.main` takes over Ctrl-C once it is imported."""
    mine = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if mine:  # not in a background job that ignores Ctrl-C
        signal.signal(signal.SIGINT, _stop)
    from habitus.cli.main import main

    if mine:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    main()


def _stop(number: int, frame: object) -> None:
    os.write(2, b"habitus: stopped; nothing was written\n")
    os._exit(130)


if __name__ == "__main__":
    start()
