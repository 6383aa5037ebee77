"""One video for each output of the renderer."""

from __future__ import annotations

import dataclasses

import av
import numpy as np

from operators.outcome import OutcomeBuilder
from operators.sinks.video import OutputVideosOp


def test_output_videos_sink_writes_one_video_per_output(tmp_path, rendered, compute):
    sink = OutputVideosOp(None, folder=tmp_path, outputs=("depth", "normals", "image"), fps=10.0)
    for seq in range(3):
        shown = rendered(seq)
        height, width = shown.depth.shape
        normals = np.broadcast_to(np.array([0, 0, -1], np.float32), (height, width, 3))
        message = dataclasses.replace(shown, outputs={"normals": normals})
        compute(sink, rendered=message)
    sink.stop()
    for name in ("depth", "normals", "image"):
        with av.open(str(tmp_path / f"{name}.mp4")) as video:
            frames = [each.to_ndarray(format="rgb24") for each in video.decode(video=0)]
        assert len(frames) == 3 and frames[0].shape == (height, width, 3)
        if name == "normals":
            assert abs(int(np.median(frames[0][shown.alpha > 0.9][:, 2])) - 255) < 12
    outcome = OutcomeBuilder()
    sink.contribute(outcome)
    assert dict(outcome.outputs) == {
        f"video_{name}": tmp_path / f"{name}.mp4" for name in ("depth", "normals", "image")
    }
