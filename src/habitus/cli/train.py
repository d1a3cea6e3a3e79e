"""`habitus train`: from registrations to a body model."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.first_run import told_of_compilation
from habitus.cli.screen import Flag, plain, progress_bar, say, screen, unset
from habitus.learn.options import EnergyWeights, TrainOptions

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from habitus.jobs.train import Training
    from habitus.learn.callback import Record

_OPTIONS = TrainOptions()
_WEIGHTS = EnergyWeights()
_WIDE = 200  # columns of a table that goes to a file or a pipe
_SPEED_OVER = (
    3600.0  # seconds: steps of a round differ, so that only a long look back tells the time left
)


@dataclass(frozen=True)
class Train:
    """Learn a body model from registrations: meshes of people in poses, all in a template's
    topology.

    OUT receives model.npz and model.pkl (SMPL's names), poses.npz (poses, rest surfaces and joints
    of the people), and training.json (energies of every step, seconds, options). A run that was
    stopped goes on with the same command.
    """

    datasets: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DATASET [DATASET …]")
    ]
    """An npz, a zarr or mesh folder, a folder with registrations.csv, FAUST's meshes, Dyna's h5."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results, and for the checkpoint."""
    template: Annotated[str, tyro.conf.arg(metavar="default|female|male|FILE")] = "default"
    """The mesh, its parts and joints: npz, toml with a mesh, or a body model; "default" is the body
    of habitus.
    """
    detail: Literal["coarse", "full"] = "coarse"
    """Of a body of two levels of detail; "full" gives a body of two levels again."""
    joints: Annotated[
        Literal["smpl", "smplh", "smplx"] | None, tyro.conf.arg(help_behavior_hint="")
    ] = None
    """Of a body that has more; as a file has them, if not told, and "smpl" of the body of habitus.
    """
    sex: Literal["all", "each", "female", "male"] = "all"
    """One model of all people, one of each sex (in OUT/female and OUT/male), or one of them."""
    skinning: Literal["lbs", "dqbs"] = _OPTIONS.skinning  # type: ignore[assignment]
    """Linear or dual quaternion blend skinning."""
    pose_shapes: Literal["full", "sparse", "local", "low_rank", "l1", "none"] = _OPTIONS.pose_shapes  # type: ignore[assignment]
    """Pose blend shapes: all, of the joints that move a vertex, of those near it that matter, of
    few directions, with an L1 penalty, or none.
    """
    pose_features: Literal["rotations", "angles", "sin_cos", "quaternions", "polynomials"] = (
        _OPTIONS.pose_features
    )  # type: ignore[assignment]
    """What drives them; only the rotations' entries are SMPL's."""
    shape_features: Annotated[int, tyro.conf.arg(metavar="S")] = _OPTIONS.shape_features
    """How many shape coefficients they depend on."""
    rank: Annotated[int, tyro.conf.arg(metavar="K")] = _OPTIONS.rank
    """Directions of low_rank pose blend shapes."""
    l1: Annotated[float, tyro.conf.arg(metavar="λ")] = _OPTIONS.l1
    """Weight of the l1 penalty."""
    least_effect: Annotated[float, tyro.conf.arg(metavar="M")] = _OPTIONS.least_effect
    """What a joint must bring a vertex, in metres, for local pose blend shapes to keep it."""
    rotation_prior: Annotated[float, tyro.conf.arg(metavar="μ")] = _OPTIONS.rotation_prior
    """Weight of local pose blend shapes staying small at rotations by 0 to 90 degrees about every
    axis, which keeps them from extrapolating; 0.003 suits.
    """
    influences: Annotated[int, tyro.conf.arg(metavar="K")] = _OPTIONS.influences
    """Joints that move a vertex, at most."""
    num_betas: Annotated[int, tyro.conf.arg(metavar="B")] = _OPTIONS.num_betas
    """Shape directions to keep."""
    rounds: Annotated[int, tyro.conf.arg(metavar="N")] = _OPTIONS.rounds
    """Rounds of people, skinning weights, pose blend shapes and poses, at most."""
    tolerance: Annotated[float, tyro.conf.arg(metavar="SHARE")] = _OPTIONS.tolerance
    """End when a round lowers the energy by less than this share of it."""
    start: Literal["parts", "body"] = _OPTIONS.start  # type: ignore[assignment]
    """From the template's parts, or from the weights, joint regressor and blend shapes of the body
    that it is of.
    """
    fixed: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ARRAY …")] = _OPTIONS.fixed
    """What stays: arrays of that body (skinning_weights, joint_regressor, posedirs, shapedirs), and
    of registrations that tell them, people (rest surfaces) and poses.
    """
    regressor: Literal["auto", "convex", "signed"] = _OPTIONS.regressor  # type: ignore[assignment]
    """Joints from vertices: convex combinations, or with weights below zero (auto: where these
    serve new people).
    """
    weight_symmetry: Annotated[float, tyro.conf.arg(metavar="λ")] = _WEIGHTS.symmetry
    """Weight of left and right being alike (eq. 14, λ_Y)."""
    weight_joint_symmetry: Annotated[float, tyro.conf.arg(metavar="λ")] = _WEIGHTS.joint_symmetry
    """How much more joints count in that (λ_U)."""
    weight_joints: Annotated[float, tyro.conf.arg(metavar="λ")] = _WEIGHTS.joints
    """Weight of joints staying in the middle of their rings (λ_J)."""
    weight_pose_shapes: Annotated[float, tyro.conf.arg(metavar="λ")] = _WEIGHTS.pose_shapes
    """Weight of pose blend shapes staying small (λ_P); small data want less."""
    weight_skinning: Annotated[float, tyro.conf.arg(metavar="λ")] = _WEIGHTS.skinning
    """Weight of skinning weights staying near the template's (λ_W)."""
    baselines: Flag = False
    """Train plain LBS and plain DQBS on the same registrations as well."""
    unit: Annotated[str, tyro.conf.arg(metavar="m|cm|mm|…")] = "m"
    """Unit of the registrations, where the data do not tell it."""
    every: Annotated[int, tyro.conf.arg(metavar="K")] = 1
    """Take one frame in K of sequences (h5)."""
    cluster: Annotated[str | None, unset("ADDRESS")] = None
    """Work on the Dask cluster whose scheduler has this address, tcp://host:8786 say, which you
    trust.
    """
    workers: Annotated[int | None, unset("N")] = None
    """Threads to work with; as many as there are cores, if not told."""
    restart: Flag = False
    """Throw the checkpoint in OUT away and begin anew."""
    quiet: Flag = False
    """Print nothing but errors."""

    @property
    def options(self) -> TrainOptions:
        """The options of the training itself. Raises HabitusError for numbers that make no
        sense.
        """
        shared = {key: getattr(self, key) for key in vars(_OPTIONS) if key != "weights"}
        weights = {key: getattr(self, f"weight_{key}") for key in vars(_WEIGHTS)}
        return TrainOptions(**shared, weights=EnergyWeights(**weights))


