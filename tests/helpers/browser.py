"""Headless Chromium for tests: a page's DOM and its picture."""

import json
import shutil
import subprocess
import time
from pathlib import Path
from urllib.request import urlopen

import pytest

FLAGS = (
    "--headless --no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader",
    "--disable-background-networking --no-first-run --disable-component-update --disable-sync "
    "--hide-scrollbars",
)


def chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome"):
        found = shutil.which(name)
        if found:
            return found
    pytest.skip("no Chromium here: apt-get install chromium")


def visit(
    page: Path,
    folder: Path,
    *,
    fragment: str = "",
    size: tuple[int, int] = (1280, 1000),
    picture: Path | None = None,
    extra: tuple[str, ...] = (),
) -> str:
    """The DOM after the script ran, or with ``picture`` a screenshot there."""
    profile = folder / f"profile-{len(list(folder.glob('profile-*')))}"
    what = f"--screenshot={picture}" if picture else "--dump-dom"
    command = [
        chromium(),
        *" ".join(FLAGS).split(),
        *extra,
        f"--user-data-dir={profile}",
        f"--window-size={size[0]},{size[1]}",
    ]
    url = f"{page.resolve().as_uri()}#{fragment}"
    done = subprocess.run(
        [*command, "--virtual-time-budget=1500", what, url],
        capture_output=True,
        timeout=120,
        check=True,
        text=True,
    )
    return done.stdout


def live_dom(url: str, folder: Path, expected: str, seconds: float = 60.0) -> str:
    """The DOM of a served page once it holds ``expected``, or after ``seconds``.

    A page that gets its content by a websocket is never "loaded" by the browser's own account
    (virtual time does not wait for sockets), so that the DOM is asked for again and again.
    """
    connect = pytest.importorskip("websockets.sync.client").connect
    profile = folder / f"profile-{len(list(folder.glob('profile-*')))}"
    command = [chromium(), *" ".join(FLAGS).split(), f"--user-data-dir={profile}"]
    browser = subprocess.Popen(
        [*command, "--remote-debugging-port=0", url],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    end = time.monotonic() + seconds
    dom = ""
    try:
        with connect(_page_socket(profile, end), max_size=None) as socket:
            while expected not in dom and time.monotonic() < end:
                time.sleep(0.2)
                script = {"expression": "document.documentElement.outerHTML"}
                socket.send(json.dumps({"id": 1, "method": "Runtime.evaluate", "params": script}))
                answer = json.loads(socket.recv(timeout=seconds))
                dom = answer["result"]["result"].get("value", "")
    finally:
        browser.kill()
        browser.wait()
    return dom


def _page_socket(profile: Path, end: float) -> str:
    """Address of the debugging socket of the browser's one page."""
    port = profile / "DevToolsActivePort"
    while time.monotonic() < end:
        if port.exists() and port.read_text().strip():
            with urlopen(f"http://127.0.0.1:{port.read_text().split()[0]}/json/list") as answer:
                pages = [page for page in json.load(answer) if page["type"] == "page"]
            if pages:
                return pages[0]["webSocketDebuggerUrl"]
        time.sleep(0.1)
    raise TimeoutError("Chromium opened no page")
