"""Checkpoints of a training: what is saved after every step, checked when read, and the callback
that writes it.
"""

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, shown
from habitus.files import atomic_write, tidy
from habitus.io.archives import mapped_header, open_archive, reason
from habitus.learn.callback import NoCallback, Record, TrainingState
from habitus.learn.energy import Energy
from habitus.learn.estimate import Estimate
from habitus.learn.options import STOPPING, TrainOptions
from habitus.learn.posing.rig import Rig
from habitus.learn.steps.alternation import STEPS
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template, check_parents
from habitus.types import Progress

_DAMAGE = Exception  # whatever a spoilt file makes the readers of its parts raise
_BEFORE = "before_"
_ESTIMATE = ("templates", "joints", "descriptors", "pose", "trans")


def fingerprint(
    registrations: Registrations,
    template: Template,
    options: TrainOptions,
    body: BodyModel | None = None,
) -> dict[str, Any]:
    """Identifies a training: the registrations' words, number, first and last, and what is known of
    them where that is started from; the template; the options but those that say how long; the
    ``body`` that it starts from, if it does.
    """
    ends: list[np.ndarray] = [registrations.read(k) for k in (0, len(registrations) - 1)]
    if registrations.known is not None and options.start == "body":
        ends += list(registrations.known.arrays().values())
        ends += list(registrations.known.rest.values())
    words = [*registrations.name, *registrations.subject, *registrations.sex, *registrations.set]
    mirrors = [np.zeros(0) if m is None else m for m in (template.mirror, template.joint_mirror)]
    tree = [template.vertices, template.faces, template.part, np.array(template.parents), *mirrors]
    return {
        "registrations": [len(registrations), registrations.num_vertices, _digest(ends, words)],
        "template": _digest(tree, template.joint_names),
        "options": {key: value for key, value in asdict(options).items() if key not in STOPPING},
        "body": _digest(_of_body(body), ()) if body is not None and options.start == "body" else "",
    }


def _of_body(body: BodyModel) -> list[np.ndarray]:
    """The arrays of a body that a training may start from."""
    posedirs = np.zeros(0) if body.posedirs is None else body.posedirs
    return [body.skinning_weights, body.joint_regressor, posedirs, body.v_template, body.shapedirs]


def _digest(arrays: Sequence[np.ndarray], words: Sequence[str]) -> str:
    digest = hashlib.sha256(json.dumps([str(word) for word in words]).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array, np.float64).tobytes())
    return digest.hexdigest()


