"""The notebooks of the examples run, show what is saved in them, and hold nothing of the machine they ran on."""

from __future__ import annotations

import json
import re
import tempfile
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("nbclient", reason="running notebooks needs requirements/notebooks.txt")
pytest.importorskip("ipykernel", reason="running notebooks needs requirements/notebooks.txt")

import notebooks as tool

PATHS = sorted(tool.FOLDER.glob("*.ipynb"))
NEEDED = {
    "01_first_model": ("viser", "zenoh"),
    "02_a_joint_of_your_own": ("viser",),
    "04_open_a_door": ("viser", "daqp"),
}
SLOW = ("01_first_model", "04_open_a_door")  # seconds: pictures of kitchens, control

LARGEST = 60_000  # bytes of a picture in the repository


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[object]:
    """One real kernel for all, with files of its own."""
    folder = tmp_path_factory.mktemp("jupyter")
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory(prefix="kv-") as sockets:
        patch.setenv("KINEVERSE_RUNTIME_DIR", sockets)
        for name in ("JUPYTER_RUNTIME_DIR", "JUPYTER_DATA_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR"):
            patch.setenv(name, str(folder / name.lower()[:9]))
        with tool.start_kernel() as running:
            yield running


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=pytest.mark.long) if p.stem in SLOW else p for p in PATHS],
    ids=lambda path: path.stem,
)
def test_a_notebook_runs_and_shows_what_is_saved(path: Path, kernel: object) -> None:
    for module in NEEDED.get(path.stem, ()):
        pytest.importorskip(module)
    saved = tool.read_notebook(path)
    shown = tool.run_notebook(saved, kernel)
    differences = tool.compare_notebooks(saved, shown)
    assert not differences, "\n".join(differences)
    for cell in [cell for cell in shown.cells if cell.get("outputs")]:
        kept, cell.outputs = cell.outputs, []
        assert len(tool.compare_notebooks(saved, shown)) == 1  # each output is compared
        cell.outputs = kept


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_saved_notebook_is_small_and_of_no_machine(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"127\.0\.0\.1|http://|/home/|/root/|/tmp/|/work/|\d{4}-\d{2}-\d{2}T", text)
    notebook = json.loads(text)
    assert notebook["metadata"] == tool.METADATA
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert not any(cell["metadata"] for cell in notebook["cells"])
    pictures = [
        o["data"]["image/png"] for c in code for o in c["outputs"] if "image/png" in o.get("data", {})
    ]
    embedded = re.findall(r'base64,([^"\\]*)', text)
    assert all(len(b64decode(png)) <= LARGEST for png in (*pictures, *embedded))


def test_a_cell_that_fails_is_an_error(kernel: object) -> None:
    notebook = tool.read_notebook(PATHS[0])
    notebook.cells = notebook.cells[:2]
    notebook.cells[1].source = "import kineverse as kv\nkv.load('kitchn')"
    with pytest.raises(Exception, match="Did you mean 'kitchen'"):
        tool.run_notebook(notebook, kernel)


def test_the_list_of_examples_names_the_notebooks() -> None:
    text = (tool.FOLDER.parent / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| \[notebooks/(\S+)\]\(notebooks/(\S+)\) ", text, re.MULTILINE) == [
        (path.name, path.name) for path in PATHS
    ]
