"""Fixtures of the tests of all commands."""

from functools import partial

import pytest

from kineverse.cli import main
from kineverse.view import picture, pictures

assert picture  # in the face of the package before tests exchange that of the module


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch):
    """Have commands draw small pictures: what is in them does not depend on the size, and is tested elsewhere."""
    monkeypatch.setattr(pictures, "picture", partial(pictures.picture, size=(320, 240)))


@pytest.fixture
def run(capsys):
    """Run the command in this process: status, standard output, standard error."""

    def call(*words):
        status = main([str(word) for word in words])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call
