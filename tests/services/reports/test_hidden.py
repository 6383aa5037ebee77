"""The report shows and scores tissue behind tools, depth and a side view of the scene."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from services.reports.figures import NOTHING_THERE, hidden_pictures
from services.reports.html import render_html
from services.reports.schema import DepthErrors, TruthFacts

TRUTH = TruthFacts(
    behind_tools_psnr_db=23.34,
    last_seen_psnr_db=22.27,
    inpainted_psnr_db=22.03,
    frames=22,
    depth=DepthErrors(reconstruction=0.0081, level_plane=0.0451, best_plane=0.0227, frames=23),
    depth_behind_tools=None,
)


@pytest.fixture
def model() -> Model:
    """Return one small red Gaussian in front of a camera of 24x16 px."""
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, 60.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), 1.6),
        logit_opacities=torch.tensor([6.0]),
        sh=torch.tensor([[[1.7, -1.7, -1.7]]]),
    )
    return Model(1, gaussians, None, Camera.from_focal(24.0, 24, 16), (0.0, 1.0))


def pixels(uri):
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def test_side_view_shows_model_and_grey_background(scored, model):
    pictures = hidden_pictures(scored, model)
    aside = pixels(pictures.aside)
    height, width = aside.shape[:2]
    middle, corner = aside[height // 2, width // 2], aside[2, 2]
    assert middle[0] > middle[1] + 60, "what the camera looks at stays in the middle"
    assert np.abs(corner - NOTHING_THERE).max() < 12
    assert (pictures.seq, pictures.time_s) == (1, 0.04)


def test_behind_tools_picture_has_outline_of_tool(scored, model):
    from dataclasses import replace

    mask = np.ones((16, 24), np.uint8)
    mask[4:12, 8:16] = 0
    frame = scored.rendered.frame.with_fields(mask=mask)
    dark = replace(scored.rendered, frame=frame, image=np.full((16, 24, 3), 20, np.uint8))
    drawn = pixels(hidden_pictures(replace(scored, rendered=dark), model).behind).mean(axis=-1)
    zoom = drawn.shape[0] // 16
    centre = lambda row, column: drawn[row * zoom + zoom // 2, column * zoom + zoom // 2]
    assert centre(4, 11) > 180 and centre(7, 11) < 60 and centre(1, 2) < 60
    assert dark.image.max() == 20, "the run's own picture is not drawn into"


def test_hidden_pictures_is_none_for_empty_alpha(scored, model):
    from dataclasses import replace

    empty = replace(scored.rendered, alpha=np.zeros((16, 24), np.float32))
    assert hidden_pictures(replace(scored, rendered=empty), model) is None


def test_hidden_section_shows_figures_with_baselines(report, scored, model):
    quality = report.quality.model_copy(update={"truth": TRUTH})
    page = render_html(report.model_copy(update={"quality": quality}), [], None, hidden_pictures(scored, model))
    section = page[page.index("What the camera does not show") :]
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", section[: section.index("</section>")]))
    assert "Behind tools, PSNR of 22 frames IntraSplat 23.34 dB Each pixel as it was seen last 22.27 dB" in text
    assert "Filled in from around the tool 22.03 dB" in text
    assert (
        "Depth that is seen, RMS error of 23 frames IntraSplat 0.81 % Best level plane 4.51 % Best tilted plane 2.27 %"
        in text
    )
    assert "Depth behind tools" not in text


def test_report_without_truth_and_pictures_has_no_hidden_section(report):
    assert "What the camera does not show" not in render_html(report, [])
