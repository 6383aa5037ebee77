"""A publisher that detects whether it has readers."""

from __future__ import annotations

import time

import numpy as np
import zmq

from services.bus.messages import WatchedPublisher, picture_from, subscribe, wait_for_readers

IMAGE = np.zeros((2, 3, 3), np.uint8)


def wait_until_watched(publisher: WatchedPublisher, watched: bool) -> None:
    until_s = time.monotonic() + 300
    while publisher.watched is not watched:
        assert time.monotonic() < until_s, f"watched did not become {watched}"
        wait_for_readers([publisher], 0.05)


def test_publisher_is_watched_from_first_to_last_reader(runtime):
    endpoint = runtime.stream("a").endpoint("depth")
    with zmq.Context() as context:
        publisher = WatchedPublisher(endpoint, context)
        assert not publisher.watched
        with subscribe(context.socket(zmq.SUB), endpoint) as one:
            wait_until_watched(publisher, True)
            with subscribe(context.socket(zmq.SUB), endpoint) as other:
                while not other.poll(20):
                    publisher.publish({"seq": 1}, IMAGE)
                assert picture_from(other.recv_multipart(copy=False)).header["seq"] == 1
            assert one.poll(300_000)
            assert publisher.watched
        wait_until_watched(publisher, False)
        publisher.close()


def test_publisher_is_watched_by_reader_that_subscribed_before(runtime):
    endpoint = runtime.stream("a").endpoint("orbit")
    with zmq.Context() as context, subscribe(context.socket(zmq.SUB), endpoint):
        publisher = WatchedPublisher(endpoint, context)
        wait_until_watched(publisher, True)
        publisher.close()
