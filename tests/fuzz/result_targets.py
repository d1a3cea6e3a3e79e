"""Readers of what habitus itself wrote: fits, motions, persons, manifests and subjects of
archives, folders of results.
"""

import json
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
from target import Target, alone

from habitus.errors import HabitusError


def result_makers() -> tuple[Callable[[Path], list[Target]], ...]:
    """What makes the targets, each in a folder of its own."""
    return _fits, _motions, _persons, _archives, _pages, _other_programs


def _check_moving(moving) -> None:
    frames, joints = moving.pose.shape[:2]
    assert frames > 0 and joints == moving.body.num_joints and moving.trans.shape == (frames, 3)
    assert moving.betas.shape == (moving.body.num_betas,)
    arrays = (moving.pose, moving.trans, moving.betas, moving.soft_tissue, moving.dynamics)
    assert all(np.isfinite(array).all() for array in arrays if array is not None)
    assert 0 < moving.rate_hz < 1e6 and moving.up_axis[1] in "xyz"


def _fits(folder: Path) -> list[Target]:
    from synthetic_fit import synthetic_fit, tube_body

    from habitus.export.npz import write_npz
    from habitus.io.people import read_fit

    body = tube_body()

    def read(path: Path) -> None:
        fit = read_fit(path, body)
        _check_moving(fit)
        assert len(fit.labels) == fit.observed_markers.shape[1]
        assert not np.isinf(fit.observed_markers).any()
        assert all(0 <= corner < body.num_vertices for corner in fit.attachment.triangles.ravel())

    for name, soft in (("hard", False), ("soft", True)):
        write_npz(synthetic_fit(frames=6, soft=soft), folder / f"{name}.npz")
    return [
        alone(
            "fit.npz", read, *((folder / f"{name}.npz").read_bytes() for name in ("hard", "soft"))
        )
    ]


def _motions(folder: Path) -> list[Target]:
    from synthetic_fit import synthetic_fit, tube_body

    from habitus.body.motion import BodyMotion
    from habitus.export.motion import write_motion
    from habitus.io.people import read_motion

    body = tube_body()

    def read(path: Path) -> None:
        motion = read_motion(path, body)
        _check_moving(motion)
        assert np.isfinite(motion.vertices([0, motion.num_frames - 1])).all()

    fit = synthetic_fit(frames=6)
    write_motion(BodyMotion.of(fit), folder / "own.npz")
    np.savez(
        folder / "amass.npz",
        poses=np.array(fit.pose).reshape(6, -1),
        trans=fit.trans,
        betas=fit.betas,
        mocap_framerate=120.0,
        gender="female",
        dmpls=np.ones((6, 8)),
    )
    return [
        alone(
            "motion.npz",
            read,
            *((folder / f"{name}.npz").read_bytes() for name in ("own", "amass")),
        )
    ]


def _persons(folder: Path) -> list[Target]:
    from synthetic_fit import tube_body

    from habitus.io.people import BodyShape, open_person

    body = tube_body()

    def read(path: Path) -> None:
        person = open_person(path, body)
        if isinstance(person, BodyShape):
            assert np.isfinite(person.betas).all() and np.isfinite(person.rest_vertices()).all()
            assert person.name.isprintable()

    betas = np.linspace(-1.0, 1.0, body.num_betas)
    skin = np.full(body.num_vertices, 0.001)
    np.savez(folder / "a.npz", betas=betas, surface_model_type="tube", gender="neutral")
    np.savez_compressed(folder / "b.npz", body_betas=betas, betas=betas, skin_offset=skin)
    return [alone("person.npz", read, *((folder / f"{name}.npz").read_bytes() for name in "ab"))]


def _archives(folder: Path) -> list[Target]:
    from habitus.jobs.archive.items import FileContent, Fitted, Seen, Shaped, read_known
    from habitus.jobs.archive.manifest import FILE, open_manifest
    from habitus.jobs.finding import MarkerSet

    def manifest(path: Path) -> None:
        with open_manifest(path.parent) as found:
            rows = found.captures()
            list(found.results()), found.people(), list(found.marker_sets()), found.stamps()
            assert found.count() >= 0 and found.left_out() >= 0
            for row in rows:
                assert not Path(row.folder).is_absolute() and ".." not in Path(row.folder).parts
                found.subject(row.subject)

    def subject(path: Path) -> None:
        known = read_known(path)
        assert np.isfinite(known.shape.betas).all() and known.seconds >= 0

    place = folder / "archive"
    place.mkdir()
    markers = MarkerSet("Ann", ("A", "B", "C"), np.ones((3, 3)))
    with open_manifest(place) as made:
        for k, name in enumerate(("one.c3d", "two.c3d", "no.c3d")):
            people = (Seen("Ann", 5, 100.0, markers),) if k < 2 else ()
            held = FileContent("digest", people, "" if people else "broken")
            made.record_file(name, (1, 2), held, [name[:3]][: len(people)])
        made.group({(name, ""): "Ann" for name in ("one.c3d", "two.c3d")})
        for row in made.captures():
            made.fitted(row, "key", Fitted({"frames": 5}, b"picture", 1.0))
        shape = Shaped("digest", (0,), {}, {"height_m": 1.7}, (0.5,), b"picture", 1.0)
        made.shaped("Ann", "ann.npz", "recipe", {"one.c3d": "digest"}, shape)
    return [alone(FILE, manifest, (place / FILE).read_bytes()), _subject(folder, subject)]


