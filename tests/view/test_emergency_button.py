"""The emergency stop in a real Chromium: above everything, after a reload, on two pages, and without a server."""

from __future__ import annotations

import threading

import pytest
from browsers import PATIENCE, until
from small_models import cabinet

pytest.importorskip("viser", reason="the page needs the extra 'view'")
pytest.importorskip("zenoh")

import kineverse as kv
from kineverse.live.live_page import LivePage
from kineverse.live.streams import ROBOT, RobotNote, answer_by, encode
from kineverse.view import view

pytestmark = pytest.mark.browser

BUTTON, RELEASE, LINE = (f"#kineverse-stop .{name}" for name in ("stop", "release", "line"))
DOOR = "cabinet/door"


class Robot:
    """Stand-in for a world: it reports, and is stopped."""

    def __init__(self, live):
        self.stopped, self._over = "", threading.Event()
        answer = answer_by({"stop": lambda: self._set("emergency stop"), "release": lambda: self._set("")})
        self._source = live.exchange.publisher(ROBOT, [DOOR], answer=answer)
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def _set(self, stopped):
        self.stopped = stopped

    def _work(self):
        ticks = 0
        while not self._over.wait(0.05):
            ticks += 1
            note = RobotNote("kinematic", 0.04, [], self.stopped, ticks=ticks)
            self._source.put([0.5], note=encode(note))

    def close(self):
        self._over.set()
        self._thread.join()
        self._source.close()


def test_the_robot_is_stopped_from_any_page(browser, sockets):
    def reads(page, text):
        until(page, lambda: page.locator(BUTTON).inner_text() == text)

    def open_page(width, height):
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(PATIENCE)
        page.goto(viewer.address)
        page.locator(BUTTON).wait_for()
        return page

    served = kv.exchange.serve(cabinet(), name="home")
    with served as server, kv.load("live:home") as live, kv.load("live:home") as other:
        robot = Robot(other)
        with view(live, port=0) as viewer, LivePage(viewer, live):
            desk = open_page(700, 500)
            reads(desk, "EMERGENCY STOP")
            desk.get_by_text("nothing is done").wait_for()
            assert desk.get_by_role("tab", name="Move").count() == 0
            server.close()
            desk.locator(BUTTON).click()
            reads(desk, "STOPPED")
            assert robot.stopped
            desk.reload()
            reads(desk, "STOPPED")
            phone = open_page(390, 700)
            reads(phone, "STOPPED")
            phone.locator(RELEASE).click()
            until(phone, lambda: not robot.stopped)
            reads(desk, "EMERGENCY STOP")
            # Nothing lies above the button, whose middle is hit.
            box = phone.locator(BUTTON).bounding_box()
            middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            hit = "([x, y]) => document.elementFromPoint(x, y).className"
            assert phone.evaluate(hit, middle) == "stop"
            phone.close()
        reads(desk, "NO CONNECTION")
        assert "does not reach the robot" in desk.locator(LINE).inner_text()
        desk.close()
        robot.close()
