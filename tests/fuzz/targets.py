"""Every reader of the project with small sound files for it: what the fuzz tests spoil, and how
they read it.
"""

import json
import pickle
import sys
import tempfile
import types
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from camera_targets import camera_makers
from gait_targets import gait_makers
from measurement_targets import measurement_makers
from motion_targets import motion_makers
from result_targets import result_makers
from robot_targets import robot_makers
from sensor_targets import sensor_makers
from target import Target, Tree, alone, tree_of


def all_targets() -> tuple[Target, ...]:
    """The targets; made anew, in a few seconds, the same ones each time."""
    makers = (
        _captures,
        _layouts,
        _models,
        _templates,
        _registrations,
        _checkpoints,
        *sensor_makers(),
        *gait_makers(),
        *robot_makers(),
        *motion_makers(),
        *camera_makers(),
        *result_makers(),
        *measurement_makers(),
    )
    with tempfile.TemporaryDirectory() as folder:
        found = []
        for maker in makers:
            place = Path(folder) / maker.__name__
            place.mkdir()
            found += maker(place)
        return tuple(found)


# -- captures --------------------------------------------------------------------------------------


def _read_capture(path: Path) -> None:
    from habitus.io.captures.read import read_captures

    for capture in read_captures(path):
        frames, markers, axes = capture.markers.shape
        assert (
            frames > 0 and markers == len(capture.labels) == len(set(capture.labels)) and axes == 3
        )
        assert np.isfinite(capture.markers).any() and not np.isinf(capture.markers).any()
        assert 0 < capture.rate_hz < 1e6 and capture.up_axis[1] in "xyz"
        told = (
            *capture.labels,
            *capture.warnings,
            *sum(capture.dropped, ()),
            capture.subject or "",
            capture.name,
        )
        assert all(text.isprintable() and len(text) < 500 for text in told)


def _captures(folder: Path) -> list[Target]:
    from capture_texts import motive_text, qtm_text, trc_text
    from mannequin import LABELS, world_points, write_raw_c3d

    labels = LABELS[:12]
    points = world_points("+y", frames=10)[:, :12]
    points[2:4, 3] = np.nan
    parameters = {
        ("SUBJECTS", "NAMES"): ["Ann"],
        ("PROCESSING", "HEIGHT"): [1.7],
        ("POINT", "ANGLES"): ["LKNA"],
    }
    write_raw_c3d(folder / "a.c3d", labels, points * 1e3, parameters=parameters)
    write_raw_c3d(folder / "b.c3d", tuple(f"Ann:{one}" for one in labels), points, unit="m")
    whole = np.nan_to_num(points)
    for write, name, arrays in (
        (np.savez, "a.npz", {"labels": np.array(labels)}),
        (np.savez_compressed, "b.npz", {"labels": np.array([labels] * len(points))}),
        (
            np.savez,
            "c.npz",
            {
                "labels": np.array(labels).astype("S"),
                "units": "m",
                "up_axis": "+y",
                "gender": "female",
            },
        ),
    ):
        write(folder / name, markers=points, frame_rate=100, **arrays)
    c3d, npz = (
        [(folder / f"{name}.{kind}").read_bytes() for name in names]
        for kind, names in (("c3d", "ab"), ("npz", "abc"))
    )
    trc = trc_text(labels, whole * 1e3)
    tsv = [qtm_text(labels, points * 1e3), qtm_text(labels, points * 1e3, times=True, more=True)]
    return [
        alone("capture.c3d", _read_capture, *c3d),
        alone("capture.npz", _read_capture, *npz),
        alone(
            "capture.trc",
            _read_capture,
            trc_text(labels, points * 1e3).encode(),
            trc.replace("\t", " ").encode(),
        ),
        alone("capture.csv", _read_capture, motive_text(labels, points).encode()),
        alone("capture.tsv", _read_capture, *(text.encode() for text in tsv)),
    ]


# -- layouts ---------------------------------------------------------------------------------------

