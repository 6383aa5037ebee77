"""Use the service through its Python client: models, streams, snapshots, recordings, replays and keys.

Needs a running service (`intrasplat serve`) and its administrator's key. Makes two models of one colour each, uploads them as versions of one
model, shows it as a stream, and changes what is shown: activate, roll back, stop, start. It exports the model, and a snapshot of a live
reconstruction. It uploads a small recording, replays it as a job, follows its progress and reads its report. Then it rotates an API key, and
reads the audit log and the metrics. It deletes everything it created, except the active version of the model.

Usage: python examples/06_service_life_cycle.py --key-file ~/.local/share/intrasplat/admin.key [--url http://127.0.0.1:8000]
"""

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path

import torch

from gsplat_core import Camera, Gaussians
from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.recordings import synthesize
from gsplat_core.models import Model
from services.client import Client, Refused
from services.registry.bundle_file import pack

MODEL = STREAM = RECORDING = "life-cycle"
SOURCE = "synthetic:?width=64&height=48&frames=4&fps=10"
WITHIN_S = 60.0


def wall(colour: tuple[float, float, float]) -> Model:
    """Return a wall of one colour in front of the camera: 144 static Gaussians."""
    x, y = torch.meshgrid(torch.linspace(-2, 2, 12), torch.linspace(-2, 2, 12), indexing="xy")
    means = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((144,), 4.0)], 1)
    colours = ((torch.tensor(colour) - 0.5) / 0.28209479).expand(144, 1, 3).clone()
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(144, 1)
    gaussians = Gaussians(means, quats, torch.full((144, 3), -1.0), torch.full((144,), 6.0), colours)
    return Model(1, gaussians, None, Camera.from_focal(40.0, 64, 48), (0.0, 1.0))


def uploaded(client: Client, folder: Path, name: str, colour: tuple[float, float, float]) -> int:
    """Save, pack and upload a model, wait for the server's check, and return its version."""
    save_bundle(wall(colour), folder / name)
    pack(folder / name, folder / f"{name}.isplat")
    version = client.upload(MODEL, folder / f"{name}.isplat").version  # sends the file's SHA-256 along
    checked = client.checked(MODEL, version)
    print(f"{name} is {MODEL}/{version}: {checked.state}")
    return version


def wait_until_shown(client: Client, version: int) -> None:
    """Watch the stream until its pictures show a version."""
    end_s = time.monotonic() + WITHIN_S
    while time.monotonic() < end_s:
        if client.stream(STREAM).state == "live":
            for picture in client.pictures(STREAM):
                if picture.header["model_version"] == version:
                    print(
                        f"a picture of version {version}: {len(picture.jpeg)} bytes, {picture.header['age_ms']:.0f} ms old"
                    )
                    return
        time.sleep(0.2)
    raise SystemExit(f"no picture of version {version} within {WITHIN_S:g} s")


def models_change(client: Client, folder: Path) -> None:
    """Upload, activate and roll back versions, and wait until the stream shows them."""
    active = {model.name: model.active for model in client.models()}.get(MODEL)
    red, green = (uploaded(client, folder, *each) for each in (("red", (0.9, 0.1, 0.1)), ("green", (0.1, 0.9, 0.1))))
    client.activate(MODEL, red, expected_current=active)
    client.create_stream(STREAM, SOURCE, show=f"model {MODEL}", device="cpu")
    wait_until_shown(client, red)
    try:
        client.activate(MODEL, green, expected_current=None)  # somebody who does not know that red is active
    except Refused as refused:
        print(f"refused ({refused.status}): {refused.sentence}")
    client.activate(MODEL, green, expected_current=red)
    wait_until_shown(client, green)
    print(f"rolled back to {client.rollback(MODEL).version}")
    wait_until_shown(client, red)
    client.stop_stream(STREAM)
    client.start_stream(STREAM)
    wait_until_shown(client, red)
    client.delete_stream(STREAM)
    client.delete_version(MODEL, green)
    size = client.export_version(MODEL, red, "glb", folder / "red.glb")
    print(f"red.glb: {size} bytes")


def snapshot_is_taken(client: Client, folder: Path) -> None:
    """Take a snapshot of a live stream and export the reconstruction for other programs."""
    client.create_stream(STREAM, SOURCE, show="live", device="cpu")
    end_s = time.monotonic() + WITHIN_S
    while client.stream(STREAM).state != "live" and time.monotonic() < end_s:
        time.sleep(0.2)
    next(client.pictures(STREAM))
    number = client.take_snapshot(STREAM).id
    assert number is not None  # it did not become a model's version
    size = client.export_snapshot(STREAM, number, "ply", folder / "live.ply")
    print(f"live.ply: {size} bytes of snapshot {number}")
    client.delete_snapshot(STREAM, number)
    client.delete_stream(STREAM)


def recording_is_replayed(client: Client, folder: Path) -> None:
    """Upload a recording, replay it as a job, and read the report."""
    synthesize(folder / RECORDING, frames=6, width_px=64, height_px=48, stereo=False)
    archive = shutil.make_archive(str(folder / RECORDING), "zip", folder, RECORDING)
    client.upload_recording(RECORDING, Path(archive))
    print(f"{RECORDING} is {client.checked_recording(RECORDING).state}")
    replay = client.start_replay(RECORDING, {"steps_per_frame": 4, "device": "cpu"})
    while replay.state in ("queued", "running"):
        print(f"replay: {replay.state}, {replay.frames_done} of {replay.frames or '?'} frames")
        time.sleep(0.5)
        replay = client.replay(replay.id)
    print(f"replay: {replay.state}, {replay.frames_done} of {replay.frames} frames")
    client.result(replay.id, "report.json", folder / "report.json")
    displayed = json.loads((folder / "report.json").read_text())["frames"]["displayed"]
    print(f"report.json: {displayed} frames displayed, the newest at {replay.psnr_db:.1f} dB")
    client.delete_replay(replay.id)
    client.delete_recording(RECORDING)


def keys_change(client: Client) -> None:
    """Rotate a key: create a second one of the same name, then revoke the first."""
    old = client.make_key("life-cycle", "viewer")
    new = client.make_key("life-cycle", "viewer")
    client.revoke_key(old.id)
    with Client(client.url, old.key) as gone, Client(client.url, new.key) as caller:
        print(f"the new key sees {len(caller.streams())} streams")
        try:
            gone.streams()
        except Refused as refused:
            print(f"the old key: {refused.status}")
    client.revoke_key(new.id)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--key-file", type=Path, required=True)
    options = parser.parse_args()
    with Client(options.url, options.key_file.read_text()) as client, tempfile.TemporaryDirectory() as folder:
        print(f"IntraSplat {client.about()['version']}")
        models_change(client, Path(folder))
        snapshot_is_taken(client, Path(folder))
        recording_is_replayed(client, Path(folder))
        keys_change(client)
        for entry in client.audit(count=5).entries:
            print(f"audit {entry.seq}: {entry.event} {entry.subject} by {entry.actor}: {entry.outcome}")
        counted = [line for line in client.metrics().splitlines() if line.startswith("intrasplat_upload_bytes_total")]
        print(*counted, sep="\n")


if __name__ == "__main__":
    main()
