"""The output folder is deleted while a replay writes into it: one sentence, no traceback."""

from __future__ import annotations

import shutil

import pytest

from gsplat_core.errors import UserError
from gsplat_core.io.recordings import synthesize
from operators.applications.replay import ReplaySettings, replay
from operators.errors import RunFailed
from services.cli.terminal import user_sentence


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return synthesize(tmp_path_factory.mktemp("take") / "rec", frames=3, width_px=48, height_px=48)


@pytest.mark.parametrize("frame", [1, 3])
@pytest.mark.parametrize("what", ["the folder", "the folder of the run", "the folder around it"])
def test_replay_reports_output_folder_deleted_during_run_without_traceback(recording, tmp_path, caplog, what, frame):
    out = tmp_path / "around" / "out"

    def remove(progress):
        if progress.done == frame:
            run = next(out.glob(".run-*"))
            shutil.rmtree({"the folder": out, "the folder of the run": run, "the folder around it": out.parent}[what])

    with pytest.raises((UserError, RunFailed)) as ended:
        replay(ReplaySettings(recording=recording, out=out, steps_per_frame=1, depth="none"), remove)
    assert str(out) in (user_sentence(ended.value) or "")
    assert not any(record.exc_info for record in caplog.records)
