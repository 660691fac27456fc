"""The package as a workspace has it: launch file, manifest, set-up, and the command without ROS."""

from __future__ import annotations

import ast
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from kineverse._version import __version__
from kineverse.cli import main
from kineverse_ros.model_settings import SETTINGS, ModelSettings
from kineverse_ros.ros import _MESSAGES, import_ros

PACKAGE = Path(__file__).parents[2] / "ros" / "kineverse_ros"


def launch(monkeypatch, given):
    """Return the node of the launch file with its parameters, as ``ros2 launch`` would evaluate them."""

    class Argument(SimpleNamespace):
        def __init__(self, name, **options):
            super().__init__(name=name, text=given.get(name, options.get("default_value")))
            assert self.text is not None, f"{name} is required"

    for name, members in {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": Argument},
        "launch.substitutions": {"LaunchConfiguration": str},
        "launch_ros": {},
        "launch_ros.actions": {"Node": lambda **options: SimpleNamespace(**options)},
        "launch_ros.parameter_descriptions": {
            "ParameterValue": lambda name, value_type: SimpleNamespace(name=name, kind=value_type)
        },
    }.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    namespace: dict[str, object] = {}
    exec((PACKAGE / "launch" / "model.launch.py").read_text("utf-8"), namespace)
    *arguments, node = namespace["generate_launch_description"]()
    texts = {argument.name: argument.text for argument in arguments}
    (parameters,) = node.parameters
    return node, {
        name: texts[value.name] == "true" if value.kind is bool else value.kind(texts[value.name])
        for name, value in parameters.items()
    }


def test_the_launch_file_starts_the_node_with_all_settings(monkeypatch):
    node, parameters = launch(monkeypatch, {"model": "kitchen pr2", "joint_names": "pr2/= kitchen/=k_"})
    assert (node.package, node.executable) == ("kineverse_ros", "model_node")
    assert set(parameters) == {*SETTINGS, "use_sim_time"}
    settings = ModelSettings.from_values(parameters)
    defaults = ModelSettings.from_values(
        {"model": ["kitchen", "pr2"], "joint_names": ["pr2/=", "kitchen/=k_"]}
    )
    assert settings == defaults


def test_the_manifest_lists_what_is_imported_and_the_set_up_what_is_there():
    manifest = ET.parse(PACKAGE / "package.xml").getroot()
    needed = {element.text for element in manifest.iter("exec_depend")}
    assert needed == {"rclpy", "launch", "launch_ros", *_MESSAGES}
    set_up = (PACKAGE / "setup.py").read_text("utf-8")
    for version in (manifest.findtext("version"), re.search(r'version="(.*?)"', set_up)[1]):
        assert version == __version__
    for module, function in re.findall(r"{NAME}\.(\w+)(?::(\w+))?", set_up):
        tree = ast.parse((PACKAGE / "kineverse_ros" / f"{module}.py").read_text("utf-8"))
        names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        assert {function or "run"} <= names


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["kitchen"],
            r"kineverse: ROS 2 cannot be imported \(.*rclpy.*\). With an installed ROS 2, source it",
        ),
        (["kitchen", "--rate", "fast"], "argument --rate: invalid float value: 'fast'"),
        (["kitchen", "--speed", "1"], "kineverse ros has no option '--speed'"),
        ([], "required: MODEL"),
    ],
)
def test_the_command_says_in_a_line_what_is_wrong(words, said, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    import_ros.cache_clear()
    assert main(["ros", *words]) == 2
    *usage, error = capsys.readouterr().err.splitlines()
    assert re.search(said, error)
    assert not usage or usage[0].startswith("usage: ")