_LAYOUT = """\
name = "mine"
title = "A set"
also_known_as = ["ours", "m-1"]
fingerprint = ["[LR]FHD"]
extends = "cmu-41"
without = ["C7"]

[defaults]
distance = 0.0095

[markers]
"[LR]NEW" = { place = "[left|right]_asis", aliases = ["[LR]N"], distance_spread = 0.002, direction = [1, 0, 0.5] }
MID = { between = ["left_asis", "right_asis", 0.5], optional = true, place_spread = 0.01 }
STRN = "sternum"

[left_out]
JUNK = "a prop"
"""


def _read_layout(path: Path) -> None:
    from habitus.io.layouts.files import load_layout
    from habitus.io.layouts.toml import layout_text, parse_layout

    layout = load_layout(path)
    again = parse_layout(layout_text(layout), "again.toml", lambda name: layout)
    assert again == layout and len(layout.markers)


def _layouts(folder: Path) -> list[Target]:
    one = {
        "indices": {"LFHD": 100, "RFHD": 200, "C7": 829},
        "distance_from_skin": 0.0095,
        "type": "body",
    }
    moshpp = json.dumps({"markersets": [one], "surface_model_type": "smplx"}, indent=1)
    plain = _LAYOUT.replace('extends = "cmu-41"\n', "").replace(
        'without = ["C7"]\n', "num_vertices = 6890\n"
    )
    return [
        alone("layout.toml", _read_layout, _LAYOUT.encode(), plain.encode()),
        alone("layout.json", _read_layout, moshpp.encode()),
    ]


# -- models ----------------------------------------------------------------------------------------


def _read_body(path: Path) -> None:
    from habitus.io.models.bodies import load_body

    body = load_body(path)
    assert np.isfinite(body(betas=np.zeros(body.num_betas)).vertices).all()
    assert all(name.isprintable() for name in body.joint_names)


def _read_blendscape(path: Path) -> None:
    from habitus_lab.baselines.files import load_blendscape

    assert np.isfinite(load_blendscape(path).template).all()


def _models(folder: Path) -> list[Target]:
    import scipy.sparse
    from synthetic import official_arrays, synthetic_body, with_features
    from worm_model import worm_model

    from habitus.io.models.bodies import save_body
    from habitus_lab.baselines.files import save_blendscape

    arrays = official_arrays("mano", 24, num_betas=2)
    np.savez(folder / "official.npz", **arrays)
    boxed = np.empty((), object)
    boxed[()] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    np.savez_compressed(folder / "boxed.npz", **(arrays | {"J_regressor": boxed}))
    save_body(
        with_features(synthetic_body("mano", 24, num_betas=2), "quaternions", 1), folder / "own.npz"
    )
    save_blendscape(worm_model(np.random.default_rng(0), subdivisions=0), folder / "worm.npz")
    npz = [(folder / f"{name}.npz").read_bytes() for name in ("official", "boxed", "own")]
    worm = (folder / "worm.npz").read_bytes()
    sparse = arrays | {
        "J_regressor": boxed[()],
        "bs_style": "lbs",
        "joint_names": [f"j{k}" for k in range(16)],
    }
    plain = [pickle.dumps(OrderedDict(sparse), protocol) for protocol in (0, 2, 4, 5)]
    return [
        alone("body.npz", _read_body, *npz),
        alone("body.pkl", _read_body, *plain, _chumpy_pickle(arrays)),
        alone("worm.npz", _read_blendscape, worm),
    ]


def _chumpy_pickle(arrays: Mapping[str, np.ndarray]) -> bytes:
    """A model as SMPL's owners ship it: arrays wrapped in classes of a package that is not
    there.
    """
    modules = {
        name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")
    }
    ch = modules["chumpy.ch"].Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    select = modules["chumpy.reordering"].Select = type(
        "Select", (ch,), {"__module__": "chumpy.reordering"}
    )
    whole = ch()
    chosen = select()
    whole.__dict__ |= {"x": arrays["shapedirs"], "_dirty_vars": {"x"}}
    index = np.arange(arrays["shapedirs"].size).reshape(arrays["shapedirs"].shape)[..., :2]
    chosen.__dict__ |= {"a": whole, "idxs": index.ravel(), "preferred_shape": index.shape}
    sys.modules.update(modules)
    try:
        return pickle.dumps(dict(arrays) | {"shapedirs": chosen}, 2)
    finally:
        for name in modules:
            sys.modules.pop(name, None)


