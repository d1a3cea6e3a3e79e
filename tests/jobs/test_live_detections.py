"""Detections of several cameras, sent over a socket, become a person in motion; cameras that are
missing, late or see somebody else are survived and said.
"""

import json
import socket
import threading
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import habitus as hb
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.cameras.live import KeypointSubject, keypoint_tracker
from habitus.io.keypoints.fits import read_camera_fit
from habitus.io.streams.detections import DetectionStream
from habitus.jobs.cameras import CameraResult, fit_cameras
from habitus.results.cameras import save_cameras
from habitus_lab.population.camera_scenes import CameraScene, camera_scene

RATE = 60.0
FRAMES = 150
DOCS = Path(__file__).resolve().parents[2] / "docs" / "cameras.md"


@cache
def scene(seed: int = 3, shift: float = 0.0) -> CameraScene:
    """Somebody who walks on the spot, turns and swings the arms."""
    body = hb.load_body("female")
    names = body.joint_names
    rng = np.random.default_rng(seed)
    mean = prior_of(body).for_joints(names).mean.reshape(-1, 3)
    phase = np.linspace(0.0, 4.0 * np.pi, FRAMES) + seed
    pose = np.tile(np.concatenate([np.zeros((1, 3)), mean]), (FRAMES, 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * np.sin(phase)
        pose[:, names.index(f"{side}_hip"), 0] -= 0.5 * np.maximum(swing, -0.3)
        pose[:, names.index(f"{side}_knee"), 0] += 0.6 * np.maximum(swing, 0.0)
        pose[:, names.index(f"{side}_elbow"), 1] -= sign * 0.5
        pose[:, names.index(f"{side}_shoulder"), 1] += 0.4 * swing
    pose[:, 0, 1] = 0.4 * phase
    trans = np.zeros((FRAMES, 3))
    trans[:, 0] = shift + 0.3 * np.sin(phase / 3.0)
    return camera_scene(body, pose, trans, RATE, 4, rng)


@cache
def offline() -> CameraResult:
    (fit,) = fit_cameras(scene().detections, scene().rig)
    return fit


def errors(fit, made: CameraScene, first: int = 0) -> np.ndarray:
    """Distances (m) of joints but fingers, frame by frame."""
    rows = slice(first, first + len(fit.pose))
    truth = np.asarray(made.body(made.betas, made.pose[rows], made.trans[rows]).joints)
    return np.linalg.norm(fit.joints()[:, :22] - truth[:, :22], axis=-1)


def line(made: CameraScene, t: int, c: int, **other) -> dict:
    """What a detector sends of one camera and frame."""
    detections = made.detections
    at = np.nan_to_num(detections.pixels[t, c, 0] - 0.5)
    row = np.column_stack([at, detections.confidence[t, c, 0]]).round(3)
    return {
        "camera": detections.cameras[c],
        "frame": t,
        "convention": detections.convention,
        "keypoints": row.tolist(),
        **other,
    }


def every_line(made: CameraScene) -> list[list[dict]]:
    """Of each frame the lines of its cameras."""
    return [[line(made, t, c) for c in range(4)] for t in range(made.detections.num_frames)]


def free_port() -> int:
    """Of UDP on this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        return udp.getsockname()[1]


def follow(frames: list[list[dict | bytes]], rate: float = RATE, **options):
    """`habitus.live` on a socket to which the lines are sent; the fit and what was said."""
    stream = DetectionStream(scene().rig.names, f"127.0.0.1:{free_port()}", RATE)
    done = threading.Event()
    said: list[str] = []

    def send() -> None:
        began = time.perf_counter()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            for k, lines in enumerate(frames):
                time.sleep(max(0.0, began + k / rate - time.perf_counter()))
                for each in lines:
                    packet = each if isinstance(each, bytes) else json.dumps(each).encode()
                    udp.sendto(packet, ("127.0.0.1", stream.port))
        done.wait(0.3)
        stream.ended = True

    thread = threading.Thread(target=send)
    thread.start()
    try:
        fit = hb.live(
            stream,
            cameras=scene().rig,
            fps=RATE,
            say=lambda text, mark="": said.append(text),
            **options,
        )
    finally:
        done.set()
        thread.join()
    return fit, " | ".join(said)


def test_detections_become_a_person_in_motion(tmp_path):
    fit, said = follow(every_line(scene()), known=offline(), out=tmp_path / "out")
    assert len(fit.pose) == FRAMES and fit.up_axis == "+y"
    found, wanted = errors(fit, scene()).mean(), errors(offline(), scene()).mean()
    assert found < 1.5 * wanted
    assert fit.verdict.level == "good" and "as saved" in said
    assert "hatch" in (tmp_path / "out" / "report.html").read_text().lower()
    again = read_camera_fit(tmp_path / "out")
    np.testing.assert_allclose(again.pose, fit.pose, atol=1e-6)
