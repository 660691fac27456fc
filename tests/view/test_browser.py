"""The page in a real Chromium: moving a slider moves the part."""

import re

import browsers
import numpy as np
import pytest
from browsers import PATIENCE, until
from small_models import cabinet, held_door

from kineverse.view import Camera, view
from kineverse.view.drawables import collect_drawables
from kineverse.view.rendering.rasterizer import TriangleSoup

pytest.importorskip("viser", reason="the page needs the extra 'view'")

pytestmark = pytest.mark.browser

SLIDERS = "xpath=//*[@role='tablist']/following::*[@role='slider']"
"""Those of degrees of freedom: in the tabs, not in the folder above them."""


@pytest.fixture(scope="module")
def cabinet_page(browser):
    """A viewer of the cabinet, and the page a browser has of it: drawing the first picture takes seconds."""
    camera = Camera((-2.4, -1.6, 1.3), (0.0, 0.0, 0.5))
    with view(cabinet(), port=0, camera=camera) as viewer:
        page = browser.new_page(viewport={"width": 660, "height": 400})
        page.set_default_timeout(PATIENCE)
        errors = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(viewer.address)
        page.wait_for_selector(SLIDERS)
        # viser's warning of slow computers has a red bar, and slides in over the scene at some time.
        page.add_style_tag(content=".mantine-Notifications-root { display: none }")
        yield viewer, page, errors
        page.close()


@pytest.fixture
def opened(cabinet_page):
    """The viewer and its page at the first state. A test leaves switches as it has found them."""
    viewer, page, errors = cabinet_page
    viewer.move({"cabinet/drawer": 0.0, "cabinet/door": 0.0})
    page.get_by_role("tab", name="Move").click()
    for name in ("cabinet/drawer", "cabinet/door"):
        until(page, lambda name=name: slider(page, viewer, name).get_attribute("aria-valuenow") == "0")
    # The picture is there once the red front of the drawer is.
    until(page, lambda: reddish(shot(page)).sum() > 300)
    yield viewer, page
    assert errors == []


def shot(page):
    """The left of the page, where nothing but the scene is drawn."""
    return browsers.shot(page, 270, 400)


def reddish(image):
    r, g, b = np.moveaxis(image, -1, 0)
    return (r > 1.6 * g) & (r > 1.6 * b)


def row(page, label, end=""):
    """The line of controls with a label, which goes on with its range and ends in some way."""
    return page.get_by_text(re.compile(f"^{re.escape(label)} .* to .*{re.escape(end)}$"))


def slider(page, viewer, name):
    """The thumb of the slider of a degree of freedom; they come in the order of the model."""
    order = list(viewer._panel._sliders)
    return page.locator(SLIDERS).nth(order.index(name))


def test_moving_a_slider_moves_the_part(opened, tmp_path):
    viewer, page = opened
    row(page, "drawer [m]").wait_for()
    before, pose = shot(page), viewer.pose("cabinet/drawer")
    thumb = slider(page, viewer, "cabinet/drawer")
    thumb.focus()
    page.keyboard.press("End")
    until(page, lambda: viewer.values["cabinet/drawer"] == 0.4)
    assert viewer.settled()
    np.testing.assert_allclose(viewer.pose("cabinet/drawer")[:3, 3] - pose[:3, 3], [-0.4, 0, 0], atol=1e-9)
    until(page, lambda: reddish(shot(page)).sum() > 1.5 * reddish(before).sum())
    assert (shot(page) != before).any(axis=2).sum() > 1000
    page.screenshot(path=tmp_path / "moved.png")
    assert (tmp_path / "moved.png").stat().st_size > 10_000
    # And back, by the keyboard and by the button.
    page.keyboard.press("Home")
    until(page, lambda: viewer.values["cabinet/drawer"] == 0.0)
    page.keyboard.press("ArrowRight")
    until(page, lambda: 0.0 < viewer.values["cabinet/drawer"] <= 0.001)
    page.get_by_role("button", name="Reset").click()
    until(page, lambda: viewer.values["cabinet/drawer"] == 0.0)
    until(page, lambda: thumb.get_attribute("aria-valuenow") == "0")