# -- templates and registrations -------------------------------------------------------------------


def _read_template(path: Path) -> None:
    from habitus.io.registrations.templates import load_template

    assert all(name.isprintable() for name in load_template(path).joint_names)


def _read_registrations(path: Path) -> None:
    from habitus.io.registrations.open import open_registrations

    found = open_registrations(path)
    for row in {0, len(found) - 1}:
        assert np.asarray(found.vertices[row]).shape == (found.num_vertices, 3)
    assert all(name.isprintable() for name in (*found.subject, *found.name))


def _read_mesh(path: Path) -> None:
    from habitus.io.meshes import read_mesh

    vertices, faces = read_mesh(path)
    assert faces.min() >= 0 and faces.max() < len(vertices)


def _ball() -> tuple[np.ndarray, np.ndarray]:
    from habitus.mesh.shapes import icosphere

    shape = icosphere(0)
    return shape.vertices.numpy(), shape.faces.numpy()


def _templates(folder: Path) -> list[Target]:
    import trimesh

    from habitus.io.registrations.templates import save_template
    from habitus.mesh.template import Template

    vertices, faces = _ball()
    part = (vertices[:, 1] > 0).astype(np.int64)
    save_template(
        Template(vertices, faces, part, (-1, 0), ("root", "top"), np.arange(12)),
        folder / "template.npz",
    )
    (folder / "tree").mkdir()
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "tree" / "ball.ply")
    joints = [
        ("root", "", np.flatnonzero(part == 0)),
        ("top", 'parent = "root"\n', np.flatnonzero(part)),
    ]
    text = "".join(
        f'[[joint]]\nname = "{name}"\n{up}vertices = {list(map(int, which))}\n'
        for name, up, which in joints
    )
    (folder / "tree" / "ball.toml").write_text(f'mesh = "ball.ply"\nunit = "mm"\n\n{text}')
    return [
        alone("template.npz", _read_template, (folder / "template.npz").read_bytes()),
        Target("template.toml", (tree_of(folder / "tree"),), "ball.toml", _read_template),
    ]


def _registrations(folder: Path) -> list[Target]:
    vertices, faces = _ball()
    many = np.stack([vertices * scale for scale in (1.0, 1.1, 1.2)])
    words = {
        "subject": np.array(["Ann", "Ann", "Bob"]),
        "sex": np.array(["female", "female", ""]),
        "unit": np.array("cm"),
    }
    arrays = {"vertices": many, "faces": faces, **words}
    np.savez(folder / "stored.npz", **arrays)
    np.savez_compressed(folder / "packed.npz", **arrays)
    trees = [_npy_folder, _mesh_folder, _numbered_folder]
    found = [
        Target(
            f"registrations {make.__name__}",
            (_made(folder, make, many, faces),),
            "set",
            _read_registrations,
        )
        for make in trees
    ]
    npz = [(folder / f"{name}.npz").read_bytes() for name in ("stored", "packed")]
    stores = [
        alone("registrations.npz", _read_registrations, *npz),
        *_meshes(folder, vertices, faces),
    ]
    return [*stores, *found, _h5(folder, many, faces), _zarr(folder, arrays)]


def _made(folder: Path, make: Callable[..., None], many: np.ndarray, faces: np.ndarray) -> Tree:
    place = folder / make.__name__
    (place / "set").mkdir(parents=True)
    make(place / "set", many, faces)
    return tree_of(place)


def _npy_folder(folder: Path, many: np.ndarray, faces: np.ndarray) -> None:
    np.save(folder / "vertices.npy", many)
    np.save(folder / "faces.npy", faces)
    (folder / "registrations.csv").write_text("subject,sex,frame\nAnn,f,1\nAnn,f,2\nBob,m,1\n")


def _mesh_folder(folder: Path, many: np.ndarray, faces: np.ndarray) -> None:
    import trimesh

    rows = []
    for k, (vertices, ending) in enumerate(zip(many, ("ply", "obj", "ply"), strict=True)):
        trimesh.Trimesh(vertices, faces, process=False).export(folder / f"m{k}.{ending}")
        rows.append(f"m{k}.{ending};S{k};mm")
    (folder / "registrations.csv").write_text("file;subject;unit\n" + "\n".join(rows))


