"""JSON and YAML that describe cameras: plain tables, OpenCV's matrices included."""

from pathlib import Path
from typing import Any

from habitus.errors import HabitusError, require_extra, shown
from habitus.io.limits import check_text
from habitus.io.structured_text import read_json

ENDINGS = (".json", ".yaml", ".yml")


def read_description(path: Path) -> Any:
    """What a .json or .yaml holds. Raises HabitusError where it is neither."""
    try:
        check_text(path.stat().st_size, str(path))
        text = path.read_text(encoding="utf-8-sig")
        return read_json(text) if path.suffix.lower() == ".json" else _yaml(text)
    except FileNotFoundError:
        raise HabitusError(f"{path}: no such file; expected camera intrinsics") from None
    except (OSError, UnicodeDecodeError) as error:
        raise HabitusError(
            f"{path}: cannot be read ({shown(error, 120)}); expected JSON or YAML"
        ) from error
    except HabitusError as error:
        raise HabitusError(f"{path}: is no {path.suffix[1:].upper()} ({error})") from error


def _yaml(text: str) -> Any:
    yaml = require_extra("yaml", "YAML files", "rgbd")

    class Loader(yaml.SafeLoader):  # type: ignore[name-defined, misc]
        """Plain values only; a tag that is not known is passed over."""

    def untagged(loader: Any, suffix: str, node: Any) -> Any:
        if isinstance(node, yaml.MappingNode):
            return loader.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return loader.construct_sequence(node, deep=True)
        return loader.construct_scalar(node)

    Loader.add_multi_constructor("", untagged)
    if text.startswith("%YAML:"):  # OpenCV writes a colon there, which YAML does not know
        text = text.partition("\n")[2]
    if text.count("&") + text.count("*") > 1000:
        raise HabitusError("it refers to itself without end")
    try:
        return yaml.load(text, Loader=Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise HabitusError(shown(error, 160)) from error
