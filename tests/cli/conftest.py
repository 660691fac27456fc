"""Fixtures of the tests of all commands."""

from __future__ import annotations

import pytest

from kineverse.cli import main


@pytest.fixture
def run(capsys):
    """Run the command in this process: status, standard output, standard error."""

    def call(*words):
        status = main([str(word) for word in words])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call
