"""Frames over ZeroMQ: real sockets on this machine, keys, senders that go and come."""

from __future__ import annotations

import itertools
import threading
import time

import numpy as np
import pytest
import zmq
import zmq.auth

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import FrameStatus
from operators.errors import SourceUnavailable
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import SourceState
from operators.sources.zeromq import FramePublisher, is_of_this_machine

ALL = SourceOptions(waiting=64)


def image(value, height=4, width=6):
    return np.full((height, width, 3), value, np.uint8)


ARRAYS = {
    "image": image(7),
    "right_image": image(9),
    "depth": np.full((4, 6), 50.5, np.float32),
    "mask": np.ones((4, 6), np.uint8),
    "pose": np.eye(4) * 2,
}


class Sending:
    """A publisher that sends frames all the time, from a thread: a subscriber misses what was sent before it was known."""

    def __init__(self, endpoint, send=None, **options):
        self.publisher = FramePublisher(endpoint, **options)
        self.send = send or (lambda publisher, k: publisher.publish(image(k % 256), pts_ns=k * 20_000_000))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        k = 0
        while not self._stop.wait(0.005):
            self.send(self.publisher, k)
            k += 1

    def close(self):
        self._stop.set()
        self._thread.join()
        self.publisher.close()


@pytest.fixture
def sending():
    made = []

    def begin(*arguments, **options):
        made.append(Sending(*arguments, **options))
        return made[-1]

    yield begin
    for each in made:
        each.close()


def address_of(sender, query=""):
    return f"zmq+{sender.publisher.endpoint}{query}"


@pytest.mark.parametrize("process", [False, True])
def test_zeromq_source_delivers_frames_unchanged(sending, reading, process):
    def send(publisher, k):
        arrays = {name: array for name, array in ARRAYS.items() if name != "image"}
        publisher.publish(image(k % 256), pts_ns=k * 20_000_000, **arrays)

    sender = sending("tcp://127.0.0.1:*", send)
    source = open_source(address_of(sender, "?fps=50"), SourceOptions(waiting=64, process=process))
    about = source.description
    assert (about.width_px, about.height_px, about.fps) == (6, 4, 50)
    assert about.fields == {"right_image", "depth", "mask", "pose"} and "there is no calibration" in about.notes[0]
    stream = reading(source)
    frames = [stream.frame() for _ in range(5)]
    for a, b in itertools.pairwise(frames):
        assert b.pts_ns - a.pts_ns == (b.seq - a.seq) * 20_000_000 and b.seq > a.seq
    for name in ("right_image", "depth", "mask", "pose"):
        np.testing.assert_array_equal(getattr(frames[0], name), ARRAYS[name])
    assert frames[0].status is FrameStatus.LIVE and frames[0].arrived_ns <= time.monotonic_ns()


def test_zeromq_source_reconnects_after_sender_restart(sending, reading, tmp_path):
    endpoint = f"ipc://{tmp_path}/frames"
    first = sending(endpoint)
    stream = reading(open_source(address_of(first), ALL))
    before = stream.frame()
    first.close()
    stream.until(lambda: stream.source.state is SourceState.RECONNECTING)
    assert "is being re-established" in stream.source.state_sentence
    while (last := stream.source.read(0)) is not None:
        before = last
    second = sending(endpoint)
    after = stream.frame()
    assert after.seq > before.seq and after.pts_ns > before.pts_ns and stream.source.state is SourceState.LIVE
    assert stream.source.counts()["reconnections"] == 1
    second.close()


def test_zeromq_slow_reader_gets_newest_frame(sending, reading):
    sender = sending("tcp://127.0.0.1:*")
    stream = reading(open_source(address_of(sender), SourceOptions(waiting=1)))
    first = stream.frame()
    before = stream.source.counts().get("too_late", 0)
    while stream.source.counts().get("too_late", 0) < before + 6:
        time.sleep(0.01)
    assert stream.frame().seq - first.seq > 6


