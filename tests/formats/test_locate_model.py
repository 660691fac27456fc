"""The search for the file of a model by its name, and the errors for models that are not found."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from urdf_texts import pair

import kineverse as kv
from kineverse.formats.locate import Source, locate_model, model_folders


class Places:
    """Empty folders in place of everything that is searched, filled by the tests."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.first, self.second, self.here = root / "first", root / "second", root / "here"
        self.installed = root / "site" / "cmeel.prefix/share/example-robot-data/robots"
        self.fetched = root / "fetched"
        for folder in (self.first, self.second, self.here, self.installed, self.fetched):
            folder.mkdir(parents=True)

    def put(self, folder: Path, *names: str) -> Path:
        """Write a small robot under each name and return the path of the last."""
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(pair())
        return (folder / names[-1]).resolve()


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Places:
    found = Places(tmp_path)
    monkeypatch.setenv("KINEVERSE_MODEL_PATH", f"{found.first}{os.pathsep}{found.second}")
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(found.fetched))
    monkeypatch.setattr("sysconfig.get_paths", lambda: {"purelib": str(tmp_path / "site")})
    monkeypatch.chdir(found.here)
    return found


def miss(name: str | Path) -> str:
    with pytest.raises(kv.errors.UnknownNameError) as info:
        locate_model(name)
    return str(info.value)


# -- what is found ---------------------------------------------------------------------------------------------


def test_a_shipped_model_is_found_under_its_name_whatever_else_is_called_so(places: Places) -> None:
    for folder in (places.here, places.first, places.installed):
        places.put(folder, "kitchen", "kitchen.urdf")
    found = locate_model("kitchen")
    assert found.shipped == "kitchen"
    assert found.path.name == "kitchen.urdf"
    assert places.root not in found.path.parents
    assert kv.load("kitchen").fk("kitchen/fridge_door_handle").shape == (4, 4)
    # A path says what is meant, and brings no prefix.
    assert locate_model("./kitchen.urdf") == Source((places.here / "kitchen.urdf").resolve())
    assert "l1" in kv.load("./kitchen.urdf").frames


def test_every_shipped_model_is_found(places: Places) -> None:
    for name in kv.shipped_models():
        assert locate_model(name).path.is_file()


def test_places_are_searched_in_order(places: Places) -> None:
    """A file in the working directory counts under its full name, then come folders one after the other."""
    in_order = [places.first, places.second, places.installed, places.fetched]
    expected = [places.put(folder, "deep/down/arm.urdf") for folder in in_order]
    for path in expected:
        assert locate_model("arm") == locate_model("arm.urdf") == locate_model("down/arm") == Source(path)
        path.unlink()
    miss("arm")
    local = places.put(places.here, "arm.urdf")
    assert locate_model("arm.urdf") == locate_model(Path("arm.urdf")) == Source(local)
    miss("arm")


