from __future__ import annotations

import json

import zmq

from services.bus.messages import Heartbeats, subscribe


def test_heartbeats_send_first_changed_and_last_state(runtime):
    endpoint = runtime.stream("a").status("capture")
    said = {"state": "starting"}
    with zmq.Context() as context, subscribe(context.socket(zmq.SUB), endpoint, waiting=100) as socket:
        heartbeats = Heartbeats(endpoint, lambda: dict(said))
        assert json.loads(socket.recv())["state"] == "starting"
        said["state"] = "live"
        heartbeats.say_now()
        while json.loads(socket.recv())["state"] != "live":
            pass
        said["state"] = "ended"
        heartbeats.close()
        while json.loads(socket.recv())["state"] != "ended":
            pass
