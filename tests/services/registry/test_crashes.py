"""A process that changes the registry is killed at every step; the old or new state remains, without leftovers."""

import multiprocessing
import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from services.registry.models import ModelRegistry
from services.registry.records import activation_steps
from tests.services.registry import dying
from tests.services.registry.made import add_ready, assert_whole, packed_model
from tests.services.registry.stub_check import ALWAYS_READY

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
COMMITTED = {
    "upload": "upload committed",
    "activate": "activation committed",
    "rollback": "rollback committed",
    "delete": "row deleted",
}
"""Step from which each change has taken effect."""
STEPS = {
    "upload": ["upload staged", "blob stored", "row written", "upload committed"],
    "check": ["model unpacked", "version validated", "check ended"],
    "activate": [
        "model unpacked", "files of the version checked", "earlier version retired", "version marked active",
        "model points to version", "activation committed",
    ],
    "rollback": ["active version retired", "activations taken back", "model unpacked", "rollback committed"],
    "delete": ["unpacked copy deleted", "row deleted", "blob deleted"],
}  # fmt: skip


def prepare(folder, files, action, database_url=None):
    """Make versions 1 and 2 ready and activate 1, or 1 then 2 for a rollback. Version 3 awaits check or deletion."""
    with ModelRegistry(folder, database_url=database_url, check_program=ALWAYS_READY) as registry:
        for seed in (0, 1):
            add_ready(registry, files, seed)
        registry.activate("liver", 1, None, "admin")
        if action == "rollback":
            registry.activate("liver", 2, 1, "admin")
        if action != "upload":
            registry.upload("liver", packed_model(files, 2), None, "surgeon")
        if action == "delete":
            registry.check("liver", 3)
        if action in ("activate", "rollback"):
            for made in (folder / "unpacked").iterdir():
                shutil.rmtree(made)


@pytest.fixture(scope="module")
def run_dying():
    """Run `dying` in forks of a process that has imported it, and return their exit codes."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([dying.__name__])

    def run(*arguments):
        process = context.Process(target=dying.main, args=[str(argument) for argument in arguments])
        process.start()
        process.join(300)
        return process.exitcode

    return run


@pytest.mark.parametrize("action", STEPS)
def test_registry_actions_reach_all_listed_steps(action, tmp_path, files):
    prepare(tmp_path, files, action)
    steps = []
    with ModelRegistry(tmp_path, check_program=ALWAYS_READY, reached=steps.append) as registry:
        dying.ACTIONS[action](registry, packed_model(files, 2))
    assert steps == STEPS[action]


@pytest.mark.parametrize(("action", "step"), [(action, step) for action, steps in STEPS.items() for step in steps])
def test_kill_at_any_step_leaves_old_or_new_state(run_dying, action, step, tmp_path, files, database_url):
    prepare(tmp_path, files, action, database_url)
    assert run_dying(tmp_path, database_url or "", packed_model(files, 2), action, step) == -9
    happened = action in COMMITTED and STEPS[action].index(step) >= STEPS[action].index(COMMITTED[action])

    with ModelRegistry(tmp_path, database_url=database_url, check_program=ALWAYS_READY) as registry:
        recovery = registry.recover()
        assert recovery.damaged == () and recovery.skipped is None
        assert_whole(registry)
        states = {each.version: str(each.state) for each in registry.versions("liver")}
        old, new = {
            "upload": ({1: "active", 2: "ready"}, {1: "active", 2: "ready", 3: "uploaded"}),
            "check": ({1: "active", 2: "ready", 3: "uploaded" if step == "model unpacked" else "validated"}, None),
            "activate": ({1: "active", 2: "ready", 3: "uploaded"}, {1: "retired", 2: "active", 3: "uploaded"}),
            "rollback": ({1: "retired", 2: "active", 3: "uploaded"}, {1: "active", 2: "retired", 3: "uploaded"}),
            "delete": ({1: "active", 2: "ready", 3: "ready"}, {1: "active", 2: "ready"}),
        }[action]
        assert states == (new if happened else old)
        # And it goes on: what was lost can be done again.
        if not happened:
            dying.ACTIONS[action](registry, packed_model(files, 2))
            assert_whole(registry)


def test_random_kills_during_activations_lose_no_confirmed_change(tmp_path, files):
    prepare(tmp_path, files, "activate")
    dice = random.Random(0)
    with ModelRegistry(tmp_path, check_program=ALWAYS_READY) as reader:
        for _ in range(6):
            before = activations(reader)
            swapping = subprocess.Popen(
                [sys.executable, dying.__file__, tmp_path, "", "-", "swap"],
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(ROOT)]))}, stdout=subprocess.PIPE,
            )  # fmt: skip
            with swapping:
                said = len(swapping.stdout.read(1))
                until = time.monotonic() + dice.uniform(0, 0.2)
                while time.monotonic() < until:
                    assert reader.active("liver").version in (1, 2)
                swapping.kill()
                said += len(swapping.stdout.read())
            # What was said is on the disk; at most one swap more was made before it could be said.
            assert said > 0 and activations(reader) - before in (said, said + 1)
            assert_whole(reader)


def activations(registry):
    with registry._database.reading() as connection:
        return len(activation_steps(connection, "liver"))