def test_violated_constraints_are_listed_on_the_page(opened):
    viewer, page = opened
    page.get_by_text("All constraints hold.").wait_for()
    thumb = slider(page, viewer, "cabinet/door")
    thumb.focus()
    page.keyboard.press("End")
    until(page, lambda: viewer.values["cabinet/door"] == 1.5)
    page.get_by_text("All constraints hold.").wait_for()
    # Each slider stays inside its own limits; only together they are wrong.
    slider(page, viewer, "cabinet/drawer").focus()
    page.keyboard.press("End")
    page.get_by_text("cabinet/no_clash").wait_for()
    page.get_by_label("beyond limits").check()
    until(page, lambda: thumb.get_attribute("aria-valuemax") == "1.8")
    thumb.focus()
    page.keyboard.press("End")
    page.get_by_text("cabinet/door/range").wait_for()
    assert viewer.values["cabinet/door"] == 1.8
    page.get_by_label("beyond limits").uncheck()


def test_frames_and_their_names_are_shown_on_demand(opened):
    viewer, page = opened
    before = shot(page)
    page.get_by_role("tab", name="Show").click()
    page.get_by_label("frames", exact=True).check()
    until(page, lambda: viewer._scene._axes is not None)
    until(page, lambda: (shot(page) != before).any(axis=2).sum() > 200)
    unnamed = shot(page)
    page.get_by_label("frame names").check()
    until(page, lambda: (shot(page) != unnamed).any(axis=2).sum() > 200)
    page.get_by_label("bodies").uncheck()
    until(page, lambda: reddish(shot(page)).sum() < 0.2 * reddish(before).sum())
    page.get_by_label("bodies").check()
    page.get_by_label("frame names").uncheck()
    page.get_by_label("frames", exact=True).uncheck()


def test_sliders_are_filtered_by_name_and_follow_edits(opened):
    import kineverse as kv

    viewer, page = opened
    page.get_by_role("textbox").first.fill("door")
    row(page, "drawer [m]").wait_for(state="hidden")
    row(page, "door [rad]").wait_for()
    with viewer.model.edit() as edit:
        edit.add_frame("lid", parent="world", transform=kv.translation(0, 0, kv.position("lid")))
    row(page, "lid [m]").wait_for()
    page.get_by_role("textbox").first.fill("")


def test_two_browsers_show_the_same_state(opened, browser):
    viewer, page = opened
    viewer.move({"cabinet/drawer": 0.4})
    other = browser.new_page(viewport={"width": 660, "height": 400})
    other.set_default_timeout(PATIENCE)
    other.goto(viewer.address)
    other.wait_for_selector(SLIDERS)
    until(other, lambda: slider(other, viewer, "cabinet/drawer").get_attribute("aria-valuenow") == "0.4")
    until(page, lambda: slider(page, viewer, "cabinet/drawer").get_attribute("aria-valuenow") == "0.4")
    other.close()


def test_a_slider_range_follows_a_state_dependent_limit(browser):
    """The latch of a door: while its bolt is in, the door's slider goes nowhere; drawn, all the way."""
    with view(held_door(), port=0) as viewer:
        page = browser.new_page(viewport={"width": 660, "height": 400})
        page.set_default_timeout(PATIENCE)
        page.goto(viewer.address)
        page.wait_for_selector(SLIDERS)
        door, bolt = slider(page, viewer, "door"), slider(page, viewer, "bolt")
        until(page, lambda: float(door.get_attribute("aria-valuemax")) < 0.01)
        bolt.focus()
        page.keyboard.press("End")
        until(page, lambda: door.get_attribute("aria-valuemax") == "1.5")
        door.focus()
        page.keyboard.press("End")
        until(page, lambda: viewer.values["door"] == 1.5)
        page.get_by_text("All constraints hold.").wait_for()
        # A lid whose speed is locked until the door is open: its slider is dead, and says so.
        row(page, "lid [rad]").wait_for()
        door.focus()
        page.keyboard.press("Home")
        row(page, "lid [rad]", " · locked").wait_for()
        page.close()


