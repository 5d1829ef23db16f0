"""The notebooks: each runs from top to bottom, training next to nothing, and is in git without outputs."""

import os
from pathlib import Path

import pytest

import sb3_ars

nbformat = pytest.importorskip("nbformat", reason='nbformat is missing: pip install "sb3-ars[notebooks]"')
nbclient = pytest.importorskip("nbclient", reason='nbclient is missing: pip install "sb3-ars[notebooks]"')
pytest.importorskip("ipykernel", reason='ipykernel is missing: pip install "sb3-ars[notebooks]"')

ROOT = Path(sb3_ars.__file__).parents[1]
NAMES = (
    "01_quickstart",
    "02_why_rewards_must_be_scaled",
    "03_ars_on_metaworld",
    "04_tuning_n_reset",
    "05_your_own_tasks",
    "06_reading_a_sweep",
)
NOTEBOOKS = [ROOT / "notebooks" / f"{name}.ipynb" for name in NAMES]


def test_every_notebook_is_run():
    assert tuple(sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb"))) == NAMES


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_in_git_has_stable_cells_and_no_outputs(path):
    notebook = nbformat.read(path, as_version=nbformat.NO_CONVERT)
    nbformat.validate(notebook)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    for cell in notebook.cells:
        assert cell.cell_type == "markdown" or (cell.outputs == [] and cell.execution_count is None), cell.id


@pytest.mark.metaworld
@pytest.mark.filterwarnings("ignore")  # of Jupyter's machinery in this process; the kernel is another
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom_and_draws(path, tmp_path, monkeypatch):
    for name, value in {
        "SB3_ARS_SHORT": "1",
        "OMP_NUM_THREADS": "1",
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    }.items():
        monkeypatch.setenv(name, value)  # the kernel inherits it
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert pictures, "it shows no picture"
    assert not any(output.output_type == "error" for output in outputs)
