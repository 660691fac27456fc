"""The learner of a live system: it edits the served model, waits for a server that is away, and answers."""

from __future__ import annotations

import time

import pytest
from watched_kitchenette import DOOR, HINGE, SHELF, Camera, make_served, make_truth

pytest.importorskip("zenoh")

import kineverse as kv
from kineverse.errors import KineverseError
from kineverse.live import LearnerProcess
from kineverse.live.streams import CAMERA, LEARNER, CameraNote, LearnerNote, ask, encode, read_note

NAME = "learned-kitchenette"


class Live:
    """Learner of a served model, and a camera whose pictures it is given one by one."""

    def __init__(self, name, truth, **options):
        self.name, self.model = name, kv.load(f"live:{name}")
        self.learner = LearnerProcess(self.model, **options)
        self.source = self.model.exchange.publisher(CAMERA, ())
        self.reader = self.model.exchange.reader()
        self.camera, self.number, self.time = Camera(truth), 0, 0.0

    def show(self, poses):
        """Publish a picture, and have the learner take it."""
        self.number += 1
        note = encode(CameraNote.make(self.number, poses))

        def is_taken():  # what comes before somebody listens is lost
            self.source.put((), self.camera.time, note)
            self.reader.wait(0.005)
            return self.learner.take()

        self._wait(is_taken)

    def look(self, seconds, door=lambda t: 0.0):
        """Show pictures for a time of the camera [s]."""
        for k in range(round(seconds * 15)):
            self.show(self.camera.look(door(k / 15)))

    def note(self, condition, seconds=60.0):
        """Return what the learner thinks, once a condition holds."""

        def is_told():
            self.learner.tell()
            self.reader.wait(0.02)
            note = read_note(self.reader, LEARNER, LearnerNote)
            return note if note is not None and condition(note) else None

        return self._wait(is_told, seconds)

    @staticmethod
    def _wait(result, seconds=60.0):
        end = time.monotonic() + seconds
        while not (found := result()):
            assert time.monotonic() < end, "it takes too long"
            time.sleep(0.002)
        return found

    def close(self):
        """End the processes of the live system, but for the server."""
        self.learner.close()
        self.source.close()
        self.model.close()


def swing(t):
    """Return the angle of a door that opens from 1.5 s on [rad]."""
    return min(1.0, max(0.0, 0.5 * (t - 1.5)))


def test_a_learner_edits_the_served_model_while_others_edit_it_too():
    with kv.exchange.serve(make_served("joint"), name=NAME):
        live, other = Live(NAME, make_truth()), kv.load(f"live:{NAME}")
        try:
            assert live.note(lambda n: n.problem).problem == "There is no camera: no picture has come in."
            with pytest.raises(KineverseError, match="Nothing is proposed"):
                ask(live.reader, LEARNER, "accept", tag=HINGE)
            for k in range(28):  # in between, somebody else adds something with each few pictures
                live.look(0.2, lambda t, k=k: swing(t + 0.2 * k))
                with other.edit() as edit:
                    edit.add_frame(f"room/cup_{k}", SHELF)
            note = live.note(lambda n: n.edits)
            assert "revolute" in note.last
            (coordinate,) = live.model.fk(DOOR).symbols
            assert str(coordinate) == DOOR
            assert other.wait(live.model.version, 10.0)
            assert "room/cup_27" in live.model.frames
            assert other.fk(DOOR).symbols == (coordinate,)
        finally:
            live.close()
            other.close()


def test_edits_wait_for_a_server_that_is_away(tmp_path):
    server = kv.exchange.serve(make_served("joint"), name=NAME, store=tmp_path / "room.kv")
    live = Live(NAME, make_truth())
    try:
        live.look(2.0)
        server.close()
        live.look(3.6, lambda t: swing(t + 1.5))
        note = live.note(lambda n: n.proposals and n.proposals[0].waits)
        assert note.proposals[0].waits == "the model server is away"
        assert note.edits == 0
        assert not live.model.fk(DOOR).symbols
        server = kv.exchange.serve(name=NAME, store=tmp_path / "room.kv")
        assert live.note(lambda n: n.edits).edits == 1
        assert live.model.fk(DOOR).symbols
    finally:
        live.close()
        server.close()


def test_a_camera_that_sees_nothing_and_one_of_another_version_are_told_of():
    with kv.exchange.serve(make_served("joint"), name=NAME):
        live = Live(NAME, make_truth())
        try:
            live.show({"somewhere/else": live.camera.look()[DOOR]})
            assert live.note(lambda n: n.problem).problem == "The camera sees nothing that the model has."
            live.source.put((), live.camera.time + 1.0, b"gibberish")
            words = live.note(lambda n: not live.learner.take() and "language" in n.problem).problem
            assert words == "The camera speaks another language; is its process of another version?"
            live.camera.time += 2.0
            live.look(0.5)
            live.note(lambda n: not n.problem)
        finally:
            live.close()
