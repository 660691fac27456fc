"""Settings of the model node: one table for ROS parameters and for options of the command."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from kineverse._checks import finite_number
from kineverse.errors import DuplicateNameError, InvalidValueError, UnknownNameError, suggest

from .names import TF, check_topics

Value = str | float | list[str]

_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides")  # parameters of any node


@dataclass(frozen=True)
class Setting:
    """Setting with its default, and what it is for; that of a list may be given several times."""

    default: Value
    metavar: str
    help: str


SETTINGS: Mapping[str, Setting] = {
    "model": Setting([], "MODEL", "names of shipped models, paths of files, or the address of a live model"),
    "robot": Setting("", "NAME", "the joints of this robot have their own names in ROS, without NAME/"),
    "rate": Setting(50.0, "HZ", "how often transforms and joint states are published, at most (50)"),
    "sources": Setting(
        ["joint_states"], "TOPIC", "joint states that are read (joint_states); '' for none; may be repeated"
    ),
    "observed": Setting(
        [],
        "FRAME=SOURCE",
        "pose of a frame from a topic of PoseStamped, or from a frame of TF with tf:NAME; may be repeated",
    ),
    "position_noise": Setting(0.01, "M", "standard deviation of observed positions (0.01)"),
    "orientation_noise": Setting(0.0175, "RAD", "standard deviation of observed orientations (0.0175)"),
    "omit": Setting(
        [], "FRAME", "frame that somebody else publishes; NAME/ for all below it; may be repeated"
    ),
    "joint_names": Setting(
        [], "NAME=ROS", "name of a joint in ROS; NAME/= takes a prefix away; may be repeated"
    ),
    "frame_names": Setting([], "NAME=ROS", "name of a frame in ROS, likewise; world=map; may be repeated"),
    "frame_prefix": Setting("", "TEXT", "is put before the names of all frames in ROS"),
    "share": Setting("", "SOURCE", "give what is read to a live model's server, as the source of that name"),
}


@dataclass(frozen=True)
class ModelSettings:
    """Checked values of :data:`SETTINGS`."""

    model: tuple[str, ...]
    robot: str
    rate: float
    sources: tuple[str, ...]
    observed: Mapping[str, str]
    deviations: tuple[float, float]
    omit: tuple[str, ...]
    joint_names: Mapping[str, str]
    frame_names: Mapping[str, str]
    frame_prefix: str
    share: str

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> ModelSettings:
        """Check values by name; those that are missing have their default.

        Raises
        ------
        InvalidValueError, DuplicateNameError
            For a value of another type or range, and a name that is given twice.
        """
        given = {name: values.get(name, setting.default) for name, setting in SETTINGS.items()}
        texts = {name: _read_text(name, given[name]) for name in ("robot", "frame_prefix", "share")}
        lists = {
            name: _read_texts(name, given[name])
            for name in ("model", "sources", "observed", "omit", "joint_names", "frame_names")
        }
        rules = {name: _read_rules(name, lists[name]) for name in ("observed", "joint_names", "frame_names")}
        if texts["robot"]:
            rules["joint_names"].setdefault(f"{texts['robot'].rstrip('/')}/", "")
        poses = [*rules["observed"].values()]
        check_topics([*lists["sources"], *(one for one in poses if not one.startswith(TF) or one == TF)])
        for source in poses:
            if poses.count(source) > 1:
                raise DuplicateNameError(f"observed has the source '{source}' twice, for two frames.")
        if not lists["model"]:
            raise InvalidValueError(
                "model is not given: the name of a model, the path of a file, or live:NAME."
            )
        return cls(
            model=lists["model"],
            robot=texts["robot"],
            rate=_read_positive("rate", given["rate"]),
            sources=lists["sources"],
            observed=rules["observed"],
            deviations=(
                _read_positive("position_noise", given["position_noise"]),
                _read_positive("orientation_noise", given["orientation_noise"]),
            ),
            omit=lists["omit"],
            joint_names=rules["joint_names"],
            frame_names=rules["frame_names"],
            frame_prefix=texts["frame_prefix"],
            share=texts["share"],
        )


def add_setting_options(parser: argparse.ArgumentParser) -> None:
    """Declare an option for each setting."""
    for name, setting in SETTINGS.items():
        if name == "model":
            parser.add_argument(name, metavar=setting.metavar, nargs="+", help=setting.help)
            continue
        option, text = f"--{name.replace('_', '-')}", setting.help
        if isinstance(setting.default, list):
            parser.add_argument(option, metavar=setting.metavar, action="append", help=text)
        else:
            parser.add_argument(option, metavar=setting.metavar, type=type(setting.default), help=text)


def given_settings(arguments: argparse.Namespace) -> dict[str, Value]:
    """Return the settings that options give."""
    found = {name: getattr(arguments, name) for name in SETTINGS}
    return {name: value for name, value in found.items() if value is not None}


def declare_settings(ros: Any, node: Any, given: Mapping[str, Value]) -> ModelSettings:
    """Declare the settings as parameters of a node, and return their values; its own ones come first.

    They cannot be set later, as they count at the start alone.

    Raises
    ------
    UnknownNameError
        If the node was given parameters that are none.
    """
    for name, value in node.get_parameters_by_prefix("").items():
        if name not in SETTINGS and name.partition(".")[0] not in _OF_ROS:
            raise UnknownNameError(
                f"There is no parameter '{name}' ({value.value!r}). {suggest(name, SETTINGS, 'parameter')}"
            )
    values: dict[str, Any] = {}
    for name, setting in SETTINGS.items():
        descriptor = ros.ParameterDescriptor(description=setting.help, read_only=True)
        if node.has_parameter(name):
            descriptor.type = node.describe_parameter(name).type
            node.set_descriptor(name, descriptor)
        else:
            value = given.get(name, setting.default)
            node.declare_parameter(name, [""] if value == [] else value, descriptor)  # [] has no type in ROS
        values[name] = node.get_parameter(name).value
    return ModelSettings.from_values(values)


def _read_texts(name: str, value: object) -> tuple[str, ...]:
    """Return the texts of a list, or the words of one text; empty ones do not count."""
    texts = value.split() if isinstance(value, str) else value
    if not isinstance(texts, Iterable) or not all(isinstance(text, str) for text in texts):
        raise InvalidValueError(f"{name} is a list of texts, not {value!r:.80}.")
    return tuple(text for text in texts if text)


def _read_text(name: str, value: object) -> str:
    if not isinstance(value, str):
        raise InvalidValueError(f"{name} is a text, not {value!r:.80}.")
    return value


def _read_positive(name: str, value: object) -> float:
    number = finite_number(value)
    if number is None or number <= 0.0:
        raise InvalidValueError(f"{name} is a positive number, not {value!r:.80}.")
    return number


def _read_rules(name: str, texts: Iterable[str]) -> dict[str, str]:
    rules: dict[str, str] = {}
    for text in texts:
        key, equals, other = text.partition("=")
        if not equals or not key:
            raise InvalidValueError(f"{name} has '{text}', which is not of the form NAME=OTHER.")
        if key in rules:
            raise DuplicateNameError(f"{name} has '{key}' twice.")
        rules[key] = other
    return rules
