"""``kineverse info`` prints the hash of a document."""

import json

import pytest

import kineverse as kv
from kineverse.cli import main


@pytest.mark.parametrize("ending", ["kv.json", "kv.msgpack"])
def test_info_prints_the_hash_of_a_document(ending, tmp_path, capsys):
    path = tmp_path / f"door.{ending}"
    model = kv.load("shelf_door")
    model.save(path)
    assert main(["info", str(path)]) == 0
    assert f"  document, sha256 {kv.formats.document_hash(model)}\n" in capsys.readouterr().out
    assert main(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sha256"] == kv.formats.document_hash(model)


def test_only_documents_have_a_hash(capsys):
    assert main(["info", "shelf_door", "--json"]) == 0
    assert "sha256" not in json.loads(capsys.readouterr().out)
