"""Files and pages that attack the viewer, in a real Chromium."""

from html import escape

import pytest
from browsers import PATIENCE, launched, until

import kineverse as kv
from kineverse.model.body import Body, Box, Mesh, Shape
from kineverse.view import view
from kineverse.view.access_control import AccessControl

pytest.importorskip("viser", reason="the page needs the extra 'view'")

pytestmark = pytest.mark.browser

# Every name there is points to this computer: rebinding, and no way out.
HERE = "--host-resolver-rules=MAP * 127.0.0.1"

IMAGE = """<img src=x onerror="window.owned='{}'">"""
FRAME = """<iframe srcdoc="<script>parent.owned='{}'</script>"></iframe>"""
STYLE = """</style><style>* {{ display: none }}</style><svg onload="window.owned='{}'">"""
TITLE = """</title><script>window.owned='title'</script>"""
LINK = """[![]({}:http://evil.example/leak)](javascript:window.owned=1)"""

URDF = """<robot name="{robot}">
  <link name="{base}"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>
  <link name="{arm}"><visual><geometry><box size="1 1 1"/></geometry></visual></link>
  <joint name="{joint}" type="revolute">
    <parent link="{base}"/><child link="{arm}"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
</robot>
"""


@pytest.fixture(scope="module")
def browser(chromium):
    with launched(chromium, HERE) as browser:
        yield browser


@pytest.fixture
def hostile(tmp_path):
    """A model with hostile names everywhere: of links, joints, meshes, constraints, operations, prefixes."""
    names = {
        "robot": IMAGE.format("robot"),
        "base": FRAME.format("base"),
        "arm": IMAGE.format("arm"),
        "joint": IMAGE.format("joint"),
        "mesh": "package://" + IMAGE.format("mesh") + LINK.format("mesh"),
    }
    path = tmp_path / "hostile.urdf"
    path.write_text(URDF.format(**{key: escape(text) for key, text in names.items()}))
    model = kv.load(path, prefix=STYLE.format("prefix"))
    joint, lost = model.degrees_of_freedom[0], kv.position(IMAGE.format("lost"))
    with model.edit() as edit:
        edit.constrain(IMAGE.format("limit"), 1, joint, 2)
        edit.constrain(FRAME.format("free"), 0, kv.position(FRAME.format("free")), 1)
        cube = (Shape(Box((0.1, 0.1, 0.1))),)
        gone = (Shape(Mesh(IMAGE.format("gone") + ".stl", folder=str(tmp_path))),)
        edit.add_frame(IMAGE.format("post"), "world", kv.translation(2, 0, 0), Body(cube, cube))
        edit.add_frame(FRAME.format("post"), "world", kv.translation(2.15, 0, joint), Body(cube, cube))
        edit.add_frame(IMAGE.format("gone"), "world", kv.translation(3, 0, joint), Body((), gone))
        edit.add_frame(IMAGE.format("hook"), "world", kv.translation(1 / lost, 0, 0), Body(cube, cube))
    return model, lost


def inside(page):
    """The text of the page, whether it is seen or not."""
    return page.evaluate("() => document.body.textContent")


def test_html_in_names_is_shown_as_text(browser, hostile):
    model, lost = hostile
    # Without the policy that comes with the page: escaping has to be enough.
    context = browser.new_context(bypass_csp=True, viewport={"width": 560, "height": 300})
    with view(model, {lost: 1.0}, port=0, label=TITLE) as viewer:
        requests, page = [], context.new_page()
        page.set_default_timeout(PATIENCE)
        page.on("request", lambda request: requests.append(request.url))
        page.goto(viewer.address)
        page.get_by_role("tab", name="Move").wait_for()
        # The title, groups, joints and a constraint that is violated.
        assert page.title() == TITLE
        viewer.move({model.degrees_of_freedom[0]: 0.0})
        for text in (
            """<svg onload="window.owned='prefix'">""",
            IMAGE.format("joint"),
            IMAGE.format("limit"),
        ):
            until(page, lambda text=text: text in inside(page))
        # Hints appear over what they are about.
        page.get_by_text(IMAGE.format("joint")).first.hover()
        # What is near, what is left out, and why.
        viewer.collisions.show_near(0.2, ignored=True)
        assert viewer.settled(30.0)
        until(page, lambda: IMAGE.format("post") in inside(page) and IMAGE.format("gone") in inside(page))
        # Meshes that are missing, and the names of frames.
        page.get_by_role("tab", name="Show").click()
        page.get_by_text("could not be loaded").wait_for()
        assert "mesh:http://evil.example" in inside(page)
        viewer._scene.show_frames(True, True)
        # Why a state cannot be shown.
        viewer.move({lost: 0.0})
        until(page, lambda: f"Not finite, and hidden: {IMAGE.format('hook')}" in inside(page))
        # Two frames are drawn for whatever would have run to have run.
        until(page, lambda: viewer.settled())
        assert page.evaluate("() => window.owned") is None
        assert page.locator("iframe, img[src='x'], svg[onload]").count() == 0
        assert page.locator("a[href^='javascript']").count() == 0
        assert {url.partition(":")[0] for url in requests if not url.startswith(viewer.address)} <= {
            "data",
            "blob",
        }
    context.close()


def test_only_the_own_page_of_a_browser_reaches_the_viewer(browser, monkeypatch):
    monkeypatch.setattr(
        AccessControl, "from_host", staticmethod(lambda host, **_: AccessControl(host, "s3cret"))
    )
    attempt = """([address, protocol]) => new Promise(done => {
      const socket = new WebSocket(address, protocol)
      socket.onmessage = () => done('read')
      socket.onerror = () => done('refused')
    })"""
    fetched = "address => fetch(address).then(answer => answer.status, () => 'refused')"
    import viser

    protocol = f"viser-v{viser.__version__}"
    with view(kv.Model(), port=0) as viewer:
        own = viewer.address
        page = browser.new_page(viewport={"width": 560, "height": 300})
        page.set_default_timeout(PATIENCE)
        errors = []
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(own)
        page.get_by_role("tab", name="Move").wait_for()
        # The address that the page puts into the bar has to work as well.
        page.reload()
        page.get_by_role("tab", name="Move").wait_for()
        assert errors == []
        # It connects to nothing else, whatever runs in it.
        assert page.evaluate(attempt, [own.replace("http", "ws"), protocol]) == "read"
        assert page.evaluate(attempt, ["ws://evil.example/", protocol]) == "refused"
        assert page.evaluate(fetched, "http://evil.example/") == "refused"
        assert all("Content Security Policy" in text for text in errors)
        page.close()

        port, other = own.split(":")[2].split("/")[0], browser.new_page()
        other.route(
            "http://evil.example/**",
            lambda route: route.fulfill(body="<p>evil</p>", content_type="text/html"),
        )
        other.goto("http://evil.example/")
        for address in (own, f"http://localhost:{port}/s3cret", f"http://rebound.example:{port}/s3cret"):
            assert other.evaluate(attempt, [address.replace("http", "ws"), protocol]) == "refused"
            assert other.evaluate(fetched, address) == "refused"
        # A name of the attacker that points to this computer now, and an address without the token.
        for address in (
            f"http://rebound.example:{port}/s3cret",
            f"http://127.0.0.1:{port}/",
            f"{own}?playbackPath=x",
        ):
            assert other.goto(address).status == 403
        other.close()
