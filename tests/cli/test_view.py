"""``kineverse view``: list of models, and options of the page."""

import re

import pytest

URDF = '<robot name="lamp"><link name="foot"/></robot>'


def test_view_without_a_name_lists_all_models(run):
    status, out, err = run("view")
    assert (status, err) == (0, "")
    assert out.startswith("models: fetch, hsr, kitchen, pr2, shelf_door, shelf_drawers\n\nmodel ")
    status, articulations, err = run("view", "articulations")
    assert (status, err) == (0, "")
    assert out.endswith(articulations)
    lines = articulations.splitlines()
    assert sum(line.startswith("articulations/") for line in lines) > 30
    assert any(re.match(r"articulations/folding_door +A cupboard whose door folds", line) for line in lines)
    assert run("view", "articulations/") == (0, articulations, "")


def test_a_picture_needs_a_model(run, tmp_path):
    status, out, err = run("view", "--picture", tmp_path / "a.png")
    assert (status, out) == (2, "")
    assert err == "kineverse: --picture needs a MODEL to draw; 'kineverse view' alone lists them\n"


@pytest.fixture
def shown(monkeypatch):
    """Return the pages shown, with unit and address."""
    viewer = pytest.importorskip("kineverse.view.viewer")
    pytest.importorskip("viser", reason="the page needs the extra 'view'")
    pages = []

    def interrupted(page):
        pages.append((page._display.degrees, page.address))
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer.Viewer, "wait", interrupted)
    return pages


def test_the_page_has_the_name_of_the_robot_in_the_file(run, shown, tmp_path, monkeypatch):
    from kineverse.view import server

    labels = []
    monkeypatch.setattr(
        server,
        "start",
        lambda port, label, host, start=server.start, **options: (
            labels.append(label) or start(port, label, host, **options)
        ),
    )
    (tmp_path / "robot.urdf").write_text(URDF)
    status, out, _ = run("view", tmp_path / "robot.urdf", "--port", "0", "--no-browser", "--degrees")
    assert (status, labels) == (0, ["lamp"])
    ((degrees, address),) = shown
    assert degrees
    assert out.startswith(f"{address}   (Ctrl-C ends)\n")


def test_with_a_host_the_address_has_a_token(run, shown, tmp_path, monkeypatch):
    from kineverse.view.access_control import AccessControl

    # Tests stay on this computer.
    monkeypatch.setattr(
        AccessControl, "from_host", staticmethod(lambda host, **_: AccessControl("127.0.0.1", f"for-{host}"))
    )
    monkeypatch.setattr("kineverse.view.server.find_free_port", lambda host, port: port)
    (tmp_path / "robot.urdf").write_text(URDF)
    status, out, _ = run(
        "view", tmp_path / "robot.urdf", "--port", "0", "--no-browser", "--host", "localhost"
    )
    assert status == 0
    assert re.match(r"http://127\.0\.0\.1:\d+/for-localhost   \(Ctrl-C ends\)\n", out)


def test_a_host_of_another_computer_is_refused(run, tmp_path):
    pytest.importorskip("viser", reason="the page needs the extra 'view'")
    (tmp_path / "robot.urdf").write_text(URDF)
    status, _, err = run("view", tmp_path / "robot.urdf", "--host", "192.0.2.77")
    assert status == 2
    assert "'192.0.2.77' is no address of this computer" in err
