"""Units of systemd in ``deploy``: systemd reads them, and what they start serves, relays and backs up."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

pytest.importorskip("zenoh")
pytest.importorskip("cryptography")
pytest.importorskip("resource")  # there are no units elsewhere

from faults.costs import write_on_paper
from faults.edge import HOST, find_port
from figures.pages import DOCS, find_blocks

import kineverse as kv
from kineverse.cli.command_line import make_parser
from kineverse.exchange.keys import make_keys
from kineverse.exchange.store import Store

UNITS = Path(__file__).parents[2] / "deploy" / "systemd"
SERVICES = sorted(UNITS.rglob("*.service"))
PROGRAM = re.compile(r"(?:/opt|%h)/kineverse/bin/kineverse")
NAME = "home"


def read(unit: Path, key: str) -> list[str]:
    """Return what a unit has for a key, of the instance ``NAME``."""
    found = re.findall(rf"^{key}=(.*)$", unit.read_text("utf-8"), re.MULTILINE)
    return [one.replace("%i", NAME).replace("%%", "%").replace("$$", "$") for one in found]


def names(path: Path) -> str:
    return path.relative_to(UNITS).as_posix()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
@pytest.mark.parametrize("unit", sorted(UNITS.rglob("*.*")), ids=names)
def test_systemd_takes_the_units(unit: Path, tmp_path: Path) -> None:
    for one in unit.parent.glob("*.*"):  # a timer needs its service
        text = PROGRAM.sub(sys.executable, one.read_text("utf-8"))
        (tmp_path / one.name.replace("@", f"@{NAME}")).write_text(text, "utf-8")
    whose = ["--user"] if unit.parent.name == "user" else []
    command = ["systemd-analyze", *whose, "verify", str(tmp_path / unit.name.replace("@", f"@{NAME}"))]
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    said = done.stdout + done.stderr  # also about units of this computer
    assert (done.returncode, "@" in said) == (0, False), said


@pytest.mark.parametrize("unit", SERVICES, ids=names)
def test_the_commands_of_services_parse(unit: Path) -> None:
    (command,) = read(unit, "ExecStart")
    words = shlex.split(PROGRAM.split(command)[1].replace("'", ""))
    arguments = make_parser(words[0]).parse_args(words)
    assert NAME in (getattr(arguments, "name", ""), str(getattr(arguments, "server", "")).rpartition("/")[2])


class Computer:
    """Folders of this computer, in another place, and services that run as their units say."""

    def __init__(self, root: Path) -> None:
        self.root, self.running = root, list[subprocess.Popen[str]]()
        self.program = root / "kineverse"
        self.program.write_text(f'#!/bin/sh\nexec {sys.executable} -m kineverse "$@"\n', "utf-8")
        self.program.chmod(0o700)

    def start(self, service: str, port: int = 0, server: int = 0) -> subprocess.Popen[str]:
        unit = UNITS / f"{service}@.service"
        environment = dict(os.environ)
        for line in read(unit, "Environment"):
            environment |= dict(word.split("=", 1) for word in shlex.split(self._move(line)))
        environment["SERVER"] = f"{HOST}:{server}"
        for kind in ("Runtime", "State", "Cache"):
            for folder in read(unit, f"{kind}Directory"):
                (self.root / kind / folder).mkdir(0o700, parents=True, exist_ok=True)
        (command,) = read(unit, "ExecStart")
        command = PROGRAM.sub(str(self.program), self._move(command)).replace(
            "0.0.0.0:7410", f"{HOST}:{port}"
        )
        words = [word.replace("${SERVER}", environment["SERVER"]) for word in shlex.split(command)]
        self.running.append(
            subprocess.Popen(
                words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            )
        )
        return self.running[-1]

    def _move(self, text: str) -> str:
        for kind, place in (("Runtime", "/run"), ("State", "/var/lib"), ("Cache", "/var/cache")):
            text = text.replace(f"{place}/", f"{self.root / kind}/")
        return text


@pytest.fixture
def computer(sockets: Path) -> Iterator[Computer]:
    computer = Computer(sockets)
    yield computer
    for process in computer.running:
        with process:
            process.kill()


@pytest.mark.skipif(
    not Path("/bin/sh").exists() or not Path("/usr/bin/find").exists(), reason="needs a shell"
)
def test_services_serve_relay_and_back_up(computer: Computer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keys are copied to where the page says; a client at a site edits, and the backup has it."""
    keys, state = computer.root / "keys", computer.root / "State"
    make_keys(keys, server=[HOST], user=["alice"], relay={"site": [HOST]})
    rights = keys / "server" / "rights.toml"
    rights.write_text(rights.read_text("utf-8").replace('"see"', '"edit"'), "utf-8")
    shutil.copytree(keys / "server", state / "kineverse" / NAME / "keys")
    shutil.copytree(keys / "relays" / "site", state / "kineverse-relay" / NAME / "keys")
    port, relay_port = find_port(), find_port()
    server = computer.start("kineverse", port)
    wait_for(server, "  live:tls/")
    relay = computer.start("kineverse-relay", relay_port, port)
    wait_for(relay, "connected")
    monkeypatch.setenv("KINEVERSE_KEYS", str(keys / "users" / "alice"))
    with closing(kv.load(f"live:tls/{HOST}:{relay_port}/{NAME}")) as model, model.edit() as edit:
        edit.add_frame("shelf", "world")
    backup = computer.start("kineverse-backup")
    assert backup.wait(30) == 0, backup.communicate()
    (copy,) = (state / "kineverse-backups" / NAME).glob("*.db")
    with closing(Store(copy)) as store:
        assert store.revision == 1
    for process in (relay, server):
        process.send_signal(signal.SIGTERM)  # as systemd does
        assert process.wait(10) == 0


def wait_for(process: subprocess.Popen[str], beginning: str) -> None:
    assert process.stdout is not None
    told = []
    for line in process.stdout:
        told.append(line)
        if line.startswith(beginning):
            return
    pytest.fail("".join(told))


def test_the_table_on_paper_follows_from_the_costs() -> None:
    blocks = {block.name: block.tables[0] for block in find_blocks(DOCS / "deployment.md")}
    assert write_on_paper(blocks["costs"].rows) == [*blocks["on-paper"].rows]
