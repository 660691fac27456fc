"""What somebody does in their first hour, and what they read then: never a bare error of Python, never silence.

Each mistake is a piece of code or a command. It either works, as one would expect, or ends in one of our errors whose message says
what to do: the pattern is what the message cannot do without.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import sys
from dataclasses import dataclass

import numpy as np
import pytest

import kineverse as kv
from kineverse import errors
from kineverse.cli import main
from markdown_examples import ROOT


@dataclass(frozen=True)
class Mistake:
    """What one writes, and the pattern of what one reads; without a pattern it works."""

    name: str
    code: str
    says: str = ""


PYTHON = [
    # Models and edits.
    Mistake("a model by its name", "kv.Model('kitchen')", r"kv\.load\(.kitchen.\)"),
    Mistake("a model of a list", "kv.Model([1, 2])", r"kv\.load\("),
    Mistake("an edit without with", "kv.Model().edit().add_frame('a', parent='world')", r"with model\.edit\(\) as edit"),
    Mistake("a parent called World", "edit.add_frame('b', parent='World')", r"'world'"),
    Mistake("a frame that is there", "edit.add_frame('door', parent='world')", r"'door'"),
    Mistake("yes as a text", "edit.add_frame('door', parent='world', override='no')", r"True or False"),
    Mistake("joints of a model", "model.joints", r"articulations|degrees_of_freedom"),
    Mistake("forward kinematics by its long name", "model.forward_kinematics('door')", r"\bfk\b"),
    Mistake("a forgotten prefix", "kitchen.fk('fridge_door_handle')", r"Did you mean 'kitchen/fridge_door_handle'"),
    Mistake("a mistyped model", "kv.load('kichen')", r"Did you mean 'kitchen'"),
    Mistake("rates, printed", "assert 'object at 0x' not in repr(kitchen.rates)"),
    Mistake("the root of a long chain, removed", "long_chain().edit_away()", r"and \d+ more"),
    # Articulations.
    Mistake("a hinge by that name", "kv.Hinge", r"Revolute|Did you mean"),
    Mistake("arguments by position", "kv.Revolute('d', 'world', 'd')", r"name=|keyword"),
    Mistake("a tuple for an origin", "kv.Revolute(name='d', parent='world', child='d', axis=(0, 0, 1), origin=(.1, 0, 0), lower=0, upper=1)", r"not a pose"),
    Mistake("an axis of zeros", "edit.apply(kv.Revolute(name='d', parent='world', child='d', axis=(0, 0, 0), lower=0, upper=1))", r"axis"),
    Mistake("limits the wrong way round", "edit.apply(kv.Revolute(name='d', parent='world', child='d', axis=(0, 0, 1), lower=2, upper=1))", r"lower|2"),
    # States and values.
    Mistake("a state, assigned to", "state = model.default_state(); state['door'] = 1.0", r"updated"),
    Mistake("a state, merged", "assert (model.default_state() | {'door': 1.0})['door'] == 1.0"),
    Mistake("a value as an attribute", "model.default_state().door", r"state\['door'\]"),
    Mistake("a state of another model", "kitchen.violations(kv.State({'fridge_door': 1.0}))", r"Did you mean 'kitchen/fridge_door'"),
    Mistake("a state, spread", "q({**model.default_state(), 'door': 1.0})", r"updated"),
    Mistake("a state, updated without the prefix", "kitchen.default_state().updated({'fridge_door': 1.0})", r"Did you mean 'kitchen/fridge_door'"),
    Mistake("a mapping without the prefix", "kitchen.fk('kitchen/fridge_door_handle')({'fridge_door': 1.0})", r"kitchen/fridge_door"),
    Mistake("a value that nobody needs", "q({'door': 1.0, 'dor': 2.0})", r"dor"),
    Mistake("a value that is missing", "q({})", r"door"),
    # Expressions.
    Mistake("math.sin", "import math; math.sin(q)", r"np\.sin"),
    Mistake("float of an expression", "float(q)", r"value|scalar|constant"),
    Mistake("if of an expression", "if q > 0.3: pass", r"if |truth|condition|np\.where|kv\."),
    Mistake("a quaternion as a list", "assert kv.quaternion([0, 0, 0, 1]).shape == (4, 4)"),
    Mistake("angles as a tuple", "assert kv.rpy((0, 0, 1)).shape == (4, 4)"),
    Mistake("a text for an angle", "kv.rotation_z('30')", r"30"),
    Mistake("an expression, printed like a number", "f'{q:.2f}'", r"call it with values"),
    Mistake("a compiled constant, called", "assert kv.compile(kv.array([1.0, 2.0]))() is not None"),
    # Extras.
    Mistake("distances without coal", "kv.geometry.Scene(kitchen)", r"pip install -e '.*\[geometry\]'"),
]  # fmt: skip

METHODS = [
    "mean()", "max()", "min()", "clip(0,1)", "copy()", "trace()", "diagonal()", "squeeze()", "tolist()", "astype(float)", "round(2)",
    "var()", "any()", "all()", "argmax()", "sort()", "inv()", "det()", "norm()", "subs({})", "diff(q)", "eval()", "dtype", "value", "shap",
    "sum()", "flatten()", "ravel()", "reshape(1,4)", "transpose()", "dot(v)", "cumsum()", "prod()", "std()"
]  # fmt: skip
"""What one calls on arrays, tried on an expression of the shape (2, 2)."""

CALLS = [
    "round(q)", "divmod(q,2.0)", "abs(q)", "q.item()", "np.einsum('ij,j->i',m,v)", "np.diag(v)", "np.diag(m)",
    "np.linalg.norm(m,axis=1)", "np.linalg.solve(m,v)", "np.block([[m,m],[m,m]])", "np.kron(m,m)", "np.tensordot(m,v,1)",
    "np.cumsum(v)", "np.diff(v)", "np.cross(w,w)", "np.log10(q)", "np.log2(q)", "np.exp2(q)", "np.cbrt(q)", "np.trace(m)",
    "np.linalg.matrix_power(m,2)", "np.split(v,2)", "np.append(v,1.0)", "np.dot(m,v)", "np.sum(m,axis=0,keepdims=True)",
    "np.linalg.inv(m)", "np.linalg.det(m)", "np.concatenate([v,v])", "np.stack([v,v])", "np.vstack([v,v])", "np.hstack([v,v])",
    "np.outer(v,v)", "np.where(q>0,q,0)", "np.maximum(q,0)", "np.clip(q,0,1)", "np.mean(v)", "np.array([q,q])", "np.eye(2)@m",
    "m.T@m", "np.isclose(q,1.0)", "np.linalg.eigvals(m)", "np.sort(v)"
]  # fmt: skip
"""What one tries of numpy: ``q`` is a scalar, ``v`` of two, ``w`` of three numbers, ``m`` of the shape (2, 2)."""


class Names(dict):
    """What the pieces of code may use; each is made when it is asked for."""

    def __missing__(self, name):
        if name not in MADE:
            raise KeyError(name)
        self[name] = MADE[name]()
        return self[name]


def _door() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1.5))
    return model


class _LongChain:
    """Sixty links, of which somebody takes the first one away."""

    def __init__(self) -> None:
        self.model = kv.Model()
        with self.model.edit() as edit:
            for k in range(60):
                parent = f"link{k - 1}" if k else "world"
                edit.add_frame(f"link{k}", parent=parent, transform=kv.translation(0, 0, 1), tag=f"link{k}")

    def edit_away(self) -> None:
        with self.model.edit() as edit:
            edit.remove("link0")


def _applied(what: str):
    def do(*arguments, **keywords):
        with _door().edit() as edit:
            getattr(edit, what)(*arguments, **keywords)

    return do


class _Edit:
    """An edit of a model with a door, which ends at once."""

    add_frame = staticmethod(_applied("add_frame"))
    apply = staticmethod(_applied("apply"))


MADE = {
    "kv": lambda: kv,
    "np": lambda: np,
    "model": _door,
    "kitchen": lambda: kv.load("kitchen"),
    "edit": _Edit,
    "long_chain": lambda: _LongChain,
    "q": lambda: kv.position("door"),
    "v": lambda: kv.array([kv.position("a"), kv.position("b")]),
    "w": lambda: kv.array([kv.position("a"), kv.position("b"), kv.position("c")]),
    "m": lambda: kv.array([[kv.position("a"), kv.position("b")], [kv.position("c"), 1.0 + kv.position("d")]]),
}


@pytest.mark.parametrize("mistake", PYTHON, ids=lambda m: m.name)
def test_code_for_other_libraries_works_or_names_the_equivalent(mistake, monkeypatch):
    if "coal" in mistake.name:
        monkeypatch.setitem(sys.modules, "coal", None)
        assert kv.geometry
    if not mistake.says:
        exec(mistake.code, {}, Names())
        return
    with pytest.raises(kv.KineverseError) as caught:
        exec(mistake.code, {}, Names())
    said = str(caught.value)
    assert re.search(mistake.says, said), said
    assert len(said) < 600


@pytest.mark.parametrize("call", [f"m.{method}" for method in METHODS] + CALLS)
def test_numpy_idioms_work_or_name_the_equivalent(call):
    said = ""
    try:
        assert eval(call, {}, Names()) is not None
    except kv.KineverseError as error:
        said = str(error)
    assert not said or len(said) > 20


COMMANDS = [
    Mistake("nothing at all", "", ""),
    Mistake("a mistyped command", "inof kitchen", r"Did you mean 'info'"),
    Mistake("a model without a command", "kitchen", r"kineverse info kitchen"),
    Mistake("a mistyped option", "info kitchen --jsno", r"Did you mean '--json'"),
    Mistake("a mistyped model", "info kichen", r"Did you mean 'kitchen'"),
    Mistake("a frame without its prefix", "fk kitchen fridge_door_handle", r"Did you mean 'kitchen/fridge_door_handle'"),
    Mistake("a position without its prefix", "fk kitchen world --set fridge_door=1", r"Did you mean 'kitchen/fridge_door'"),
    Mistake("a value without a name", "fk kitchen world --set 1", r"NAME=VALUE"),
    Mistake("degrees without a unit", "fk kitchen kitchen/fridge_door --set kitchen/fridge_door=30", r"\[0, 1\.571\].*30deg"),
    Mistake("metres of an angle", "fk kitchen kitchen/fridge_door --set kitchen/fridge_door=1m", r"'kitchen/fridge_door' is in rad; write 30deg or 0.5"),
    Mistake("a table with two parts", f"fit {shlex.quote(str(ROOT / 'examples' / 'poses.csv'))}", r"--child"),
    Mistake("a file that is not there", "info nofile.urdf", r"no model 'nofile\.urdf'"),
    Mistake("a page of text", f"info {shlex.quote(str(ROOT / 'README.md'))}", r"reads URDF"),
    Mistake("a folder", f"info {shlex.quote(str(ROOT / 'examples'))}", r"door\.urdf"),
    Mistake("unexpanded xacro", "info robot.urdf.xacro", r"xacro"),
    Mistake("an ending that nobody knows", "convert kitchen kitchen.stl", r"Use one of .*\.urdf"),
    Mistake("a table that is not there", "fit poses.csv", r"no such file"),
    Mistake("a part that nobody saw", f"fit {shlex.quote(str(ROOT / 'examples' / 'poses.csv'))} --child dor", r"Did you mean 'door'"),
    Mistake("an experiment that nobody made", "reproduce fig33", r"Did you mean 'fig3'"),
    Mistake("a benchmark that nobody wrote", "bench cal", r"Did you mean 'call'"),
    Mistake("a port beyond all", "view kitchen --port 80000 --no-browser", r"numbers from 0"),
]  # fmt: skip


@pytest.mark.parametrize("mistake", COMMANDS, ids=lambda m: m.name)
def test_an_unknown_command_names_a_similar_one(mistake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.urdf.xacro").write_text(
        '<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="a.xacro"/></robot>'
    )
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(shlex.split(mistake.code))
    if not mistake.code:
        assert (status, err.getvalue()) == (0, "")
        assert "kineverse info kitchen" in out.getvalue()
        return
    said = err.getvalue()
    assert re.search(mistake.says, said), said
    assert "Traceback" not in said
    assert len(said.splitlines()) == 1
    noted = "--set kitchen/" in mistake.code and "write" not in said
    assert status == (0 if noted else 2)


def test_docs_warn_of_comparing_an_expression_with_a_number():
    """``if q == 0.3`` compares what is written, so that it is False; nothing can say so when it happens."""
    assert any("if q == 0.3" in page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))


def test_the_table_of_mistakes_is_long_enough():
    assert len(PYTHON) + len(COMMANDS) >= 25


def test_the_page_of_errors_has_each_class_with_the_built_in_error_that_it_is() -> None:
    page = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| `(\w+)` \|", page, re.MULTILINE))
    classes = {name: getattr(errors, name) for name in errors.__all__ if name.endswith("Error")}
    assert set(rows) == set(classes) - {"KineverseError"}
    for name, base in rows.items():
        assert base in {one.__name__ for one in classes[name].__mro__[1:]}, name