def test_folders_are_the_ones_of_the_environment(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [folder for _, folder in model_folders()] == [
        places.first,
        places.second,
        places.installed,
        places.fetched,
    ]
    monkeypatch.setenv("KINEVERSE_MODEL_PATH", "")
    assert [place for place, _ in model_folders()] == ["example-robot-data", "robot_descriptions"]


def test_the_file_closest_to_the_top_counts(places: Places) -> None:
    top = places.put(places.first, "b/c/arm.urdf", "z/arm.urdf")
    assert locate_model("arm").path == top
    assert locate_model("c/arm").path == places.first / "b/c/arm.urdf"


def test_names_are_whole_parts_of_a_path(places: Places) -> None:
    places.put(places.first, "my_robot/left_arm.urdf", ".hidden/arm.urdf", "1/2/3/4/5/6/7/deep.urdf")
    for name in ("arm", "robot/left_arm", "my_robot", "left_arm.ur", "deep"):
        miss(name)
    assert locate_model("my_robot/left_arm").path.name == "left_arm.urdf"


@pytest.mark.parametrize("name", ["arm.urdf", "arm.xml", "arm.sdf", "arm.kv.json"])
def test_suffixes_may_be_left_out(places: Places, name: str) -> None:
    path = places.put(places.first, name)
    assert locate_model("arm").path == path
    assert locate_model(name).path == path


def test_a_path_may_begin_at_home(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(places.here))
    path = places.put(places.here, "robots/arm.urdf")
    assert locate_model("~/robots/arm.urdf").path == path


def test_robots_of_the_installed_package_are_found_by_name() -> None:
    if not any(place == "example-robot-data" for place, _ in model_folders()):
        pytest.skip("no example-robot-data")
    assert kv.load("talos_full_v2", prefix="talos").fk("talos/gripper_left_base_link").shape == (4, 4)


def test_published_data_are_found_by_name(published: Callable[..., Path]) -> None:
    path = published("iai_kitchen/iai_kitchen/urdf_obj/IAI_kitchen.urdf")
    assert locate_model("urdf_obj/IAI_kitchen").path == path.resolve()  # the folder may be a link
    message = miss("IAI_kitchen")
    for folder in ("urdf", "urdf_obj"):
        assert f"'iai_kitchen/iai_kitchen/{folder}/IAI_kitchen.urdf'" in message


# -- what is not -----------------------------------------------------------------------------------------------


def test_a_miss_lists_what_was_searched_and_how_to_get_it(places: Places) -> None:
    message = miss("walrus")
    for place in (
        f"KINEVERSE_MODEL_PATH ({places.first}); KINEVERSE_MODEL_PATH ({places.second})",
        f"example-robot-data ({places.installed})",
        f"robot_descriptions ({places.fetched})",
    ):
        assert place in message
    assert f"Models that ship: {', '.join(kv.shipped_models())}." in message
    assert "Give the path of a file" in message
    assert "pip install" not in message  # everything is there already


def test_a_miss_says_how_to_get_more_robots(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KINEVERSE_MODEL_PATH", f"{places.root / 'gone'}{os.pathsep}{places.first}")
    places.fetched.rmdir()
    places.installed.rmdir()
    message = miss("walrus")
    assert "pip install example-robot-data" in message
    assert "robot_descriptions pull" in message
    assert f"names folders that do not exist: {places.root / 'gone'}." in message
    monkeypatch.delenv("KINEVERSE_MODEL_PATH")
    assert "Searched after the shipped ones: nothing else." in miss("walrus")


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("kitchn", "'kitchen'"),
        ("KITCHEN", "'kitchen'"),
        ("kitchen/", "'kitchen'"),
        ("romeo_smal", "'romeo_small'"),
        ("Romeo_Small", "'romeo_small'"),
        ("small", "'romeo_small'"),
        ("romeo_description", "'romeo_small'"),
        ("rightarm", "'a/right_arm' or 'b/right_arm'"),
        ("right_arm.urd", "'a/right_arm' or 'b/right_arm'"),
    ],
)
def test_a_near_miss_suggests_names_that_work(places: Places, name: str, meant: str) -> None:
    places.put(places.first, "romeo_description/urdf/romeo_small.urdf", "a/right_arm.urdf")
    places.put(places.installed, "b/right_arm.urdf")
    message = miss(name)
    assert "Did you mean " in message
    for one in meant.split(" or "):
        assert one in message
        locate_model(one.strip("'"))


def test_an_ambiguous_name_lists_paths_that_work(places: Places) -> None:
    places.put(places.first, *(f"{letter}/arm.urdf" for letter in "abcdefgh"), "x/y/arm.urdf")
    message = miss("arm")
    assert f"'arm' is ambiguous in {places.first}: 'a/arm.urdf', 'b/arm.urdf'" in message
    assert "'f/arm.urdf' and 2 more" in message
    assert "x/y" not in message
    assert locate_model("b/arm.urdf").path == locate_model("b/arm").path == places.first / "b/arm.urdf"


def test_missing_path_is_an_error(places: Places) -> None:
    places.put(places.here, "robots/arm.urdf", "robots/platform.urdf")
    (places.here / "robots/readme.txt").touch()
    for name in ("./robots/amr.urdf", places.here / "robots/amr.urdf"):
        message = miss(name)
        assert f"There is no file {str(name)!r}. Did you mean 'arm.urdf'" in message
        assert "Searched" not in message  # a path is looked for nowhere else
    assert "Available: arm.urdf, platform.urdf." in miss("./robots/z.kv.json")
    assert f"The folder {str(places.here / 'rowboats')!r} does not exist." in miss(
        places.here / "rowboats/arm.urdf"
    )
    message = miss("robots/amr.urdf")  # this may be a name as well
    assert "Did you mean 'arm.urdf'" in message
    assert "Searched" in message


def test_a_folder_is_no_model_and_its_models_are_named(places: Places) -> None:
    places.put(places.here, "robots/urdf/arm.urdf", "robots/platform.urdf")
    for name in ("robots", "robots/", "./robots", places.here / "robots"):
        assert "It is a folder; models in it: platform.urdf, urdf/arm.urdf." in miss(name)
    assert "It is a folder; models in it: none." in miss(places.first)
    # Even where a folder is called so, the name of a robot is one.
    path = places.put(places.first, "robots.urdf")
    assert locate_model("robots").path == path


def test_the_text_of_a_description_is_not_its_name(places: Places) -> None:
    for text in (pair(), f"  \n{pair()}", '<?xml version="1.0"?><robot/>'):
        assert "parse_urdf" in miss(text)


@pytest.mark.parametrize(
    "name", ["", " ", "*", "..", "a\0b", "a\nb", "~walrus-nobody/x.urdf", "/", "x" * 5000]
)
def test_nonsense_names_are_not_found(places: Places, name: str) -> None:
    assert len(miss(name)) < 2000
    with pytest.raises(kv.errors.UnknownNameError):
        kv.load(name)


def test_unreadable_folders_are_skipped(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "is_file", refuse)
    assert "There is no file" in miss("/secret/arm.urdf")
