"""Make a notebook with its outputs out of a script whose cells begin with ``# %%``.

Examples:
    python scripts/make_notebook.py                 # runs scripts/interaction_loop.py, writes the .ipynb beside it
    python scripts/make_notebook.py --check         # only says whether the notebook has the script's cells
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import Any

SCRIPT = Path(__file__).parent / "interaction_loop.py"


def cells_of(script: str) -> list[tuple[str, str]]:
    """Kind (``"code"`` or ``"markdown"``) and source of every cell; what is marked ``script only`` is left out."""
    found = []
    for piece in re.split(r"^# %%", script, flags=re.MULTILINE)[1:]:
        mark, _, body = piece.partition("\n")
        if "script only" in mark:
            continue
        if "[markdown]" in mark:
            found.append(("markdown", re.sub(r"^# ?", "", body.strip(), flags=re.MULTILINE)))
        else:
            found.append(("code", body.strip()))
    return found


def notebook_of(script: Path) -> Any:
    """The notebook without outputs."""
    import nbformat.v4 as nbformat

    make = {"code": nbformat.new_code_cell, "markdown": nbformat.new_markdown_cell}
    cells = [make[kind](source, id=f"cell-{k}") for k, (kind, source) in enumerate(cells_of(script.read_text()))]
    metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return nbformat.new_notebook(cells=cells, metadata=metadata)


def is_current(script: Path, notebook: Path) -> bool:
    """Whether the notebook has the script's cells, all of them run and none with an error."""
    import nbformat

    if not notebook.is_file():
        return False
    cells = nbformat.read(notebook, as_version=4).cells
    ran = all(cell.execution_count is not None for cell in cells if cell.cell_type == "code")
    errors = [output for cell in cells for output in cell.get("outputs", ()) if output.output_type == "error"]
    return ran and not errors and [(cell.cell_type, cell.source) for cell in cells] == cells_of(script.read_text())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("script", nargs="?", type=Path, default=SCRIPT, help="default scripts/interaction_loop.py")
    parser.add_argument("--check", action="store_true", help="write nothing; status 1 if the notebook is not current")
    arguments = parser.parse_args()
    script, notebook = arguments.script, arguments.script.with_suffix(".ipynb")
    if not script.is_file():
        print(f"make_notebook: there is no file {script}", file=sys.stderr)
        return 1
    if arguments.check:
        current = is_current(script, notebook)
        print(f"{notebook}: {'current' if current else 'not current; run python scripts/make_notebook.py'}")
        return 0 if current else 1
    import nbformat
    from nbclient import NotebookClient

    made = notebook_of(script)
    NotebookClient(made, timeout=600, kernel_name="python3", record_timing=False).execute()
    nbformat.write(made, notebook)
    print(f"{notebook}: {len(made.cells)} cells")
    return 0


if __name__ == "__main__":
    sys.exit(main())
