"""Warnings of readers are emitted at every load, whether the file is read or cached."""

from __future__ import annotations

import logging

import kineverse as kv
from kineverse.formats.reader_warnings import collect_warnings

TWICE = """<robot name="r"><link name="a"><inertial><mass value="1"/><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link><part_joint/></robot>"""


def test_warnings_are_emitted_at_every_load(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(TWICE)
    heard = []
    for _ in range(2):
        with collect_warnings() as remarks:
            kv.load(path)
        heard.append(remarks)
    assert heard[0] == heard[1]
    assert heard[0]
    assert all(remark.startswith("r.urdf, line ") for remark in heard[0])
    assert any("<part_joint>" in remark for remark in heard[0])


def test_warnings_are_logged_and_collectors_nest(tmp_path, caplog):
    path = tmp_path / "r.urdf"
    path.write_text(TWICE)
    with (
        caplog.at_level(logging.INFO, "kineverse.formats"),
        collect_warnings() as outer,
        collect_warnings() as inner,
    ):
        kv.load(path)
    assert outer == inner == [record.getMessage() for record in caplog.records]
    with collect_warnings() as later:
        pass
    kv.load(path)
    assert later == []
