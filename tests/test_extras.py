"""What is said where an extra is missing: a line that works for how the package is installed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from kineverse import _extras
from kineverse._extras import DISTRIBUTION, install_command, install_distribution, requirements
from kineverse._version import __version__
from kineverse.cli.arguments import MODULES
from test_examples import NEEDED, SCRIPTS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
STUDIES = tomllib.loads((ROOT / "studies" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HERE = Path(sys.executable)


def pip() -> str:
    return f"{HERE.with_name('pip')}" if HERE.with_name("pip").is_file() else f"{HERE} -m pip"


def test_install_command_of_a_checkout_is_editable_with_the_extra(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert install_command("figures") == f"{pip()} install -e '{ROOT}[figures]'"


def test_install_command_in_the_checkout_is_relative(tmp_path, monkeypatch):
    root = tmp_path / "clone"
    (root / "src" / "kineverse").mkdir(parents=True)
    (root / ".venv" / "bin").mkdir(parents=True)
    for file in ("pyproject.toml", "src/kineverse/_extras.py", ".venv/bin/pip"):
        (root / file).touch()
    monkeypatch.chdir(root)
    monkeypatch.setattr(_extras, "__file__", str(root / "src" / "kineverse" / "_extras.py"))
    monkeypatch.setattr(sys, "executable", str(root / ".venv" / "bin" / "python"))
    assert install_command("figures") == ".venv/bin/pip install -e '.[figures]'"
    (root / ".venv" / "bin" / "pip").unlink()
    assert install_command("view") == ".venv/bin/python -m pip install -e '.[view]'"


def test_install_command_of_an_installed_copy_lists_the_extra(tmp_path):
    place = tmp_path / "site-packages"
    (place / "kineverse").mkdir(parents=True)
    (place / "kineverse" / "__init__.py").touch()
    shutil.copy(_extras.__file__, place / "kineverse")
    about = place / "kineverse_articulation-0.1.0.dist-info"
    about.mkdir()
    text = metadata.distribution(DISTRIBUTION).read_text("METADATA")
    assert text is not None
    (about / "METADATA").write_text(text, encoding="utf-8")
    program = (
        f"import sys; sys.path.insert(0, {str(place)!r})\n"
        "from kineverse._extras import install_command\n"
        "print(install_command('figures')); print(install_command('geometry'))"
    )
    said = subprocess.run(
        [sys.executable, "-I", "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path
    ).stdout.splitlines()
    assert said[0] == f"{pip()} install '{EXTRAS['figures'][0]}'"
    assert f" '{EXTRAS['geometry'][0]}' " in said[1]
    assert "extra" not in said[1]


def test_requirements_keep_other_markers():
    declared = ['pybullet>=3; (python_version < "3.12" and sys_platform == "linux") and extra == \'peers\'']
    assert requirements("peers", declared) == [
        'pybullet>=3; (python_version < "3.12" and sys_platform == "linux")'
    ]


def test_install_command_of_distributions_beside_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert install_distribution(_extras.STUDIES).endswith(" install -e ./studies")
    assert install_distribution(_extras.ROS).endswith(" install -e ./ros/kineverse_ros")
    assert install_distribution(_extras.STUDIES, "peers").endswith(" install -e './studies[peers]'")
    monkeypatch.chdir(tmp_path)
    assert install_distribution(_extras.STUDIES) == f"{pip()} install -e {ROOT / 'studies'}"
    monkeypatch.setattr(_extras, "__file__", str(tmp_path / "a" / "kineverse" / "_extras.py"))
    assert install_distribution(_extras.STUDIES, "peers") == f"{pip()} install 'kineverse-studies[peers]'"


def test_install_command_without_metadata_asks_for_a_checkout(tmp_path, monkeypatch):
    monkeypatch.setattr(_extras, "__file__", str(tmp_path / "a" / "kineverse" / "_extras.py"))
    monkeypatch.setattr(_extras, "DISTRIBUTION", "no-such-distribution")
    assert install_command("view").endswith("install -e '.[view]' in a checkout")


@pytest.mark.parametrize("extra", [name for name in EXTRAS if name != "all"])
def test_requirements_of_each_extra_are_in_the_metadata(extra):
    found = requirements(extra, metadata.requires(DISTRIBUTION))
    assert [line.partition(";")[0].strip() for line in found] == [
        line.partition(";")[0].strip() for line in EXTRAS[extra]
    ]


def test_the_compiler_is_installed_only_where_it_is_asked_for():
    (requirement,) = EXTRAS["compiler"]
    assert "ziglang" in requirement
    assert [
        name for name, lines in EXTRAS.items() if "ziglang" in str(lines) or "compiler" in str(lines)
    ] == ["compiler"]
    for file in (ROOT / "requirements").glob("*.txt"):
        assert "ziglang" not in file.read_text("utf-8"), file


def test_studies_have_the_version_of_the_package_and_need_it():
    assert STUDIES["version"] == __version__
    assert STUDIES["dependencies"] == [f"{DISTRIBUTION}=={__version__}"]


def test_every_missing_extra_names_the_same_install_command():
    """No message names the distribution to pip, and each names an extra that there is."""
    named = set()
    for file in sorted((ROOT / "src").rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        assert f"{DISTRIBUTION}[" not in text, file
        named |= {extra for extra in EXTRAS if f'install_command("{extra}")' in text}
        named |= {extra for extra in EXTRAS if f"install_command('{extra}')" in text}
    assert named >= {"figures", "geometry", "decomposition", "mjcf", "view", "recording"}
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        text = page.read_text(encoding="utf-8")
        assert f"{DISTRIBUTION}[" not in text, page
        assert "pip install '." not in text.replace("pip install -e '.", ""), page
        for extra in re.findall(r"/studies\[(\w+)\]", text):
            assert extra in STUDIES["optional-dependencies"], page


def test_each_example_names_the_extras_that_it_needs():
    """Those that name none run with the core alone; a release tries this."""
    modules = {module: extra for extra, module in MODULES.items()} | {"jax": "jax"}
    listed = (ROOT / "examples" / "README.md").read_text("utf-8").splitlines()
    for script in SCRIPTS:
        (row,) = (line for line in listed if line.startswith(f"| [{script.name}]"))
        assert {modules[name] for name in NEEDED.get(script.stem, ())} <= {*re.findall(r"`(\w+)`", row)}, row


def test_the_installation_page_has_every_variable_that_is_read():
    page = (ROOT / "docs" / "installation.md").read_text("utf-8")
    sources = [*(ROOT / "src").rglob("*.py"), *(ROOT / "ros").rglob("*.py")]
    read = {
        name
        for source in sources
        for name in re.findall(r"\bKINEVERSE_[A-Z_]+\b", source.read_text("utf-8"))
        if name != "KINEVERSE_FLOAT"  # a macro of C
    }
    assert "KINEVERSE_CACHE_DIR" in read
    assert {name for name in read if f"| `{name}`" not in page} == set()


CORE_COMMANDS = ("info", "fk", "convert", "diff", "validate", "unlock", "fit", "calibrate", "cache")
TRIED = """\
info kitchen
fk kitchen kitchen/fridge_door_handle --set kitchen/fridge_door=30deg
convert kitchen made.urdf
convert made.urdf made.kv.json
convert kitchen made.sdf
convert kitchen made.xml
validate made.urdf made.sdf
diff examples/door.urdf examples/door.urdf
unlock lockboxes/thesis --goal lockbox/a=1.2
fit examples/poses.csv --parent cupboard --child door
calibrate examples/door.urdf --help
cache
"""


def test_what_the_installation_page_promises_of_the_core_is_true(tmp_path):
    """With all other packages hidden, in another process; a release tries it where they are not installed."""
    page = (ROOT / "docs" / "installation.md").read_text("utf-8")
    promised = page.partition("The core alone has")[2].partition("\n\n")[0]
    assert {*CORE_COMMANDS} <= {*re.findall(r"[`,\s](\w+)`", promised)}
    assert {*CORE_COMMANDS} == {line.split()[0] for line in TRIED.splitlines()}
    allowed = {re.split(r"[>=]", line)[0] for line in PROJECT["dependencies"]}
    allowed |= {"kineverse", "markdown_it", "mdurl", "pygments"}
    hidden = {name for name in metadata.packages_distributions() if name not in allowed}
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    program = f"""
import sys
sys.modules.update(dict.fromkeys({sorted(hidden)!r}))
sys.path.append({str(ROOT / "tests")!r})
import shlex
import markdown_examples
from kineverse.cli import main
for line in {TRIED.splitlines()!r}:
    status = main(shlex.split(line))
    assert status == 0, (line, status)
markdown_examples.run(markdown_examples.ROOT / "docs" / "models.md")
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
