"""A page in a notebook: who reaches it sees it, and all others a picture."""

from __future__ import annotations

import builtins
import io
import re
import sys
import types
import urllib.error
import urllib.request
from base64 import b64decode

import numpy as np
import pytest
from small_models import cabinet, dependent

import kineverse as kv
from kineverse.view import notebook, picture, view

HOSTILE = "<img src=x onerror=alert(1)>\"'&"


@pytest.fixture(autouse=True)
def kernel(monkeypatch):
    """Let this process look like the kernel of a notebook."""
    shell = types.SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))


def pixels_of(bundle):
    image = pytest.importorskip("PIL.Image").open(io.BytesIO(b64decode(bundle["image/png"])))
    return np.asarray(image)


def test_a_display_has_the_page_and_within_it_the_picture():
    with kv.show(cabinet(), {"cabinet/door": 1.0}, port=0) as page:
        bundle = page._repr_mimebundle_()
        found = re.fullmatch(r'<object [^>]*data="([^"]*)"[^>]*>(<img [^>]*>)</object>', bundle["text/html"])
        assert found[1] == page.address
        assert f'src="data:image/png;base64,{bundle["image/png"]}"' in found[2]
        expected = picture(cabinet(), {"cabinet/door": 1.0}, notebook.SIZE)
        assert np.array_equal(pixels_of(bundle), expected)
        assert bundle["text/plain"] == repr(page)
        page.move({"cabinet/door": 0.2})
        assert page._repr_mimebundle_()["image/png"] != bundle["image/png"]
    after = page._repr_mimebundle_()
    assert "<object" not in after["text/html"]
    assert "This page has been taken down." in after["text/html"]
    assert pixels_of(after).shape == expected.shape


def test_the_address_of_a_saved_notebook_leads_to_no_other_page():
    with kv.show(cabinet(), port=0) as page:
        address = page.address
        with urllib.request.urlopen(address, timeout=30) as answer:
            assert answer.status == 200
    port = int(address.split(":")[2].split("/")[0])
    with kv.show(dependent(), port=port) as other:
        assert other.address != address
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address, timeout=30)


def test_without_viser_a_notebook_shows_a_picture(monkeypatch):
    imported = builtins.__import__

    def without_viser(name, *rest):
        if name.partition(".")[0] == "viser":
            raise ImportError(name)
        return imported(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_viser)
    for name in [name for name in sys.modules if name.partition(".")[0] == "viser"]:
        monkeypatch.delitem(sys.modules, name)
    model = cabinet()
    with kv.show(model, {"cabinet/door": 1.0}) as shown:
        bundle = shown._repr_mimebundle_()
        assert "pip install" in bundle["text/html"]
        assert np.array_equal(pixels_of(bundle), picture(model, {"cabinet/door": 1.0}, notebook.SIZE))
        shown.move({"cabinet/door": 0.1, "cabinet/drawer": 0.2})
        assert shown.values == {"cabinet/door": 0.1, "cabinet/drawer": 0.2, "cabinet/knob": 0.0}
        assert shown._repr_mimebundle_()["image/png"] != bundle["image/png"]
        with pytest.raises(kv.errors.UnknownNameError, match="cabinet/door"):
            shown.move({"cabinet/dor": 0.1})
        with model.edit() as edit:
            edit.add_frame(HOSTILE, "world", kv.translation(0, 0, kv.position(HOSTILE)))
        assert HOSTILE not in shown._repr_mimebundle_()["text/html"]
    with pytest.raises(kv.errors.UnknownNameError):
        kv.show(cabinet(), {"cabinet/dor": 1.0})
    monkeypatch.setitem(sys.modules, "IPython", None)
    with pytest.raises(kv.errors.MissingDependencyError):
        view(cabinet())


@pytest.mark.parametrize(
    "body", [kv.model.Body(), kv.model.Body(visuals=(kv.model.Shape(kv.model.Box((1, 1, 1))),))]
)
def test_frames_without_a_finite_pose_are_not_in_the_picture(body):
    model = kv.Model()
    q = kv.position("q")
    with model.edit() as edit:
        edit.add_frame("part", "world", kv.translation(0, 0, 1 / q), body=body)
    with kv.show(model, port=0) as page:
        bundle = page._repr_mimebundle_()
        assert page.address in bundle["text/html"]
        assert np.array_equal(pixels_of(bundle), picture(kv.Model(), size=notebook.SIZE))


def test_an_empty_model_is_shown():
    with kv.show(kv.Model(), port=0) as page:
        assert pixels_of(page._repr_mimebundle_()).shape == (notebook.SIZE[1], notebook.SIZE[0], 3)


@pytest.mark.browser
def test_a_browser_shows_the_page_and_the_picture_once_it_is_gone(browser, tmp_path):
    with kv.show(cabinet(), port=0) as page:
        saved = tmp_path / "saved.html"
        saved.write_text(page._repr_mimebundle_()["text/html"], encoding="utf-8")
        tab = browser.new_page()
        tab.goto(saved.as_uri())
        tab.wait_for_function("document.querySelector('object').getBoundingClientRect().height == 600")
        tab.frames[1].wait_for_selector("canvas", timeout=60_000)
    tab.goto(saved.as_uri())
    tab.wait_for_function("document.querySelector('img').getBoundingClientRect().height > 200")
    tab.close()
