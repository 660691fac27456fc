"""kv.show in a script, at a prompt and in a notebook; titles of pages."""

import os
import signal
import subprocess
import sys
import types
import urllib.request
import webbrowser

import pytest
from small_models import cabinet, held_door

import kineverse as kv
from kineverse.view import show, view
from kineverse.view.page import choose_title, read_title
from kineverse.view.viewer import Viewer

pytest.importorskip("viser", reason="the page needs the extra 'view'")

SCRIPT = """
import kineverse as kv

model = kv.Model()
with model.edit() as edit:
    edit.add_frame("lid", parent="world", transform=kv.rotation_x(kv.position("lid")))
page = kv.show(model, {"lid": 0.5}, port=0)
print("went on", page)
"""


@pytest.fixture
def opened(monkeypatch):
    """The addresses that the browser is told to open, on a computer with a screen."""
    addresses = []
    monkeypatch.setattr(webbrowser, "open", addresses.append)
    monkeypatch.setenv("DISPLAY", ":0")
    return addresses


def test_show_in_a_script_waits_until_ctrl_c(monkeypatch, capfd, opened):
    def interrupted(page):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Viewer, "wait", interrupted)
        page = kv.show(cabinet(), {"cabinet/door": 0.5}, port=0)
    assert page.values["cabinet/door"] == 0.5
    out, err = capfd.readouterr()
    assert (out, err) == ("", f"{page.address}   (Ctrl-C ends)\n\n")
    assert opened == [page.address]
    assert "taken down" in repr(page)
    with pytest.raises(
        kv.KineverseError, match=r"There is no page to wait for.*kv\.show\(model\) waits by itself"
    ):
        page.wait()


def test_show_without_block_returns_at_once(capfd, opened):
    with kv.show(cabinet(), port=0, block=False, open_browser=False, degrees=True) as page:
        assert page.settled()
        assert page._display.degrees
        assert capfd.readouterr().err == f"{page.address}   (page.stop() ends)\n"
        assert repr(page) == f"<page of {page.model!r}, {page.address}>"
    assert opened == []


def test_show_at_a_prompt_does_not_wait(monkeypatch, opened):
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    show(cabinet(), port=0).stop()
    assert len(opened) == 1


def test_show_in_a_notebook_returns_the_page_as_the_result_of_the_cell(monkeypatch, capfd, opened):
    shell = types.SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
    with show(cabinet(), port=0) as page:
        assert f'<object style="border:none" data="{page.address}"' in page._repr_mimebundle_()["text/html"]
        assert (capfd.readouterr().err, opened) == ("", [])
    assert "taken down" in page._repr_mimebundle_()["text/html"]


def test_show_without_a_screen_opens_no_browser(monkeypatch, opened):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    show(cabinet(), port=0, block=False).stop()
    assert opened == []


def test_a_real_script_ends_with_ctrl_c(hears_ctrl_c):
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={name: value for name, value in os.environ.items() if name not in hidden},
    ) as script:
        said = script.stderr.readline()
        script.send_signal(signal.SIGINT)
        out, err = script.communicate(timeout=60)
    assert "(Ctrl-C ends)" in said
    assert (script.returncode, err) == (0, "\n")
    assert out.startswith("went on <page of <Model: 1 frame, 1 DoF")


def test_show_refuses_other_objects_and_leaves_no_thread():
    for wrong, words in (
        ("kitchen", r"shows a kineverse\.Model, not 'kitchen'\. Read it first: kv\.load\('kitchen'\)"),
        (None, "not a NoneType"),
        (cabinet().default_state(), "not a State"),
    ):
        with pytest.raises(kv.errors.InvalidValueError, match=words):
            kv.show(wrong, block=False)
    with pytest.raises(kv.errors.UnknownNameError, match="Did you mean 'cabinet/door'"):
        kv.show(cabinet(), {"cabinet/dor": 1.0}, block=False)


def test_show_accepts_partial_and_larger_states(capfd):
    state = cabinet().default_state().updated({"cabinet/door": 0.7})
    with kv.show(cabinet(), state, port=0, block=False, open_browser=False) as page:
        assert page.values["cabinet/door"] == 0.7
    with kv.show(held_door(), state, port=0, block=False, open_browser=False) as page:
        assert page.values == {"bolt": 0.0, "door": 0.0, "lid": 0.0}
    with kv.show(cabinet(), {"cabinet/knob": 1.0}, port=0, block=False, open_browser=False) as page:
        assert page.values == {"cabinet/drawer": 0.0, "cabinet/door": 0.0, "cabinet/knob": 1.0}


def test_a_page_follows_bodies_that_come_and_go():
    model = kv.Model()
    with kv.show(model, port=0, block=False, open_browser=False) as page:
        assert page.settled()
        with model.edit() as edit:
            edit.add_frame("lid", parent="world", transform=kv.rotation_x(kv.position("lid")), tag="lid")
        assert page.settled()
        assert page.values == {"lid": 0.0}
        with model.edit() as edit:
            edit.remove("lid")
        assert page.settled()
        assert page.values == {}
        assert "cannot be shown" not in page._panel._status.content


def test_page_titles_are_names_of_models(tmp_path):
    both = kv.Model()
    both.include("shelf_door")
    both.include("shelf_drawers")
    assert (choose_title(cabinet()), choose_title(both)) == ("cabinet", "shelf_door, shelf_drawers")
    assert (choose_title(kv.Model()), choose_title(held_door())) == ("Kineverse", "Kineverse")
    with view(cabinet(), port=0) as page, urllib.request.urlopen(page.address, timeout=10) as answer:
        assert b"<title>cabinet</title>" in answer.read()
    for name, text, title in (
        ("a.urdf", '<robot name="lamp"><link name="foot"/></robot>', "lamp"),
        ("b.urdf", '<robot name=" "><link name="foot"/></robot>', "b.urdf"),
        ("c.sdf", '<sdf version="1.7"><world name="room"><model name="m"/></world></sdf>', "room"),
        ("d.xml", '<mujoco model="arm"><worldbody/></mujoco>', "arm"),
        ("e.xml", "<mujoco><worldbody/></mujoco>", "e.xml"),
        ("f.urdf", "<robot", "f.urdf"),
        ("g.urdf", f'<robot name="{"x" * 100}"><link name="foot"/></robot>', "x" * 59 + "…"),
    ):
        (tmp_path / name).write_text(text)
        assert read_title(str(tmp_path / name)) == title
    assert read_title("kitchen") == "kitchen"
    assert read_title("articulations/screw") == "screw"
