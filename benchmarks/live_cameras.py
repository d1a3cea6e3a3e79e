"""A person followed live through detections of calibrated cameras: how far from the truth, how far
from the offline fit, and how fast.

python benchmarks/live_cameras.py CAPTURE ... [--seeds 2] [--frames 240] [--rates 60 200]

Motions and people are those of `benchmarks/cameras.py`. The first half of a scene is fitted offline
and gives the person's shape; the second half is followed frame by frame, and fitted offline with
that half alone, for comparison; ``unknown``: live with the shape from its own first second (errors
after that). ``nobody``: frames in which nobody was found, which have no error. Errors (mm) are distances of joints (fingers apart), without any alignment. Times: a
process of its own sends the first scene's lines over UDP on loopback; the clock runs from just
before a frame's last line is sent until the pose is handed on.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import json
import multiprocessing
import socket
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from cameras import JOINTS, motion_of, scene_of
from common import parser, run, show_table

import habitus as hb
from habitus.body.prior import prior_of
from habitus.fit.cameras.live import KeypointSubject, keypoint_tracker
from habitus.io.streams.detections import DetectionStream
from habitus.jobs.cameras import fit_cameras
from habitus.kernels.threads import one_blas_thread
from habitus_lab.population.camera_scenes import CameraScene

SOCKET_S, BEGUN_S = 15.0, 4.0
"""Seconds over a socket, and those at the start, which are not counted."""


def part(scene: CameraScene, rows: slice) -> CameraScene:
    """Some frames of a scene."""
    seen = scene.detections
    seen = replace(seen, pixels=seen.pixels[rows], confidence=seen.confidence[rows])
    return replace(scene, pose=scene.pose[rows], trans=scene.trans[rows], detections=seen)


def errors(scene: CameraScene, body, betas, pose, trans, first: int = 0) -> np.ndarray:
    """Distances (mm) of joints from where they are."""
    truth = scene.body(scene.betas, scene.pose, scene.trans).joints[first : first + len(pose)]
    found = body(np.tile(betas, (len(pose), 1)), pose, trans).joints
    return 1e3 * np.linalg.norm(np.asarray(found - truth)[:, :JOINTS], axis=-1)


def followed(scene: CameraScene, known) -> tuple[np.ndarray, list[float]]:
    """Errors of a person of known shape, followed live, and seconds a frame."""
    seen = scene.detections
    subject = KeypointSubject.of_fit(known, prior_of(known.body))
    tracker = keypoint_tracker(subject, seen.rate_hz)
    frames, took = [], []
    with one_blas_thread():
        for pixels, sure in zip(seen.pixels, seen.confidence, strict=True):
            began = time.perf_counter()
            frames.append(tracker.step(np.concatenate([pixels, sure[..., None]], -1)))
            took.append(time.perf_counter() - began)
    pose, trans = (np.array([getattr(f, name) for f in frames]) for name in ("pose", "trans"))
    return errors(scene, known.body, known.betas, pose, trans), took


def unknown(scene: CameraScene, second: int) -> np.ndarray:
    """Errors after the first second, whose fit gives the shape."""
    (own,) = fit_cameras(part(scene, slice(0, second)).detections, scene.rig)
    return followed(scene, own)[0][second:]


def send(lines: list[list[bytes]], port: int, rate_hz: float, sent, ready) -> None:
    """The sender's process."""
    ready.wait(60.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        began = time.perf_counter()
        for k, frame in enumerate(lines):
            time.sleep(max(0.0, began + k / rate_hz - time.perf_counter()))
            for line in frame[:-1]:
                udp.sendto(line, ("127.0.0.1", port))
            sent[k] = time.perf_counter()
            udp.sendto(frame[-1], ("127.0.0.1", port))


class Clock:
    """When each frame's pose was handed on."""

    def __init__(self, done: np.ndarray):
        self._done = done

    def show(self, now, quality) -> None:
        """Look at the clock."""
        self._done[now.number] = time.perf_counter()

    def close(self) -> None:
        """Nothing is open."""


def on_socket(scene: CameraScene, known, rate_hz: float) -> dict:
    """Latencies (ms) of frames that come over a socket, the scene played forth and back."""
    frames = round(SOCKET_S * rate_hz)
    seen = scene.detections
    count = seen.num_frames
    there = np.abs((np.arange(frames) + count - 1) % (2 * count - 2) - (count - 1))
    lines = []
    for k, t in enumerate(there):
        own = []
        for c, name in enumerate(seen.cameras):
            at = np.nan_to_num(seen.pixels[t, c, 0] - 0.5)
            row = np.column_stack([at, seen.confidence[t, c, 0]]).round(2).tolist()
            table = {"camera": name, "frame": k, "convention": seen.convention, "keypoints": row}
            own.append(json.dumps(table).encode())
        lines.append(own)
    context = multiprocessing.get_context("spawn")
    sent, ready = context.RawArray("d", frames), context.Event()
    done = np.full(frames, np.nan)
    stream = DetectionStream(seen.cameras, None, rate_hz)
    sender = context.Process(target=send, args=(lines, stream.port, rate_hz, sent, ready))
    sender.start()
    ready.set()
    hb.live(
        stream,
        cameras=scene.rig,
        known=known,
        fps=rate_hz,
        keep=False,
        stop_after=frames / rate_hz + 4.0,
        sinks=[lambda person: Clock(done)],
    )
    sender.join(5.0)
    took = 1e3 * (done - np.array(sent))[round(BEGUN_S * rate_hz) :]
    there = np.isfinite(took)
    p50, p99 = np.percentile(took[there], [50, 99])
    return {"rate Hz": rate_hz, "p50 ms": p50, "p99 ms": p99, "longest ms": took[there].max()} | {
        "frames": int(there.sum()),
        "not solved": int((~there).sum()),
    }


def measure(options: argparse.Namespace) -> dict:
    """All scenes, then the socket."""
    rows, times = [], []
    timed = None
    for k, path in enumerate(options.captures):
        motion = motion_of(path, options.frames)
        for count in (2, 4):
            for seed in range(options.seeds):
                scene, _ = scene_of(motion, seed, k, cameras=count)
                half = len(scene.pose) // 2
                first, second = part(scene, slice(0, half)), part(scene, slice(half, None))
                (known,) = fit_cameras(first.detections, scene.rig)
                (offline,) = fit_cameras(second.detections, scene.rig)
                live, took = followed(second, known)
                fitted = errors(
                    second, offline.body, offline.betas, offline.pose, offline.trans,
                    offline.first_frame,
                )  # fmt: skip
                late = unknown(second, round(scene.detections.rate_hz))
                rows.append(
                    {"motion": path.stem, "cameras": count, "seed": seed}
                    | {"live": np.nanmean(live), "live 95 %": np.nanpercentile(live, 95)}
                    | {"nobody": int(np.isnan(live[:, 0]).sum()), "frames": len(live)}
                    | {"offline": fitted.mean(), "offline 95 %": np.percentile(fitted, 95)}
                    | {"unknown": np.nanmean(late)}
                )
                if count == 4:
                    times += took[5:]
                    timed = timed or (second, known)
    summary = []
    for count in (2, 4):
        own = [row for row in rows if row["cameras"] == count]
        keys = ("live", "live 95 %", "offline", "offline 95 %", "unknown")
        means = {key: float(np.mean([row[key] for row in own])) for key in keys}
        lost = sum(row["nobody"] for row in own) / sum(row["frames"] for row in own)
        ratio = means["live"] / means["offline"]
        summary.append({"cameras": count, **means, "ratio": ratio, "nobody %": 100.0 * lost})
    assert timed is not None
    step = {"step ms, median": 1e3 * float(np.median(times)), "frames/s": 1 / np.mean(times)}
    sockets = [on_socket(*timed, rate) for rate in options.rates]
    return {"summary": summary, "rows": rows, "step": step, "sockets": sockets}


def show(found: dict) -> None:
    """Print the tables."""
    show_table("scenes", found["rows"], 1)
    show_table("live through cameras, mm", found["summary"], 2)
    show_table("a step, 4 cameras", [found["step"]])
    show_table("over a socket, 4 cameras", found["sockets"])


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("captures", nargs="+", type=Path)
    arguments.add_argument("--seeds", type=int, default=2)
    arguments.add_argument("--frames", type=int, default=240)
    arguments.add_argument("--rates", type=float, nargs="+", default=[60.0, 200.0])
    run(arguments, measure, show)
