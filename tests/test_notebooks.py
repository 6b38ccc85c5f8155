"""The notebooks of examples/notebooks: kept without outputs, and run from top to bottom."""

import nbformat
import pytest
from places import ROOT

BOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", BOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_small_and_without_outputs(path):
    book = nbformat.read(path, as_version=4)
    nbformat.validate(book)
    assert path.stat().st_size < 20_000
    assert book.cells[0].cell_type == "markdown"
    for cell in book.cells:
        assert cell.cell_type == "markdown" or (cell.outputs == [] and cell.execution_count is None)


@pytest.mark.slow
@pytest.mark.render
@pytest.mark.filterwarnings("ignore")  # of the kernel's own packages
@pytest.mark.parametrize("path", BOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(path, tmp_path):
    from nbclient import NotebookClient

    book = nbformat.read(path, as_version=4)
    NotebookClient(book, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    shown = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in shown if output.output_type == "error"]
    html = "".join(output.data.get("text/html", "") for output in shown if "data" in output)
    text = "".join(output.get("text", "") for output in shown)
    assert "PASS" in html + text
    assert any("image/png" in output.data or "<img" in output.data.get("text/html", "") for output in shown
               if "data" in output)  # fmt: skip
    if "film(" in path.read_text(encoding="utf-8"):
        assert "data:video/mp4;base64" in html
    assert list(tmp_path.iterdir()) == []  # files go to a folder of their own