def test_zeromq_source_passes_frames_of_other_size(sending, reading):
    sizes = [(4, 6), (8, 10)]
    sender = sending("tcp://127.0.0.1:*", lambda p, k: p.publish(image(1, *sizes[k // 40 % 2]), pts_ns=k * 10**7))
    stream = reading(open_source(address_of(sender), ALL))
    seen = set()
    while len(seen) < 2:
        seen.add(stream.frame().image.shape[:2])
    assert seen == set(sizes)


def test_zeromq_source_without_sender_raises_source_unavailable(sending):
    with pytest.raises(SourceUnavailable, match=r"no frame came\. Start what sends to it"):
        open_source("zmq+tcp://127.0.0.1:1?open_s=0.2")


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    for name in ("server", "client", "stranger"):
        zmq.auth.create_certificates(folder, name)
    (folder / "allowed").mkdir()
    (folder / "allowed" / "client.key").write_bytes((folder / "client.key").read_bytes())
    return folder


def test_zeromq_encrypted_frames_require_allowed_keys(sending, reading, keys):
    secret, allowed = str(keys / "server.key_secret"), str(keys / "allowed")
    sender = sending("tcp://127.0.0.1:*", certificate=secret, clients=allowed)
    query = f"?server={keys}/server.key&client={keys}/{{}}.key_secret&open_s={{}}"
    stream = reading(open_source(address_of(sender, query.format("client", 10)), ALL))
    assert stream.frame().image.shape == (4, 6, 3)
    for refused in (query.format("stranger", 0.6), "?open_s=0.6", f"?server={keys}/stranger.key&open_s=0.6"):
        with pytest.raises(SourceUnavailable, match="no frame came"):
            open_source(address_of(sender, refused), ALL)


@pytest.mark.parametrize(
    ("endpoint", "here"),
    [
        ("tcp://127.0.0.1:5", True),
        ("tcp://127.9.9.9:5", True),
        ("tcp://localhost:5", True),
        ("tcp://[::1]:5", True),
        ("ipc:///run/x", True),
        ("tcp://10.0.0.1:5", False),
        ("tcp://*:5", False),
        ("tcp://0.0.0.0:5", False),
        ("tcp://localhost.example:5", False),
        ("tcp://127.0.0.1.example:5", False),
        ("tcp://eth0;127.0.0.1:5", False),
        ("tcp://[::]:5", False),
    ],
)
def test_zeromq_endpoint_locality(endpoint, here):
    assert is_of_this_machine(endpoint) is here
    if not here:
        with pytest.raises(InvalidSetting, match="leads to another machine"):
            open_source(f"zmq+{endpoint}")
        with pytest.raises(InvalidSetting, match="leads to another machine"):
            FramePublisher(endpoint)


@pytest.mark.parametrize(
    ("address", "what"),
    [
        ("zmq+tcp://127.0.0.1", "leads to another machine"),
        ("zmq+tcp://127.0.0.1:port", "cannot be used|leads to another"),
        ("zmq+ipc://" + 200 * "x", "cannot be used"),
        ("zmq+tcp://127.0.0.1:5?server=/nowhere", "is no certificate"),
        ("zmq+tcp://127.0.0.1:5?client=/nowhere", "needs server"),
        ("zmq+tcp://127.0.0.1:5?topic=x", "unknown option 'topic'"),
    ],
)
def test_invalid_zeromq_address_is_refused(address, what):
    with pytest.raises(InvalidSetting, match=what):
        open_source(address)


def test_zeromq_refuses_public_key_as_secret_key(keys):
    with pytest.raises(InvalidSetting, match="has no secret key"):
        FramePublisher("tcp://127.0.0.1:*", certificate=str(keys / "server.key"))
    with pytest.raises(InvalidSetting, match="has no secret key"):
        open_source(f"zmq+tcp://127.0.0.1:5?server={keys}/server.key&client={keys}/client.key")
