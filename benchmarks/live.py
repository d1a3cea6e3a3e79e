"""From a packet to a pose: how long a live fit takes, with the viewer and without, on a quiet and
on a busy machine.

python benchmarks/live.py [--seconds 30] [--rate 120] [--layout mosh-67] [--busy] [--browser] [--out
FILE.json]

A process of its own sends NatNet packets of a synthetic capture on loopback, as Motive sends them.
The clock runs from just before a packet is sent until the pose is handed on. --busy keeps every
core occupied meanwhile; --browser opens the viewer's page in a headless Chromium, which without a
graphics card draws on the processor and keeps it busy, too.
"""

import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

import numpy as np
from common import in_words, machine, parser, synthetic, write_json
from natnet_server import NatNetServer, frame, model

import habitus as hb
from habitus.jobs.live_sinks import sinks

GATHERED_S = 2.0
PAGE_S = 8.0


class Clock:
    """When each frame's pose was handed on, by the frame's number."""

    def __init__(self, done, person):
        self._done = done

    def show(self, now, quality):
        """Look at the clock."""
        self._done[now.number] = time.perf_counter()

    def close(self):
        """Nothing is open."""


def send(points, labels, rate_hz, sent, ready, ended):
    """The server's process: frames at a rate, and when each was sent."""
    with NatNetServer(model("Bob", labels), rate_hz=rate_hz) as server:
        packets = [frame(k, each, "Bob") for k, each in enumerate(points)]
        ready.put(server.address)
        while server.client is None or 4 not in server.asked:  # the model was asked for: it listens
            time.sleep(0.01)
        began = time.perf_counter()
        for k, packet in enumerate(packets):
            time.sleep(max(0.0, began + k / rate_hz - time.perf_counter()))
            sent[k] = time.perf_counter()
            server.socket.sendto(packet, server.client)
        ended.wait(2.0)


def occupied():
    """Work that never ends."""
    while True:
        sum(range(10_000))


def browse(url, folder):
    """A headless Chromium that shows the page."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("no Chromium here")
    words = (
        "--headless --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
    )
    command = [
        chromium,
        *words.split(),
        "--remote-debugging-port=0",
        f"--user-data-dir={folder}",
        url,
    ]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def run(subject, points, labels, options, view, folder):
    """Latencies (ms) of all frames but the first seconds, and how many were lost or late."""
    context = multiprocessing.get_context("spawn")
    sent = context.RawArray("d", len(points))
    done = np.full(len(points), np.nan)
    ready = context.Queue()
    ended = context.Event()
    browsers = []
    said = []

    def say(text):
        if options.browser and text.startswith("viewer: "):
            browsers.append(browse(text.removeprefix("viewer: "), folder))

    server = context.Process(
        target=send, args=(points, labels, options.rate, sent, ready, ended), daemon=True
    )
    others = (
        [context.Process(target=occupied, daemon=True) for _ in range(os.cpu_count() or 1)]
        if options.busy
        else []
    )
    for each in (server, *others):
        each.start()
    made = [partial(Clock, done), *(sinks((), 8090, say) if view else [])]
    try:
        address = ready.get(timeout=60)
        until = len(points) / options.rate
        note = lambda text, mark="": said.append(text)  # noqa: E731
        hb.live(
            "natnet",
            address,
            known=subject,
            sinks=made,
            stop_after=until,
            say=note,
            on_status=note,
        )
    finally:
        ended.set()
        for each in (server, *others):
            each.terminate()
        for each in browsers:
            each.terminate()
    began = round((PAGE_S + GATHERED_S) * options.rate)
    took = 1e3 * (done - np.array(sent))[began:-10]
    if not np.isfinite(took).any():
        sys.exit("\n".join(["no frame was solved in time:", *said]))
    if options.verbose:
        print("\n".join(said))
    return took[np.isfinite(took)], int(np.isnan(took).sum())


def main() -> None:
    """Make a person, follow them, print and write."""
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=float, default=30.0)
    arguments.add_argument("--rate", type=float, default=120.0)
    arguments.add_argument("--layout", default="mosh-67")
    arguments.add_argument("--busy", action="store_true")
    arguments.add_argument("--browser", action="store_true")
    arguments.add_argument("--verbose", action="store_true")
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    named = machine()
    body = hb.load_body("default")
    capture = synthetic(
        body, options.layout, round((options.seconds + PAGE_S + GATHERED_S) * options.rate)
    )
    subject = hb.Mosh(layout=options.layout, soft_tissue=False).fit(capture[:600], body)
    print(
        f"{in_words(named)}; {len(capture.labels)} markers at {options.rate:g} "
        f"Hz{', busy' if options.busy else ''}"
    )
    print(
        "| viewer | p50 ms | p99 ms | p99.9 ms | longest ms | frames | not solved "
        "|\n|---|---|---|---|---|---|---|"
    )
    rows = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        for view in (False, True):
            took, missing = run(subject, capture.markers, capture.labels, options, view, folder)
            p50, p99, p999 = np.percentile(took, [50, 99, 99.9])
            what = "none" if not view else "and its page" if options.browser else "served"
            rows.append(
                {
                    "viewer": what,
                    "p50_ms": p50,
                    "p99_ms": p99,
                    "p999_ms": p999,
                    "longest_ms": took.max(),
                }
                | {"frames": len(took), "not_solved": missing}
            )
            print(
                f"| {what} | {p50:.2f} | {p99:.2f} | {p999:.2f} | {took.max():.1f} | {len(took)} "
                f"| {missing} |",
                flush=True,
            )
    if options.out:
        write_json(
            options.out,
            {"machine": named, "busy": options.busy, "rate_hz": options.rate, "rows": rows},
        )


if __name__ == "__main__":
    main()
