"""The notebook runs from top to bottom, on fewer steps and smaller pictures."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from pages import ROOT

NOTEBOOK = ROOT / "docs" / "notebooks" / "start.ipynb"
RUN = 'compose(*shared, f"ctm={ctm}")'
BRIEF = 'compose(*shared, f"ctm={ctm}", *(["ctm.pretrain_steps=4"] if ctm == "quick" else []))'
SMALL = 'steps = 4\ndownscale = 8\nmore = ["trainer=smoke", "backbone.grow=[2]"]'


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel finds this checkout, and keeps its files to itself."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))


@pytest.mark.slow
def test_notebook(kernel, tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    (parameters,) = [cell for cell in code if "parameters" in cell.metadata.get("tags", [])]
    parameters.source = SMALL
    (runs,) = [cell for cell in code if RUN in cell.source]
    runs.source = runs.source.replace(RUN, BRIEF)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(output.get("text", "") for cell in code for output in cell.outputs)
    assert "depth error" in printed
    assert "cycle error of the scene's colours" in printed
    pictures = [output for cell in code for output in cell.outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 3
