"""Recordings: what is written is read, and damaged files are refused."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

import kineverse as kv
from cupboards import cupboard, state
from kineverse.errors import FormatError, InvalidValueError, KineverseError, UnknownNameError
from kineverse.worlds import Contact, Observation, Recorder, read_run_recording
from kineverse.worlds.recorder import TOPICS

pytest.importorskip("mcap", reason="recordings need the extra 'recording'")
zstandard = pytest.importorskip("zstandard")

DOOR, X = kv.position("cupboard/door"), kv.position("robot/base/x")
TOUCH = Contact("robot/neck", "cupboard/panel", np.array([1.0, 2, 3]), np.array([1.0, 0, 0]), -1e-4, math.nan)


@dataclass
class Result:
    done: bool = True
    value: float = 1 / 3
    measures: dict = field(default_factory=lambda: {"p99": np.float64(0.1), "worst": math.nan})


def step(model, world: SimpleNamespace, k: int, **more):
    """The k-th step of a session in a world whose door opens by a third of a radian a second."""
    truth = kv.State(state(model, cupboard__door=k * 0.02 / 3), stamp=0.02 * k)
    world.state, world.contacts = truth, lambda: [TOUCH][: k % 2]
    believed = truth.updated({"cupboard/door": k * 0.02 / 3 + 0.01})
    commands = {X.derivative(): 0.1 * math.sin(k)}
    known = {"observation": Observation(0.02 * k, {}), "vectors": {}} | more
    return SimpleNamespace(
        time=0.02 * k, state=believed, commands=commands, phase="pull" if k > 20 else "reach", **known
    )


@pytest.fixture(scope="module")
def model():
    return cupboard()


@pytest.fixture(scope="module")
def run(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run.mcap"
    world = SimpleNamespace()
    with Recorder(path, model, {"robot": "robot", "noise": "3mm"}, world=world) as recorder:
        for k in range(150):
            seen = Observation(0.02 * k - 0.01, {X: 0.5}, {"cupboard": np.eye(4)}, frozenset({"robot/neck"}))
            recorder(
                step(model, world, k, observation=seen, vectors={"p": (np.zeros(3), np.array([0.0, 0, k]))})
            )
        recorder.write_belief(3.0, {"cupboard/other": 1.0}, {"cupboard/panel": np.eye(4)})
        recorder.write_outcome(Result())
    return path


def test_what_is_written_is_read(model, run):
    read = read_run_recording(run)
    assert read.complete
    assert (read.about, read.duration) == ({"robot": "robot", "noise": "3mm"}, 0.02 * 149)
    assert kv.formats.document_hash(read.model) == kv.formats.document_hash(model)
    truths, world = [], SimpleNamespace()
    for k in range(150):
        step(model, world, k)
        truths.append(world.state)
    np.testing.assert_allclose(read.times, [0.02 * k for k in range(150)], atol=1e-9)
    assert set(read.states.symbols) == set(truths[0])
    for symbol in truths[0]:
        np.testing.assert_array_equal(read.states[symbol], [one[symbol] for one in truths])
    np.testing.assert_array_equal(
        read.commands["robot/base/x:velocity"], [0.1 * math.sin(k) for k in range(150)]
    )
    np.testing.assert_allclose(read.beliefs["cupboard/door"][:150] - read.states["cupboard/door"], 0.01)
    assert read.belief_poses.last(3.0).keys() == {"cupboard/panel"}
    assert [list(read.phases.times), read.phases.entries] == [[0.0, 0.42], ("reach", "pull")]
    assert read.phases.last(0.41) == "reach"
    (contact,) = read.contacts.last(0.02 * 149)
    assert (contact.a, contact.b, contact.distance) == ("robot/neck", "cupboard/panel", -1e-4)
    assert math.isnan(contact.force)
    np.testing.assert_array_equal(contact.point, TOUCH.point)
    assert not read.contacts.last(0.0)
    seen = read.observations.last(0.02)
    assert (seen.stamp, seen.joints, seen.touching) == (0.01, {X: 0.5}, frozenset({"robot/neck"}))
    np.testing.assert_array_equal(read.vectors.last(0.2)["p"][1], [0, 0, 10])
    assert read.outcome == {"done": True, "value": 1 / 3, "measures": {"p99": 0.1, "worst": None}}


def test_states_are_linear_between_records(run):
    states = read_run_recording(run).states
    assert states.at(0.03)["cupboard/door"] == pytest.approx(0.01)
    assert states.at(-1)["cupboard/door"] == 0.0
    assert states.at(99)["cupboard/door"] == states["cupboard/door"][-1]
    with pytest.raises(UnknownNameError, match="cupboard/door"):
        states["cupboard/dor"]


def test_a_run_that_was_killed_is_read_up_to_there(model, tmp_path):
    """The file is taken while it is written, and then cut at every part of it."""
    path, killed = tmp_path / "run.mcap", tmp_path / "killed.mcap"
    world = SimpleNamespace()
    recorder = Recorder(path, model, world=world)
    for k in range(120):
        recorder(step(model, world, k))
    data = path.read_bytes()
    recorder.close()
    killed.write_bytes(data)
    read = read_run_recording(killed)
    assert not read.complete
    assert 2.38 - 0.5 <= read.duration < 2.38
    whole, last = read_run_recording(path), 0.0
    for size in range(len(data) // 2, len(data), 997):
        killed.write_bytes(data[:size])
        part = read_run_recording(killed)
        assert not part.complete
        assert last <= part.duration <= 2.38
        last = part.duration
        np.testing.assert_array_equal(part.times, whole.times[: len(part.times)])
    assert last > 1.0
    killed.write_bytes(data[:100])
    with pytest.raises(FormatError, match="cut"):
        read_run_recording(killed)


def test_no_damage_goes_unnoticed_or_breaks_the_reader(run, tmp_path):
    """One changed byte gives the same run or an error of the library."""
    data, path = run.read_bytes(), tmp_path / "damaged.mcap"
    times = read_run_recording(run).times
    reasons: list[str] = []
    for place in np.linspace(8, len(data) - 9, 30).astype(int):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        try:
            np.testing.assert_array_equal(read_run_recording(path).times, times)
        except KineverseError as error:
            reasons.append(str(error))
    assert len(reasons) > 10
    assert all("damaged.mcap" in reason for reason in reasons)


def mcap(path, *messages: tuple[str, object], schema: str = "") -> None:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, content in messages:
            number = writer.register_schema(schema or f"kineverse.{TOPICS[topic][0]}", "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", number)
            text = content if isinstance(content, bytes) else json.dumps(content).encode()
            writer.add_message(channel, 10**9, text, 10**9)
        writer.finish()


@pytest.mark.parametrize(
    ("topic", "content", "says"),
    [
        ("/state", b"{", "/state at 1.000 s: Input data was truncated"),
        ("/state", b"[" * 100_000, "got `array`"),
        ("/outcome", b'{"a": ' + b"[" * 100_000, "recursion"),
        ("/state", b'{"values": {"cupboard/door": NaN}}', "JSON is malformed"),
        ("/state", {"values": [1]}, r"Expected `object`, got `array` - at `\$\.values`"),
        ("/state", {"values": {"cupboard/door": "1"}}, "Expected `float`, got `str`"),
        ("/state", {"values": {"cupboard/door": 10**400}}, "Number out of range"),
        ("/command", {"speeds": {"a:no_such_order": 1.0}}, "no name of a symbol"),
        ("/belief", {"values": {}, "poses": {"wall": [[1, 2], [3, 4]]}}, "Expected `array` of length 4"),
        ("/contacts", {"contacts": [{"a": "x", "b": "y"}]}, "missing required field `point`"),
        ("/contacts", {"contacts": ["x"]}, "Expected `object`, got `str`"),
        (
            "/controller",
            {"vectors": {"p": {"origin": [0, 0, 0], "vector": [0, True, 0]}}},
            "Expected `float`, got `bool`",
        ),
        ("/phase", {"phase": 3}, "Expected `str`, got `int`"),
        ("/model", {"format": "kineverse"}, "/model"),
    ],
)
def test_messages_that_are_wrong_are_refused(model, tmp_path, topic, content, says):
    from kineverse.formats.document.writer import to_json

    path = tmp_path / "wrong.mcap"
    first = [] if topic == "/model" else [("/model", to_json(model).encode())]
    mcap(path, *first, (topic, content))
    with pytest.raises(FormatError, match=says) as error:
        read_run_recording(path)
    assert "wrong.mcap" in str(error.value)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "other.mcap"
    with pytest.raises(FormatError, match="no such file"):
        read_run_recording(path)
    path.write_bytes(b"PK\x03\x04 no recording")
    with pytest.raises(FormatError, match="not an MCAP file"):
        read_run_recording(path)
    mcap(path, ("/model", {"a": 1}), schema="tf2_msgs/TFMessage")
    with pytest.raises(FormatError, match="its topics are /model"):
        read_run_recording(path)


def test_chunks_that_are_larger_than_they_say_are_refused(tmp_path):
    path, packed = tmp_path / "bomb.mcap", zstandard.compress(bytes(1 << 26))
    for states in (100, 1 << 40):
        body = struct.pack("<QQQI", 0, 0, states, 0) + struct.pack("<I", 4) + b"zstd"
        body += struct.pack("<Q", len(packed)) + packed
        path.write_bytes(b"\x89MCAP0\r\n" + b"\x06" + struct.pack("<Q", len(body)) + body)
        with pytest.raises(FormatError, match=r"checksum|at most"):
            read_run_recording(path)


def test_the_recorder_refuses_what_cannot_be_read_again(model, tmp_path):
    with pytest.raises(FormatError, match=r"run\.mcap"):
        Recorder(tmp_path / "run.bag", model)
    with pytest.raises(FormatError, match="cannot be written"):
        Recorder(tmp_path / "no" / "run.mcap", model)
    recorder = Recorder(tmp_path / "run.mcap", model)
    with pytest.raises(InvalidValueError, match="/state"):
        recorder.write_state(math.nan, {})
    with pytest.raises(InvalidValueError, match="NaN"):
        recorder.write_command(0.0, {X: math.nan})
    recorder.close()
    recorder.close()
    with pytest.raises(KineverseError, match="closed"):
        recorder.write_state(0.0, {})
    assert len(read_run_recording(tmp_path / "run.mcap").states) == 0


def test_without_a_known_truth_the_belief_is_recorded_alone(model, tmp_path):
    with Recorder(tmp_path / "run.mcap", model) as recorder:
        for k in range(20):
            recorder(step(model, SimpleNamespace(), k))
    read = read_run_recording(tmp_path / "run.mcap")
    assert (len(read.states), len(read.contacts.times), len(read.beliefs)) == (0, 0, 20)
    assert read.duration == pytest.approx(0.02 * 19)
    np.testing.assert_allclose(read.motion["cupboard/door"], [k * 0.02 / 3 + 0.01 for k in range(20)])


def test_a_full_disk_ends_a_recording_that_can_be_read_up_to_there(model, tmp_path):
    resource, path = pytest.importorskip("resource"), tmp_path / "run.mcap"
    before, recorder = resource.getrlimit(resource.RLIMIT_FSIZE), Recorder(path, model)
    recorder.write_state(0.0, state(model))
    recorder.write_state(1.0, state(model))
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000, before[1]))
    try:
        with pytest.raises(
            FormatError, match=r"run.mcap cannot be written: File too large. .* ends at [1-9]"
        ) as info:
            for k in range(2, 2000):
                recorder.write_state(float(k), state(model))
                recorder.write_vectors(float(k), {"noise": (np.random.default_rng(k).random(3), np.zeros(3))})
        recorder.close()  # does nothing
        with pytest.raises(KineverseError, match="is closed"):
            recorder.write_phase(3000.0, "late")
        with (
            pytest.raises(FormatError, match="cannot be written"),
            Recorder(tmp_path / "b.mcap", model) as other,
        ):
            for k in range(2000):
                other.write_phase(float(k), f"{k}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    found = read_run_recording(path)
    assert not found.complete
    assert found.duration >= float(str(info.value).rpartition("ends at ")[2].partition(" s")[0])
