"""A viser server for this machine's user alone: for `habitus view` and `habitus live --view`.

viser answers whoever reaches its port, so that a page of any website, open in the same browser,
could read the scene over a websocket, or by a host name that resolves to 127.0.0.1 (DNS rebinding).
`PageServer` answers requests only that

- name this machine in ``Host``: 127.0.0.1, localhost or [::1];
- come from a page of this server where they carry an ``Origin``, as those of websockets do;
- begin their path with a random token, which is part of the address that is printed.

Everything else is answered with 403, the page and the websocket alike. viser has no hook for this:
while it starts, the function of the package websockets that serves is replaced by one that checks
first. Where that function was not called, nothing is served.
"""

import hmac
import logging
import re
import secrets
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from dataclasses import replace
from io import StringIO
from typing import Any
from urllib.parse import urlsplit

from habitus.errors import HabitusError, require_extra

HOST = "127.0.0.1"
NAMES = frozenset({HOST, "localhost", "::1"})
"""What a browser on this machine calls it."""
TOKEN_BYTES = 16
_starting = threading.Lock()


def new_token() -> str:
    """A random word for an address, that nobody can guess."""
    return secrets.token_urlsafe(TOKEN_BYTES)


def page_address(port: int, token: str) -> str:
    """Where the page is, for a browser on this machine."""
    return f"http://{HOST}:{port}/{token}/"


def markdown_text(text: str) -> str:
    """Markdown that shows a text as it is, on one line: names out of files may hold HTML, which
    viser puts into the page unchanged.
    """
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(text.split()))


def refusal(host: str | None, origin: str | None, path: str, token: str) -> str | None:
    """Why a request is refused, by its headers and its path; None where it is answered."""
    try:
        name = urlsplit(f"//{host}").hostname if host else None
    except ValueError:
        name = None
    if name not in NAMES:
        return "the request names another host than this machine"
    if origin is not None and origin != f"http://{host}":
        return "the request comes from another page"
    given = path.partition("?")[0].split("/")[1:2]
    if not given or not hmac.compare_digest(given[0].encode(), token.encode()):
        return "the address lacks its token; open the whole address that habitus printed"
    return None


class PageServer:
    """A page on a port of this machine, or on the next free one; ``viser`` is its server."""

    def __init__(self, port: int, label: str, token: str):
        viser = require_extra("viser", "views", "view")
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a closed tab is no error
        with _checked(token), _without_viser_output():
            self.viser: Any = viser.ViserServer(HOST, port, label=label, verbose=False)
        self.port: int = self.viser.get_port()
        self.address = page_address(self.port, token)

    def stop(self) -> None:
        """Serve no more."""
        with _without_viser_output():
            self.viser.stop()


def _without_viser_output() -> AbstractContextManager[Any]:
    """viser prints addresses without the token, which are not answered."""
    return redirect_stdout(StringIO())


@contextmanager
def _checked(token: str) -> Iterator[None]:
    """Within, a server that the package websockets starts answers requests with the token only.

    Raises HabitusError where none was started.
    """
    import websockets.asyncio.server as server

    original = server.serve
    calls = 0

    def serve(handler: Any, *place: Any, process_request: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1

        def check(connection: Any, request: Any) -> Any:
            host, origin = (_only(request.headers, name) for name in ("Host", "Origin"))
            why = refusal(host, origin, request.path, token)
            if why is not None:
                return connection.respond(403, f"habitus: {why}\n")
            inside = request.path[len(token) + 1 :] or "/"
            response = process_request(connection, replace(request, path=inside))
            if response is not None:
                response.headers["Referrer-Policy"] = "no-referrer"  # the token stays here
                response.headers["X-Frame-Options"] = "SAMEORIGIN"
            return response

        return original(handler, *place, process_request=check, **options)

    with _starting:
        server.serve = serve
        try:
            yield
        finally:
            server.serve = original
    if not calls:
        raise HabitusError(
            "this version of viser starts its page in a way that habitus cannot protect; install "
            "another one: pip install viser==1.1.1"
        )


def _only(headers: Any, name: str) -> str | None:
    """The header's value; of several the sum, which no check lets pass."""
    values = headers.get_all(name)
    return ", ".join(values) if values else None
