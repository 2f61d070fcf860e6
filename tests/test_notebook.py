import pytest


@pytest.mark.slow
def test_the_notebook_runs_and_what_it_trains_shows_the_room(root, tmp_path, monkeypatch):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path))
    notebook = nbformat.read(root / "docs" / "notebook.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "commit it without outputs"
    notebook.cells.append(nbformat.v4.new_code_cell("assert psnr > 18 and losses[-1] < losses[0] / 2, psnr"))
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
