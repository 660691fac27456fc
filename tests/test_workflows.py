"""The workflows of continuous integration: they name commands, targets and files that there are, and may write nothing."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
TARGETS = re.findall(r"^([\w$(){}./-]+):(?!=)", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
CLASSIFIER = r"Programming Language :: Python :: (3\.\d+)\b"
DISTRIBUTIONS = ("pyproject.toml", "studies/pyproject.toml", "ros/kineverse_ros/setup.py")


def read(path: Path) -> dict:
    return yaml.safe_load(path.read_text("utf-8"))


def commands(job: dict) -> Iterator[str]:
    """Yield the command lines of a job, with each value of its matrix in its place."""
    matrix = job.get("strategy", {}).get("matrix", {})
    for step in job["steps"]:
        for line in step.get("run", "").splitlines():
            values = next((matrix[name] for name in re.findall(r"\$\{\{ matrix\.(\w+) }}", line)), [""])
            yield from (re.sub(r"\$\{\{.*?}}", str(value), line) for value in values)


JOBS = [
    pytest.param(job, id=f"{path.stem}-{name}")
    for path in WORKFLOWS
    for name, job in read(path)["jobs"].items()
]


def test_there_are_workflows_of_tests_documentation_and_releases() -> None:
    assert {path.stem for path in WORKFLOWS} >= {"tests", "docs", "release", "nightly"}


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_may_only_read(path: Path) -> None:
    workflow = read(path)
    assert workflow["permissions"] == {"contents": "read"}
    assert not any("permissions" in job for job in workflow["jobs"].values())
    assert "secrets." not in path.read_text("utf-8")


@pytest.mark.parametrize("job", JOBS)
def test_a_job_ends_in_time_and_uses_actions_of_one_version(job: dict) -> None:
    assert 0 < job["timeout-minutes"] <= 90
    used = [step["uses"] for step in job["steps"] if "uses" in step]
    assert used
    assert all(re.fullmatch(r"actions/[\w-]+@v\d+\.\d+\.\d+", action) for action in used), used
    assert {*job["steps"][0]} == {"uses"}  # the checkout
    assert [*commands(job)]


@pytest.mark.parametrize("job", JOBS)
def test_a_job_names_targets_and_files_that_there_are(job: dict) -> None:
    targets = {target.replace("$(VENV)", ".venv").replace("$(BIN)", ".venv/bin") for target in TARGETS}
    for line in commands(job):
        if line.startswith("make "):
            named = [word for word in line.partition("ARGS=")[0].split()[1:] if "=" not in word]
            assert named, line
            assert {*named} <= targets, line
        for word in re.findall(r"(?<![\w./-])(?:tools|tests|examples|\.ci|studies)/[\w./-]+", line):
            assert (ROOT / word).exists(), line


def test_all_versions_of_python_that_are_declared_are_tested() -> None:
    tested = read(ROOT / ".github" / "workflows" / "tests.yml")["jobs"]["linux"]["strategy"]["matrix"][
        "python"
    ]
    for file in DISTRIBUTIONS:
        assert re.findall(CLASSIFIER, (ROOT / file).read_text("utf-8")) == tested, file
    least = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["requires-python"]
    assert least == f">={tested[0]}"
    assert f"{tested[0]} to {tested[-1]}" in (ROOT / "requirements" / "core.txt").read_text("utf-8")
    asked = (ROOT / "tools" / "dependencies.py").read_text("utf-8")
    assert re.findall(r'"(3\.\d+)"', re.findall(r"PYTHONS = (.*)", asked)[0]) == tested


def test_every_pinned_file_has_hashes() -> None:
    for file in sorted((ROOT / "requirements").glob("*.txt")):
        pins = re.split(r"\n(?=\w)", file.read_text("utf-8"))[1:]
        assert pins, file
        for pin in pins:
            assert re.match(r"[\w.-]+==\S+", pin), (file, pin)
            assert re.findall(r"--hash=sha256:[0-9a-f]{64}\b", pin), (file, pin)


def test_the_licenses_of_all_distributions_are_that_of_the_repository() -> None:
    for folder in ("studies", "ros/kineverse_ros"):
        assert (ROOT / folder / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes(), folder
