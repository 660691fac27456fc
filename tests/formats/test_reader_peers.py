"""Files that pinocchio and MuJoCo read are read: a short run of ``tools/fuzz/peers.py``."""

from itertools import islice
from random import Random

import pytest

pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")


from fuzz.inputs import inputs
from fuzz.peers import find_peer, quiet, unexcused_error
from fuzz.targets import TARGETS
from fuzz.worker import make_input_folder


@pytest.mark.parametrize(("name", "tried", "read"), [("urdf", 200, 50), ("mjcf", 30, 1)])
def test_files_that_other_parsers_read_are_refused_for_six_reasons_only(tmp_path, name, tried, read):
    target, folder = TARGETS[name], make_input_folder(tmp_path)
    with quiet():
        given = [
            data
            for data in islice(inputs(target, target.own_seeds(), Random(7)), tried)
            if find_peer(name, data)
        ]
    assert len(given) >= read
    refused = [(text, data) for data in given if (text := unexcused_error(target, data, folder))]
    assert refused == []


@pytest.mark.parametrize(
    ("text", "by"),
    [
        ('<robot name="r"><link name="l"/></robot>', "pinocchio"),
        ("<robot><link name='l'/></robot>", "MuJoCo"),
        ("<robot name='r'><link name='l'/><link/></robot>", ""),
        ('<robot name="r"><link name="l"><visual><origin xyz="nan 0 0"/></visual></link>', ""),
    ],
)
def test_parsers_that_read_each_file_are_recorded(text, by):
    with quiet():
        assert find_peer("urdf", text.encode()) == by


def test_refusal_without_a_known_reason_is_detected(tmp_path):
    target = TARGETS["urdf"]
    assert "has the name of the link" in unexcused_error(
        target, b'<robot name="r"><link name="l"/><link name="l"/></robot>', tmp_path
    )
    for excused in (b"<robot name='r'/>", b"<robot", b"<!DOCTYPE robot><robot/>"):
        assert unexcused_error(target, excused, tmp_path) == ""
