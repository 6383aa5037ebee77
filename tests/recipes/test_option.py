"""A new option of the engine is one field of `operators/settings.py` and one use; every way to give an option accepts it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsplat_core.io.recordings.synthetic.synthesize import synthesize

ROOT = Path(__file__).resolve().parents[2]
DECLARATION = (
    "operators/settings.py",
    '    field: Annotated[str, Option("Deformation field',
    '    example: Annotated[int, Option("Example of an option", unit="frames", ge=0, le=9)] = 0\n',
)
USE = ("gsplat_core/training/config.py", "    gaussians: int = 30_000\n", "    example: int = 0\n")
# An editable installation finds its packages before the path does; here the path comes first.
PROGRAM = """
import json, sys
from importlib.machinery import PathFinder
from pathlib import Path

sys.meta_path.sort(key=lambda finder: finder is not PathFinder)

import services.cli.runs
from operators.applications.replay import ReplaySettings, prepare, replay_graph
from services.cli.app import run
from services.bus.runtime import StreamFolder
from services.settings import StreamSettings
from services.api.replays import ReplayRequest
from services.api.streams import StreamRequest
from services.settings import load_settings
from services.supervisor.engine import live_settings
from services.supervisor.worker import ProcessSpec, specs_of

recording, folder = Path(sys.argv[1]), Path(sys.argv[2])
values = {}


def at_the_operator(settings):
    '''The configuration that the operator of a replay reconstructs with.'''
    settings.out.mkdir(exist_ok=True)
    graph = replay_graph(prepare(settings, []), settings)
    graph.compose()
    graph.reconstruct.start()
    return graph.reconstruct._learner.reconstructor.config.example


def live_at_the_operator(settings):
    return settings.reconstructor_config(1000).example


def replayed(settings, *, as_json):
    values["replay"] = at_the_operator(settings)
    return 0


def shown(settings, *, keep, as_json):
    values["live"] = live_at_the_operator(settings)
    return 0


services.cli.runs.replay_command = replayed
services.cli.runs.live_command = shown
assert run(["replay", str(recording), "--out", str(folder / "a"), "--example", "1"]) == 0
assert run(["live", str(recording), "--example", "2"]) == 0
assert run(["replay", str(recording), "--out", str(folder / "a"), "--example", "10"]) == 2


def of_stream(name, source, device, options):
    spec = specs_of(name, StreamSettings(source=source, device=device, options=options))["engine"]
    path = spec.write(StreamFolder(folder / "stream"))
    return live_at_the_operator(live_settings(ProcessSpec.read(path, "engine").engine, folder / "b", "camera"))


file = folder / "settings.yaml"
file.write_text("streams: {a: {source: 'synthetic:', options: {example: 3}}}")
stream = load_settings(file).streams["a"]
values["yaml"] = of_stream("a", stream.source, "cpu", stream.options)
stream = StreamRequest.model_validate({"name": "a", "source": "synthetic:", "options": {"example": 4}})
values["rest"] = of_stream("a", stream.source, "cpu", stream.options)
wanted = ReplayRequest.model_validate({"recording": "a", "options": {"example": 5}})
stored = json.loads(json.dumps(wanted.options.chosen()))
values["job"] = at_the_operator(ReplaySettings(recording=recording, out=folder / "c", **stored))
values["form"] = ReplayRequest.model_json_schema()["$defs"]["CallerJobOptions"]["properties"]["example"]
values["stream form"] = StreamRequest.model_json_schema()["properties"]["options"]["properties"]["example"]
print(json.dumps(values))
"""


def link(package: str, place: Path, changed: set[str]) -> None:
    """Make a package that is the one of this repository, except for the changed files, which are left out."""
    folders = {str(parent) for name in changed for parent in Path(name).parents}
    for entry in (ROOT / package).iterdir():
        name = f"{package}/{entry.name}"
        (place / package).mkdir(exist_ok=True)
        if name in folders:
            link(name, place, changed)
        elif name not in changed and entry.name != "__pycache__":
            (place / name).symlink_to(entry)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="links packages")
def test_an_option_is_a_field_and_its_use(tmp_path):
    """Adds `reconstruct.example` to a copy of the program, by one line in each of two files."""
    changed = {DECLARATION[0], USE[0]}
    place = tmp_path / "program"
    place.mkdir()
    for package in ("gsplat_core", "operators", "services"):
        link(package, place, changed)
    for name, before, line in (DECLARATION, USE):
        text = (ROOT / name).read_text()
        assert text.count(before) == 1
        (place / name).write_text(text.replace(before, line + before))
    recording = synthesize(tmp_path / "tiny", frames=2, width_px=64, height_px=48, stereo=False)
    (tmp_path / "run").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(recording), str(tmp_path / "run")],
        capture_output=True, text=True, cwd=place, env={**os.environ, "PYTHONPATH": str(place)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    values = json.loads(done.stdout.splitlines()[-1])
    assert [values[name] for name in ("replay", "live", "yaml", "rest", "job")] == [1, 2, 3, 4, 5]
    assert "example is 10; it must be from 0 to 9" in done.stderr
    assert values["form"] == {
        "default": 0, "description": "Example of an option.", "maximum": 9, "minimum": 0, "title": "Example",
        "type": "integer", "x-unit": "frames",
    }  # fmt: skip
    assert values["stream form"]["description"] == "Example of an option." and values["stream form"]["default"] == 0
