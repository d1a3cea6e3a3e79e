"""Runs the notebooks of examples/notebooks and writes what their cells print into them: python
tools/notebooks.py.
"""

import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "notebooks"


def read(path: Path) -> dict[str, Any]:
    """A notebook (format 4)."""
    return json.loads(path.read_text("utf-8"))


def run(notebook: dict[str, Any]) -> list[str]:
    """What each code cell prints, in their order, all in one namespace."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    said = []
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            with redirect_stdout(io.StringIO()) as text:
                exec(compile("".join(cell["source"]), cell["id"], "exec"), namespace)
            said.append(text.getvalue())
    return said


def with_outputs(notebook: dict[str, Any], said: list[str]) -> dict[str, Any]:
    """The same notebook with these texts as the outputs of its code cells."""
    left = iter(said)
    cells = []
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            text = next(left)
            outputs = (
                [{"name": "stdout", "output_type": "stream", "text": text.splitlines(True)}]
                if text
                else []
            )
            cell = cell | {"execution_count": None, "outputs": outputs}
        cells.append(cell)
    return notebook | {"cells": cells}


def page(notebook: dict[str, Any]) -> str:
    """The notebook as a page of Markdown: text, code, and what the code printed when it was last
    run.
    """
    parts = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", ()):
            parts.append("```text\n" + "".join(output["text"]).rstrip("\n") + "\n```")
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Run all and write them anew."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        notebook = read(path)
        told = with_outputs(notebook, run(notebook))
        path.write_text(json.dumps(told, indent=1, ensure_ascii=False) + "\n", "utf-8")
        print(f"ran {path.name}")


if __name__ == "__main__":
    main()