OPTIONS = Train
ABOUT = Train.__doc__
NEEDS = ("habitus.jobs.train", "rich.progress", "numba.core.event")


def run(options: Train, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""

    from habitus.jobs.train import train

    console = console or screen(options.quiet)
    with told_of_compilation(options.quiet), progress_bar(console, _SPEED_OVER) as bar:
        task = bar.add_task("open", total=1.0)

        def progress(stage: str, share: float) -> None:
            if bar.tasks[0].description != stage:
                bar.reset(task, description=stage)
            bar.update(task, completed=share)

        def on_warning(text: str) -> None:
            say(console, text, mark="note")

        def on_step(model: str, record: "Record") -> None:
            say(console, told(model, record))

        found = train(
            options.datasets,
            options.out,
            template=options.template,
            options=options.options,
            detail=options.detail,
            joints=options.joints,
            sex=options.sex,
            baselines=options.baselines,
            unit=options.unit,
            every=options.every,
            restart=options.restart,
            workers=options.workers if options.cluster is None else options.cluster,
            progress=progress,
            on_step=on_step,
            on_warning=on_warning,
        )
    console.print(summary(found))
    say(console, f"results lie in {options.out}")


def left(options: Train) -> str:
    """What a run that was stopped has left."""
    if next(options.out.glob("**/progress.npz"), None) is None:
        return f"there is no checkpoint in {options.out} yet"
    return (
        f"the checkpoint in {options.out} is whole: the same command without --restart goes on "
        "from there"
    )


def told(model: str, record: "Record") -> str:
    """A step's energy in one line."""
    terms = ", ".join(
        f"{name.replace('_', ' ')} {value:.4g}" for name, value in record.energy.terms.items()
    )
    return (
        f"{model}, round {record.round}, {record.step}: energy {record.energy.total:.6g} ({terms})"
    )


def summary(found: "list[Training]") -> "Table":
    """One row a model."""
    from rich.table import Table

    table = Table(title="trained models")
    for heading in (
        "model",
        "rounds",
        "energy before",
        "after",
        "data error, mm",
        "shapes",
        "minutes",
    ):
        table.add_column(
            heading, justify="left" if heading == "model" else "right", no_wrap=heading == "model"
        )
    for one in found:
        for name, trained in {"model": one.trained, **one.baselines}.items():
            first = trained.history[0].energy
            last = trained.history[-1].energy
            estimate = trained.estimate
            error = (last.terms["data"] / (len(estimate.pose) * trained.body.num_vertices)) ** 0.5
            table.add_row(
                plain(f"{one.sex} {name}".strip()),
                str(trained.history[-1].round),
                f"{first.total:.4g}",
                f"{last.total:.4g}",
                f"{1e3 * error:.2f}",
                str(trained.body.num_betas),
                f"{one.seconds[name] / 60:.1f}",
            )
    return table