def _numbered_folder(folder: Path, many: np.ndarray, faces: np.ndarray) -> None:
    import trimesh

    for k, vertices in enumerate(many[:2]):
        trimesh.Trimesh(vertices, faces, process=False).export(folder / f"tr_reg_{k:03}.ply")


def _meshes(folder: Path, vertices: np.ndarray, faces: np.ndarray) -> list[Target]:
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    ply = [trimesh.exchange.ply.export_ply(mesh, encoding=kind) for kind in ("binary", "ascii")]
    obj = trimesh.exchange.obj.export_obj(mesh).encode()
    quads = (
        b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3 4/1\nf "
        b"1/1 2/2 3/3\nf -1 -2 -3\n"
    )
    return [alone("mesh.ply", _read_mesh, *ply), alone("mesh.obj", _read_mesh, obj, quads)]


def _h5(folder: Path, many: np.ndarray, faces: np.ndarray) -> Target:
    import h5py

    contents = []
    for options in ({}, {"chunks": (6, 3, 1), "compression": "gzip", "shuffle": True}):
        with h5py.File(folder / "dyna.h5", "w") as file:
            file["faces"] = faces
            file.create_dataset("50002_jump", data=many.transpose(1, 2, 0), **options)
        contents.append((folder / "dyna.h5").read_bytes())
    return alone("registrations.h5", _read_registrations, *contents)


def _zarr(folder: Path, arrays: Mapping[str, np.ndarray]) -> Target:
    import zarr

    warnings.simplefilter("ignore")  # texts of a fixed length are not in zarr's specification yet
    trees = []
    for version in (2, 3):
        place = folder / f"zarr{version}"
        group = zarr.open_group(str(place / "set.zarr"), mode="w", zarr_format=version)
        for name, array in arrays.items():
            group.create_array(
                name, data=np.atleast_1d(array), chunks=(2, *np.atleast_1d(array).shape[1:])
            )
        trees.append(tree_of(place))
    return Target("registrations.zarr", tuple(trees), "set.zarr", _read_registrations, 1)


# -- checkpoints -----------------------------------------------------------------------------------


def _read_checkpoint(path: Path) -> None:
    from habitus.jobs.checkpoints import Checkpoint

    checkpoint = Checkpoint.open(
        path, {"registrations": [3, 12, "x"], "template": "y", "body": "", "options": {"rounds": 2}}
    )
    checkpoint.load()
    assert checkpoint.surface_count >= 0 and checkpoint.seconds >= 0
    surfaces, done = checkpoint.surface_store((3, 12, 3))
    assert surfaces.shape == (3, 12, 3) and 0 <= done <= 3


def _checkpoints(folder: Path) -> list[Target]:
    from habitus.jobs.checkpoints import Checkpoint
    from habitus.learn.callback import Record, TrainingState
    from habitus.learn.energy import Energy
    from habitus.learn.estimate import Estimate
    from habitus.learn.posing.rig import Rig

    run = {"registrations": [3, 12, "x"], "template": "y", "body": "", "options": {"rounds": 2}}
    place = folder / "tree" / "checkpoint"
    checkpoint = Checkpoint.open(place, run)
    rig = Rig(
        (-1, 0),
        "lbs",
        "rotations",
        0,
        np.zeros((12, 2), np.int64),
        np.ones((12, 2)) / 2,
        np.zeros((12, 3, 9)),
    )
    shapes = {
        "templates": (2, 12, 3),
        "joints": (2, 2, 3),
        "descriptors": (2, 1),
        "pose": (3, 2, 3),
        "trans": (3, 3),
    }
    estimate = Estimate(rig, **{key: np.zeros(shape) for key, shape in shapes.items()})
    history = (Record(0, "pose", Energy({"data": 1.0})),)
    checkpoint.save(TrainingState(estimate, history, False), [1.5])
    checkpoint.surface_store((3, 12, 3))
    checkpoint.on_surfaces_stored(2, 1.0)
    return [Target("checkpoint", (tree_of(folder / "tree"),), "checkpoint", _read_checkpoint, 2)]