def greenish(image):
    r, g, b = np.moveaxis(image, -1, 0)
    return (g > 1.25 * r) & (g > 1.25 * b)


def test_nearest_pairs_are_shown_and_follow_the_sliders(opened):
    viewer, page = opened
    viewer.move({"cabinet/door": 0.5})
    page.get_by_text("Collisions").click()
    assert not greenish(shot(page)).any()
    page.get_by_label("nearest pairs").check()
    page.get_by_text("1 pair within 0.1 m, none touches").wait_for()
    # A line half as long as the radius is yellow, and one much shorter than it green.
    page.get_by_text("cabinet/drawer – cabinet/door").wait_for()
    viewer.collisions.show_near(0.055)
    until(page, lambda: greenish(shot(page)).sum() > 10)
    # Pulled by hand, the drawer comes right above the door.
    slider(page, viewer, "cabinet/drawer").focus()
    page.keyboard.press("End")
    page.get_by_text("50.0 mm").wait_for()
    viewer.collisions.show_shapes()
    page.get_by_label("nearest pairs").uncheck()
    page.get_by_text("50.0 mm").wait_for(state="detached")
    until(page, lambda: not greenish(shot(page)).any())


def vivid(image):
    return image.max(axis=-1) - image.min(axis=-1) > 100


def corners(viewer, camera):
    """Project the corners of the scene into the picture of a browser, (N, 2) in [-1, 1] if they are in it."""
    poses = {name: viewer.pose(name) for name in viewer.model.frames}
    points = TriangleSoup.from_drawables(collect_drawables(viewer.model), poses).corners.reshape(-1, 3)
    place = Camera(tuple(camera.position), tuple(camera.look_at), field_of_view=camera.fov)
    seen = (points - place.position) @ place.axes.T
    assert (seen[:, 2] > 0).all()
    half = np.tan(camera.fov / 2) * np.array([camera.image_width / camera.image_height, 1.0])
    return seen[:, :2] / seen[:, 2:] / half


