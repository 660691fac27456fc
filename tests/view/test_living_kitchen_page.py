"""The page of the demo: its thread, and a real Chromium that opens it."""

import socket
import threading

import browsers
import numpy as np
import pytest
from browsers import PATIENCE, until
from living_kitchen.simulation import Simulation

import kineverse as kv

pytest.importorskip("viser", reason="the page needs the extra 'view'")

from living_kitchen.page import SimulationPage


def threads():
    return {thread.name for thread in threading.enumerate()}


def test_a_page_without_browsers_pauses_and_stop_frees_thread_and_port():
    with SimulationPage(port=0) as page:
        assert "kineverse-living" in threads()
        assert page.address.startswith("http://127.0.0.1:")
        page.stop()
        assert page.simulation.time == 0.0
        with pytest.raises(kv.KineverseError, match="There is no page to wait for"):
            page.wait()
    page.stop()
    assert "kineverse-living" not in threads()
    port = int(page.address.rpartition(":")[2])
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", port))  # and the port is free again


def test_a_port_in_use_is_refused_without_a_thread_left():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(kv.errors.InvalidValueError, match=r"port \d+ is taken"):
            SimulationPage(port=other.getsockname()[1])
    assert "kineverse-living" not in threads()


def test_a_failed_step_is_logged_and_the_simulation_continues(monkeypatch, caplog):
    done, moments = threading.Event(), iter([True, False])

    def step(self, dt):
        if next(moments, False):
            raise RuntimeError("stumbled")
        done.set()

    with SimulationPage(port=0) as page:
        monkeypatch.setattr(Simulation, "step", step)
        monkeypatch.setattr(page._server, "get_clients", lambda: {0: None})
        assert done.wait(30.0)
    assert any("could not go on" in record.message for record in caplog.records)


def opened(browser, page, errors):
    """Return a tab that shows a page; what goes wrong on it is noted."""
    tab = browser.new_page(viewport={"width": 640, "height": 300})
    tab.set_default_timeout(PATIENCE)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.goto(page.address)
    tab.get_by_text("the track is off by").wait_for()
    return tab


def shot(tab):
    """The left of the page, where nothing but the scene is drawn."""
    return browsers.shot(tab, 250, 300)


@pytest.mark.long
@pytest.mark.browser
def test_the_browser_shows_the_simulation_and_the_identified_joint(browser, monkeypatch):
    # The mechanism stays, however slowly the page is drawn.
    monkeypatch.setattr("living_kitchen.simulation.MECHANISM_TIME", 3600.0)
    simulation, errors = Simulation(), []
    while simulation.time < 5.5:
        simulation.step(1.0 / 12.0)
    assert simulation.learner.result.is_ambiguous
    with SimulationPage(simulation, port=0) as page:
        # It starts in a pause: a page that takes long to be drawn would miss the beginning.
        page._panel._paused.value = True
        tab = opened(browser, page, errors)
        tab.get_by_text("cannot tell").wait_for()
        before = shot(tab)
        assert np.ptp(before) > 150
        assert simulation.time < 6.0
        tab.get_by_label("pause").uncheck()
        tab.get_by_text("revolute, 9").wait_for()
        tab.get_by_text("the tracked part is off by").wait_for()
        until(tab, lambda: (np.abs(shot(tab) - before).max(axis=2) > 40).sum() > 150)
        # Switches change what is seen.
        tab.get_by_label("50% hidden").check()
        until(tab, lambda: simulation.readings.visible.sum() < 20)
        tab.get_by_role("button", name="Forget, and learn again").click()
        until(tab, lambda: len(simulation.learner.history) < 3)
        tab.close()
    assert errors == []
    assert "kineverse-living" not in threads()


@pytest.mark.long
@pytest.mark.browser
def test_a_second_browser_continues_where_the_first_leaves(browser):
    simulation, errors = Simulation(), []
    with SimulationPage(simulation, port=0) as page:
        tab = opened(browser, page, errors)
        came, left = threading.Event(), threading.Event()
        page._server.on_client_connect(lambda _: came.set())
        page._server.on_client_disconnect(lambda _: left.set())
        # Two that are drawn at once by software may take minutes: the second has only to be there.
        other = browser.new_page(viewport={"width": 640, "height": 300})
        other.goto(page.address, wait_until="commit", timeout=PATIENCE)
        assert came.wait(60.0)
        tab.close()
        assert left.wait(60.0)
        time = simulation.time
        other.get_by_text("the track is off by").wait_for(timeout=PATIENCE)
        until(other, lambda: simulation.time > time)
        other.close()
    assert errors == []
    assert "kineverse-living" not in threads()
