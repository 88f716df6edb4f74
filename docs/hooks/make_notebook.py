"""Make the notebooks with their outputs out of the scripts whose cells begin with ``# %%``."""

import re
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "scripts"
SCRIPTS = (FOLDER / "interaction_loop.py", FOLDER / "tour.py")
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def cells_of(script: str) -> list[tuple[str, str]]:
    """Kind (``"code"`` or ``"markdown"``) and source of every cell; what is marked ``script only`` is left out."""
    found = []
    for piece in re.split(r"^# %%", script, flags=re.MULTILINE)[1:]:
        mark, _, body = piece.partition("\n")
        if "[markdown]" in mark:
            found.append(("markdown", re.sub(r"^# ?", "", body.strip(), flags=re.MULTILINE)))
        elif "script only" not in mark:
            found.append(("code", body.strip()))
    return found


def is_current(script: Path, notebook: Path) -> bool:
    """Whether the notebook has the script's cells, all of them run and none with an error."""
    cells = nbformat.read(notebook, as_version=4).cells
    ran = all(cell.execution_count is not None for cell in cells if cell.cell_type == "code")
    errors = [output for cell in cells for output in cell.get("outputs", ()) if output.output_type == "error"]
    return ran and not errors and [(cell.cell_type, cell.source) for cell in cells] == cells_of(script.read_text())


if __name__ == "__main__":
    make = {"code": nbformat.v4.new_code_cell, "markdown": nbformat.v4.new_markdown_cell}
    for script in SCRIPTS:
        sources = enumerate(cells_of(script.read_text()))
        cells = [make[kind](source, id=f"cell-{k}") for k, (kind, source) in sources]
        notebook = nbformat.v4.new_notebook(cells=cells, metadata=METADATA)
        NotebookClient(notebook, timeout=600, kernel_name="python3", record_timing=False).execute()
        nbformat.write(notebook, script.with_suffix(".ipynb"))