@pytest.mark.long
def test_the_camera_frames_the_model_in_any_window_until_it_is_moved(browser):
    with view(cabinet(), port=0) as viewer:
        page = browser.new_page(viewport={"width": 900, "height": 420})
        page.set_default_timeout(PATIENCE)
        page.goto(viewer.address)
        page.wait_for_selector(SLIDERS)
        until(page, lambda: len(viewer._server.get_clients()) == 1)
        (client,) = viewer._server.get_clients().values()
        camera = client.camera
        for size in ((900, 420), (390, 844)):
            page.set_viewport_size({"width": size[0], "height": size[1]})
            # What the client reported last may still be of the window before.
            wide = size[0] > size[1]
            until(page, lambda wide=wide: (camera.image_width > camera.image_height) is wide)
            # As large as it can be, with some room at the edges.
            until(page, lambda: 0.75 < np.abs(corners(viewer, camera)).max() < 0.95)
        canvas, panel = page.locator("canvas[data-engine]"), page.locator(".mantine-Paper-root").first
        # On a phone the panel is a sheet, below the whole model when it is open and when it is folded.
        for folded in (False, True):
            if folded:
                page.get_by_text("cabinet", exact=True).first.click()
            until(page, lambda folded=folded: (canvas.bounding_box()["height"] > 750) is folded)
            until(page, lambda: canvas.bounding_box()["height"] <= panel.bounding_box()["y"] + 1)
            until(page, lambda: 0.75 < np.abs(corners(viewer, camera)).max() < 0.95)
            if not folded:
                # The model is what is seen of the page first: of its red and blue fronts, a tenth of the screen.
                until(page, lambda: vivid(browsers.shot(page, 390, 844)).mean() > 0.1)
        moved, reports = camera.position + 0.3, []
        client.camera.on_update(lambda camera: reports.append(camera.position.copy()))
        camera.position = moved
        # Reports from before the move may still be on their way: the window waits until the browser tells of it.
        until(page, lambda: any(np.abs(position - moved).max() < 1e-3 for position in reports))
        page.set_viewport_size({"width": 900, "height": 420})
        until(page, lambda: camera.image_width > camera.image_height)
        np.testing.assert_allclose(camera.position, moved, atol=1e-3)

        # Names stand on a line of their own, and the client's own numbers at the ends do not.
        door = row(page, "door [rad]")
        assert door.text_content() == "door [rad]   0 to 1.5"
        assert door.bounding_box()["height"] < 25
        assert door.bounding_box()["y"] < slider(page, viewer, "cabinet/door").bounding_box()["y"] - 8
        assert page.locator(".mantine-Slider-markLabel:visible").count() == 0
        page.get_by_label("degrees").check()
        row(page, "door [°]").wait_for()
        assert row(page, "door [°]").text_content() == "door [°]   0 to 85.94"
        assert row(page, "drawer [m]").text_content() == "drawer [m]   0 to 0.4"
        slider(page, viewer, "cabinet/door").focus()
        page.keyboard.press("End")
        until(page, lambda: viewer.values["cabinet/door"] == 1.5)
        page.get_by_text("All constraints hold.").wait_for()
        page.get_by_label("degrees").uncheck()
        until(page, lambda: slider(page, viewer, "cabinet/door").get_attribute("aria-valuenow") == "1.5")
        page.close()


@pytest.mark.long
def test_a_click_and_a_drag_of_the_gizmo_open_the_drawer(browser):
    camera = Camera((-1.6, -2.4, 1.6), (0.0, 0.0, 0.5))
    with view(cabinet(), port=0, camera=camera) as viewer:
        page = browser.new_page(viewport={"width": 900, "height": 420})
        page.set_default_timeout(PATIENCE)
        page.goto(viewer.address)
        page.wait_for_selector(SLIDERS)
        page.add_style_tag(content=".mantine-Notifications-root { display: none }")
        until(page, lambda: reddish(browsers.shot(page, 520, 420)).sum() > 300)
        (client,) = viewer._server.get_clients().values()

        def pixel(point):
            eye = client.camera
            place = Camera(tuple(eye.position), tuple(eye.look_at), field_of_view=eye.fov)
            right, up, ahead = place.axes @ (np.asarray(point) - eye.position)
            scale = eye.image_height / 2 / np.tan(eye.fov / 2) / ahead
            return np.array([eye.image_width / 2 + scale * right, eye.image_height / 2 - scale * up])

        page.mouse.click(*pixel([-0.22, 0.0, 0.7]))
        until(page, lambda: viewer._drag._gizmo is not None)
        assert viewer._drag._grip.frame == "cabinet/drawer"
        # The red arrow points along x, into the cabinet: it is taken near its root, and pulled out.
        origin = viewer._drag._gizmo.position
        begin = pixel(origin)
        along = pixel(np.add(origin, [0.01, 0.0, 0.0])) - begin
        along *= 40 / np.linalg.norm(along)
        page.mouse.move(*(begin + along))
        until(page, lambda: page.evaluate("() => document.querySelectorAll('canvas').length"))
        page.mouse.down()
        for share in np.linspace(0.8, -1.0, 10):
            page.mouse.move(*(begin + share * along))
        until(page, lambda: viewer.values["cabinet/drawer"] > 0.05)
        assert viewer.settled()
        held = viewer._drag._held_pose()[:3, 3]
        np.testing.assert_allclose(held, viewer._drag._wanted[:3, 3], atol=1e-3)
        page.mouse.up()
        until(page, lambda: viewer._drag._holder is None)
        page.close()
