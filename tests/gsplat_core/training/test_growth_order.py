"""Order of growth and maintenance of a live scene, with parts that note their calls."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsplat_core.scene.cameras import Camera
from gsplat_core.training import upkeep
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.upkeep import REVEALED_SHARE, PostponedGrowth

CAMERA = Camera.from_focal(60.0, 200, 100)
CONFIG = ReconstructorConfig(gaussians=10, max_gaussians=20, preallocate=True, history_s=1.0)


class Parts:
    """Notes calls in order. `revealed_px` is by how far the motion has moved the scene away from an edge."""

    def __init__(self) -> None:
        self.calls: list[Any] = []
        self.revealed_px = 0.0

    def cover(self, *given: Any) -> None:
        self.calls.append("cover")

    def cover_revealed(self) -> None:
        self.calls.append("revealed")

    def has_revealed(self, least_px: float) -> bool:
        return self.revealed_px >= least_px


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> Parts:
    made = Parts()

    class Upkeep:
        def __init__(self, camera: Camera, config: ReconstructorConfig) -> None:
            made.calls.append(("upkeep of", camera))

        def __call__(self, step: Any, seen: Any, last_seen: Any) -> None:
            made.calls.append(("upkeep", last_seen))

        def once(self, step: Any, seen: Any, last_seen: Any) -> None:
            made.calls.append(("once", last_seen))

    class OutOfView:
        last_seen, archive = "last seen", [1, 2, 3]

        def __init__(self, capacity: int, device: Any) -> None:
            made.calls.append(("archive of", capacity))

        def restart(self) -> None:
            made.calls.append("restart")

        def follow(self, step: Any, seen: Any) -> None:
            made.calls.append("archive")

        def unseen_s(self, count: int) -> str:
            return f"unseen {count}"

    monkeypatch.setattr(upkeep, "Upkeep", Upkeep)
    monkeypatch.setattr(upkeep, "OutOfView", OutOfView)
    monkeypatch.setattr(
        upkeep, "fill_new_tissue", lambda step, frame, seen, before, *_: made.calls.append(("fill", before))
    )
    monkeypatch.setattr(upkeep, "has_moved", lambda camera, before, distance: abs(camera.position[0]) > 5)
    return made


def growth_of(parts: Parts, **changed: Any) -> PostponedGrowth:
    made = PostponedGrowth(replace(CONFIG, **changed), torch.device("cpu"), parts)
    made.begin(CAMERA)
    return made


def seen_from(x: float) -> Any:
    pose = np.eye(4)
    pose[0, 3] = -x
    return SimpleNamespace(camera=CAMERA.with_pose(pose))


STEP = SimpleNamespace(distance=lambda camera: 60.0)


def test_growth_finish_runs_archive_upkeep_and_covering(parts: Parts) -> None:
    growth = growth_of(parts)
    assert parts.calls == [("archive of", 20), "restart", ("upkeep of", CAMERA)]
    parts.calls.clear()
    growth.finish(STEP, None, seen_from(0), parts)
    assert parts.calls == ["archive", ("upkeep", "last seen"), "cover", "revealed"]
    parts.calls.clear()
    growth.once(STEP, seen_from(0))
    assert parts.calls == [("once", "last seen")]
    assert growth.archived == 3 and growth.unseen_s(7) == "unseen 7"


def test_growth_skips_archive_without_preallocation_and_upkeep_without_history(parts: Parts) -> None:
    growth = growth_of(parts, preallocate=False)
    growth.finish(STEP, None, seen_from(0), parts)
    assert parts.calls == [("upkeep of", CAMERA), ("upkeep", None), "cover", "revealed"]
    assert growth.archived == 0 and growth.unseen_s(7) is None
    parts.calls.clear()
    growth = growth_of(parts, preallocate=False, history_s=None)
    growth.finish(STEP, None, seen_from(0), parts)
    growth.once(STEP, seen_from(0))
    assert parts.calls == ["cover", "revealed"]


def test_growth_fills_new_tissue_after_camera_motion(parts: Parts) -> None:
    growth = growth_of(parts)
    parts.calls.clear()
    near, far = seen_from(3), seen_from(9)
    for seen in (seen_from(0), near, far, far):
        growth.prepare(STEP, None, seen, parts)
    assert parts.calls == [("fill", CAMERA)]
    growth.begin(seen_from(30).camera)
    parts.calls.clear()
    growth.prepare(STEP, None, seen_from(30), parts)
    assert not parts.calls, "another scene begins with its own camera"
    growth.prepare(STEP, None, seen_from(40), parts)
    assert parts.calls == [("fill", seen_from(30).camera)], "the second frame of a scene can show new tissue"


@pytest.mark.parametrize(("share", "is_covered"), [(0.99, False), (1.0, True)])
def test_growth_covers_revealed_strip_before_first_step(parts: Parts, share: float, is_covered: bool) -> None:
    growth = growth_of(parts)
    parts.calls.clear()
    parts.revealed_px = share * REVEALED_SHARE * 200
    growth.prepare(STEP, None, seen_from(0), parts)
    assert parts.calls == (["cover", "revealed"] if is_covered else [])


def test_upkeep_relaxes_and_renews_after_fixed_numbers_of_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted from the last time, at which steps may already have been many."""
    calls: list[Any] = []
    made = upkeep.Upkeep(CAMERA, CONFIG)

    def relax(step: Any, seen: Any, camera: Any) -> None:
        calls.append(("relax", step.steps))
        made._relaxed_at = step.steps

    def renew(step: Any, seen: Any, observation: Any, last_seen: Any, useless: Any) -> None:
        calls.append(("renew", step.steps, last_seen, useless))
        made._renewed_at = step.steps

    monkeypatch.setattr(made, "_examine", lambda step, observation: "seen")
    monkeypatch.setattr(made, "_relax", relax)
    monkeypatch.setattr(made, "_renew", renew)
    monkeypatch.setattr(made, "_useless", lambda step, seen: "useless")
    every, renewal = upkeep.RELAX_EVERY, upkeep.RENEW_EVERY
    for steps in range(0, 2 * renewal + 1, every // 4):
        made(SimpleNamespace(steps=steps), seen_from(0), "last seen")
    assert [call[1] for call in calls if call[0] == "relax"] == list(range(every, 2 * renewal + 1, every))
    assert [call[1:] for call in calls if call[0] == "renew"] == [
        (steps, "last seen", "useless") for steps in (renewal, 2 * renewal)
    ]
    assert not made._has_moved
    made(SimpleNamespace(steps=2 * renewal), seen_from(1), None)
    made(SimpleNamespace(steps=2 * renewal), seen_from(0), None)
    assert made._has_moved