def _subject(folder: Path, read: Callable[[Path], None]) -> Target:
    from habitus.fit.markers.shape import ShapeFit
    from habitus.fit.markers.suspects import Suspect
    from habitus.jobs.archive.items import BodyChoice, KnownSubject, write_known
    from habitus.jobs.subjects import Agreed
    from habitus.markers.layouts import Marker, MarkerLayout
    from habitus.observe.markers import MarkerAttachment

    layout = MarkerLayout("mine", (Marker("A", landmark="c7"), Marker("B", vertex=3)))
    attachment = MarkerAttachment(np.zeros((2, 3), np.int64), np.zeros((2, 3)))
    arrays = (np.ones(4), np.ones((2, 3)), attachment, np.zeros((3, 2, 3)), np.zeros((3, 3)))
    write_known(
        KnownSubject(
            BodyChoice("smplh", 8.0, "female", 0.1, ("told",)),
            Agreed(layout, 0.9, ("a note",), (Suspect("A", "b", 3, True),), ("a doubt",)),
            ShapeFit(*arrays, {"data": 1 / 3}, "converged", 7),
            ((0, 1),),
            (0,),
            1.5,
            "name",
        ),
        folder / "subject.npz",
    )
    return alone("subject.npz", read, (folder / "subject.npz").read_bytes())


def _pages(folder: Path) -> list[Target]:
    from habitus.report.index import write_index

    def read(path: Path) -> None:
        page = write_index(path)
        text = page.read_text("utf-8") if page else ""
        assert not page or text.rstrip().endswith("</html>")

    numbers = {
        "capture": "walk",
        "frames": 5,
        "rate_hz": 100.0,
        "markers": 41,
        "marker_error_mm": {"pose": {"mean": 3.0, "median": 2.0, "p95": 9.0, "max": 20.0}},
        "suspect_markers": [{"label": "A", "reason": "b", "frames": 2}],
        "verdict": {"level": "good", "text": "fine"},
        "warnings": ["one"],
    }
    tree = {
        "set/walk/metrics.json": json.dumps(numbers, indent=1).encode(),
        "set/walk/report.html": b"<html></html>",
    }
    return [Target("results", (tree,), "set", read)]


# -- what other programs read ----------------------------------------------------------------------


def _module(path: str) -> ModuleType:
    """A file of the add-on or of a program, which are no packages of habitus."""
    file = Path(__file__).resolve().parents[2] / path
    spec = spec_from_file_location(f"fuzzed_{file.stem}", file)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _other_programs(folder: Path) -> list[Target]:
    """The Blender add-on's import and the reader that Maya and Unreal share: ValueError, KeyError
    and OSError are what they show in one line.
    """
    core = _module("blender/habitus_body/core.py")
    correctives = _module("programs/habitus_correctives.py")
    names = [f"joint{k}" for k in range(5)]
    body = core.Body(
        {"joint_names": np.array(names), "parents": np.arange(5) - 1, "drivers": np.zeros(0, int)}
        | {"shapedirs": np.zeros((4, 3, 2))},
        "body",
    )

    def motion(path: Path) -> None:
        try:
            found = core.Motion(str(path), core.read_arrays(str(path)), body)
        except (OSError, ValueError, KeyError) as error:
            raise HabitusError(error) from error
        assert np.isfinite(found.pose).all() and np.isfinite(found.trans).all()
        assert found.pose.shape == (len(found.trans), 5, 3) and 0 < found.rate < 1e6

    def drivers(path: Path) -> None:
        try:
            found = correctives.Correctives(path.read_text("utf-8"))
            turns = {name: [[1, 0, 0], [0, 1, 0], [0, 0, 1]] for name in found.joints}
            weights = found.weights(turns, ((0, 1.0), (1, 1.0), (2, 1.0)))
        except (OSError, ValueError) as error:
            raise HabitusError(error) from error
        assert all(0.0 <= weight <= 1.0 for weight in weights)

    np.savez(
        folder / "motion.npz",
        poses=np.ones((3, 15)),
        trans=np.zeros((3, 3)),
        betas=np.zeros(2),
        mocap_framerate=100.0,
        joint_names=np.array(names),
        up_axis="+z",
    )
    record = {
        "format": "habitus-correctives",
        "version": 2,
        "joints": [
            {"name": name, "rest": [0.0, 0.1 * k, 0.0], "parent": names[max(0, k - 1)]}
            for k, name in enumerate(names)
        ],
        "channels": [
            {"name": "a", "joint": "joint2", "row": [0.1] * 9, "bias": -0.2, "power": 2.0},
        ],
    }
    return [
        alone("addon.npz", motion, (folder / "motion.npz").read_bytes()),
        alone("correctives.json", drivers, json.dumps(record, indent=1).encode()),
    ]