@dataclass
class Checkpoint:
    """A folder with the last whole state of one training.

    ``run.json`` says what the training is of, ``progress.npz`` holds the estimate, the energies and
    when they were reached, ``surfaces.npy`` the pose-normalised surfaces, ``surfaces.json`` how
    many of them are there. Seconds are of work, counted over all runs.
    """

    folder: Path
    _surfaces: np.ndarray | None = field(default=None, repr=False)

    @staticmethod
    def open(folder: Path, run: Mapping[str, Any], *, restart: bool = False) -> "Checkpoint":
        """The checkpoint of a run (see `fingerprint`), empty where there is none yet or ``restart``
        is asked for.

        Raises HabitusError where the folder holds another training's, or cannot be written to.
        """
        record = json.loads(json.dumps(run))
        file = folder / "run.json"
        tidy(folder)
        if restart and file.exists():
            shutil.rmtree(folder)
        if file.exists():
            other = _differences(_read_json(file), record)
            if other:
                raise HabitusError(
                    f"{folder}: it belongs to a training with other {other}; expected the same to "
                    "go on from there: "
                    "choose another folder, or discard it with --restart"
                )
        else:
            for left in ("progress.npz", "surfaces.json"):
                if (folder / left).exists():
                    (folder / left).unlink()
            _write_json(file, record)
        return Checkpoint(folder)

    def save(self, state: TrainingState, seconds: Sequence[float]) -> None:
        """Write the state; ``seconds`` are those at which each record of its history was reached.

        Surfaces that are stored belong to an earlier state: they are made again.
        """
        estimate = state.estimate
        arrays = _arrays(estimate, "")
        if state.before is not None:
            arrays |= _arrays(state.before, _BEFORE)
        record = {
            "finished": state.finished,
            "parents": estimate.rig.parents,
            "skinning": estimate.rig.skinning,
            "pose_features": estimate.rig.pose_features,
            "shape_features": estimate.rig.shape_features,
            "history": [[r.round, r.step, dict(r.energy.terms)] for r in state.history],
            "seconds": list(seconds),
        }
        (self.folder / "surfaces.json").unlink(missing_ok=True)
        with atomic_write(self.folder / "progress.npz") as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, record=np.array(json.dumps(record)), **arrays)
        self._surfaces = None

    def load(self) -> tuple[TrainingState | None, list[float]]:
        """The last whole state and its seconds; None where there is none. Raises HabitusError for
        damaged files.
        """
        path = self.folder / "progress.npz"
        if not path.exists():
            return None, []
        try:
            with open_archive(path) as file:
                record = json.loads(str(file["record"]))
                before = _estimate(record, file, _BEFORE) if f"{_BEFORE}index" in file else None
                history = tuple(
                    Record(number, step, Energy(terms)) for number, step, terms in record["history"]
                )
                state = TrainingState(
                    _estimate(record, file, ""), history, record["finished"], before
                )
                return checked_state(state, record["seconds"])
        except _DAMAGE as error:
            raise _damaged(path, error) from error

    def surface_store(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """Surfaces (S,V,3) that lie on disk, and how many of them are there already."""
        path = self.folder / "surfaces.npy"
        done = self.surface_count
        try:
            if done and path.exists():
                with path.open(
                    "rb"
                ) as stream:  # a file that is too short is refused, which "r+" would lengthen
                    mapped_header(stream, path)
                self._surfaces = np.lib.format.open_memmap(path, "r+")
            if (
                self._surfaces is None
                or self._surfaces.shape != shape
                or self._surfaces.dtype != np.float32
            ):
                self._surfaces = None  # Windows does not shorten a mapped file
                self._surfaces = np.lib.format.open_memmap(path, "w+", np.float32, shape)
                done = 0
        except (ValueError, HabitusError) as error:
            raise _damaged(path, error) from error
        except OSError as error:
            raise HabitusError(
                f"cannot write {path}: {error.strerror or error}; expected room for "
                f"{4 * np.prod(shape) / 1e6:.0f} MB"
            ) from error
        if not 0 <= done <= len(self._surfaces):
            raise _damaged(
                path.with_suffix(".json"),
                ValueError(f"it counts {done} surfaces of {len(self._surfaces)}"),
            )
        return self._surfaces, done

    def on_surfaces_stored(self, count: int, seconds: float) -> None:
        """Record that ``count`` surfaces are stored; they are flushed to disk before the number
        is.
        """
        if isinstance(self._surfaces, np.memmap):
            self._surfaces.flush()
        _write_json(self.folder / "surfaces.json", {"done": count, "seconds": seconds})

    @property
    def surface_count(self) -> int:
        """Number of stored surfaces."""
        return int(self._stored("done"))

    @property
    def seconds(self) -> float:
        """The seconds at which the last surfaces were there; 0 where there are none."""
        return float(self._stored("seconds"))

    def _stored(self, key: str) -> Any:
        path = self.folder / "surfaces.json"
        value = _read_json(path).get(key, 0) if path.exists() else 0
        if type(value) not in (int, float) or not 0 <= value < 1e15:
            raise _damaged(path, ValueError(f"{key} is {shown(value)}"))
        return value


def _arrays(estimate: Estimate, lead: str) -> dict[str, np.ndarray]:
    """The arrays of an estimate by name, ``lead`` before each."""
    arrays = {key: getattr(estimate, key) for key in _ESTIMATE}
    arrays |= {"index": estimate.rig.index, "value": estimate.rig.value}
    if estimate.rig.posedirs is not None:
        arrays["posedirs"] = estimate.rig.posedirs
    return {f"{lead}{key}": value for key, value in arrays.items()}


def _estimate(record: Mapping[str, Any], file: Any, lead: str) -> Estimate:
    words = (
        tuple(record["parents"]),
        record["skinning"],
        record["pose_features"],
        record["shape_features"],
    )
    rig = Rig(*words, file[f"{lead}index"], file[f"{lead}value"], file.get(f"{lead}posedirs"))
    return Estimate(rig, **{key: file[f"{lead}{key}"] for key in _ESTIMATE})


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """In words, what of a run is not as it was; empty where all is."""
    words = [
        key for key in ("registrations", "template", "body") if before.get(key, "") != now[key]
    ]
    old, new = (
        {k: v for k, v in _flat(o.get("options", {})).items() if k not in STOPPING}
        for o in (before, now)
    )
    words += [
        f"{key} ({old.get(key)}, now {new.get(key)})"
        for key in {**old, **new}
        if old.get(key) != new.get(key)
    ]
    return ", ".join(words)


def _flat(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options by name, those of groups with the group's name before theirs."""
    arrays: dict[str, Any] = {}
    for key, value in options.items():
        arrays |= (
            {f"{key}.{name}": entry for name, entry in value.items()}
            if isinstance(value, Mapping)
            else {key: value}
        )
    return arrays


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except _DAMAGE as error:
        raise _damaged(path, error) from error
    if not isinstance(content, dict):
        raise _damaged(path, TypeError("no object in it"))
    return content


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")


def _damaged(path: Path, error: Exception) -> HabitusError:
    return HabitusError(
        f"{path}: damaged ({reason(error)}); discard it with --restart, or choose another folder"
    )


def checked_state(state: TrainingState, seconds: Any) -> tuple[TrainingState, list[float]]:
    """The state and its seconds as they are. Raises ValueError, TypeError or HabitusError where
    they cannot be.
    """
    if type(state.finished) is not bool:
        raise ValueError("it does not say whether it is finished")
    for record in state.history:
        if type(record.round) is not int or record.round < 0 or not isinstance(record.step, str):
            raise ValueError("its history is spoilt")
        if not np.isfinite([float(value) for value in record.energy.terms.values()]).all():
            raise ValueError("its energies are spoilt")
    times = [float(second) for second in seconds]
    if len(times) != len(state.history) or not np.isfinite(times).all():
        raise ValueError("its seconds are spoilt")
    for estimate in filter(None, (state.estimate, state.before)):
        _check_estimate(estimate)
    return state, times


def _check_estimate(estimate: Estimate) -> None:
    rig = estimate.rig
    check_parents(rig.parents)
    s = len(estimate.templates)
    n = len(estimate.pose)
    j = rig.num_joints
    v = rig.num_vertices
    shapes = {
        "templates": (s, v, 3),
        "joints": (s, j, 3),
        "descriptors": (s, *estimate.descriptors.shape[1:]),
        "pose": (n, j, 3),
        "trans": (n, 3),
    }
    arrays = {key: getattr(estimate, key) for key in shapes} | {"value": rig.value}
    shapes["value"] = rig.index.shape
    if rig.posedirs is not None:
        arrays["posedirs"], shapes["posedirs"] = rig.posedirs, (v, 3, *rig.posedirs.shape[2:])
    for key, array in arrays.items():
        if array.shape != shapes[key] or array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"its {key} are {array.dtype} of shape {array.shape}, or not finite")
    whole = rig.index.dtype.kind in "iu" and rig.index.ndim == 2 and rig.index.size > 0
    if not whole or rig.index.min() < 0 or rig.index.max() >= j:
        raise ValueError("its skinning names joints that are not there")


@dataclass(frozen=True)
class Callbacks:
    """Whom a run tells how far it is, the energy after each step of a model, and warnings."""

    progress: Progress
    on_step: Callable[[str, Record], None]
    on_warning: Callable[[str], None]

    @staticmethod
    def of(
        progress: Progress | None,
        on_step: Callable[[str, Record], None] | None,
        on_warning: Callable[[str], None] | None,
    ) -> "Callbacks":
        """Those that are None do nothing."""
        return Callbacks(
            progress or (lambda stage, share: None),
            on_step or (lambda model, record: None),
            on_warning or (lambda text: None),
        )


class CheckpointingCallback:
    """Stores checkpoints of a training, sums its seconds of work over all runs, and reports
    progress.

    Stages are "poses by edges", "rounds" (at most ``rounds`` of them), "shapes" and, where pose
    blend shapes depend on shape, "rounds by shape", each preceded by ``title``. ``state`` is where
    an earlier run stopped, or None. Without a ``checkpoint`` nothing is written and surfaces are
    kept in memory.
    """

    def __init__(
        self,
        title: str,
        checkpoint: Checkpoint | None,
        rounds: int,
        progress: Progress,
        on_step: Callable[[str, Record], None],
    ):
        self.title = title
        self.checkpoint = checkpoint
        self.progress = progress
        self.on_step = on_step
        self.state, self.seconds = checkpoint.load() if checkpoint else (None, [])
        self._total_steps = rounds * len(STEPS)
        self._steps = (
            len(STEPS) * self.state.rounds + len(self.state.steps_done) if self.state else -1
        )  # -1: not begun
        self._ended: int | None = None  # steps of the first rounds, once these are over
        self._kept = len(self.state.history) if self.state else 0  # records in the checkpoint
        self._share = 0.0
        self._surfaces = 0
        self._stored = 0
        self._earlier = max([0.0, *self.seconds[-1:], checkpoint.seconds if checkpoint else 0.0])
        self._began = time.perf_counter()

    @property
    def elapsed(self) -> float:
        """Seconds of work so far, including earlier runs."""
        return self._earlier + time.perf_counter() - self._began

    def on_item(self, done: int, total: int) -> None:
        """After ``done`` of ``total`` items of a parallel map, which is part of a step."""
        if self._stored < self._surfaces:
            return
        if self._steps < 0:
            self.progress(f"{self.title}: poses by edges", done / total)
            return
        step = (self._steps - (self._ended or 0) + done / total) / self._total_steps
        self._share = min(1.0, max(self._share, step))
        self.progress(
            f"{self.title}: rounds{'' if self._ended is None else ' by shape'}", self._share
        )

    def on_step_end(self, record: Record) -> None:
        """Note the seconds and report the energy."""
        steps = list(STEPS)
        done = steps.index(record.step) + 1 if record.step in steps else len(steps)
        self._steps = len(steps) * (record.round - 1) + done
        self.seconds.append(self.elapsed)
        self.on_step(self.title, record)

    def on_state(self, state: TrainingState) -> None:
        """Write the checkpoint."""
        if self.checkpoint and len(state.history) > self._kept:
            self.checkpoint.save(state, self.seconds)
            self._kept = len(state.history)

    def on_round_end(self, state: TrainingState) -> None:
        """Write the checkpoint."""
        self.on_state(state)
        if state.finished:
            self._ended = self._steps
            self._share = 0.0

    def surface_store(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """An array (S,V,3), on disk where there is a checkpoint, and how many surfaces it already
        holds.
        """
        store, self._stored = (self.checkpoint or NoCallback()).surface_store(shape)
        self._surfaces = shape[0]
        return store, self._stored

    def on_surfaces_stored(self, count: int) -> None:
        """Write how many surfaces are stored, and report progress."""
        self._stored = count
        if self.checkpoint:
            self.checkpoint.on_surfaces_stored(count, self.elapsed)
        self.progress(f"{self.title}: shapes", count / self._surfaces)
