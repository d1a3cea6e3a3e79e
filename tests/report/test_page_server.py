"""The server of `habitus view` and `habitus live --view`: nobody reads the scene without the whole
address, from another page or by another name of the machine; a browser that opens the address does.
"""

import http.client
import time
from types import SimpleNamespace

import numpy as np
import pytest
from browser import live_dom
from injection import HOSTILE, TEXTS

from habitus.errors import HabitusError
from habitus.fit.verdict import Verdict
from habitus.jobs.live_sinks import _text as live_text
from habitus.report import page_server
from habitus.report.page_server import PageServer, new_token, refusal

pytest.importorskip("viser")
connect = pytest.importorskip("websockets.sync.client").connect
InvalidStatus = pytest.importorskip("websockets.exceptions").InvalidStatus
SECRET = "a-name-that-only-the-scene-has"


@pytest.fixture(scope="module")
def page():
    token = new_token()
    server = PageServer(8791, "habitus test", token)
    triangle = np.eye(3, dtype=np.float32)
    server.viser.scene.add_mesh_simple(f"/{SECRET}", triangle, np.array([[0, 1, 2]]))
    server.viser.gui.add_markdown(SECRET)
    yield server, token
    server.stop()


def get(server, path, **headers):
    """The status and the body of an answer to a request with just these headers."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, answer.read(), dict(answer.headers)
    connection.close()
    return found


def scene(server, path, **options):
    """What a raw websocket client of viser's protocol is sent within a second."""
    import viser

    protocol = f"viser-v{viser.__version__}"
    url = f"ws://127.0.0.1:{server.port}{path}"
    with connect(url, subprotocols=[protocol], max_size=None, **options) as socket:
        received = b""
        until = time.monotonic() + 1.0
        while time.monotonic() < until:
            try:
                received += socket.recv(timeout=0.2)
            except TimeoutError:
                if received:
                    break
    return received


def test_the_whole_address_is_answered(page):
    server, token = page
    assert server.address == f"http://127.0.0.1:{server.port}/{token}/" and len(token) >= 20
    for host in (f"127.0.0.1:{server.port}", f"localhost:{server.port}", "localhost:9000"):
        status, body, headers = get(server, f"/{token}/", Host=host)
        assert status == 200 and b"<html" in body.lower()
        assert headers["Referrer-Policy"] == "no-referrer"
    own = f"http://127.0.0.1:{server.port}"
    assert len(scene(server, f"/{token}", origin=own)) > 500
    assert len(scene(server, f"/{token}", origin=None)) > 500  # no browser: it has the token


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8791",
        "127.0.0.1.evil.example",
        "127.0.0.1@evil.example",
        "",
        "[",
    ],
)
def test_another_host_name_is_refused(page, host):
    """DNS rebinding: the browser believes that evil.example is this machine."""
    server, token = page
    status, body, _ = get(server, f"/{token}/", Host=host)
    assert status == 403 and b"<html" not in body.lower()


@pytest.mark.parametrize("path", ["/", "/index.html", "/{}x/", "/x{}/", "//{}/", "/%2e%2e/{}/", ""])
def test_a_path_without_the_token_is_refused(page, path):
    server, token = page
    status, body, _ = get(server, path.format(token) or "/?x=/" + token, Host="localhost")
    assert status == 403 and b"<html" not in body.lower()


def test_a_request_without_a_host_or_with_two_is_refused(page):
    server, token = page
    assert get(server, f"/{token}/")[0] == 403
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.putrequest("GET", f"/{token}/", skip_host=True)
    connection.putheader("Host", "localhost")
    connection.putheader("Host", "evil.example")
    connection.endheaders()
    assert connection.getresponse().status == 403
    connection.close()


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        "http://127.0.0.1",
        "http://localhost:1",
        "https://127.0.0.1:8791",
    ],
)
def test_a_websocket_of_another_page_is_refused(page, origin):
    server, token = page
    with pytest.raises(InvalidStatus, match="403"):
        scene(server, f"/{token}", origin=origin)


def test_a_websocket_without_the_token_or_by_another_name_is_refused(page):
    server, token = page
    own = f"http://127.0.0.1:{server.port}"
    for path in ("", "/", "/viser", f"/{token[:-1]}"):
        with pytest.raises(InvalidStatus, match="403"):
            scene(server, path, origin=own)
    name = f"evil.example:{server.port}"
    assert refusal(name, f"http://{name}", f"/{token}", token) is not None


def test_a_browser_shows_the_scene_by_the_whole_address_only(page, tmp_path):
    server, _ = page
    assert SECRET in live_dom(server.address, tmp_path, SECRET)
    without_token = f"http://127.0.0.1:{server.port}/"
    assert SECRET not in live_dom(without_token, tmp_path, SECRET, seconds=8)


def test_names_out_of_files_stay_text(tmp_path):
    """viser puts HTML in markdown into the page; `markdown_text` keeps it text."""
    server = PageServer(8795, "habitus test", new_token())
    gui = server.viser.gui
    verdict = Verdict("doubtful", TEXTS)
    quality = SimpleNamespace(verdict=verdict, mean_mm=1.0, seen=3, labels=TEXTS, what="markers")
    with gui.add_folder(HOSTILE):
        gui.add_markdown(live_text(HOSTILE, SimpleNamespace(seconds=1.0), quality))
        gui.add_dropdown(HOSTILE, TEXTS)
        gui.add_checkbox(HOSTILE, False)
    server.viser.scene.add_label("/name", HOSTILE)
    shown = "&lt;b id=injected&gt;bold&lt;/b&gt;"
    seen = live_dom(server.address, tmp_path, shown)
    server.stop()
    assert shown in seen
    root = seen[seen.index("<html") :].partition(">")[0]
    assert (
        "data-ran" not in root
        and '<b id="injected"' not in seen
        and 'href="javascript:' not in seen
    )


def test_a_viser_that_cannot_be_protected_is_not_served(monkeypatch):
    import viser

    class Other:
        def __init__(self, *place, **options):
            pass

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(HabitusError, match="viser"):
        PageServer(8799, "habitus test", new_token())


def test_tokens_differ():
    assert len({page_server.new_token() for _ in range(100)}) == 100
