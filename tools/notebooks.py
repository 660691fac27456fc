"""Run the notebooks of the examples: compare what they show with what is saved, or save it.

    python tools/notebooks.py                   # each, and say which outputs differ
    python tools/notebooks.py --write           # save what they show now
    python tools/notebooks.py 01_first_model    # one of them

Saved outputs have no times, versions and addresses. Of a page the picture is kept.
"""

from __future__ import annotations

import argparse
import difflib
import math
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import nbformat
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "notebooks"

TIMEOUT = 300  # longest time of a cell [s]; the slowest takes three

METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_TOLERANCE = 2e-3  # largest difference of equal numbers, relative above 1: machines round differently
_PICTURE = re.compile(r'src="data:[^"]*"')
_ADDRESS = re.compile(r", http://[^\s>]+")


def read_notebook(path: Path) -> Any:
    """Return a notebook."""
    return nbformat.read(path, as_version=4)


def write_notebook(path: Path, notebook: Any) -> None:
    """Write a notebook."""
    path.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")


@contextmanager
def start_kernel() -> Iterator[KernelManager]:
    """Start a kernel of this interpreter, for the time of a ``with`` block."""
    # Sockets of the file system, as others on this computer could read and write those of the network.
    kernel = KernelManager(kernel_name="python3", transport="ipc")
    kernel.start_kernel()
    try:
        yield kernel
    finally:
        kernel.shutdown_kernel(now=True)


def run_notebook(notebook: Any, kernel: KernelManager) -> Any:
    """Return a notebook with the outputs of all cells, run in an empty folder; an error of a cell is raised.

    The kernel forgets all names first.
    """
    reset = nbformat.v4.new_code_cell("")
    new = nbformat.v4.new_notebook(cells=[reset, *(nbformat.from_dict(dict(c)) for c in notebook.cells)])
    with tempfile.TemporaryDirectory() as folder:
        reset.source = f"import os\nos.chdir({folder!r})\n%reset -f"
        client = NotebookClient(new, km=kernel, timeout=TIMEOUT, record_timing=False)
        try:
            client.execute()
        finally:
            if client.kc is not None:
                client.kc.stop_channels()
    new.cells = new.cells[1:]
    new.metadata = nbformat.from_dict(METADATA)
    count = 0
    for cell in new.cells:
        cell.metadata = nbformat.from_dict({})
        if cell.cell_type == "code":
            count += 1
            cell.execution_count = count
            cell.outputs = [_strip(output, count) for output in cell.outputs]
    return new


def _strip(output: Any, count: int) -> Any:
    """Return an output without what belongs to this run."""
    if "execution_count" in output:
        output.execution_count = count
    data = output.get("data", {})
    if "text/plain" in data:
        data["text/plain"] = _ADDRESS.sub("", data["text/plain"])
    if "<object " in data.get("text/html", ""):
        del data["text/html"]
    return output


def compare_notebooks(saved: Any, shown: Any) -> list[str]:
    """Return the differences of the outputs, a text for each cell that differs; numbers are rounded."""
    found = []
    for before, after in zip(saved.cells, shown.cells, strict=True):
        old, new = (_list_texts(cell.get("outputs", [])) for cell in (before, after))
        if len(old) != len(new) or not all(map(_agree, old, new)):
            lines = difflib.unified_diff(old, new, "saved", "now", lineterm="", n=0)
            found.append("\n".join([f"cell {before.id}: {before.source[:60]}", *lines]))
    return found


def _list_texts(outputs: Any) -> list[str]:
    texts = []
    for output in outputs:
        if output.output_type == "stream":
            texts.append(f"{output.name}: {output.text}")
        for kind, content in sorted(output.get("data", {}).items()):
            is_picture = kind == "image/png"
            texts.append(kind if is_picture else f"{kind}: {_PICTURE.sub('', content)}")
        if output.output_type == "error":
            texts.append(output.ename)
    return texts


def _agree(a: str, b: str) -> bool:
    numbers = [[float(number) for number in _NUMBER.findall(text)] for text in (a, b)]
    return _NUMBER.sub("", a) == _NUMBER.sub("", b) and all(
        math.isclose(x, y, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE) for x, y in zip(*numbers, strict=True)
    )


def main() -> int:
    """Run the notebooks, and compare or save what they show."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    known = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"all by default: {', '.join(known)}")
    parser.add_argument("--write", action="store_true", help="save the outputs")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in known]
    if unknown:
        parser.error(f"There is no notebook {unknown[0]!r}; there are {', '.join(known)}.")
    status = 0
    for name in arguments.names or known:
        path = FOLDER / f"{name}.ipynb"
        saved = read_notebook(path)
        with start_kernel() as kernel:
            shown = run_notebook(saved, kernel)
        if arguments.write:
            write_notebook(path, shown)
            print(f"{name}: saved, {path.stat().st_size / 1e3:.0f} kB")
            continue
        differences = compare_notebooks(saved, shown)
        print("\n".join([f"{name}: {'differs' if differences else 'as saved'}", *differences]))
        status |= bool(differences)
    return status


if __name__ == "__main__":
    sys.exit(main())
